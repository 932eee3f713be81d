"""Codecs that send samples: the dense cloud, a lattice with a spline, a simplified mesh.

`encode` takes heights (rows, columns) and a setting, `decode` the bytes and which of them are known to be lost.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.interpolate import LinearNDInterpolator, RectBivariateSpline
from scipy.sparse import diags_array, eye_array, kron
from scipy.sparse.linalg import spsolve
from scipy.spatial import KDTree

from common.errors import PacketError
from common.surface import BoolArray, FloatArray, IntArray
from simulator.codecs.message import (
    HEADER,
    Header,
    Ladders,
    Setting,
    deflate,
    inflate,
    pack_bits,
    read_header,
    scaled,
    unpack_bits,
    write_header,
)

LATTICE = struct.Struct("<BB")
"""Samples along the longer side, bits a sample."""

MESH = struct.Struct("<HB")
"""Nodes of a mesh less one, bits a height."""

POINT = struct.Struct("<fff")
"""A point of the cloud: column, row, height."""

BITS = (3, 4, 5, 6, 7, 8, 10, 12)
"""Bits a sample that are tried."""

RIDGE = 1e-9
"""Pull of unknown samples towards the mean, where nothing else determines them."""

STRAYS = 3000
"""Of so many intact samples one may be set aside by the receiver's filter: its threshold is chosen so."""


