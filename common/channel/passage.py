"""What an impairment is given besides the datagrams: random draws, the scale of the heights, the fault log."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Self

import numpy as np

from common.channel.datagram import Datagram
from common.surface import FloatArray


class Purpose(IntEnum):
    """What a stream of draws is for; streams of different purpose are independent."""

    HARM = 0
    APPLICATION = 1
    CHAIN = 2


@dataclass(frozen=True, slots=True)
class Draws:
    """Random generators of one impairment in one call.

    A counter-based generator (Philox 4x64, Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", 2011) is
    placed by key and counter instead of being run on: the key stands for (seed, transmission, attempt, position of
    the impairment in the channel), the counter for the datagram. So the draws of a packet are the same in whatever
    order, and in whatever company, it is sent.
    """

    key: int

    @classmethod
    def of(cls, seed: int, transmission: str, attempt: int, position: int) -> Self:
        """The draws of the impairment at `position` in a channel."""
        name = f"{seed}\0{attempt}\0{position}\0{transmission}".encode("utf-8", "surrogatepass")
        return cls(int.from_bytes(hashlib.blake2b(name, digest_size=16).digest(), "little"))

    def generator(self, purpose: Purpose, number: int, repeat: int = 0, twin: int = 0) -> np.random.Generator:
        """The generator placed at (purpose, number, repeat, twin), each a non-negative integer."""
        counter = [0, purpose << 56 | twin, repeat, number]
        return np.random.Generator(np.random.Philox(key=self.key, counter=counter))


@dataclass(frozen=True, slots=True)
class Reference:
    """What relative strengths refer to: range (max - min) and deviation, the mean removed, of x, y, z; each (3,)."""

    ranges: FloatArray
    deviations: FloatArray

    @classmethod
    def of(cls, flight: Sequence[Datagram]) -> Self:
        """Of the points that `flight` carries as sent, each packet counted once; zeros where it carries none.

        The points are taken in the order of their packets, so that the order of arrival changes no rounding.
        """
        packets = {
            (datagram.sent.number, datagram.sent.data): datagram.sent.packet.points
            for datagram in flight
            if datagram.sent.packet is not None and len(datagram.sent.packet.points)
        }
        if not packets:
            return cls(np.zeros(3), np.zeros(3))
        points = np.concatenate([packets[name] for name in sorted(packets)])
        # A hostile packet may hold the largest double: scaled, neither range nor squares can overflow.
        scale = np.maximum(np.abs(points).max(axis=0), np.finfo(float).tiny)
        scaled = points / scale
        limit = np.finfo(float).max
        with np.errstate(over="ignore"):
            return cls(np.minimum(np.ptp(scaled, axis=0) * scale, limit), scaled.std(axis=0) * scale)


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that was done to one packet: `amount` of `unit` (17 bits, 35 points, 0.25 s)."""

    packet: int
    """Sequence number of the packet; for a datagram that is no packet, its position in the call."""
    kind: str
    amount: float = 1.0
    unit: str = "packet"
    copy: int = 0
    """Which copy of the packet, where the sender repeats itself."""

    @property
    def detail(self) -> str:
        """Amount and unit, for people."""
        return f"{self.amount:g} {self.unit}"


@dataclass(frozen=True, slots=True)
class Passage:
    """One impairment at work on the datagrams of one call."""

    kind: str
    draws: Draws
    reference: Callable[[], Reference]
    log: list[Fault] = field(default_factory=list)

    def rng(self, datagram: Datagram) -> np.random.Generator:
        """The generator of this datagram, fresh at each call."""
        sent = datagram.sent
        return self.draws.generator(Purpose.HARM, sent.number, sent.repeat, datagram.twin)

    def spares(self, datagram: Datagram, probability: float) -> bool:
        """Whether the impairment, applied with `probability`, passes this datagram by."""
        if probability >= 1:
            return False
        sent = datagram.sent
        draws = self.draws.generator(Purpose.APPLICATION, sent.number, sent.repeat, datagram.twin)
        return bool(draws.random() >= probability)

    def note(self, datagram: Datagram, amount: float = 1.0, unit: str = "packet") -> None:
        """Write into the fault log what was done to `datagram`."""
        packet = datagram.sent.packet
        sequence, copy = (datagram.sent.number, 0) if packet is None else (packet.sequence, packet.copy)
        self.log.append(Fault(sequence, self.kind, float(amount), unit, copy))
