"""Wrong points: found by what the network says without them, set aside where that explains the rest better.

A point is suspected where its leave-one-out residual is far off the others', in the deviations that the residuals
should have. The network is fitted again without the suspects; points that the new network agrees with come back. A
closer look then finds wrong points that hide behind the residuals that they cause around them; it is believed where the
network without them knows the others far better. In the end the two readings are compared by their likelihood: all
points belong to the surface, or the suspects are drawn from anywhere within twice the range of the values. So a peak,
which is far off but well explained, stays. Wrong points know nothing of each other: where more neighbours of a suspect
are far off on the same side than chance allows, they are an island, or the edge of a cliff, and none of them is wrong.
Where many points all lie on plains with clean edges between them none is asked for. Where many points may be wrong
`common.network.contamination` is asked first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.special import bdtrc

from common.network import contamination, evaluation
from common.network.contamination import MOST, NORMAL_MEDIAN, NORMAL_UPPER
from common.network.dense import Dense
from common.network.partition import Partition
from common.network.search import CLIMBED, neighbourhoods
from common.network.selection import NOISY, Fit, Samples
from common.surface import BoolArray, FloatArray, IntArray

FEWEST = 10
"""Points below which none is suspected: so few do not tell what is usual among them."""

SUSPECT = 8.0
"""Robust deviations beyond which a point is suspected: smaller errors do little harm, and are found in real terrain."""

SHARE = 0.01
"""Expected share of wrong points, in the comparison of the two readings."""

FEW = 0.3
"""Greatest share of the points that is set aside as few wrong ones."""

HARMLESS = 0.02
"""Residuals below this share of the values' deviation are never suspected."""

TELLING = 0.5
"""What a closer look finds is believed where the others' residuals become less than this share of what they were."""

PATIENCE = 2
"""Rounds of a closer look without that."""

TRIALS = 4
"""Fits that ask which small finds of a closer look may come back: one for each point, or for each group of many."""

ROUNDS = 10

GLANCE = 5000
"""Points looked at first: where none of them is suspect, the others are not looked at."""

UNEVEN = 5.0
"""Kurtosis of what values are off their neighbours, 3 to 4 for noise on a surface, from which a network is asked."""

APART = 4.0
"""Robust deviations from the neighbours beyond which the first network goes without a point."""

WORST = 3.0
"""Robust deviations beyond which the worst point of all is tried without."""

TAIL, TAIL_DEVIATIONS = 0.995, 2.81
"""A quantile far out, and where it is for normal residuals."""

NEIGHBOURS = 12
"""Nearest points that a value of many is compared with."""

CHANCE = 0.01
"""Probability that any wrong value of all is taken for company of those around it."""


class Cleaned(NamedTuple):
    """The samples that are kept, with weights, their fit, and the rows of the others."""

    samples: Samples
    fit: Fit
    outliers: IntArray


def set_aside(samples: Samples, fit: Fit, refit: Callable[[Samples, bool], Fit]) -> Cleaned:
    """The samples without the wrong points; the given ones and their fit where there are none."""
    n = len(samples)
    whole = Cleaned(samples, fit, np.zeros(0, dtype=np.int64))
    if n < FEWEST:
        return whole
    near = _near(tree_of(samples.X), np.arange(n))
    # Fewer points do not tell an edge from wrong points beside it so well, and their fits cost little.
    if n > CLIMBED and _flat(samples.y, near):
        return whole
    many = _many(samples, fit, refit, near) if contamination.suspected(fit) else None
    if many is not None and many.noisy:
        many = _with_returned(many, samples, refit)
        part = many.of(samples)
        return Cleaned(part, refit(part, False), many.outliers)
    if many is not None:
        out = _out(samples, many.kept, refit, near, many=True)
    else:
        kept = _kept(fit.residuals, fit.deviations)
        if kept.all() and not _far_off(samples.y, near).any():
            return whole
        # Wrong points hide one another from a network that was fitted to them, but not from their neighbours.
        out = _out(samples, kept & ~_far_off(samples.y, near, APART), refit, near, many=False)
    if not len(out):
        return whole
    part = samples.without(out)
    clean = refit(part, False)
    cost = np.log(2 * np.ptp(samples.y, axis=0)).sum() + np.log((1 - SHARE) / SHARE)
    if _likelihood(clean) + len(out) * cost >= _likelihood(fit):
        return whole
    return Cleaned(part, clean, out)


class Many(NamedTuple):
    """Weights of the points, which of them are kept, and whether these are noisy still."""

    weights: FloatArray
    kept: BoolArray
    noisy: bool

    @property
    def outliers(self) -> IntArray:
        """Rows of the points that are not kept."""
        return np.flatnonzero(~self.kept)

    def of(self, samples: Samples) -> Samples:
        """Those that are kept, with their weights where they are noisy."""
        weights = samples.weights * self.weights if self.noisy else samples.weights
        return replace(samples, weights=weights).without(self.outliers)


