"""A packet on its way: what was sent, what it looks like by now, when it arrives."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from common.errors import WireError
from common.surface import FloatArray
from common.wire import Packet, PacketDecoder, inner, repack, split
from common.wire.compact import Effort
from common.wire.decoder import decode_each
from common.wire.framing import CODED_EXTENSION, framing_bytes
from common.wire.inner import Shape
from common.wire.points import decode_packets

NOT_A_PACKET = 1 << 31
"""Instead of the repeat number of a datagram that is no packet, so that it never shares the draws of a packet."""

MAX_TWIN = 2**56

BATCH = 1024
"""Datagrams decoded or corrected at once: bounds the memory, and what one damaged datagram costs the others."""


def decode(data: bytes) -> Packet | None:
    """The one packet that `data` is, uncorrected; None where it is none, several or one that cannot be used."""
    return decode_each([data], Effort())[0]


@dataclass(frozen=True, slots=True)
class Sent:
    """A datagram as it was sent.

    `number` is the packet's number among the datagrams of its transmission, or the position in the call for a datagram
    that is no packet; `repeat` tells datagrams of one number apart.
    """

    data: bytes
    packet: Packet | None
    number: int
    repeat: int


@dataclass(frozen=True, slots=True)
class Datagram:
    """A datagram on its way.

    Impairments on packets change `data`, the bytes in the air, which keep the length they were sent with.
    Impairments on points leave `data` alone and set `points` (k, 3); these are written into the datagram when it is
    delivered, if it can still be decoded then. So the exposure to bit errors and the time on air are those of what
    was sent, whatever the order of the impairments.
    """

    sent: Sent
    data: bytes
    points: FloatArray | None = None
    at: float = 0.0
    """Seconds of virtual time, counted from the start of the call, at which it arrives."""
    twin: int = 0
    """0 for the datagram that was sent; for a duplicate made on the way, a number drawn for it, below `MAX_TWIN`."""

    def damaged(self, data: bytes) -> Self:
        """The same datagram with other bytes."""
        return replace(self, data=data)

    def delayed(self, seconds: float) -> Self:
        """The same datagram, arriving later."""
        return replace(self, at=self.at + seconds)


def launch(packets: Sequence[bytes], *, numbered: bool = False) -> list[Datagram]:
    """The datagrams of one call, in the order given.

    What tells them apart depends on their contents alone, so that the order of arrival changes nothing. Where the
    transport has `numbered` them, one that is no packet stands for the packet of its position.
    """
    effort = Effort()
    batches = (packets[start : start + BATCH] for start in range(0, len(packets), BATCH))
    decoded = [packet for batch in batches for packet in _decode(batch, effort)]
    numbers = [index if packet is None else packet.number for index, packet in enumerate(decoded)]
    repeats = [NOT_A_PACKET if packet is None and not numbered else 0 for packet in decoded]
    sent: Counter[int] = Counter()
    for index in sorted(range(len(packets)), key=lambda i: (numbers[i], packets[i])):
        if decoded[index] is not None:
            repeats[index] = sent[numbers[index]]
            sent[numbers[index]] += 1
    return [Datagram(Sent(*each), each[0]) for each in zip(packets, decoded, numbers, repeats, strict=True)]


def intact(flight: Sequence[Datagram]) -> list[Packet | None]:
    """Of each datagram the packet that can still be decoded, with the help of the inner code if it has one, or None."""
    packets = [datagram.sent.packet if datagram.data is datagram.sent.data else None for datagram in flight]
    harmed = [index for index, datagram in enumerate(flight) if datagram.data is not datagram.sent.data]
    shapes = [_shape(flight[index].sent.data) for index in harmed]
    repaired = dict(zip(harmed, _repair([flight[index].data for index in harmed], shapes), strict=True))
    other = [index for index in harmed if repaired[index] != flight[index].sent.data]
    found = dict(zip(other, decode_each([repaired[index] for index in other], Effort()), strict=True))
    for index in harmed:
        packets[index] = found[index] if index in found else flight[index].sent.packet
    return packets


def deliver(flight: Sequence[Datagram]) -> list[bytes]:
    """The bytes that arrive: moved points are written into what can still be decoded."""
    arriving = [datagram.data for datagram in flight]
    moved = [index for index, datagram in enumerate(flight) if datagram.points is not None]
    for index, packet in zip(moved, intact([flight[index] for index in moved]), strict=True):
        points = flight[index].points
        if packet is not None and points is not None and packet.points.shape == points.shape:
            arriving[index] = repack(packet, points)
    return arriving


def _decode(packets: Sequence[bytes], effort: Effort) -> list[Packet | None]:
    """`decode` of each, after correction; at once where all are intact, which spares the headers that they repeat."""
    body = b"".join(packets)
    with suppress(WireError):
        found = PacketDecoder().find(body)
        if len(found) == len(packets) and split(body) == list(packets):
            return decode_packets(found, effort)
    decoded = decode_each(packets, effort)
    # The datagrams of a transmission are coded alike: the intact ones tell how to correct the others.
    known = [shape for data, packet in zip(packets, decoded, strict=True) if packet and (shape := _shape(data))]
    alike = {shape.size: shape for shape in known}
    shapes = [None if packet else alike.get(len(data)) for data, packet in zip(packets, decoded, strict=True)]
    lost = [index for index, packet in enumerate(decoded) if packet is None]
    repaired = _repair(packets, shapes)
    for index, packet in zip(lost, decode_each([repaired[index] for index in lost], effort), strict=True):
        decoded[index] = packet
    return decoded


def _shape(data: bytes) -> Shape | None:
    """How an intact datagram is coded against bit errors, or None if it is not."""
    start = framing_bytes(len(data))
    coded = len(data) > start and data[start - 1] == CODED_EXTENSION
    return inner.shape_of(memoryview(data)) if coded else None


def _repair(data: Sequence[bytes], shapes: Sequence[Shape | None]) -> list[bytes]:
    """The datagrams with their errors corrected as far as the inner code, of the shape each was sent in, goes."""
    repaired = list(data)
    for shape in {shape for shape in shapes if shape}:
        # A datagram that is cut off lost bytes that the code can fill in again.
        shortest = shape.size - shape.strength // 2
        chosen = [i for i, own in enumerate(shapes) if own == shape and shortest <= len(data[i]) <= shape.size]
        for batch in (chosen[start : start + BATCH] for start in range(0, len(chosen), BATCH)):
            rows = np.frombuffer(b"".join(data[i].ljust(shape.size, b"\0") for i in batch), dtype=np.uint8)
            words = inner.recover(rows.reshape(len(batch), shape.size), shape.strength)
            for i, word in zip(batch, words, strict=True):
                repaired[i] = word.tobytes()
    return repaired
