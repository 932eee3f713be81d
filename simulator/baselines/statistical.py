"""Fits that estimate their own smoothness; same arguments as in `interpolation`."""

from __future__ import annotations

import warnings

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cho_factor, cho_solve

from common.network.kernel import chunks
from common.surface import FloatArray
from simulator.baselines.interpolation import nodes

SEGMENTS = (4, 24)
"""Least and most segments of the spline along an axis; between them as many as the square root of the points."""

PENALTIES = np.logspace(-9, 4, 40)
"""Candidates for the smoothing of the spline, relative to the mean of the normal matrix's diagonal."""

RIDGE = 1e-12
"""What holds coefficients that neither points nor penalty determine, on the same scale."""

NEGLIGIBLE = 1e-20
"""Variance about the plane, of heights in 0..1, below which the plane is all."""

LIKELIHOOD_LIMIT = 300
"""Points whose likelihood chooses the variogram; of more, a random sample this large."""

KRIGING_LIMIT = 3000
"""Points that are kriged; of more, a random sample this large."""


def plane(points: FloatArray) -> FloatArray:
    """Coefficients (constant, x, y) of the least-squares plane of (n, 3) points."""
    design = np.column_stack([np.ones(len(points)), points[:, :2]])
    return np.asarray(np.linalg.lstsq(design, points[:, 2], rcond=None)[0])


def heights_of_plane(coefficients: FloatArray, xy: FloatArray) -> FloatArray:
    """Heights (m,) of a plane at positions (m, 2)."""
    return np.asarray(coefficients[0] + xy @ coefficients[1:])


def smoothing_spline(points: FloatArray, x: FloatArray, y: FloatArray, _: np.random.Generator) -> FloatArray:
    """A plane and on it a bicubic spline with penalised second differences, smoothing by generalised cross-validation.

    (FITPACK's smoothing spline of scattered points, SciPy's SmoothBivariateSpline, places its own knots and swings by
    tens of times the range where a region between them is empty.)
    """
    trend = plane(points)
    grid = heights_of_plane(trend, nodes(x, y)).reshape(len(y), len(x))
    rest = points[:, 2] - heights_of_plane(trend, points[:, :2])
    if np.mean(rest**2) <= NEGLIGIBLE:
        return grid
    segments = int(np.clip(np.sqrt(len(points)), *SEGMENTS))
    knots_x, knots_y = (_knots(np.concatenate([points[:, k], axis]), segments) for k, axis in ((0, x), (1, y)))
    along_x, along_y = _basis(points[:, 0], knots_x), _basis(points[:, 1], knots_y)
    design = (along_y[:, :, None] * along_x[:, None, :]).reshape(len(points), -1)
    differences = np.diff(np.eye(segments + 3), 2, axis=0)
    bending = differences.T @ differences
    penalty = np.kron(bending, np.eye(segments + 3)) + np.kron(np.eye(segments + 3), bending)
    coefficients = _penalised(design, rest, penalty).reshape(segments + 3, segments + 3)
    return np.asarray(grid + _basis(y, knots_y) @ coefficients @ _basis(x, knots_x).T)


def _knots(positions: FloatArray, segments: int) -> FloatArray:
    """Knots of a cubic spline of equal segments over all positions."""
    low, high = float(positions.min()), float(positions.max())
    return np.asarray(low + (high - low) / segments * np.arange(-3, segments + 4), dtype=np.float64)


def _basis(positions: FloatArray, knots: FloatArray) -> FloatArray:
    """Cubic B-splines at positions, shape (len(positions), segments + 3)."""
    inside = np.clip(positions, knots[3], knots[-4])  # the ends, by rounding
    return np.asarray(BSpline.design_matrix(inside, knots, 3).toarray())


def _penalised(design: FloatArray, heights: FloatArray, penalty: FloatArray) -> FloatArray:
    """Coefficients that minimise |heights - design c|^2 + lambda c' penalty c, lambda of the least score.

    The score is n |r|^2 / (n - tr A)^2, tr A = tr((N + lambda P)^-1 N), N the normal matrix.
    """
    n = len(heights)
    normal, right = design.T @ design, design.T @ heights
    scale = float(np.trace(normal)) / len(normal)
    best, least = np.zeros(len(normal)), float("inf")
    for candidate in PENALTIES * scale:
        factor = cho_factor(normal + candidate * penalty + RIDGE * scale * np.eye(len(normal)))
        coefficients = cho_solve(factor, right)
        freedom = n - float(np.trace(cho_solve(factor, normal)))
        score = n * float(np.sum((heights - design @ coefficients) ** 2)) / max(freedom, 1e-9) ** 2
        if score < least:
            best, least = coefficients, score
    return np.asarray(best)


def kriging(points: FloatArray, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Plane and kriging of what it leaves, variogram by maximum likelihood; draws samples of many points."""
    from sklearn.exceptions import ConvergenceWarning
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import ConstantKernel, Matern, WhiteKernel

    trend = plane(points)
    at = nodes(x, y)
    grid = heights_of_plane(trend, at)
    rest = points[:, 2] - heights_of_plane(trend, points[:, :2])
    deviation = float(np.sqrt(np.mean(rest**2)))
    if deviation**2 > NEGLIGIBLE:
        order = rng.permutation(len(points))[:KRIGING_LIMIT]
        xy, residuals = points[order, :2], rest[order] / deviation
        variogram = ConstantKernel(1.0, (1e-3, 1e4)) * Matern(0.3, (1e-3, 1e2), nu=1.5) + WhiteKernel(1e-2, (1e-10, 10))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)  # a parameter at its bound is a valid variogram
            chosen = GaussianProcessRegressor(variogram).fit(xy[:LIKELIHOOD_LIMIT], residuals[:LIKELIHOOD_LIMIT])
        process = GaussianProcessRegressor(chosen.kernel_, optimizer=None).fit(xy, residuals)
        for part in chunks(len(at), len(xy)):
            grid[part] += deviation * process.predict(at[part])
    return grid.reshape(len(y), len(x))
