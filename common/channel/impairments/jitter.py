"""Time that differs from packet to packet."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, Literal

from pydantic import Field

from common.channel.datagram import Datagram
from common.channel.impairment import Impairment
from common.channel.passage import Passage


class Jitter(Impairment):
    """A packet arrives U(0, `seconds`) later, independently of the others; who arrives earlier overtakes."""

    kind: Literal["jitter"] = "jitter"
    seconds: float = Field(ge=0, le=3600, description="most that is added, seconds")

    idle_at_0: ClassVar[str | None] = "seconds"

    def harm(self, datagram: Datagram, passage: Passage) -> Iterable[Datagram]:
        """The datagram, later."""
        seconds = float(passage.rng(datagram).uniform(0.0, self.seconds))
        if seconds:
            passage.note(datagram, seconds, "s")
        return [datagram.delayed(seconds)]
