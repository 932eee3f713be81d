"""Wrong points: found by what the network says without them, set aside where that explains the rest better.

A point is suspected where its leave-one-out residual is far off the others', in the deviations that the residuals
should have. The network is fitted again without the suspects; points that the new network agrees with come back. In the
end the two readings are compared by their likelihood: all points belong to the surface, or the suspects are drawn from
anywhere within twice the range of the values. So a peak, which is far off but well explained, stays.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import KDTree

from common.network import evaluation
from common.network.dense import Dense
from common.network.partition import BoolArray, Partition
from common.network.selection import Fit, Samples
from common.surface import FloatArray, IntArray

SUSPECT = 8.0
"""Robust deviations beyond which a point is suspected: smaller errors do little harm, and are found in real terrain."""

SHARE = 0.01
"""Expected share of wrong points, in the comparison of the two readings."""

MOST = 0.3
"""Greatest share of the points that is ever set aside."""

HARMLESS = 0.02
"""Residuals below this share of the values' deviation are never suspected."""

ROUNDS = 10

GLANCE = 5000
"""Points looked at first: where none of them is suspect, the others are not looked at."""

NEIGHBOURS = 12
"""Nearest points that a value of many is compared with."""


def set_aside(samples: Samples, fit: Fit, refit: Callable[[Samples, bool], Fit]) -> tuple[Fit, IntArray]:
    """The fit without the wrong points, and the rows of those; the given fit and no rows where there are none."""
    n = len(samples)
    kept = _kept(fit.residuals, fit.deviations)
    if kept.all() or n < 10:
        return fit, np.zeros(0, dtype=np.int64)
    rows = np.arange(n)
    agreed = kept
    for _ in range(ROUNDS):
        rows = np.flatnonzero(kept)
        agreed = _kept(*_everywhere(samples, rows, refit(samples.take(rows), True)))
        # While wrong points are left the network is not to be asked which ones may come back.
        left = kept & agreed
        if np.array_equal(left, kept) or np.count_nonzero(~left) > MOST * n:
            break
        kept = left
    rows = np.flatnonzero(kept | agreed)
    out = np.setdiff1d(np.arange(n), rows)
    if not len(out):
        return fit, out
    clean = refit(samples.take(rows), False)
    cost = np.log(2 * np.ptp(samples.y, axis=0)).sum() + np.log((1 - SHARE) / SHARE)
    if _likelihood(clean) + len(out) * cost >= _likelihood(fit):
        return fit, np.zeros(0, dtype=np.int64)
    return clean, out


def screen(X: FloatArray, y: FloatArray) -> IntArray:
    """Rows of points (n, d) whose values (n, k) are far off those of their neighbours; for many points.

    Far off is measured by the neighbours' own scatter and by what is usual everywhere. No network is fitted.
    """
    tree = KDTree(X, balanced_tree=False, compact_nodes=False)
    some = np.random.default_rng(0).permutation(len(X))[:GLANCE]
    if not _far_off(tree, y, some).any():
        return np.zeros(0, dtype=np.int64)
    return np.flatnonzero(_far_off(tree, y, np.arange(len(X))))


def _far_off(tree: KDTree, y: FloatArray, asked: IntArray) -> BoolArray:
    rows = np.asarray(tree.query(tree.data[asked], k=NEIGHBOURS + 1, workers=-1)[1])
    suspect = np.zeros(len(asked), dtype=bool)
    for values in y.T:
        around, column = values[rows[:, 1:]], values[asked]
        middle = np.median(around, axis=1)
        scatter = np.median(np.abs(around - middle[:, None]), axis=1) / 0.6745
        away = np.abs(column - middle)
        typical = np.quantile(away, 0.9) / 1.645
        suspect |= (away > SUSPECT * np.maximum(scatter, typical)) & (away > HARMLESS * values.std())
    return suspect


def cross_checked(samples: Samples, fit: Callable[[Samples], Partition]) -> IntArray:
    """Rows whose values are far off what a network of the other half of the samples says."""
    order = np.random.default_rng(0).permutation(len(samples))
    half = len(order) // 2
    residuals = np.empty_like(samples.y)
    for fitted, asked in ((order[:half], order[half:]), (order[half:], order[:half])):
        residuals[asked] = samples.y[asked] - fit(samples.take(np.sort(fitted))).predict(samples.X[asked])
    return np.flatnonzero(~_kept(residuals, np.ones(len(samples))))


def agreeing(network: Partition, samples: Samples, rows: IntArray) -> BoolArray:
    """Whether the values at `rows` agree with a network that was fitted without them, shape (len(rows),)."""
    away = np.abs(samples.y[rows] - network.predict(samples.X[rows]))
    kept = np.setdiff1d(np.arange(len(samples)), rows)
    probes = kept[:: max(1, len(kept) // 10_000)]
    noise = np.quantile(np.abs(samples.y[probes] - network.predict(samples.X[probes])), 0.9, axis=0) / 1.645
    return np.asarray(np.all(away <= SUSPECT * np.hypot(network.predict_std(samples.X[rows]), noise), axis=1))


def _kept(residuals: FloatArray, deviations: FloatArray) -> BoolArray:
    ratios = np.max(np.abs(residuals), axis=1) / deviations
    # The upper quantile keeps the heavy tails of real terrain from being suspected.
    typical = max(np.median(ratios) / 0.6745, np.quantile(ratios, 0.9) / 1.645)
    far = np.max(np.abs(residuals), axis=1) > HARMLESS
    return np.asarray((ratios <= SUSPECT * typical) | ~far)


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
    return float(fit.scored.restricted[int(np.argmin(fit.scored.scores))]) + 0.5 * len(fit.residuals) * float(
        np.log(2 * np.pi) + 1
    )
