"""Packets that are cut short."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.channel.datagram import Datagram
from common.channel.impairment import Impairment, Probability
from common.channel.passage import Passage


class Truncation(Impairment):
    """With probability `p` only the head of a packet arrives: a share of it that is uniform over `keep` to 1."""

    kind: Literal["truncation"] = "truncation"
    p: Probability = Field(description="probability that a packet is cut short, 0 to 1")
    keep: Annotated[float, Field(ge=0, lt=1, description="least share of the bytes that arrives, 0 to below 1")] = 0.0

    idle_at_0: ClassVar[str | None] = "p"

    def harm(self, datagram: Datagram, passage: Passage) -> Iterable[Datagram]:
        """The datagram, or its head."""
        rng = passage.rng(datagram)
        if rng.random() >= self.p:
            return [datagram]
        length = int(len(datagram.data) * rng.uniform(self.keep, 1.0))
        passage.note(datagram, len(datagram.data) - length, "bytes")
        return [datagram.damaged(datagram.data[:length])]
