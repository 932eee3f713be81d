"""One packet: its header, its number, its points; and its bytes."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from common.errors import PacketError
from common.surface import FeatureKind, FloatArray, Region, Units, as_points
from common.wire.framing import frame
from common.wire.header import Header
from common.wire.numbers import write_varint
from common.wire.plain import write_points

CRC_BYTES = 4

NO_POINTS: FloatArray = np.empty((0, 3))
NO_POINTS.setflags(write=False)


@dataclass(frozen=True, slots=True, eq=False)
class Packet:
    """A packet that passed its checksum.

    Parameters
    ----------
    header : Header
        What it says of its transmission.
    number : int
        Its number among the datagrams of the transmission, copies included.
    points : FloatArray, shape (k, 3)
        x, y, z, read-only; none in a packet of parity.
    block : bytes
        The points (or the parity) as they were written.
    """

    header: Header
    number: int
    points: FloatArray
    block: bytes

    @property
    def tag(self) -> int:
        """Stands for the transmission's id, see `transmission_tag`."""
        return self.header.tag

    @property
    def sequence(self) -> int:
        """Which packet it is: 0 .. total - 1 with points, total .. total + parity - 1 with parity."""
        return self.number % self.header.period

    @property
    def copy(self) -> int:
        """Which copy of that packet it is, from 0."""
        return self.number // self.header.period

    @property
    def is_parity(self) -> bool:
        """Whether it carries parity instead of points."""
        return self.sequence >= self.header.total

    @property
    def total(self) -> int:
        """Packets with points in the transmission."""
        return self.header.total

    @property
    def region(self) -> Region:
        """The region of the surface."""
        return self.header.region

    @property
    def gap(self) -> float | None:
        """The segment gap."""
        return self.header.gap

    @property
    def kind(self) -> FeatureKind:
        """How the points were chosen."""
        return self.header.kind

    @property
    def units(self) -> Units:
        """The units of the coordinates."""
        return self.header.units


def write_payloads(header: Header, blocks: Sequence[bytes], start: int = 0) -> list[bytes]:
    """The payloads, checksum included, of the packets numbered from `start` that carry `blocks`."""
    lead, rest = header.lead(), header.rest()
    payloads = []
    for number, block in enumerate(blocks, start):
        payload = lead + write_varint(number) + rest + block
        payloads.append(payload + zlib.crc32(payload).to_bytes(CRC_BYTES, "big"))
    return payloads


def write_datagrams(header: Header, blocks: Sequence[bytes], start: int = 0) -> list[bytes]:
    """The datagrams, without an inner code, of the packets numbered from `start` that carry `blocks`."""
    return frame(write_payloads(header, blocks, start))


def repack(packet: Packet, points: npt.ArrayLike) -> bytes:
    """A datagram with the header of `packet` and other points, shape (k, 3).

    They travel as float64, so nothing is clipped or rounded, and the packet is marked as altered: the receiver then
    neither takes it for a contradiction nor rebuilds lost packets from it. It may exceed the transmission's datagram.
    Raises PointsError unless the points are finite and there is one at least, PacketError where there are too many or
    `packet` carries parity.
    """
    if packet.is_parity:
        raise PacketError("a packet of parity carries no points")
    header, array = packet.header.as_altered(), as_points(points)
    return write_datagrams(header, write_points(array, [len(array)], header), packet.number)[0]
