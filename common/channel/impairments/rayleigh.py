"""A modulated carrier in flat Rayleigh fading and additive white Gaussian noise."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import repeat
from typing import Annotated, Literal

from pydantic import Field

from common.channel.datagram import Datagram
from common.channel.impairment import Impairment
from common.channel.modulation import ComplexArray, Modulation, block_fading, complex_normal, transmit
from common.channel.passage import Passage


class Rayleigh(Impairment):
    """r = h s + n for each symbol s; h complex normal with mean |h|^2 = 1, known to the receiver (coherent detection).

    Block fading: h is drawn afresh for each packet, or after every `coherence` symbols (1: each symbol by itself). The
    bit-error rate, averaged over h, is (1 - sqrt(g / (1 + g))) / 2 with g = mean Eb / N0, whatever the coherence; what
    the coherence changes is how errors cluster: in whole packets, or evenly. Source: Proakis and Salehi, "Digital
    Communications", 5th edition, section 13.3; block fading: Tse and Viswanath, "Fundamentals of Wireless
    Communication", section 5.4.
    """

    kind: Literal["rayleigh"] = "rayleigh"
    ebn0_db: float = Field(ge=-30, le=60, description="mean energy of a bit over noise density, Eb / N0, in dB")
    modulation: Modulation = Field("bpsk", description="bpsk (a bit a symbol) or qpsk (two, Gray coded)")
    coherence: Literal["packet"] | Annotated[int, Field(ge=1)] = Field(
        "packet", description="how long a gain lasts: packet, or a number of symbols"
    )

    def harm(self, datagram: Datagram, passage: Passage) -> Iterable[Datagram]:
        """The datagram as it was detected."""
        rng = passage.rng(datagram)
        gains: Iterable[ComplexArray]
        if self.coherence == "packet":
            gains = repeat(complex_normal(rng, 1, variance=1.0))
        else:
            gains = block_fading(self.modulation, datagram.data, self.coherence, passage.rng(datagram))
            # The noise is drawn behind all gains.
            for _ in block_fading(self.modulation, datagram.data, self.coherence, rng):
                pass
        data, wrong = transmit(self.modulation, datagram.data, gains, self.ebn0_db, rng)
        if not wrong:
            return [datagram]
        passage.note(datagram, wrong, "bits")
        return [datagram.damaged(data)]
