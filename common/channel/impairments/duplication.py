"""Packets that arrive more than once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import ClassVar, Literal

from pydantic import Field

from common.channel.datagram import MAX_TWIN, Datagram
from common.channel.impairment import Impairment, Probability
from common.channel.passage import Passage

MAX_COPIES = 7


class Duplication(Impairment):
    """A packet arrives 1 + `copies` times with probability `p`. Later impairments befall each copy by itself."""

    kind: Literal["duplication"] = "duplication"
    p: Probability = Field(description="probability that a packet is duplicated, 0 to 1")
    copies: int = Field(1, ge=1, le=MAX_COPIES, description="how many copies are added")

    idle_at_0: ClassVar[str | None] = "p"

    def harm(self, datagram: Datagram, passage: Passage) -> Iterable[Datagram]:
        """The datagram and its copies."""
        rng = passage.rng(datagram)
        if rng.random() >= self.p:
            return [datagram]
        passage.note(datagram, self.copies, "copies")
        twins = rng.integers(1, MAX_TWIN, size=self.copies).tolist()
        return [datagram, *(replace(datagram, twin=twin) for twin in twins)]
