"""Time that every packet takes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, Literal

from pydantic import Field

from common.channel.datagram import Datagram
from common.channel.impairment import Impairment
from common.channel.passage import Passage


class Delay(Impairment):
    """A packet arrives `seconds` later: propagation, processing."""

    kind: Literal["delay"] = "delay"
    seconds: float = Field(ge=0, le=3600, description="seconds")

    idle_at_0: ClassVar[str | None] = "seconds"

    def harm(self, datagram: Datagram, passage: Passage) -> Iterable[Datagram]:
        """The datagram, later."""
        if self.seconds:
            passage.note(datagram, self.seconds, "s")
        return [datagram.delayed(self.seconds)]
