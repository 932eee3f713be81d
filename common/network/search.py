"""Many points: a sample of them ranks the candidates, a short search on all of them settles spread and smoothing.

Each candidate of the search costs one Cholesky factorisation and the inverse of its factor. The search goes by rounds:
a step to either side in spread (or roughness) and in smoothing, all on several cores at once, and some to where the
parabolas through them have their least values. Those that were tried are averaged, as they are for few points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree

from common.network.dense import Dense
from common.network.kernel import LADDER_STEP, mean_spacing, squared_distances, upper_sum_of_levels
from common.network.selection import (
    BEHIND,
    CALM,
    CLEAN,
    NOISY,
    ROUGHNESS,
    TINY,
    WORSE,
    Candidate,
    Family,
    Fit,
    Kind,
    Samples,
    Scored,
    Solution,
    are_ladders,
    average,
    believed,
    combine,
    left_out_nll,
    rounding_floor,
    score,
    twins,
)
from common.network.threads import parallel
from common.surface import FloatArray, IntArray

AVERAGED = 250
"""Points up to which candidates are decomposed."""

RANKED = 150
"""Points that rank the candidates where there are more."""

CLIMBED = 600
"""Points on which spread and smoothing are settled where there are more."""

NEIGHBOURHOODS = 8
"""Neighbourhoods that those points come from: as dense as all points are, or what is rough would pass for noise.

Where the few that ranked the candidates tell a smooth surface from its noise already, they come from anywhere.
"""

TRIALS = 12
"""Candidates that a search may factorise."""

AFFORDED = 1000
"""Points up to which a search on all of them may factorise so many; beyond, fewer by the cube of their number."""

FAR_BEHIND = 24.0
"""Score by which a family may lie behind where many more points are to come than those that ranked it."""

DROWNED = 0.3
"""Smoothing from which on the few that rank the candidates see hardly anything but noise."""

FEWER = 2
"""Neighbourhoods that are asked then."""

ROUND = 4
"""Candidates below which a search is not begun."""

FINALISTS = 2
"""Candidates that are solved on all points instead, side by side, and averaged."""

_SMOOTHING_STEP = 10**0.5
_LOG_STEP = float(np.log(_SMOOTHING_STEP))

STEPS = (1.0, 0.5)
"""Lengths of steps, the next where the last found the best no further off; as fine as the candidates of few points."""

PROMISED = 6.0
"""Score below which what a further round may gain is not worth its candidates: it would hardly change the average."""

AIMS = 2
"""Places tried where the parabolas have their least values: one leaves a core idle."""

LEVEL = 0.1
"""Difference in score below which there is nothing to be found on the way."""

FARTHEST = 2.0
"""Steps that a parabola may lead away."""

WORTHLESS = 8.0
"""Score that a place must be expected to lie behind, and it is not tried."""

MANY_WORSE = 1.1
"""`WORSE` where points are many: a mean of many squares is itself better known."""

KNOWN = 1e-6
"""Mean square of the leave-one-out residuals up to which no kernel is doubted."""

SMOOTH = 2.0
"""Mean spacings of the points beyond which a spread is wide."""


def fit(
    samples: Samples,
    kinds: Sequence[Kind],
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
    free = _Free(kernel=len(kinds) > 1, smoothing=len(smoothings) > 1)
    # Where points are many the reach of a ladder lies beyond what a prediction needs.
    endless = [kind for kind in kinds if kind.reach == np.inf]
    ranked = average(few, endless, spreads, smoothings, lambda share: tick(0.2 * share)).scored
    starts = _starts(ranked, BEHIND)
    fine = False
    if ranked.best.smoothing >= DROWNED and free.smoothing:
        # What is finer than the few are dense passes for noise among them, but not among points next to each other.
        close = samples.take(neighbourhoods(KDTree(samples.X), RANKED, FEWER))
        finer = average(close, endless, spreads, smoothings, lambda _share: None).scored
        fine = finer.best.smoothing < NOISY
        if fine:
            starts = [*_starts(finer, BEHIND), *starts]
    smoothest = max((kind.parameter for kind in kinds if kind.family == "ladder"), default=ROUGHNESS[-1])
    ladders = _ladders(ranked)
    if n > CLIMBED and not quick:
        anywhere = _is_smooth(starts[0], mean_spacing(few.X)) and not fine
        near = samples.take(np.sort(order[:CLIMBED]) if anywhere else neighbourhoods(KDTree(samples.X)))
        search = _Search(near, spreads, smoothest, TRIALS, lambda share: tick(0.2 + 0.2 * share))
        found = search.climb(starts, free, ladders)
        # The closer the points, the rougher a surface may look.
        rough = [start for start in _starts(ranked, FAR_BEHIND) if start.kind.family == "ladder"]
        if rough and not anywhere and found.scored.best.kind.family != "ladder":
            search.budget, search.done = search.budget + TRIALS, 0.0
            search.tick = lambda share: tick(0.4 + 0.2 * share)
            found = search.climb(rough, free)
        starts = _finalists(found.scored)
    budget = min(TRIALS, round(TRIALS * (AFFORDED / n) ** 3))
    if quick:
        budget, ladders = 1, []
    elif budget < ROUND:
        budget = len(starts)
    search = _Search(samples, spreads, smoothest, budget, lambda share: tick(0.6 + 0.4 * share))
    return search.climb(starts, free, ladders)


def neighbourhoods(tree: KDTree, many: int = CLIMBED, about: int = NEIGHBOURHOODS) -> IntArray:
    """So many rows of the tree's n points: the neighbourhoods of a few points, always the same."""
    order, size = np.random.default_rng(0).permutation(tree.n), many // about
    rows = tree.query(tree.data[order[:about]], k=size)[1]
    found = np.unique(rows)
    # Where neighbourhoods overlap the points that are missing come from anywhere.
    rest = order[~np.isin(order, found)]
    return np.sort(np.concatenate([found, rest[: many - len(found)]]))


