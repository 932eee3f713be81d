"""A modulated carrier in additive white Gaussian noise."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import repeat
from typing import Literal

import numpy as np
from pydantic import Field

from common.channel.datagram import Datagram
from common.channel.impairment import Impairment
from common.channel.modulation import Modulation, transmit
from common.channel.passage import Passage


class Awgn(Impairment):
    """r = s + n for each symbol s, n complex normal of variance N0 / 2 a component; coherent detection.

    The bit-error rate of both modulations is Q(sqrt(2 Eb / N0)), Q(x) = erfc(x / sqrt(2)) / 2 (Proakis and Salehi,
    "Digital Communications", 5th edition, section 4.3). Every symbol is simulated; the formula is what it is tested by.
    """

    kind: Literal["awgn"] = "awgn"
    ebn0_db: float = Field(ge=-30, le=60, description="energy of a bit over noise density, Eb / N0, in dB")
    modulation: Modulation = Field("bpsk", description="bpsk (a bit a symbol) or qpsk (two, Gray coded)")

    def harm(self, datagram: Datagram, passage: Passage) -> Iterable[Datagram]:
        """The datagram as it was detected."""
        gains = repeat(np.ones(1, dtype=np.complex64))
        data, wrong = transmit(self.modulation, datagram.data, gains, self.ebn0_db, passage.rng(datagram))
        if not wrong:
            return [datagram]
        passage.note(datagram, wrong, "bits")
        return [datagram.damaged(data)]
