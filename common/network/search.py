"""Many points: a sample of them ranks the candidates, a short search on all of them settles spread and smoothing.

Each candidate of the search costs one Cholesky factorisation and its inverse. Those that were tried are averaged, as
they are for few points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from common.network.dense import Dense
from common.network.kernel import LADDER_STEP
from common.network.selection import (
    ROUGHNESS,
    Candidate,
    Family,
    Fit,
    Samples,
    Scored,
    Solution,
    average,
    combine,
    rounding_floor,
    score,
)
from common.surface import FloatArray

AVERAGED = 250
"""Points up to which every candidate is decomposed."""

CLIMBED = 1000
"""Points on which spread and smoothing are settled; all points then only have the last word."""

_SMOOTHING_STEP = 10**0.5


def fit(
    samples: Samples,
    kinds: Sequence[tuple[Family, float]],
    spreads: FloatArray,
    smoothings: FloatArray,
    tick: Callable[[float], None],
    *,
    quick: bool = False,
) -> Fit:
    """The averaged network of any number of points that a dense matrix can hold.

    A `quick` one takes the word of the sample for spread and smoothing.
    """
    n = len(samples)
    if n <= AVERAGED:
        return average(samples, kinds, spreads, smoothings, tick)
    order = np.random.default_rng(0).permutation(n)
    few = samples.take(np.sort(order[:AVERAGED]))
    starts = _starts(average(few, kinds, spreads, smoothings, lambda share: tick(0.2 * share)).scored)
    if len(kinds) == len(smoothings) == 1:
        return _Search(samples, spreads, 1, tick).climb(starts[:1], _no_moves)
    moves = _Moves(kernel=len(kinds) > 1, smoothing=len(smoothings) > 1)
    if quick:
        return _Search(samples, spreads, 1, tick).climb(starts[:1], _no_moves)
    if n > CLIMBED:
        some = samples.take(np.sort(order[:CLIMBED]))
        starts = [_Search(some, spreads, 10, lambda share: tick(0.2 + 0.4 * share)).climb(starts, moves).scored.best]
    budget = 10 if n <= CLIMBED else 3 if n <= 2500 else 1
    return _Search(samples, spreads, budget, lambda share: tick(0.6 + 0.4 * share)).climb(starts, moves)


class _Search:
    """Candidates solved on all samples, at most `budget` of them."""

    def __init__(self, samples: Samples, spreads: FloatArray, budget: int, tick: Callable[[float], None]) -> None:
        self.samples, self.spreads, self.budget, self.tick = samples, spreads, budget, tick
        self.tried: dict[Candidate, tuple[float, float, float, Solution]] = {}

    def value(self, candidate: Candidate) -> float:
        """The score, infinite where the budget is spent."""
        if candidate not in self.tried:
            if len(self.tried) >= self.budget:
                return np.inf
            self.tried[candidate] = _solve(self.samples, candidate, self.spreads)
            self.tick(len(self.tried) / self.budget)
        return self.tried[candidate][0]

    def climb(self, starts: Sequence[Candidate], moves: Callable[[Candidate], list[Candidate]]) -> Fit:
        """From the best of the starts to better neighbours; the average of all that were tried."""
        best = min(starts, key=self.value)
        moved = True
        while moved and len(self.tried) < self.budget:
            moved = False
            for move in moves(best):
                if self.value(move) < self.value(best):
                    best, moved = move, True
        candidates = list(self.tried)
        scored = Scored(candidates, *(np.array([self.tried[c][i] for c in candidates]) for i in range(3)))
        parts = [(c, share) for c, share in zip(candidates, scored.shares.tolist(), strict=True) if share]
        solutions = [self.tried[c][3].scaled(share) for c, share in parts]
        return combine(scored, [c.kernel(self.spreads) for c, _ in parts], solutions, self.spreads)


def _starts(ranked: Scored) -> list[Candidate]:
    """The best of each family that is not far behind, best first."""
    best: dict[Family, tuple[float, Candidate]] = {}
    for candidate, value in zip(ranked.candidates, ranked.scores.tolist(), strict=True):
        if candidate.family not in best or value < best[candidate.family][0]:
            best[candidate.family] = (value, candidate)
    ordered = sorted(best.values(), key=lambda pair: pair[0])
    return [candidate for value, candidate in ordered if value - ordered[0][0] < _BEHIND]


_BEHIND = 8.0
"""Score by which a family may lie behind in the sample and still be tried on more points."""


def _no_moves(candidate: Candidate) -> list[Candidate]:  # noqa: ARG001
    return []


@dataclass(frozen=True)
class _Moves:
    """Neighbours of a candidate in what is not given."""

    kernel: bool
    smoothing: bool

    def __call__(self, candidate: Candidate) -> list[Candidate]:
        moves: list[Candidate] = []
        if self.smoothing:
            steps = (1 / _SMOOTHING_STEP, _SMOOTHING_STEP)
            moves += [replace(candidate, smoothing=candidate.smoothing * step) for step in steps]
        if self.kernel and candidate.family == "ladder":
            at = int(np.argmin(np.abs(np.subtract(ROUGHNESS, candidate.parameter))))
            near = [ROUGHNESS[i] for i in (at - 1, at + 1) if 0 <= i < len(ROUGHNESS)]
            moves += [replace(candidate, parameter=roughness) for roughness in near]
        elif self.kernel:
            steps = (LADDER_STEP, 1 / LADDER_STEP)
            moves += [replace(candidate, parameter=candidate.parameter * step) for step in steps]
        return moves


def _solve(samples: Samples, candidate: Candidate, spreads: FloatArray) -> tuple[float, float, float, Solution]:
    """Score, signal variance, restricted nll and network of one candidate on all samples."""
    smoothing = max(candidate.smoothing, rounding_floor(len(samples)))
    dense = Dense(candidate.kernel(spreads).gram(samples.X), samples.weights, smoothing)
    coefficients, bias = dense.solve(samples.y)
    restricted, variance = dense.restricted(samples, coefficients)
    residuals, spread = dense.leave_one_out(coefficients)
    own = np.mean(residuals**2 / spread[:, None])
    left_out = 0.5 * samples.y.shape[1] * float(len(samples) * np.log(own) + np.log(spread).sum())
    value = float(score(np.array(restricted), np.array(left_out), np.array(dense.smoothing)))
    return value, variance, restricted, Solution(coefficients, bias, residuals, spread)
