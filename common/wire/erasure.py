"""Parity packets: of n packets, any k that arrive give all k with points back.

A systematic maximum-distance-separable code (Cauchy Reed-Solomon) over the packets' points. The packets with points
travel unchanged, so each is of use whether or not enough arrive to rebuild the others. A code word holds at most 256
packets; larger transmissions are dealt out to several, packet by packet, so a burst of losses is shared among them.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence

import numpy as np

from common.errors import PacketError
from common.wire.gf256 import ByteArray, combine, inverse, solve

LENGTH_BYTES = 2
CHECK_BYTES = 4
SYMBOL_OVERHEAD = LENGTH_BYTES + CHECK_BYTES
"""Bytes by which a block of parity is longer than the longest block of points: its length and CRC-32, so that a rebuilt
block is never taken for good unless it is."""

MAX_CODE_WORD = 256
"""Packets: a Cauchy matrix over 256 elements has so many rows and columns together."""


def groups(total: int, parity: int) -> int:
    """Into how many code words `total` packets and `parity` more are dealt."""
    count = -(-(total + parity) // MAX_CODE_WORD)
    while -(-total // count) + -(-parity // count) > MAX_CODE_WORD:
        count += 1
    return count


def parity_blocks(blocks: Sequence[bytes], parity: int) -> list[bytes]:
    """`parity` blocks from which as many lost ones of `blocks` can be rebuilt."""
    count = groups(len(blocks), parity)
    length = SYMBOL_OVERHEAD + max(map(len, blocks))
    out = [b""] * parity
    for group in range(count):
        data = np.stack([_symbol(block, length) for block in blocks[group::count]])
        places = range(group, parity, count)
        rows = combine(_cauchy(range(len(places)), range(len(data))), data)
        for place, row in zip(places, rows, strict=True):
            out[place] = row.tobytes()
    return out


def rebuild(
    total: int, parity: int, group: int, blocks: Mapping[int, bytes], parities: Mapping[int, bytes]
) -> dict[int, bytes]:
    """The blocks of one code word that are not in `blocks`, by sequence number.

    Parameters
    ----------
    total, parity : int
        Packets with points and with parity in the transmission.
    group : int
        Which code word, below ``groups(total, parity)``.
    blocks : mapping
        Blocks of points that arrived unaltered, by sequence number; others than those of the code word are ignored.
    parities : mapping
        Blocks of parity that arrived, by number from 0.

    Raises
    ------
    PacketError
        If too few arrived, or if what arrived does not fit together.
    """
    count = groups(total, parity)
    members = range(group, total, count)
    lost = [i for i, sequence in enumerate(members) if sequence not in blocks]
    if not lost:
        return {}
    rows = [j for j, place in enumerate(range(group, parity, count)) if place in parities][: len(lost)]
    if len(rows) < len(lost):
        raise PacketError(f"{len(lost)} packets are lost and {len(rows)} of parity are here")
    received = [parities[group + j * count] for j in rows]
    length = len(received[0])
    if any(len(row) != length for row in received):
        raise PacketError("packets of parity differ in length")
    known = [i for i in range(len(members)) if members[i] in blocks]
    right = np.stack([np.frombuffer(row, dtype=np.uint8) for row in received])
    if known:
        data = np.stack([_symbol(blocks[members[i]], length) for i in known])
        right = right ^ combine(_cauchy(rows, known), data)
    found = solve(_cauchy(rows, lost), right)
    return {members[i]: _block(row) for i, row in zip(lost, found, strict=True)}


def _cauchy(rows: Sequence[int], columns: Sequence[int]) -> ByteArray:
    return inverse((255 - np.asarray(rows))[:, None] ^ np.asarray(columns)[None, :])


def _symbol(block: bytes, length: int) -> ByteArray:
    symbol = len(block).to_bytes(LENGTH_BYTES, "big") + zlib.crc32(block).to_bytes(CHECK_BYTES, "big") + block
    if len(symbol) > length:
        raise PacketError("a packet is longer than the parity that protects it")
    return np.frombuffer(symbol.ljust(length, b"\0"), dtype=np.uint8)


def _block(symbol: ByteArray) -> bytes:
    data = symbol.tobytes()
    length = int.from_bytes(data[:LENGTH_BYTES], "big")
    block = data[SYMBOL_OVERHEAD : SYMBOL_OVERHEAD + length]
    if len(block) != length or zlib.crc32(block).to_bytes(CHECK_BYTES, "big") != data[LENGTH_BYTES:SYMBOL_OVERHEAD]:
        raise PacketError("a rebuilt packet does not pass its checksum")
    return block
