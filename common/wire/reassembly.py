"""Packets to a FeatureSet, in whatever order and however often they arrive."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from common.errors import ConflictError, LimitError, NotReadyError
from common.surface import FeatureSet
from common.wire.header import Header, transmission_tag
from common.wire.limits import MAX_POINTS
from common.wire.packet import Packet

Arrival: TypeAlias = Literal["new", "duplicate", "foreign"]


class Reassembly:
    """What arrived of one transmission.

    Parameters
    ----------
    transmission : str
        The id; packets of another one are told apart by their tag.
    """

    def __init__(self, transmission: str) -> None:
        self._tag = transmission_tag(transmission)
        self._header: Header | None = None
        self._arrived: dict[int, Packet] = {}
        self._points = 0

    def add(self, packet: Packet) -> Arrival:
        """Take a packet; say what it was.

        Which of several copies of a packet is kept does not depend on the order in which they come.

        Raises
        ------
        ConflictError
            If the packet describes another feature set than those before it, or has other points than its copy
            although neither was altered on the way.
        LimitError
            If there are more points in all than are accepted.
        """
        if packet.tag != self._tag:
            return "foreign"
        if self._header is None:
            self._header = packet.header
        elif self._header is not packet.header:
            _require_agreement(self._header, packet.header)
            if self._header.altered and not packet.header.altered:
                self._header = packet.header
        known = self._arrived.get(packet.sequence)
        if known is None:
            if self._points + len(packet.points) > MAX_POINTS:
                raise LimitError(f"more than {MAX_POINTS} points in one transmission")
            self._points += len(packet.points)
            self._arrived[packet.sequence] = packet
            return "new"
        if not known.header.altered and not packet.header.altered and known.block != packet.block:
            raise ConflictError(f"two packets are number {packet.sequence} of the transmission, with other points each")
        if _rank(packet) < _rank(known):
            self._points += len(packet.points) - len(known.points)
            self._arrived[packet.sequence] = packet
        return "duplicate"

    @property
    def total(self) -> int | None:
        """Packets with points in the transmission; None until a packet says so."""
        return self._header.total if self._header else None

    @property
    def received(self) -> int:
        """Packets with points that are here."""
        return len(self._with_points())

    @property
    def missing(self) -> tuple[int, ...]:
        """Sequence numbers of the packets with points that are not here, ascending."""
        return tuple(i for i in range(self.total or 0) if i not in self._arrived)

    @property
    def complete(self) -> bool:
        """Whether every packet with points is here."""
        return self.total is not None and self.received == self.total

    @property
    def points(self) -> int:
        """Points that are here."""
        return self._points

    def features(self) -> FeatureSet:
        """The features that are here, in the order of their packets; raises NotReadyError where there are none."""
        arrived = self._with_points()
        if not arrived or self._header is None:
            raise NotReadyError("no packet with points has arrived yet")
        points = np.concatenate([arrived[i].points for i in sorted(arrived)])
        header = self._header
        return FeatureSet(points, header.region, header.gap, header.kind, header.units)

    def _with_points(self) -> dict[int, Packet]:
        return {i: packet for i, packet in self._arrived.items() if not packet.is_parity}


def _rank(packet: Packet) -> tuple[bool, int, bytes]:
    return packet.header.altered, packet.number, packet.block


def _require_agreement(known: Header, other: Header) -> None:
    if known.about() != other.about():
        raise ConflictError(
            f"a packet belongs to another feature set of the same transmission: it says {other.total} packets over "
            f"{other.region.bounds}, those before it {known.total} over {known.region.bounds}"
        )
    if not known.altered and not other.altered and (known.form, known.grid) != (other.form, other.grid):
        raise ConflictError("a packet writes its points in another form than those before it")
