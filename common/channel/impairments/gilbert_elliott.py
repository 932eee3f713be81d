"""Loss in bursts: the Gilbert-Elliott model with four parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from pydantic import Field

from common.channel.datagram import Datagram
from common.channel.impairment import Impairment, Probability
from common.channel.passage import Passage, Purpose
from common.surface import BoolArray, FloatArray, IntArray

BLOCK = 4096
"""Steps of the chain drawn at once."""

START = 2**32
"""A block that no packet is in: its first number draws the state the chain starts from."""


class GilbertElliott(Impairment):
    """A link that is good or bad: a Markov chain with one step a datagram, and a chance of loss in each state.

    In a good state a packet arrives with probability `k`, in a bad one with `h`; before each packet a good state turns
    bad with probability `p` and a bad one good with `r`. The chain starts in its stationary distribution, bad with
    probability p / (p + r); so the loss is (1 - k) r / (p + r) + (1 - h) p / (p + r), and with k = 1, h = 0 a burst of
    losses is 1 / r packets long on average. (`tc netem loss gemodel p r 1-h 1-k` is the same.)

    The chain runs over the packets' numbers, not over the call, and is the same for every part of a transmission.

    Source: Elliott, "Estimates of error rates for codes on burst-noise channels", Bell System Technical Journal 42 (5),
    1963; the notation is that of Hasslinger and Hohlfeld, "The Gilbert-Elliott model for packet loss in real time
    services on the Internet", MMB 2008.
    """

    kind: Literal["gilbert_elliott"] = "gilbert_elliott"
    p: Probability = Field(description="probability of turning from good to bad, per packet, 0 to 1")
    r: Probability = Field(description="probability of turning from bad to good, per packet, 0 to 1")
    k: Probability = Field(1.0, description="probability that a packet arrives in the good state, 0 to 1")
    h: Probability = Field(0.0, description="probability that a packet arrives in the bad state, 0 to 1")

    @property
    def acts(self) -> bool:
        """Whether a packet is ever lost, in a state that is ever reached."""
        bad = self._stationary
        return super().acts and (1 - bad) * (1 - self.k) + bad * (1 - self.h) > 0

    def apply(self, flight: list[Datagram], passage: Passage) -> list[Datagram]:
        """The datagrams that were not lost."""
        numbers = np.array([datagram.sent.number for datagram in flight], dtype=np.int64)
        return [
            datagram
            for datagram, bad in zip(flight, self._bad(numbers, passage), strict=True)
            if passage.spares(datagram, self.probability) or not self._lost(datagram, bad=bool(bad), passage=passage)
        ]

    def _lost(self, datagram: Datagram, *, bad: bool, passage: Passage) -> bool:
        lost = bool(passage.rng(datagram).random() >= (self.h if bad else self.k))
        if lost:
            passage.note(datagram)
        return lost

    def _bad(self, numbers: IntArray, passage: Passage) -> BoolArray:
        """Whether the state is bad at each of the `numbers`."""

        def uniforms(block: int) -> FloatArray:
            return passage.draws.generator(Purpose.CHAIN, block).random(BLOCK)

        bad = np.zeros(len(numbers), dtype=np.bool_)
        for block in np.unique(numbers // BLOCK).tolist():
            here = numbers // BLOCK == block
            bad[here] = self._states(block, uniforms)[numbers[here] % BLOCK]
        return bad

    @property
    def _stationary(self) -> float:
        """Probability that the chain starts bad."""
        return self.p / (self.p + self.r) if self.p + self.r > 0 else 0.0

    # One uniform number u moves the chain a step, from good to bad if u < p, from bad to bad if u < 1 - r. So u below
    # both p and 1 - r leads to bad and u above both to good, whatever was before: from there on the state is known
    # without the past, and it can be found at any packet by going back to the last such step. Between the two, the
    # state stays (p < 1 - r) or flips (p > 1 - r).

    def _decided(self, u: FloatArray) -> BoolArray:
        """Whether each step leads to one state from both."""
        return (u < min(self.p, 1 - self.r)) | (u >= max(self.p, 1 - self.r))

    def _states(self, block: int, uniforms: Callable[[int], FloatArray]) -> BoolArray:
        """Whether the state is bad at each step of a block."""
        u = uniforms(block)
        step = np.arange(BLOCK)
        last = np.maximum.accumulate(np.where(self._decided(u), step, -1))
        known = np.where(last >= 0, u[last] < self.p, self._entry(block, uniforms) if last[0] < 0 else False)
        if self.p > 1 - self.r:
            known ^= (step - last) % 2 == 1
        return known

    def _entry(self, block: int, uniforms: Callable[[int], FloatArray]) -> bool:
        """Whether the state is bad before the first step of a block."""
        flips, steps = self.p > 1 - self.r, 0
        for earlier in range(block - 1, -1, -1):
            u = uniforms(earlier)
            decided = np.flatnonzero(self._decided(u))
            if decided.size:
                steps += BLOCK - 1 - int(decided[-1])
                return bool(u[decided[-1]] < self.p) ^ (flips and steps % 2 == 1)
            steps += BLOCK
        start = bool(uniforms(START)[0] < self._stationary)
        return start ^ (flips and steps % 2 == 1)
