"""Packets to a FeatureSet, in whatever order and however often they arrive."""

from __future__ import annotations

from contextlib import suppress
from typing import Literal, TypeAlias

import numpy as np

from common.errors import ConflictError, LimitError, NotReadyError, PacketError
from common.surface import FeatureSet
from common.wire.compact import Effort
from common.wire.erasure import groups, rebuild
from common.wire.header import Header, transmission_tag
from common.wire.limits import MAX_POINTS
from common.wire.packet import Packet
from common.wire.points import Written, check_block, decode_packets

Arrival: TypeAlias = Literal["new", "duplicate", "foreign"]


class Reassembly:
    """What arrived of one transmission.

    Packets that were lost are rebuilt from packets of parity as soon as enough of both are here. Whatever is asked for,
    the answer does not depend on the order in which the packets came.

    Parameters
    ----------
    transmission : str
        The id; packets of another one are told apart by their tag.
    """

    def __init__(self, transmission: str) -> None:
        self._tag = transmission_tag(transmission)
        self._header: Header | None = None
        self._arrived: dict[int, Packet] = {}
        self._parity: dict[int, Packet] = {}
        self._rebuilt: dict[int, Packet] = {}
        self._points = 0
        self._unsettled: set[int] = set()

    def add(self, packet: Packet) -> Arrival:
        """Take a packet; say what it was.

        Raises
        ------
        ConflictError
            If the packet says something else of the transmission than those before it, or has other points than its
            copy although neither was altered on the way.
        LimitError
            If there are more points in all than are accepted.
        """
        if packet.tag != self._tag:
            return "foreign"
        header = self._header
        if header is None:
            self._header = packet.header
        elif header is not packet.header:
            _require_agreement(header, packet.header)
            # What was altered no longer says how the points were written.
            if header.altered:
                self._header = packet.header
        sequence = packet.sequence
        store = self._arrived if sequence < packet.header.total else self._parity
        known = store.get(sequence)
        if known is not None:
            _require_same_points(known, packet)
            if _rank(known) <= _rank(packet):
                return "duplicate"
        points = self._points + len(packet.points) - (len(known.points) if known else 0)
        if points > MAX_POINTS:
            raise LimitError(f"more than {MAX_POINTS} points in one transmission")
        self._points = points
        store[sequence] = packet
        if packet.header.parity:
            self._unsettled.add(sequence)
        return "new" if known is None else "duplicate"

    @property
    def total(self) -> int | None:
        """Packets with points in the transmission; None until a packet says so."""
        return self._header.total if self._header else None

    @property
    def received(self) -> int:
        """Packets with points that arrived."""
        return len(self._arrived)

    @property
    def rebuilt(self) -> int:
        """Packets with points that did not arrive and were rebuilt from parity."""
        return len(self._settle())

    @property
    def missing(self) -> tuple[int, ...]:
        """Sequence numbers of the packets with points that are not here, ascending."""
        rebuilt = self._settle()
        return tuple(i for i in range(self.total or 0) if i not in self._arrived and i not in rebuilt)

    @property
    def complete(self) -> bool:
        """Whether every packet with points is here."""
        return self._header is not None and len(self._arrived) + len(self._settle()) == self._header.total

    @property
    def points(self) -> int:
        """Points that are here."""
        return self._points + sum(len(packet.points) for packet in self._settle().values())

    def features(self) -> FeatureSet:
        """The features that are here, in the order of their packets; raises NotReadyError where there are none."""
        here = self._arrived | self._settle()
        if self._header is None or not self.points:  # a packet whose cells are all empty has none
            raise NotReadyError("no packet with points has arrived yet")
        points = np.concatenate([here[i].points for i in sorted(here)])
        header = self._header
        return FeatureSet(points, header.region, header.gap, header.kind, header.units)

    def _settle(self) -> dict[int, Packet]:
        """The packets that could be rebuilt."""
        if self._unsettled and self._header is not None:
            header, count = self._header, groups(self._header.total, self._header.parity)
            lost: list[Written] = []
            for group in sorted({self._group(sequence, count) for sequence in self._unsettled}):
                lost += self._rebuild(header, group, count)
            self._unsettled.clear()
            # Where it takes too much to read what was rebuilt, it stays missing.
            with suppress(LimitError):
                packets = decode_packets(lost, Effort())
                self._rebuilt |= {packet.sequence: packet for packet in packets if packet is not None}
        return self._rebuilt

    def _group(self, sequence: int, count: int) -> int:
        total = self._header.total if self._header else 0
        return (sequence if sequence < total else sequence - total) % count

    def _rebuild(self, header: Header, group: int, count: int) -> list[Written]:
        """The packets of a code word that did not arrive, as far as they could be rebuilt."""
        members = range(group, header.total, count)
        for sequence in members:
            self._rebuilt.pop(sequence, None)
        # Points that were altered on the way are no longer those that the parity was made of.
        blocks = {
            i: self._arrived[i].block for i in members if i in self._arrived and not self._arrived[i].header.altered
        }
        parities = {
            place: self._parity[header.total + place].block
            for place in range(group, header.parity, count)
            if header.total + place in self._parity
        }
        if not parities or len(blocks) + len(parities) < len(members):
            return []
        original = next(iter(self._parity.values())).header
        try:
            found = rebuild(header.total, header.parity, group, blocks, parities)
            lost = [Written(original, sequence, block) for sequence, block in found.items()]
            lost = [each for each in lost if each.sequence not in self._arrived]
            for each in lost:
                check_block(original, each.block)
        except PacketError:
            # What arrived does not fit together. What arrived intact stays usable, the rest stays missing.
            return []
        return lost


def _rank(packet: Packet) -> tuple[bool, int, bytes]:
    """Which of several copies is kept: unaltered ones first, then the first sent."""
    return packet.header.altered, packet.number, packet.block


def _require_agreement(known: Header, other: Header) -> None:
    altered = known.altered or other.altered
    if known.about() == other.about() and (altered or (known.form, known.grid) == (other.form, other.grid)):
        return
    before, now = known.described(), other.described()
    differing = [
        f"{name} {now[name]} instead of {before[name]}" for name in before if name in now and before[name] != now[name]
    ]
    raise ConflictError(f"a packet does not go with those before it: {', '.join(differing)}")


def _require_same_points(known: Packet, other: Packet) -> None:
    if not known.header.altered and not other.header.altered and known.block != other.block:
        raise ConflictError(f"two packets are number {other.sequence}, with other points each")