def _many(samples: Samples, fit: Fit, refit: Callable[[Samples, bool], Fit], near: IntArray) -> Many | None:
    """What a network that counts the points by how far off they are says of them, where that is believed."""
    last = fit

    def residuals(weights: FloatArray) -> FloatArray:
        nonlocal last
        last = refit(replace(samples, weights=samples.weights * weights), True)
        return last.residuals

    found = contamination.reweighted(fit.residuals, residuals)
    if not contamination.is_believed(fit.residuals, found, samples.y, near, HARMLESS):
        return None
    return _judged(found, near, last.smoothing >= NOISY)


def _judged(found: contamination.Reweighted, near: IntArray, noisy: bool) -> Many:
    kept = found.sizes <= SUSPECT * found.usual
    return Many(found.weights, kept | _company(found.residuals, ~kept, near), noisy)


def _with_returned(many: Many, samples: Samples, refit: Callable[[Samples, bool], Fit]) -> Many:
    """The same with points that are far off only as points at their places are, in a corner or alone."""
    rows, out = np.flatnonzero(many.kept), many.outliers
    residuals, deviations = _everywhere(samples, rows, refit(many.of(samples), True))
    ratios = np.max(np.abs(residuals), axis=1) / deviations
    usual = _usual(ratios[rows])
    back = out[ratios[out] <= SUSPECT * usual]
    weights, kept = many.weights.copy(), many.kept.copy()
    weights[back], kept[back] = contamination.weights_of(ratios[back], usual), True
    return Many(weights, kept, many.noisy)


def _out(
    samples: Samples, kept: BoolArray, refit: Callable[[Samples, bool], Fit], near: IntArray, *, many: bool
) -> IntArray:
    """Rows of the wrong points, from those `kept` at first; what is usual is asked of these where others are `many`."""
    n, most = len(samples), MOST if many else FEW
    seen = _look(samples, kept, refit)
    for _ in range(ROUNDS):
        agreed = _kept(*seen, kept, harmless=0.0) if many else _kept(*seen)
        agreed |= _company(seen[0], ~agreed, near)
        # While wrong points are left the network is not to be asked which ones may come back.
        left = kept & agreed
        if np.array_equal(left, kept) or np.count_nonzero(~left) > most * n:
            break
        kept, seen = left, _look(samples, left, refit)
    first = np.ones(n, dtype=bool) if many else kept
    closer, beyond, doubts = kept, seen, 0
    while doubts < PATIENCE:
        left = closer & ~_worst(*beyond, closer, near)
        if np.array_equal(left, closer) or np.count_nonzero(~left) > most * n:
            break
        closer, beyond = left, _look(samples, left, refit)
        doubts += 1
        if np.median(np.abs(beyond[0][closer])) < TELLING * np.median(np.abs(seen[0][kept])):
            kept, seen, doubts = closer, beyond, 0
            agreed = _kept(*seen, kept, harmless=0.0)
    small = np.flatnonzero(first & ~kept & ~agreed & (np.max(np.abs(seen[0]), axis=1) <= HARMLESS))
    small = small[np.argsort(np.abs(seen[0][small]).max(axis=1) / seen[1][small])]
    for rows in filter(len, np.array_split(small, TRIALS)):
        # A point where the surface is steepest may be far off without being wrong: the others do not suffer from it.
        more = kept.copy()
        more[rows] = True
        if TELLING * np.median(np.abs(_look(samples, more, refit)[0][more])) < np.median(np.abs(seen[0][kept])):
            agreed[rows] = True
    agreed |= _within_tail(*seen, kept)
    company = _company(seen[0], ~agreed, near)
    if company.any() and not many:
        # What was far off from the surface without them may be not with them.
        kept = kept | agreed | company
        seen = _look(samples, kept, refit)
        agreed = _kept(*seen) | _within_tail(*seen, kept)
    return np.flatnonzero(~(kept | agreed))


def screen(tree: KDTree, y: FloatArray) -> IntArray:
    """Rows of the tree's n points whose values (n, k) are far off those of their neighbours; for many points.

    Far off is measured by the neighbours' own scatter and by what is usual everywhere. No network is fitted.
    """
    some = np.random.default_rng(0).permutation(tree.n)[:GLANCE]
    if not _far_off(y, _near(tree, some)).any():
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(_far_off(y, _near(tree, np.arange(tree.n))))


def tree_of(X: FloatArray) -> KDTree:
    """What finds the neighbours of points (n, d)."""
    return KDTree(X, balanced_tree=False, compact_nodes=False)


