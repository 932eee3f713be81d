"""Loss of whole packets, each by itself."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, Literal

from pydantic import Field

from common.channel.datagram import Datagram
from common.channel.impairment import Impairment, Probability
from common.channel.passage import Passage


class Erasure(Impairment):
    """A packet is lost with probability `p`, independently of the others."""

    kind: Literal["erasure"] = "erasure"
    p: Probability = Field(description="probability that a packet is lost, 0 to 1")

    idle_at_0: ClassVar[str | None] = "p"

    def harm(self, datagram: Datagram, passage: Passage) -> Iterable[Datagram]:
        """Nothing, or the datagram."""
        if passage.rng(datagram).random() >= self.p:
            return [datagram]
        passage.note(datagram)
        return []