class _Search:
    """Candidates solved on all samples, at most `budget` of them, ladders up to the `smoothest`."""

    def __init__(
        self, samples: Samples, spreads: FloatArray, smoothest: float, budget: int, tick: Callable[[float], None]
    ) -> None:
        self.samples, self.spreads, self.budget, self.tick = samples, spreads, budget, tick
        self.last = float(np.interp(smoothest, ROUGHNESS, np.arange(len(ROUGHNESS))))
        self.r2 = squared_distances(samples.X)
        self.twins = twins(samples.X)
        self.lowest = round(float(np.log(rounding_floor(len(samples))) / _LOG_STEP), 6)
        self.tried: dict[_Place, _Trial] = {}
        self.rooms: list[FloatArray] = []
        self.done = 0.0

    def scores(self, places: Sequence[_Place]) -> dict[_Place, float]:
        """Of each place, infinite where the budget is spent."""
        fresh = [place for place in dict.fromkeys(places) if place not in self.tried]
        fresh = fresh[: self.budget - len(self.tried)]
        found = parallel(self._solved, fresh)
        self.tried |= zip(fresh, found, strict=True)
        # A budget may grow on the way.
        self.done = max(self.done, len(self.tried) / self.budget)
        self.tick(self.done)
        return {place: self.tried[place].score if place in self.tried else np.inf for place in places}

    def _solved(self, place: _Place) -> _Trial:
        """One candidate on all samples."""
        samples, n, candidate = self.samples, len(self.samples), place.candidate
        try:
            room = self.rooms.pop()
        except IndexError:
            room = np.empty((2, n, n))
        kernel = candidate.kind.kernel(self.spreads)
        upper_sum_of_levels(self.r2, kernel.spreads, kernel.amplitudes, room[0])
        dense = Dense(room[0], samples.weights, candidate.smoothing, room[1])
        coefficients, bias = dense.solve(samples.y)
        restricted, variance = dense.restricted(samples, coefficients)
        (residuals, spread), (apart, variances) = dense.left_out(coefficients, *self.twins)
        self.rooms.append(room)
        own = np.maximum(np.mean(apart**2 / variances[:, None]), TINY)
        nll = left_out_nll(n, samples.y.shape[1], own, np.log(variances).sum())
        value = float(score(n, nll, np.array(dense.smoothing)))
        square = float(np.mean(apart**2))
        solution = Solution(coefficients, bias, residuals, spread)
        return _Trial(value, square, variance, restricted, solution, dense.smoothing)

    def climb(self, starts: Sequence[Candidate], free: _Free, ladders: Sequence[Candidate] = ()) -> Fit:
        """The average of all that were tried on the way from the best of the starts to the best there is.

        Where that leaves more at the points, each without itself, than noise can, the ladders are tried, too, and the
        way from the one that is believed more.
        """
        self._climb(starts, free)
        trial = self.tried[self._best()]
        unknown = trial.square > max(KNOWN, WORSE * trial.smoothing * trial.variance)
        if unknown and not any(place.family == "ladder" for place in self.tried):
            places = {self._moved(_Place.of(ladder), 1, 0.0): ladder for ladder in ladders}
            budget, self.budget = self.budget, len(self.tried) + len(places)
            self.scores(list(places))
            best = self._best()
            if best in places:
                self.budget += budget
                self._climb([places[best]], free)
        return self._averaged()

    def _climb(self, starts: Sequence[Candidate], free: _Free) -> None:
        """From the best of the starts to better neighbours, ever closer ones."""
        places = [self._moved(_Place.of(start), 1, 0.0) for start in starts]
        if free.smoothing and starts[0].smoothing < CLEAN and self.budget > len(starts):
            places = list(dict.fromkeys([places[0], self._moved(places[0], 1, -np.inf), *places[1:]]))
        best = places[0] if len(places) == 1 else _least(self.scores(places))
        axes = [axis for axis, is_free in enumerate((free.kernel, free.smoothing)) if is_free]
        for step in STEPS:
            near, promised = False, np.inf
            while not near and len(self.tried) < self.budget:
                before, (best, axes, promised) = best, self._round(best, step, axes)
                near = best.within(before, step)
            if promised < PROMISED:
                break

    def _round(self, middle: _Place, step: float, axes: Sequence[int]) -> tuple[_Place, list[int], float]:
        """The best place about the middle, the axes that are not done with, and what half as long a step may gain.

        Parabolas tell. An axis is done with where the middle lies at its end and the way from there is steep.
        """
        sides = {axis: [self._moved(middle, axis, side * step) for side in (-1, 1)] for axis in axes}
        found = self.scores([middle, *(place for pair in sides.values() for place in pair)])
        here = found[middle]
        hopes, going, gain = {middle: here}, list(axes), 0.0
        # On a lattice the next round finds some of its candidates tried already.
        far = round(FARTHEST * step / STEPS[-1])
        for axis, pair in sides.items():
            left, right = (found[place] - here for place in pair)
            if not np.isfinite(left + right) or max(abs(left), abs(right)) < LEVEL:
                continue
            if middle in pair and (left + right) * STEPS[-1] / step > WORTHLESS:
                going.remove(axis)
                continue
            gain += max(left + right, 0.0) / 8
            aims = {}
            for place, hope in hopes.items():
                for k in range(-far, far + 1):
                    aim = self._moved(place, axis, k * STEPS[-1])
                    way = (aim.at[axis] - middle.at[axis]) / step
                    aims[aim] = hope + (right - left) / 2 * way + (left + right) / 2 * way**2
            hopes = aims
        new = sorted((hope, place.at, place) for place, hope in hopes.items() if place not in self.tried)
        worth = min(found.values()) + WORTHLESS
        found |= self.scores([place for hope, _, place in new[:AIMS] if hope < worth])
        return _least(found), going, gain

    def _moved(self, place: _Place, axis: int, steps: float) -> _Place:
        """The place so many steps along the axis, within what a kernel can be and above the rounding floor."""
        at = list(place.at)
        at[axis] = round(at[axis] + steps, 6)
        if place.family == "ladder":
            at[0] = min(max(at[0], 0.0), self.last)
        return _Place(place.family, (at[0], max(at[1], self.lowest)))

    def _scored(self) -> Scored:
        """All that were tried."""
        places = list(self.tried)
        # Rounding may have asked for more smoothing than the candidate's.
        candidates = [place.candidate._replace(smoothing=self.tried[place].smoothing) for place in places]
        scores, squares, *others = (np.array([self.tried[place][i] for place in places]) for i in range(4))
        ladders = are_ladders([candidate.kind for candidate in candidates])
        return Scored(candidates, believed(scores, squares, ladders, MANY_WORSE), *others)

    def _best(self) -> _Place:
        return list(self.tried)[self._scored().least]

    def _averaged(self) -> Fit:
        scored = self._scored()
        parts = [(p, share) for p, share in zip(self.tried, scored.shares.tolist(), strict=True) if share]
        solutions = [self.tried[p].solution.scaled(share) for p, share in parts]
        kernels = [p.candidate.kind.kernel(self.spreads) for p, _ in parts]
        alone = list(self.tried.values())[scored.least].solution.spread
        return combine(scored, alone, kernels, solutions, self.spreads, self.samples.weights)