def _near(tree: KDTree, asked: IntArray) -> IntArray:
    """The rows `asked` (m,), and their nearest neighbours beside them, shape (m, 1 + k)."""
    workers = -1 if len(asked) > GLANCE else 1
    rows = np.asarray(tree.query(tree.data[asked], k=min(NEIGHBOURS + 1, tree.n), workers=workers)[1])
    return np.column_stack([asked, rows[:, 1:]])


def _far_off(y: FloatArray, near: IntArray, deviations: float = SUSPECT) -> BoolArray:
    """Which of the rows that `near` (m, 1 + k) begins with have values far off those of the neighbours, shape (m,)."""
    found = np.zeros(len(near), dtype=bool)
    for values in y.T:
        around, column = values[near[:, 1:]], values[near[:, 0]]
        middle = np.median(around, axis=1)
        scatter = np.median(np.abs(around - middle[:, None]), axis=1) / NORMAL_MEDIAN
        away = np.abs(column - middle)
        typical = np.quantile(away, 0.9) / NORMAL_UPPER
        suspect = (away > deviations * np.maximum(scatter, typical)) & (away > HARMLESS * values.std())
        if deviations >= SUSPECT:
            # What is less far off may have slopes for company.
            share = float(suspect.mean())
            suspect[suspect] = ~_together((column - middle)[suspect], (around - middle[:, None])[suspect], share)
        found |= suspect
    return found


def _flat(y: FloatArray, near: IntArray) -> bool:
    """Whether the values (n, k) are those of plains; `near` (n, 1 + m), the points themselves first.

    Points are of one plain where one is near the other and has its value; a few wrong ones of one height are none. No
    network tells a clean edge from wrong points without many fits: far from it the others are told exactly.
    """
    n = len(near)
    rows, columns = np.nonzero(np.all(np.abs(y[near[:, 1:]] - y[near[:, :1]]) <= contamination.ROUNDING, axis=2))
    links = coo_array((np.ones(len(rows)), (rows, near[rows, 1 + columns])), shape=(n, n))
    return bool(np.bincount(connected_components(links, directed=False)[1]).min() > NEIGHBOURS)


def _together(away: FloatArray, around: FloatArray, share: float) -> BoolArray:
    """Whether values so far off (m,) are so together with those around them (m, k), the share of such values given.

    A wrong value has another for company with half their share for a probability.
    """
    same = contamination.company(away, around)
    return np.asarray(bdtrc(same - 1, around.shape[1], 0.5 * share) * len(away) < CHANCE)


def weighed(
    samples: Samples, tree: KDTree, refit: Callable[[Samples, bool], Fit], fit: Callable[[Samples], Partition]
) -> Many | None:
    """The same as `set_aside` asks first, of so many points that `fit` cuts them; None where few or none are wrong.

    Some of the samples tell whether many are wrong, then the halves of all tell of each other which.
    """
    n = len(samples)
    near = _near(tree, np.random.default_rng(0).permutation(n)[:GLANCE])
    if not contamination.heavy(samples.y[near[:, 0]] - np.median(samples.y[near[:, 1:]], axis=1), UNEVEN):
        return None
    part = samples.take(neighbourhoods(tree))
    first = refit(part, True)
    if not contamination.suspected(first):
        return None
    believed = _many(part, first, refit, _near(tree_of(part.X), np.arange(len(part))))
    if believed is None:
        return None
    near = _near(tree, np.arange(n))
    found = contamination.reweighted(
        samples.y - np.median(samples.y[near[:, 1:]], axis=1),
        lambda weights: _crosswise(replace(samples, weights=samples.weights * weights), fit),
    )
    many = _judged(found, near, believed.noisy)
    return many if len(many.outliers) <= MOST * n else None


def _crosswise(samples: Samples, fit: Callable[[Samples], Partition]) -> FloatArray:
    """Values less what a network of the other half of the samples says, shape (n, k)."""
    order = np.random.default_rng(0).permutation(len(samples))
    half = len(order) // 2
    residuals = np.empty_like(samples.y)
    for fitted, asked in ((order[:half], order[half:]), (order[half:], order[:half])):
        residuals[asked] = samples.y[asked] - fit(samples.take(np.sort(fitted))).predict(samples.X[asked])
    return residuals


def cross_checked(samples: Samples, fit: Callable[[Samples], Partition]) -> IntArray:
    """Rows whose values are far off what a network of the other half of the samples says."""
    residuals = _crosswise(samples, fit)
    suspect = ~_kept(residuals, np.ones(len(samples)))
    if suspect.any():
        suspect &= ~_company(residuals, suspect, _near(tree_of(samples.X), np.arange(len(samples))))
    return np.flatnonzero(suspect)


