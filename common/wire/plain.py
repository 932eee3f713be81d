"""Points as they are: float64, float32, or fixed-width integers over the region, one point after the other.

Everything is done for many packets at once: points come as one array in the order in which they are sent and `sizes`
says how many belong to each packet.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from common.errors import PacketError
from common.surface import FloatArray
from common.wire.gf256 import ByteArray
from common.wire.header import Form, Grid, Header

_FLOATS: dict[Form, np.dtype[np.floating]] = {Form.FLOAT64: np.dtype("<f8"), Form.FLOAT32: np.dtype("<f4")}

UintArray: TypeAlias = npt.NDArray[np.uint64]


def point_bits(header: Header) -> int:
    """Bits of one point."""
    if header.grid is None:
        return 24 * _FLOATS[header.form].itemsize
    return 2 * header.grid.position_bits + header.grid.height_bits


def write_points(points: FloatArray, sizes: Sequence[int], header: Header) -> list[bytes]:
    """The points' bytes of each packet; `points` is (n, 3) and ``sum(sizes) == n``."""
    if header.grid is None:
        rows = points.astype(_FLOATS[header.form], order="C").view(np.uint8).reshape(len(points), -1)
        return _cut(rows, sizes)
    ranges = header.grid.ranges(header.region)
    fields = [quantise(column, *limits) for column, limits in zip(points.T, ranges, strict=True)]
    width = point_bits(header)
    if width % 8 or width > 64:
        return _write_ragged(fields, sizes, header.grid)
    p, h = header.grid.position_bits, header.grid.height_bits
    words = fields[0] << np.uint64(p + h) | fields[1] << np.uint64(h) | fields[2]
    return _cut(words.astype(">u8").view(np.uint8).reshape(-1, 8)[:, 8 - width // 8 :], sizes)


def read_points(blocks: Sequence[bytes], header: Header) -> tuple[FloatArray, list[int]]:
    """The inverse of `write_points`: (n, 3) points and how many each packet holds.

    The points are not checked to be finite. Raises PacketError where a block is no whole number of points.
    """
    width = point_bits(header)
    sizes = [8 * len(block) // width for block in blocks]
    if any(not k or len(block) != -(-k * width // 8) for k, block in zip(sizes, blocks, strict=True)):
        raise PacketError(f"the points of a packet are no whole number of {width} bits")
    data = np.frombuffer(b"".join(blocks), dtype=np.uint8)
    if header.grid is None:
        dtype = _FLOATS[header.form]
        with np.errstate(invalid="ignore"):  # a signalling NaN; whoever asked throws NaN away
            return data.view(dtype).reshape(-1, 3).astype(np.float64), sizes
    if width % 8 or width > 64:
        fields = _read_ragged(blocks, sizes, header.grid)
    else:
        p, h = header.grid.position_bits, header.grid.height_bits
        padded = np.zeros((sum(sizes), 8), dtype=np.uint8)
        padded[:, 8 - width // 8 :] = data.reshape(-1, width // 8)
        words = padded.view(">u8").ravel().astype(np.uint64)
        mask = np.uint64((1 << p) - 1)
        fields = [words >> np.uint64(p + h) & mask, words >> np.uint64(h) & mask, words & np.uint64((1 << h) - 1)]
    ranges = header.grid.ranges(header.region)
    columns = [dequantise(field, *limits) for field, limits in zip(fields, ranges, strict=True)]
    return np.stack(columns, axis=1), sizes


def quantise(values: FloatArray, low: float, high: float, bits: int) -> UintArray:
    """Values within [low, high] as integers of `bits` bits; the ends are represented exactly."""
    levels = (1 << bits) - 1
    return np.clip(np.rint((values - low) * (levels / (high - low))), 0, levels).astype(np.uint64)


def dequantise(steps: npt.NDArray[np.integer], low: float, high: float, bits: int) -> FloatArray:
    """The values that `quantise` made integers of, each within half a step."""
    values: FloatArray = np.minimum(low + steps * ((high - low) / ((1 << bits) - 1)), high)
    return values


def _cut(rows: ByteArray, sizes: Sequence[int]) -> list[bytes]:
    data, width = rows.tobytes(), rows.shape[1]
    return [data[a * width : b * width] for a, b in pairwise(accumulate(sizes, initial=0))]


def _bits(grid: Grid) -> tuple[int, int, int]:
    return grid.position_bits, grid.position_bits, grid.height_bits


def _write_ragged(fields: Sequence[UintArray], sizes: Sequence[int], grid: Grid) -> list[bytes]:
    columns = [
        np.unpackbits(field.astype(">u4").view(np.uint8).reshape(-1, 4), axis=1)[:, 32 - bits :]
        for field, bits in zip(fields, _bits(grid), strict=True)
    ]
    bits = np.concatenate(columns, axis=1)
    return [np.packbits(bits[a:b]).tobytes() for a, b in pairwise(accumulate(sizes, initial=0))]


def _read_ragged(blocks: Sequence[bytes], sizes: Sequence[int], grid: Grid) -> list[UintArray]:
    width = sum(_bits(grid))
    bits = np.concatenate(
        [
            np.unpackbits(np.frombuffer(block, dtype=np.uint8))[: size * width].reshape(size, width)
            for block, size in zip(blocks, sizes, strict=True)
        ]
    )
    fields, start = [], 0
    for count in _bits(grid):
        padded = np.zeros((len(bits), 32), dtype=np.uint8)
        padded[:, 32 - count :] = bits[:, start : start + count]
        fields.append(np.packbits(padded, axis=1).view(">u4").ravel().astype(np.uint64))
        start += count
    return fields
