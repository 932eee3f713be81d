"""The paper's drawing read literally: a network that maps a point onto the surface, (x, y, z) -> (x, y, z).

A height at (x, y) is then the fixed point of z -> f_z(x, y, z). Trained on points of the surface alone, the network
could as well learn the identity, of which every height is a fixed point; what keeps it on the surface is a spread so
small that the neurons fall silent away from it. Spread and smoothing are therefore judged by the heights that come
back, in cross-validation, not by how well the network maps its own points.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import KDTree

from common.network.dense import Dense
from common.network.kernel import Kernel, chunks, nearest_distance, squared_distances
from common.network.selection import rounding_floor
from common.surface import FloatArray, IntArray

SPREADS = 2.0 ** np.arange(1.0, 5.0, 0.5)
"""Tried, in mean distances between neighbours."""

SMOOTHINGS = (1e-10, 1e-6, 1e-4, 1e-2)
FOLDS = 5
MOST_POINTS = 300
"""Points on which spread and smoothing are judged."""

STEPS = 30
SETTLED = 1e-12
LEAST_SLOPE = 0.1
"""Where z - f_z(z) rises by less than this, Newton's step is not to be trusted."""


def heights(
    X: FloatArray, points: FloatArray, spread: float, coefficients: FloatArray, bias: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Fixed points in the last coordinate at X (m, d), shape (m,), and the slope of f_z by z there (m,).

    Newton's method from the value of the nearest of the points (n, d + 1), kept within twice their range.
    `coefficients` (n, d + 1) and `bias` (d + 1,) are those of the map.
    """
    z, slope = np.empty(len(X)), np.empty(len(X))
    start = points[KDTree(points[:, :-1]).query(X)[1], -1]
    for part in chunks(len(X), len(points)):
        level = np.exp(squared_distances(X[part], points[:, :-1]) * (-0.5 / spread**2))
        z[part], slope[part] = _fixed_points(level * coefficients[:, -1], points[:, -1], spread, bias[-1], start[part])
    return z, slope


def _fixed_points(
    terms: FloatArray, nodes: FloatArray, spread: float, bias: float, start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Solutions of z = b + sum_j t_ij exp(-(z - z_j)^2 / 2 s^2), shape (m,), and the slope of the right side."""
    extent = float(np.ptp(nodes)) or 1.0
    low, high = nodes.min() - extent / 2, nodes.max() + extent / 2
    z, slope = start, np.zeros(len(start))
    for _ in range(STEPS):
        offsets = nodes - z[:, None]
        values = terms * np.exp(offsets**2 * (-0.5 / spread**2))
        gap = values.sum(axis=1) + bias - z
        slope = np.einsum("mn,mn->m", values, offsets) / spread**2
        # A slope of one is the identity: no height is better than another, and a plain step is all there is.
        step = gap / np.where(np.abs(1 - slope) > LEAST_SLOPE, 1 - slope, 1.0)
        moved = np.clip(z + step, low, high)
        settled = float(np.max(np.abs(moved - z), initial=0.0)) <= SETTLED * extent
        z = moved
        if settled:
            break
    return z, slope


def fit(
    points: FloatArray, weights: FloatArray, spread: float, smoothing: float
) -> tuple[FloatArray, FloatArray, Dense]:
    """Coefficients (n, d + 1) and bias (d + 1,) of the map on the points (n, d + 1), and the factorisation."""
    dense = Dense(Kernel.single(spread).gram(points), weights, max(smoothing, rounding_floor(len(points))))
    coefficients, bias = dense.solve(points)
    return coefficients, bias, dense


def choose(
    points: FloatArray,
    weights: FloatArray,
    spread: float | None,
    smoothing: float | None,
    tick: Callable[[float], None],
) -> tuple[float, float]:
    """Spread and smoothing, where they are not given, of the least error of the heights in cross-validation."""
    order = np.random.default_rng(0).permutation(len(points))[:MOST_POINTS]
    folds = [order[i::FOLDS] for i in range(min(FOLDS, len(order)))]
    unit = nearest_distance(points) or 1.0
    pairs = [
        (s, m)
        for s in ((spread,) if spread is not None else (unit * SPREADS).tolist())
        for m in ((smoothing,) if smoothing is not None else SMOOTHINGS)
    ]
    errors = []
    for index, (s, m) in enumerate(pairs):
        errors.append(sum(_held_out(points, weights, order, fold, s, m) for fold in folds))
        tick((index + 1) / len(pairs))
    return pairs[int(np.argmin(errors))]


def _held_out(
    points: FloatArray, weights: FloatArray, order: IntArray, fold: IntArray, spread: float, smoothing: float
) -> float:
    rows = np.setdiff1d(order, fold)
    coefficients, bias, _ = fit(points[rows], weights[rows], spread, smoothing)
    z, _ = heights(points[fold, :-1], points[rows], spread, coefficients, bias)
    return float(np.sum((z - points[fold, -1]) ** 2))