def agreeing(network: Partition, samples: Samples, rows: IntArray) -> BoolArray:
    """Whether the values at `rows` agree with a network that was fitted without them, shape (len(rows),)."""
    away = np.abs(samples.y[rows] - network.predict(samples.X[rows]))
    kept = np.setdiff1d(np.arange(len(samples)), rows)
    probes = kept[:: max(1, len(kept) // 10_000)]
    noise = np.quantile(np.abs(samples.y[probes] - network.predict(samples.X[probes])), 0.9, axis=0) / NORMAL_UPPER
    return np.asarray(np.all(away <= SUSPECT * np.hypot(network.predict_std(samples.X[rows]), noise), axis=1))


def _kept(
    residuals: FloatArray, deviations: FloatArray, usual: BoolArray | None = None, harmless: float = HARMLESS
) -> BoolArray:
    """Which points are not suspected, by what is typical of the `usual` points, by default of all."""
    largest = np.max(np.abs(residuals), axis=1)
    ratios = largest / deviations
    typical = _usual(ratios if usual is None else ratios[usual])
    return np.asarray((ratios <= SUSPECT * typical) | (largest <= harmless))


def _usual(sizes: FloatArray) -> float:
    """Deviation that is usual among errors of these sizes (n,): the greater of what their median and decile say.

    The upper decile keeps the heavy tails of real terrain from being suspected.
    """
    return max(float(np.median(sizes)) / NORMAL_MEDIAN, float(np.quantile(sizes, 0.9)) / NORMAL_UPPER)


def _within_tail(residuals: FloatArray, deviations: FloatArray, kept: BoolArray) -> BoolArray:
    """Points no further off than the tail of those that are kept makes likely.

    Edges leave a few large residuals among many small ones, and more of the kind are no errors. Of normal residuals the
    tail says the same as the middle.
    """
    ratios = np.max(np.abs(residuals), axis=1) / deviations
    return np.asarray(ratios <= SUSPECT * np.quantile(ratios[kept], TAIL) / TAIL_DEVIATIONS)


def _company(residuals: FloatArray, suspect: BoolArray, near: IntArray) -> BoolArray:
    """Which suspects' residuals are `_together` with those around them; `near` (n, 1 + m), themselves first."""
    rows = np.flatnonzero(suspect)
    found = np.zeros_like(suspect)
    found[rows] = _together(*contamination.beside(residuals, rows, near), len(rows) / len(suspect))
    return found


def _worst(residuals: FloatArray, deviations: FloatArray, kept: BoolArray, near: IntArray) -> BoolArray:
    """Points far off by the median of all that are kept, each the worst of its neighbourhood `near` (n, k).

    A wrong point spoils the residuals around it, and with them the upper quantile; they are no reason to suspect those.
    The worst of all is tried where it is less far off: among few points it spoils the median, too.
    """
    ratios = np.where(kept, np.max(np.abs(residuals), axis=1) / deviations, 0.0)
    typical = np.median(ratios[kept]) / NORMAL_MEDIAN
    far = (ratios > SUSPECT * typical) & (ratios >= ratios[near].max(axis=1))
    return np.asarray(far | ((ratios == ratios.max()) & (ratios > WORST * typical)))


def _look(samples: Samples, kept: BoolArray, refit: Callable[[Samples, bool], Fit]) -> tuple[FloatArray, FloatArray]:
    """Residuals (n, k) and their deviations (n,) at all points, by a network of those that are kept."""
    rows = np.flatnonzero(kept)
    return _everywhere(samples, rows, refit(samples.take(rows), True))


def _everywhere(samples: Samples, rows: IntArray, fit: Fit) -> tuple[FloatArray, FloatArray]:
    """Residuals and their deviations at all points: without the point itself, whether it was fitted or not."""
    out = np.setdiff1d(np.arange(len(samples)), rows)
    residuals, deviations = np.empty_like(samples.y), np.empty(len(samples))
    residuals[rows], deviations[rows] = fit.residuals, fit.deviations
    values = evaluation.evaluate(samples.X[out], samples.X[rows], fit.spreads, fit.coefficients) + fit.bias
    residuals[out] = samples.y[out] - values
    dense = Dense(fit.kernel.gram(samples.X[rows]), fit.weights, fit.smoothing)
    variance = dense.posterior_variance(fit.kernel.gram(samples.X[rows], samples.X[out]))
    deviations[out] = np.sqrt(fit.variance * (variance + fit.smoothing / samples.weights[out]))
    return residuals, deviations


def _likelihood(fit: Fit) -> float:
    return float(fit.scored.restricted[fit.scored.least]) + 0.5 * len(fit.residuals) * float(np.log(2 * np.pi) + 1)
