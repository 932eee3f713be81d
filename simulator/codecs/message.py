"""What every codec's message starts with, and how its heights are scaled.

A message is self-contained: whatever the decoder needs is in its bytes and is counted.
"""

from __future__ import annotations

import struct
import zlib
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from common.errors import PacketError
from common.surface import BoolArray, FloatArray, IntArray

Setting: TypeAlias = tuple[float, ...]
"""What a codec is told of how finely to write: its own numbers."""

Ladders: TypeAlias = tuple[tuple[Setting, ...], ...]
"""Settings from coarse to fine, in one or several families."""

HEADER = struct.Struct("<HHff")
"""Rows, columns, least height, range of the heights."""

MAX_NODES = 1 << 22
"""Nodes a receiver is willing to fill: a damaged header may ask for 65535 x 65535."""


def write_header(z: FloatArray) -> bytes:
    """The header of a grid (rows, columns) of at most 65535 a side."""
    return HEADER.pack(*z.shape, float(z.min()), float(np.ptp(z)))


class Header(NamedTuple):
    """What a message says before its heights."""

    shape: tuple[int, int]
    low: float
    extent: float

    def heights(self, values: npt.ArrayLike) -> FloatArray:
        """Heights in the unit of the grid, of `values` in 0..1."""
        return np.asarray(values, dtype=np.float64) * self.extent + self.low


def read_header(data: bytes) -> tuple[Header, bytes]:
    """The header, and what follows it; raises PacketError where it makes no sense."""
    if len(data) < HEADER.size:
        raise PacketError(f"a message has at least {HEADER.size} bytes, got {len(data)}")
    rows, columns, low, extent = HEADER.unpack_from(data)
    if not (0 < rows * columns <= MAX_NODES and np.isfinite(low) and np.isfinite(extent)):
        raise PacketError(f"a grid of {rows} x {columns} from {low:g} to {low + extent:g} cannot be")
    return Header((rows, columns), low, extent), data[HEADER.size :]


def unbroken(data: bytes, lost: BoolArray, least: int) -> bytes:
    """The bytes before the first lost one, at least `least`: some decoders stray less at an early end than in zeros."""
    return data[: max(least, int(np.argmax(lost)))] if lost.any() else data


def scaled(z: FloatArray) -> FloatArray:
    """Heights in 0..1 by the least height and range that `write_header` keeps."""
    low, extent = (float(np.float32(v)) for v in (z.min(), np.ptp(z)))
    return np.asarray((z - low) / (extent or 1.0))


def deflate(data: bytes) -> bytes:
    """Deflated without a checksum: what can be inflated of a damaged stream is used."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    return packer.compress(data) + packer.flush()


def inflate(data: bytes, length: int) -> bytes:
    """`length` bytes: those before the damage, where it shows, then zeros; raises PacketError where there are none."""
    unpacker = zlib.decompressobj(-15)
    out = bytearray()
    try:
        for position in range(0, len(data), 64):
            out += unpacker.decompress(data[position : position + 64], length - len(out) + 1)
            if len(out) > length:
                break
    except zlib.error as error:
        if not out:
            raise PacketError(f"the stream is damaged from its start: {error}") from error
    return bytes(out[:length]).ljust(length, b"\0")


def pack_bits(values: IntArray, bits: int) -> bytes:
    """Non-negative integers below 2**bits, most significant bit first, end to end."""
    planes = (values[:, None] >> np.arange(bits - 1, -1, -1)) & 1
    return np.packbits(planes.astype(np.uint8)).tobytes()


def unpack_bits(data: bytes, bits: int, count: int) -> IntArray:
    """`count` integers of `bits` bits each; zeros where the data ends early."""
    padded = np.frombuffer(data.ljust(-(-count * bits // 8), b"\0"), dtype=np.uint8)
    planes = np.unpackbits(padded, count=count * bits).reshape(count, bits).astype(np.int64)
    return np.asarray(planes @ (1 << np.arange(bits - 1, -1, -1)))