class _Trial(NamedTuple):
    """What `Scored` has of a candidate, its network, and the smoothing that rounding allowed."""

    score: float
    square: float
    variance: float
    restricted: float
    solution: Solution
    smoothing: float


def _least(scores: dict[_Place, float]) -> _Place:
    return min(scores, key=lambda place: scores[place])


def _is_smooth(candidate: Candidate, spacing: float) -> bool:
    """Whether it is a wide kernel for noisy points of a smooth surface."""
    family, parameter, _ = candidate.kind
    return family != "ladder" and parameter > SMOOTH * spacing and candidate.smoothing >= CLEAN


def _finalists(scored: Scored) -> list[Candidate]:
    """The best candidate, and the best of another family or, where that is far behind, the second best."""
    ordered = [scored.candidates[i] for i in np.argsort(scored.scores, kind="stable")]
    others = [candidate for candidate in _starts(scored, FAR_BEHIND) if candidate.kind.family != ordered[0].kind.family]
    return [ordered[0], *others, *ordered[1:]][:FINALISTS]


def _ladders(ranked: Scored) -> list[Candidate]:
    """The best ladder, and the best calm one, if that is another: it errs least where hardly any points are."""
    ordered = [ranked.candidates[i] for i in np.argsort(ranked.scores, kind="stable")]
    ladders = [candidate for candidate in ordered if candidate.kind.family == "ladder"]
    calm = [candidate for candidate in ladders if candidate.kind.parameter <= CALM]
    return list(dict.fromkeys([*ladders[:1], *calm[:1]]))


