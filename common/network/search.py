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

RANKED = 150
"""Points that rank the candidates where there are more."""

CLIMBED = 600
"""Points on which spread and smoothing are settled where there are more."""

TRIALS = 14
"""Candidates that a search may factorise."""

_SMOOTHING_STEP = 10**0.5
_HALVINGS = 3


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
    few = samples.take(np.sort(order[:RANKED]))
    moves = _Moves(kernel=len(kinds) > 1, smoothing=len(smoothings) > 1)
    starts = _starts(average(few, kinds, spreads, smoothings, lambda share: tick(0.2 * share)).scored)
    if n > CLIMBED and not quick:
        some = samples.take(np.sort(order[:CLIMBED]))
        search = _Search(some, spreads, TRIALS, lambda share: tick(0.2 + 0.4 * share))
        starts = [search.climb(starts, moves).scored.best]
    budget = 1 if quick or n > CLIMBED else TRIALS
    return _Search(samples, spreads, budget, lambda share: tick(0.6 + 0.4 * share)).climb(starts, moves)


class _Search:
    """Candidates solved on all samples, at most `budget` of them."""

    def __init__(self, samples: Samples, spreads: FloatArray, budget: int, tick: Callable[[float], None]) -> None:
        self.samples, self.spreads, self.budget, self.tick = samples, spreads, budget, tick
        self.tried: dict[Candidate, tuple[float, float, float, Solution, float]] = {}

    def value(self, candidate: Candidate) -> float:
        """The score, infinite where the budget is spent."""
        if candidate not in self.tried:
            if len(self.tried) >= self.budget:
                return np.inf
            self.tried[candidate] = _solve(self.samples, candidate, self.spreads)
            self.tick(len(self.tried) / self.budget)
        return self.tried[candidate][0]

    def climb(self, starts: Sequence[Candidate], moves: _Moves) -> Fit:
        """From the best of the starts to better neighbours, ever closer ones; the average of all that were tried."""
        best = min(starts, key=self.value)
        for halvings in range(_HALVINGS):
            moved = True
            while moved:
                moved = False
                for move in moves.around(best, 0.5**halvings):
                    if self.value(move) < self.value(best):
                        best, moved = move, True
                        break
        candidates = list(self.tried)
        # Rounding may have asked for more smoothing than the candidate's.
        solved = [replace(c, smoothing=self.tried[c][4]) for c in candidates]
        scored = Scored(solved, *(np.array([self.tried[c][i] for c in candidates]) for i in range(3)))
        parts = [(c, share) for c, share in zip(candidates, scored.shares.tolist(), strict=True) if share]
        solutions = [self.tried[c][3].scaled(share) for c, share in parts]
        return combine(
            scored, [c.kernel(self.spreads) for c, _ in parts], solutions, self.spreads, self.samples.weights
        )


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


@dataclass(frozen=True)
class _Moves:
    """Neighbours of a candidate in what is not given."""

    kernel: bool
    smoothing: bool

    def around(self, candidate: Candidate, share: float) -> list[Candidate]:
        """Candidates one step away, the step a power `share` of the largest."""
        moves: list[Candidate] = []
        if self.kernel and candidate.family == "ladder":
            at = int(np.argmin(np.abs(np.subtract(ROUGHNESS, candidate.parameter))))
            near = [ROUGHNESS[i] for i in (at - 1, at + 1) if 0 <= i < len(ROUGHNESS)]
            moves += [
                replace(candidate, parameter=candidate.parameter + share * (roughness - candidate.parameter))
                for roughness in near
            ]
        elif self.kernel:
            step = LADDER_STEP**share
            moves += [replace(candidate, parameter=candidate.parameter * factor) for factor in (step, 1 / step)]
        if self.smoothing:
            step = _SMOOTHING_STEP**share
            moves += [replace(candidate, smoothing=candidate.smoothing * factor) for factor in (step, 1 / step)]
        return moves


def _solve(samples: Samples, candidate: Candidate, spreads: FloatArray) -> tuple[float, float, float, Solution, float]:
    """Score, signal variance, restricted nll, network and smoothing of one candidate on all samples."""
    smoothing = max(candidate.smoothing, rounding_floor(len(samples)))
    dense = Dense(candidate.kernel(spreads).gram(samples.X), samples.weights, smoothing)
    coefficients, bias = dense.solve(samples.y)
    restricted, variance = dense.restricted(samples, coefficients)
    residuals, spread = dense.leave_one_out(coefficients)
    own = np.mean(residuals**2 / spread[:, None])
    left_out = 0.5 * samples.y.shape[1] * float(len(samples) * np.log(own) + np.log(spread).sum())
    value = float(score(len(samples), np.array(restricted), np.array(left_out), np.array(dense.smoothing)))
    return value, variance, restricted, Solution(coefficients, bias, residuals, spread), dense.smoothing
