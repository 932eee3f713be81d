"""A packet on its way: what was sent, what it looks like by now, when it arrives."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Self

from common.errors import WireError
from common.surface import FloatArray
from common.wire import Packet, PacketDecoder, repack, split

NOT_A_PACKET = 1 << 31
"""Instead of the repeat number of a datagram that is no packet, so that it never shares the draws of a packet."""

MAX_TWIN = 2**56

BATCH = 256
"""Datagrams decoded at once: one that is damaged makes only its batch be decoded one by one."""


def decode(data: bytes) -> Packet | None:
    """The one packet that `data` holds, or None where it holds none, several or one that cannot be used."""
    decoder = PacketDecoder()
    try:
        packets = [*decoder.feed(data), *decoder.close()]
    except WireError:
        return None
    return packets[0] if len(packets) == 1 and not decoder.damaged else None


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

    @property
    def intact(self) -> Packet | None:
        """The packet that can still be decoded, or None."""
        return self.sent.packet if self.data is self.sent.data else decode(self.data)

    def damaged(self, data: bytes) -> Self:
        """The same datagram with other bytes."""
        return replace(self, data=data)

    def delayed(self, seconds: float) -> Self:
        """The same datagram, arriving later."""
        return replace(self, at=self.at + seconds)

    def delivered(self) -> bytes:
        """The bytes that arrive."""
        packet = self.intact if self.points is not None else None
        if packet is None or self.points is None or packet.points.shape != self.points.shape:
            return self.data
        return repack(packet, self.points)


def _decode_all(packets: Sequence[bytes]) -> list[Packet | None]:
    """`decode` of each; at once where all are intact, which spares the headers that they repeat."""
    decoder, body = PacketDecoder(), b"".join(packets)
    with suppress(WireError):
        found = [*decoder.feed(body), *decoder.close()]
        if len(found) == len(packets) and not decoder.damaged and split(body) == list(packets):
            return [*found]
    return [decode(data) for data in packets]


def launch(packets: Sequence[bytes]) -> list[Datagram]:
    """The datagrams of one call, in the order given.

    What tells them apart depends on their contents alone, so that the order of arrival changes nothing.
    """
    decoded = [
        packet for start in range(0, len(packets), BATCH) for packet in _decode_all(packets[start : start + BATCH])
    ]
    numbers = [index if packet is None else packet.number for index, packet in enumerate(decoded)]
    repeats = [NOT_A_PACKET if packet is None else 0 for packet in decoded]
    sent: Counter[int] = Counter()
    for index in sorted(range(len(packets)), key=lambda i: (numbers[i], packets[i])):
        if decoded[index] is not None:
            repeats[index] = sent[numbers[index]]
            sent[numbers[index]] += 1
    return [Datagram(Sent(*each), each[0]) for each in zip(packets, decoded, numbers, repeats, strict=True)]