def _starts(ranked: Scored, behind: float) -> list[Candidate]:
    """The best of each family that is no further behind, best first, with less smoothing where the least was best."""
    best: dict[Family, tuple[float, Candidate]] = {}
    for candidate, value in zip(ranked.candidates, ranked.scores.tolist(), strict=True):
        family = candidate.kind.family
        if family not in best or value < best[family][0]:
            best[family] = (value, candidate)
    ordered = sorted(best.values(), key=lambda pair: pair[0])
    least = min(candidate.smoothing for candidate in ranked.candidates)
    return [
        candidate._replace(smoothing=TINY) if candidate.smoothing == least < CLEAN else candidate
        for value, candidate in ordered
        if value - ordered[0][0] < behind
    ]


@dataclass(frozen=True)
class _Free:
    """What is not given."""

    kernel: bool
    smoothing: bool


@dataclass(frozen=True)
class _Place:
    """A candidate as a place in the plane of kernel and smoothing, in steps of the search.

    Coordinates are rounded, so that a way back ends where it began.
    """

    family: Family
    at: tuple[float, float]

    @classmethod
    def of(cls, candidate: Candidate) -> _Place:
        """The place of a candidate."""
        kind = candidate.kind
        if kind.family == "ladder":
            kernel = float(np.interp(kind.parameter, ROUGHNESS, np.arange(len(ROUGHNESS))))
        else:
            kernel = float(np.log(kind.parameter) / np.log(LADDER_STEP))
        return cls(kind.family, (round(kernel, 6), round(float(np.log(candidate.smoothing) / _LOG_STEP), 6)))

    @property
    def candidate(self) -> Candidate:
        """The candidate at the place."""
        kernel, smoothing = self.at
        if self.family == "ladder":
            parameter = float(np.interp(kernel, np.arange(len(ROUGHNESS)), ROUGHNESS))
        else:
            parameter = LADDER_STEP**kernel
        return Candidate(Kind(self.family, parameter), _SMOOTHING_STEP**smoothing)

    def within(self, other: _Place, steps: float) -> bool:
        """Whether the other place is no further off than so many steps on either axis."""
        return max(abs(a - b) for a, b in zip(self.at, other.at, strict=True)) <= steps