def interpolated(points: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Linear on the triangles of points (n, 3) in units of nodes, the nearest outside of their hull."""
    at = np.stack(np.meshgrid(np.arange(shape[1]), np.arange(shape[0])), axis=-1).reshape(-1, 2).astype(np.float64)
    grid = points[KDTree(points[:, :2]).query(at)[1], 2]
    if len(points) >= 4 and np.ptp(points[:, 0]) > 0 and np.ptp(points[:, 1]) > 0:
        inner = LinearNDInterpolator(points[:, :2], points[:, 2])(at)
        grid = np.where(np.isfinite(inner), inner, grid)
    return np.asarray(grid.reshape(shape))


# The dense cloud: three float32 a point, in random order, as many as there is room for.


def cloud_ladders(shape: tuple[int, int]) -> Ladders:
    """Numbers of points."""
    steps = np.unique(np.geomspace(4, shape[0] * shape[1], 120).astype(int))
    return (tuple((float(n),) for n in steps),)


def encode_cloud(z: FloatArray, setting: Setting) -> bytes:
    """Nodes in an order that scatters them, as (column, row, height)."""
    chosen = scattered(z.size)[: int(setting[0])]
    rows, columns = np.divmod(chosen, z.shape[1])
    records = np.column_stack([columns, rows, scaled(z).ravel()[chosen]])
    return write_header(z) + records.astype("<f4").tobytes()


def decode_cloud(data: bytes, lost: BoolArray) -> FloatArray:
    """Points that are in no place they could be are dropped."""
    header, body = read_header(data)
    shape = header.shape
    size = len(body) // POINT.size
    end = size * POINT.size
    whole = ~lost[HEADER.size :][:end].reshape(size, POINT.size).any(axis=1)
    limits = np.array([shape[1] - 1, shape[0] - 1, 1.0])
    with np.errstate(invalid="ignore"):  # damage can make a signalling NaN
        records = np.frombuffer(body[:end], dtype="<f4").reshape(size, 3).astype(np.float64)
        points = records[whole & np.all((records >= 0) & (records <= limits), axis=1)]
    if not len(points):
        raise PacketError("no point is left")
    _, first = np.unique(points[:, :2], axis=0, return_index=True)
    return header.heights(interpolated(points[first], shape))


def scattered(n: int) -> IntArray:
    """An order of 0..n-1 that both ends know, in which neighbours are far apart."""
    return np.random.Generator(np.random.PCG64(n)).permutation(n)


# A lattice of samples; a bicubic spline between them.


def lattice_ladders(shape: tuple[int, int]) -> Ladders:
    """For each number of bits the samples along the longer side."""
    sides = range(4, min(255, max(shape)) + 1)
    return tuple(tuple((float(n), float(bits)) for n in sides) for bits in BITS)


def _sides(shape: tuple[int, int], samples: int) -> tuple[int, int]:
    rows, columns = (min(n, max(4, round(samples * n / max(shape)))) for n in shape)
    return rows, columns


def _at(shape: tuple[int, int], sides: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Where the samples lie, in units of nodes: (rows, columns)."""
    return np.linspace(0, shape[0] - 1, sides[0]), np.linspace(0, shape[1] - 1, sides[1])


def _resampled(z: FloatArray, from_at: tuple[FloatArray, FloatArray], at: tuple[FloatArray, FloatArray]) -> FloatArray:
    degrees = [min(3, n - 1) for n in z.shape]
    return np.asarray(RectBivariateSpline(*from_at, z, kx=degrees[0], ky=degrees[1])(*at))


def _nodes(shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    return np.arange(shape[0], dtype=np.float64), np.arange(shape[1], dtype=np.float64)


def _samples(z: FloatArray, setting: Setting) -> tuple[IntArray, bytes]:
    count, bits = (int(v) for v in setting)
    at = _at(z.shape, _sides(z.shape, count))
    heights = np.clip(_resampled(scaled(z), _nodes(z.shape), at), 0, 1)
    return np.rint(heights * (2**bits - 1)).astype(np.int64), write_header(z) + LATTICE.pack(count, bits)


class Lattice(NamedTuple):
    """A header, and the lattice of samples that follows it."""

    header: Header
    sides: tuple[int, int]
    """Rows and columns of samples."""
    bits: int
    """Of a sample."""

    def heights(self, samples: FloatArray) -> FloatArray:
        """The grid on a spline through samples, shape `sides`, in 0..1."""
        shape = self.header.shape
        return self.header.heights(_resampled(samples, _at(shape, self.sides), _nodes(shape)))


def _read_lattice(data: bytes) -> tuple[Lattice, bytes]:
    header, rest = read_header(data)
    if len(rest) < LATTICE.size:
        raise PacketError("the message ends within its header")
    count, bits = LATTICE.unpack_from(rest)
    sides = _sides(header.shape, count)
    if not (1 <= bits <= 16 and min(sides) >= 2):
        raise PacketError(f"a lattice of {sides} samples of {bits} bits cannot be")
    return Lattice(header, sides, bits), rest[LATTICE.size :]


def encode_lattice(z: FloatArray, setting: Setting) -> bytes:
    """Differences to the plane through three neighbours, modulo 2**bits, deflated."""
    samples, header = _samples(z, setting)
    rest = np.diff(np.diff(samples, axis=0, prepend=0), axis=1, prepend=0) % (1 << int(setting[1]))
    return header + deflate(_planes(rest.ravel()))


def decode_lattice(data: bytes, lost: BoolArray) -> FloatArray:  # noqa: ARG001 - a stream cannot use it
    """Sums of the differences, and the spline through them."""
    lattice, rest = _read_lattice(data)
    count = lattice.sides[0] * lattice.sides[1]
    differences = _unplaned(inflate(rest, 2 * count), count).reshape(lattice.sides)
    samples = np.cumsum(np.cumsum(differences, axis=0), axis=1) % (1 << lattice.bits)
    return lattice.heights(samples / (2**lattice.bits - 1))


def _planes(values: IntArray) -> bytes:
    """Integers below 2**16: all low bytes, then all high bytes unless they are zero."""
    high = (values >> 8).astype(np.uint8)
    return (values & 255).astype(np.uint8).tobytes() + (high.tobytes() if np.any(high) else b"")


def _unplaned(data: bytes, count: int) -> IntArray:
    low, high = (np.frombuffer(part, dtype=np.uint8).astype(np.int64) for part in (data[:count], data[count:]))
    return low | high << 8


# The same lattice made to survive: fixed-width samples in scattered order, the header three times, and a receiver
# that sets aside what does not fit its neighbours.


def encode_scattered(z: FloatArray, setting: Setting) -> bytes:
    """Header, half of the samples, header, the other half, header.

    The last byte of the header is the filter's threshold in 255ths of the range.
    """
    samples, header = _samples(z, setting)
    heights = samples / (2 ** int(setting[1]) - 1)
    strays = np.sort(np.abs(heights - _expected(heights)), axis=None)[::-1]
    header += bytes([min(255, int(np.ceil(255 * strays[heights.size // STRAYS])) + 1)])
    body = pack_bits(samples.ravel()[scattered(samples.size)], int(setting[1]))
    half = len(body) // 2
    return header + body[:half] + header + body[half:] + header


def decode_scattered(data: bytes, lost: BoolArray) -> FloatArray:
    """Samples that are lost or stand out are filled from the others, then the spline."""
    size = HEADER.size + LATTICE.size + 1
    half = (len(data) - 3 * size) // 2
    if half < 0:
        raise PacketError(f"a message has at least {3 * size} bytes, got {len(data)}")
    starts = (0, size + half, len(data) - size)
    copies = np.array([np.frombuffer(data[i : i + size], dtype=np.uint8) for i in starts])
    header = _majority(copies, np.array([lost[i : i + size] for i in starts]))
    lattice, rest = _read_lattice(header.tobytes())
    body = data[size : size + half] + data[2 * size + half : -size]
    body_lost = np.concatenate([lost[size : size + half], lost[2 * size + half : -size]])
    bits, count = lattice.bits, lattice.sides[0] * lattice.sides[1]
    if len(body) != -(-count * bits // 8):
        raise PacketError(f"{count} samples of {bits} bits are not {len(body)} bytes")
    order = scattered(count)
    heights = np.empty(count)
    heights[order] = unpack_bits(body, bits, count) / (2**bits - 1)
    missing = np.empty(count, dtype=np.bool_)
    missing[order] = np.repeat(body_lost, 8)[: count * bits].reshape(count, bits).any(axis=1)
    known = np.where(missing, np.nan, heights).reshape(lattice.sides)
    for _ in range(2):  # a second look, free of the worst
        known = np.where(np.abs(known - _expected(known)) > rest[0] / 255, np.nan, known)
    return lattice.heights(_filled(known))


def _majority(copies: npt.NDArray[np.uint8], lost: BoolArray) -> npt.NDArray[np.uint8]:
    """Bit by bit what most of the copies that arrived say; the first of them in a tie."""
    bits, weights = np.unpackbits(copies, axis=1).astype(np.int64), np.repeat(~lost, 8, axis=1).astype(np.int64)
    votes = np.sum((2 * bits - 1) * weights, axis=0)
    first = np.take_along_axis(bits, np.argmax(weights, axis=0)[None, :], axis=0)[0]
    return np.packbits(np.where(votes == 0, first, votes > 0).astype(np.uint8))


def _filled(known: FloatArray) -> FloatArray:
    """Unknown samples of a lattice (NaN) such that the sum of squares of its Laplacian is least: a thin plate's."""
    unknown = ~np.isfinite(known.ravel())
    if unknown.all():
        raise PacketError("no sample is left")
    if not unknown.any():
        return known
    bends: list[Any] = [diags_array([1.0, -2.0, 1.0], offsets=[-1, 0, 1], shape=(n, n)).tolil() for n in known.shape]
    for bend in bends:
        bend[0, 0] = bend[-1, -1] = -1.0
    along_y, along_x = (bend.tocsc() for bend in bends)
    laplacian = (kron(along_y, eye_array(known.shape[1])) + kron(eye_array(known.shape[0]), along_x)).tocsc()
    values = known.ravel()
    mean = float(values[~unknown].mean())
    free, given = laplacian[:, unknown], laplacian[:, ~unknown] @ (values[~unknown] - mean)
    normal = free.T @ free
    normal.setdiag(normal.diagonal() + RIDGE)
    filled = values.copy()
    filled[unknown] = mean + spsolve(normal.tocsc(), -(free.T @ given))
    return filled.reshape(known.shape)


def _expected(known: FloatArray) -> FloatArray:
    """What the neighbours say: the median of eight straight lines through two of them; the sample itself without any.

    Four lines have the sample in their middle and four at their end; unknown neighbours are NaN.
    """
    rows, columns = known.shape
    padded = np.pad(known, 2, constant_values=np.nan)

    def at(i: int, j: int) -> FloatArray:
        return padded[2 + i : 2 + i + rows, 2 + j : 2 + j + columns]

    lines = [(at(i, j) + at(-i, -j)) / 2 for i, j in ((0, 1), (1, 0), (1, 1), (1, -1))]
    lines += [2 * at(i, j) - at(2 * i, 2 * j) for i, j in ((0, 1), (0, -1), (1, 0), (-1, 0))]
    ordered = np.sort(np.stack(lines, axis=-1), axis=-1)  # NaN last
    count = np.count_nonzero(np.isfinite(ordered), axis=-1)[..., None]
    middle = [np.take_along_axis(ordered, np.maximum(i, 0), axis=-1)[..., 0] for i in ((count - 1) // 2, count // 2)]
    return np.where(count[..., 0] > 0, (middle[0] + middle[1]) / 2, known)


# A mesh: nodes inserted greedily where the error is largest; the receiver triangulates them again.


def mesh_ladders(shape: tuple[int, int]) -> Ladders:  # noqa: ARG001 - the same for every shape
    """Greatest errors over the range, and bits a height to match."""
    errors = np.geomspace(0.5, 1e-4, 150)
    return tuple(
        tuple((float(e), float(np.clip(np.ceil(-np.log2(e)) + more, 3, 14))) for e in errors) for more in (0, 1, 2)
    )


def encode_mesh(z: FloatArray, setting: Setting) -> bytes:
    """Nodes of the mesh in raster order: gaps and differences of height, deflated."""
    from pydelatin import Delatin

    error, bits = setting[0], int(setting[1])
    heights = scaled(z)
    mesh = Delatin(np.ascontiguousarray(heights, dtype=np.float32), max_error=error)
    columns, upward = np.rint(np.asarray(mesh.vertices)[:, :2]).astype(np.int64).T
    index = np.unique((z.shape[0] - 1 - upward) * z.shape[1] + columns)
    samples = np.rint(heights.ravel()[index] * (2**bits - 1)).astype(np.int64)
    gaps, steps = np.diff(index, prepend=-1) - 1, np.diff(samples, prepend=0) % (1 << bits)
    body = _gap_bytes(gaps) + _planes(steps)
    return write_header(z) + MESH.pack(len(index) - 1, bits) + deflate(body)


def decode_mesh(data: bytes, lost: BoolArray) -> FloatArray:  # noqa: ARG001 - a stream cannot use it
    """Linear on the Delaunay triangles of the nodes."""
    header, rest = read_header(data)
    shape = header.shape
    if len(rest) < MESH.size:
        raise PacketError("the message ends within its header")
    count, bits = MESH.unpack_from(rest)
    count += 1
    if not 1 <= bits <= 16:
        raise PacketError(f"heights of {bits} bits cannot be")
    body = inflate(rest[MESH.size :], 3 * count + shape[0] * shape[1] // 255)
    gaps, used = _gaps(body, count)
    index = np.cumsum(gaps + 1) - 1
    samples = np.cumsum(_unplaned(body[used : used + 2 * count].ljust(2 * count, b"\0"), count)) % (1 << bits)
    inside = index < shape[0] * shape[1]
    rows, columns = np.divmod(index[inside], shape[1])
    if not len(rows):
        raise PacketError("no node is left")
    points = np.column_stack([columns, rows, samples[inside] / (2**bits - 1)]).astype(np.float64)
    return header.heights(interpolated(points, shape))


def _gap_bytes(gaps: IntArray) -> bytes:
    """Each gap as bytes of 255 and a rest below it."""
    return b"".join(b"\xff" * (gap // 255) + bytes([gap % 255]) for gap in gaps.tolist())


def _gaps(data: bytes, count: int) -> tuple[IntArray, int]:
    """The first `count` gaps, and the bytes they took."""
    values = np.frombuffer(data, dtype=np.uint8).astype(np.int64)
    ends = np.flatnonzero(values != 255)[:count]
    if len(ends) < count:
        raise PacketError(f"{count} gaps are announced, {len(ends)} are there")
    sums = np.cumsum(values)[ends]
    return np.diff(sums, prepend=0), int(ends[-1]) + 1
