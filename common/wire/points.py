"""The points of packets, by their form."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise

import numpy as np

from common.errors import PacketError
from common.wire.header import Header
from common.wire.limits import MAX_POINTS_PER_PACKET
from common.wire.packet import Packet
from common.wire.plain import point_bits, read_points


def check_block(header: Header, block: bytes) -> None:
    """PacketError unless `block` can be the points of one packet."""
    width = point_bits(header)
    count = 8 * len(block) // width
    if not 0 < count <= MAX_POINTS_PER_PACKET or len(block) != -(-count * width // 8):
        raise PacketError(f"the points of a packet are no whole number of {width} bits")


def decode_packets(header: Header, numbered: Sequence[tuple[int, bytes]]) -> list[Packet]:
    """The packets with points of one header, from their numbers and checked blocks, all at once.

    Packets with points that are not finite are left out. The blocks must have passed `check_block`.
    """
    if not numbered:
        return []
    points, sizes = read_points([block for _, block in numbered], header)
    points.setflags(write=False)
    packets = [
        Packet(header, number, points[a:b], block)
        for (number, block), (a, b) in zip(numbered, pairwise(accumulate(sizes, initial=0)), strict=True)
    ]
    if np.all(np.isfinite(points)):
        return packets
    return [packet for packet in packets if np.all(np.isfinite(packet.points))]
