"""The paper's drawing read literally: a network that maps a point onto the surface, (x, y, z) -> (x, y, z).

A height at (x, y) is then the fixed point of z -> f_z(x, y, z). Trained on points of the surface alone, the network
could as well learn the identity, of which every height is a fixed point; what keeps it on the surface is a spread so
small that the neurons fall silent away from it. Spread and smoothing are therefore judged by the heights that come
back, in cross-validation, not by how well the network maps its own points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from scipy.spatial import KDTree

from common.network import evaluation
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

STEPS = 60
SETTLED = 1e-12
LEAST_RISE = 1e-4
"""Of z - f_z(z): less than this determines no height, and divides neither the gradient nor the deviation."""


@dataclass(slots=True, eq=False)
class Lifted:
    """(x, z) -> (x, z) by one spread, and the heights that are its fixed points.

    Attributes
    ----------
    centers : ndarray, shape (n, d + 1)
        The points; the last column is the height.
    spread, smoothing : float
    coefficients : ndarray, shape (n, d + 1)
    bias : ndarray, shape (d + 1,)
    weights : ndarray, shape (n,)
        Measurements behind each point.
    variance : float
        Of the height, as the kernel explains it.
    """

    centers: FloatArray
    spread: float
    smoothing: float
    coefficients: FloatArray
    bias: FloatArray
    weights: FloatArray
    variance: float = 0.0

    @classmethod
    def fit(
        cls,
        points: FloatArray,
        weights: FloatArray,
        spread: float | None,
        smoothing: float | None,
        tick: Callable[[float], None],
    ) -> Self:
        """Fit to points (n, d + 1); spread and smoothing are chosen where they are None."""
        spread, smoothing = _choose(points, weights, spread, smoothing, tick)
        network, dense = cls.solved(points, weights, spread, smoothing)
        if len(points) > 1:
            residuals, deviations = dense.leave_one_out(network.coefficients)
            network.variance = float(np.mean(residuals[:, -1] ** 2 / deviations))
        return network

    @classmethod
    def solved(cls, points: FloatArray, weights: FloatArray, spread: float, smoothing: float) -> tuple[Self, Dense]:
        """The network of a given spread and smoothing, without its variance, and the factorisation."""
        dense = Dense(Kernel.single(spread).gram(points), weights, max(smoothing, rounding_floor(len(points))))
        coefficients, bias = dense.solve(points)
        return cls(points, spread, dense.smoothing, coefficients, bias, weights), dense

    def predict(self, X: FloatArray) -> FloatArray:
        """Heights at X (m, d), shape (m, 1)."""
        return self._heights(X)[0][:, None]

    def predict_grid(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Heights on a grid, shape (len(y), len(x), 1): point by point, a fixed point does not separate."""
        nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return self.predict(nodes).reshape(len(y), len(x), 1)

    def predict_gradient(self, X: FloatArray) -> FloatArray:
        """Derivatives of the height at X (m, d), shape (m, 1, d): f_zx / (1 - f_zz), as z = f_z(x, z)."""
        z, slope = self._heights(X)
        here, c = np.column_stack([X, z]), self.coefficients[None, :, -1:]
        slopes = evaluation.gradient(here, self.centers, np.array([self.spread]), c)[:, :, :-1]
        return np.asarray(slopes / _steepness(slope)[:, None, None])

    def predict_std(self, X: FloatArray) -> FloatArray:
        """Deviation of the height at X (m, d), shape (m, 1)."""
        kernel = Kernel.single(self.spread)
        dense = Dense(kernel.gram(self.centers), self.weights, self.smoothing)
        z, slope = self._heights(X)
        here = np.column_stack([X, z])
        variance = np.empty(len(X))
        for part in chunks(len(X), len(self.centers)):
            variance[part] = dense.posterior_variance(kernel.gram(self.centers, here[part]))
        return np.asarray((np.sqrt(self.variance * variance) / np.abs(_steepness(slope)))[:, None])

    def _heights(self, X: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Fixed points at X (m, d), shape (m,), and the slope of f_z by z there (m,).

        The search starts at the height of the nearest point, and keeps within twice the range of the heights.
        """
        z, slope = np.empty(len(X)), np.empty(len(X))
        flat, nodes = self.centers[:, :-1], self.centers[:, -1]
        start = nodes[KDTree(flat).query(X)[1]]
        for part in chunks(len(X), len(flat)):
            terms = np.exp(squared_distances(X[part], flat) * (-0.5 / self.spread**2)) * self.coefficients[:, -1]
            z[part], slope[part] = _fixed_points(terms, nodes, self.spread, float(self.bias[-1]), start[part])
        return z, slope

    def to_state(self) -> dict[str, np.ndarray[Any, Any]]:
        """Everything, as arrays that `numpy.savez` takes without pickling."""
        return {name: np.asarray(getattr(self, name)) for name in (*_ARRAYS, *_NUMBERS)}

    @classmethod
    def from_state(cls, state: dict[str, np.ndarray[Any, Any]]) -> Self:
        """The network that `to_state` wrote."""
        values: dict[str, Any] = {name: np.array(state[name]) for name in _ARRAYS}
        values |= {name: float(state[name]) for name in _NUMBERS}
        return cls(**values)


_ARRAYS = ("centers", "coefficients", "bias", "weights")
_NUMBERS = ("spread", "smoothing", "variance")


def _steepness(slope: FloatArray) -> FloatArray:
    """How fast z - f_z(z) rises; no less than `LEAST_RISE`, where the surface stands upright."""
    rise = 1 - slope
    return np.asarray(np.copysign(np.maximum(np.abs(rise), LEAST_RISE), rise))


def _fixed_points(
    terms: FloatArray, nodes: FloatArray, spread: float, bias: float, start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Solutions of z = b + sum_j t_ij exp(-(z - z_j)^2 / 2 s^2), shape (m,), and the slope of the right side.

    Newton's steps, at most a spread long, are halved until the gap between both sides falls. Where there is no solution
    on the way it is the height of the least gap.
    """
    extent = float(np.ptp(nodes)) or 1.0
    low, high = nodes.min() - extent / 2, nodes.max() + extent / 2

    def sides(terms: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        offsets = nodes - z[:, None]
        values = terms * np.exp(offsets**2 * (-0.5 / spread**2))
        gap = values.sum(axis=1) + bias - z
        slope = np.einsum("mn,mn->m", values, offsets) / spread**2
        rise = 1 - slope
        return gap, slope, np.clip(gap / np.where(rise == 0, np.finfo(float).tiny, rise), -spread, spread)

    z = start.copy()
    gap, slope, step = sides(terms, z)
    for _ in range(STEPS):
        unsettled = np.flatnonzero(np.abs(step) > SETTLED * extent)
        if not len(unsettled):
            break
        moved = np.clip(z[unsettled] + step[unsettled], low, high)
        found = sides(terms[unsettled], moved)
        better = np.abs(found[0]) < np.abs(gap[unsettled])
        step[unsettled[~better]] /= 2
        rows = unsettled[better]
        z[rows] = moved[better]
        gap[rows], slope[rows], step[rows] = (values[better] for values in found)
    return z, slope


def _choose(
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
    if len(points) == 1:
        return pairs[0]
    errors = []
    for index, (s, m) in enumerate(pairs):
        errors.append(sum(_held_out(points, weights, order, fold, s, m) for fold in folds))
        tick((index + 1) / len(pairs))
    return pairs[int(np.argmin(errors))]


def _held_out(
    points: FloatArray, weights: FloatArray, order: IntArray, fold: IntArray, spread: float, smoothing: float
) -> float:
    rows = np.setdiff1d(order, fold)
    network, _ = Lifted.solved(points[rows], weights[rows], spread, smoothing)
    return float(np.sum((network.predict(points[fold, :-1])[:, 0] - points[fold, -1]) ** 2))
