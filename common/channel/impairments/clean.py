"""No harm at all."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

from common.channel.datagram import Datagram
from common.channel.impairment import Impairment
from common.channel.passage import Passage


class Clean(Impairment):
    """Every datagram arrives as it was sent."""

    kind: Literal["clean"] = "clean"

    @property
    def acts(self) -> bool:
        """Never."""
        return False

    def harm(self, datagram: Datagram, passage: Passage) -> Iterable[Datagram]:  # noqa: ARG002 - nothing is drawn
        """The datagram itself."""
        return [datagram]
