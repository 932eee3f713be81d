"""A link that carries only so many bits a second."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from common.channel.datagram import Datagram
from common.channel.impairment import Impairment
from common.channel.passage import Passage


class Rate(Impairment):
    """One packet after the other takes 8 * bytes / `bits_per_second` on the line; who finds it busy waits (FIFO)."""

    kind: Literal["rate"] = "rate"
    bits_per_second: float = Field(ge=1, le=1e15, description="bits a second")

    def apply(self, flight: list[Datagram], passage: Passage) -> list[Datagram]:
        """The same datagrams, each at the end of its time on the line."""
        free = 0.0
        onward = []
        for datagram in sorted(flight, key=lambda each: each.at):
            if not passage.spares(datagram, self.probability):
                free = max(free, datagram.at) + 8 * len(datagram.data) / self.bits_per_second
                seconds = free - datagram.at
                passage.note(datagram, seconds, "s")
                datagram = datagram.delayed(seconds)
            onward.append(datagram)
        return onward
