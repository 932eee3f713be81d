"""Independent bit errors."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from common.channel.datagram import Datagram
from common.channel.impairment import Impairment, Probability
from common.channel.modulation import blocks_of, count_differing_bits
from common.channel.passage import Passage


class BitErrors(Impairment):
    """The binary symmetric channel: each bit is flipped with probability `ber`, independently of the others.

    Source: Cover and Thomas, "Elements of Information Theory", 2nd edition, section 7.1.4.
    """

    kind: Literal["bit_errors"] = "bit_errors"
    ber: Probability = Field(description="bit-error rate: probability that a bit is flipped, 0 to 1")

    idle_at_0: ClassVar[str | None] = "ber"

    def harm(self, datagram: Datagram, passage: Passage) -> Iterable[Datagram]:
        """The datagram with some of its bits flipped."""
        rng = passage.rng(datagram)
        flipped = b"".join(self._flipped(block, rng) for block in blocks_of(datagram.data))
        count = count_differing_bits(datagram.data, flipped)
        if not count:
            return [datagram]
        passage.note(datagram, count, "bits")
        return [datagram.damaged(flipped)]

    def _flipped(self, block: bytes, rng: np.random.Generator) -> bytes:
        flips = rng.random(8 * len(block)) < self.ber
        return (np.frombuffer(block, dtype=np.uint8) ^ np.packbits(flips)).tobytes()
