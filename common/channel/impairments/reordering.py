"""Packets that are overtaken."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, Literal

from pydantic import Field

from common.channel.datagram import Datagram
from common.channel.impairment import Impairment, Probability
from common.channel.passage import Passage


class Reordering(Impairment):
    """A packet falls back by 1 to `depth` places, evenly distributed, with probability `p`.

    It then arrives right after the packet that it was the last to be overtaken by, and no earlier.
    """

    kind: Literal["reordering"] = "reordering"
    p: Probability = Field(description="probability that a packet falls back, 0 to 1")
    depth: int = Field(3, ge=1, le=1_000_000, description="most places that a packet falls back by")

    idle_at_0: ClassVar[str | None] = "p"

    def apply(self, flight: list[Datagram], passage: Passage) -> list[Datagram]:
        """The same datagrams in another order."""
        places: list[tuple[float, bool, Datagram]] = []
        for place, datagram in enumerate(sorted(flight, key=lambda each: each.at)):
            back = 0 if passage.spares(datagram, self.probability) else self._places(datagram, passage)
            if back:
                passage.note(datagram, back, "places")
            places.append((place + back, back > 0, datagram))
        onward: list[Datagram] = []
        for _, overtaken, datagram in sorted(places, key=lambda entry: entry[:2]):
            late = onward[-1].at if overtaken and onward else datagram.at
            onward.append(replace(datagram, at=max(datagram.at, late)))
        return onward

    def _places(self, datagram: Datagram, passage: Passage) -> int:
        rng = passage.rng(datagram)
        return int(rng.integers(1, self.depth, endpoint=True)) if rng.random() < self.p else 0
