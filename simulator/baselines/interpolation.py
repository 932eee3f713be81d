"""Interpolants on the points' own geometry, and thin plates.

Every function takes distinct positions in units of their extent, heights in 0..1 and the axes of the grid, and returns
the heights, shape (rows, columns); none draws from `rng` unless it says so.
"""

from __future__ import annotations

import warnings

import numpy as np
from scipy.interpolate import CloughTocher2DInterpolator, LinearNDInterpolator, RBFInterpolator
from scipy.spatial import Delaunay, KDTree
from scipy.spatial.distance import cdist
from scipy.special import xlogy

from common.surface import FloatArray

DENSE_LIMIT = 2000
"""Points up to which a thin plate is solved as one dense system; of more, the nearest `NEIGHBORS` make each height."""

NEIGHBORS = 64
"""Points behind one height of a local thin plate."""

GCV_LIMIT = 600
"""Points whose spectrum is decomposed to choose the smoothing; of more, a random sample this large."""

SMOOTHINGS = np.logspace(-12, 4, 129)
"""Candidates for the smoothing, relative to the mean eigenvalue of the kernel."""


def nodes(x: FloatArray, y: FloatArray) -> FloatArray:
    """Positions of the grid's nodes, shape (rows * columns, 2), row by row."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def nearest(points: FloatArray, x: FloatArray, y: FloatArray, _: np.random.Generator) -> FloatArray:
    """Height of the nearest point."""
    index = KDTree(points[:, :2]).query(nodes(x, y))[1]
    return np.asarray(points[index, 2].reshape(len(y), len(x)))


def _outside_by_nearest(
    grid: FloatArray, points: FloatArray, x: FloatArray, y: FloatArray, rng: np.random.Generator
) -> FloatArray:
    return np.where(np.isfinite(grid), grid, nearest(points, x, y, rng))


def linear(points: FloatArray, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Linear on the Delaunay triangles; nearest outside of the hull."""
    grid = LinearNDInterpolator(Delaunay(points[:, :2]), points[:, 2])(nodes(x, y))
    return _outside_by_nearest(grid.reshape(len(y), len(x)), points, x, y, rng)


def cubic(points: FloatArray, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Clough-Tocher cubic on the Delaunay triangles; nearest outside of the hull."""
    with warnings.catch_warnings():
        # Where slivers keep the gradients from settling, the last iterate is still the usual answer.
        warnings.filterwarnings("ignore", message="Gradient estimation did not converge")
        grid = CloughTocher2DInterpolator(Delaunay(points[:, :2]), points[:, 2])(nodes(x, y))
    return _outside_by_nearest(grid.reshape(len(y), len(x)), points, x, y, rng)


def natural_neighbour(points: FloatArray, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Sibson's natural-neighbour interpolant; nearest outside of the hull."""
    import startinpy

    triangulation = startinpy.DT()
    triangulation.snap_tolerance = 1e-12  # it would merge points closer than 0.001
    triangulation.insert(points)
    grid = np.asarray(triangulation.interpolate({"method": "NNI"}, nodes(x, y))).reshape(len(y), len(x))
    # On the very edge of the hull, where it finds no neighbours, the interpolant is linear between two of them.
    return np.where(np.isfinite(grid), grid, linear(points, x, y, rng))


def _thin_plate(points: FloatArray, x: FloatArray, y: FloatArray, smoothing: float) -> FloatArray:
    neighbors = None if len(points) <= DENSE_LIMIT else NEIGHBORS
    plate = RBFInterpolator(
        points[:, :2], points[:, 2], kernel="thin_plate_spline", smoothing=smoothing, neighbors=neighbors
    )
    return np.asarray(plate(nodes(x, y)).reshape(len(y), len(x)))


def thin_plate(points: FloatArray, x: FloatArray, y: FloatArray, _: np.random.Generator) -> FloatArray:
    """Thin plate through every point."""
    return _thin_plate(points, x, y, 0.0)


def thin_plate_gcv(points: FloatArray, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Thin plate smoothed as generalised cross-validation asks; draws a sample of many points."""
    sample = points if len(points) <= GCV_LIMIT else rng.permutation(points)[:GCV_LIMIT]
    return _thin_plate(points, x, y, gcv_smoothing(sample))


def gcv_smoothing(points: FloatArray) -> float:
    """The smoothing of a thin plate with the least generalised cross-validation score (Wahba 1990, 4.3).

    With Q an orthonormal basis of what the planes leave, K the kernel matrix and Q'KQ = U diag(d) U', the score of
    lambda is n |r|^2 / tr(I - A)^2, where r = lambda (d + lambda)^-1 U'Q'z and tr(I - A) = sum lambda / (d + lambda).
    """
    n = len(points)
    if n < 5:  # too few degrees of freedom beyond the plane to judge by
        return 0.0
    r2 = cdist(points[:, :2], points[:, :2], "sqeuclidean")
    kernel = 0.5 * xlogy(r2, r2)
    planes = np.column_stack([np.ones(n), points[:, :2]])
    beyond = np.linalg.qr(planes, mode="complete")[0][:, 3:]
    d, u = np.linalg.eigh(beyond.T @ kernel @ beyond)
    d = np.maximum(d, 0)
    w = u.T @ (beyond.T @ points[:, 2])
    candidates = SMOOTHINGS * d.mean()
    shrinkage = candidates[:, None] / (d + candidates[:, None])
    scores = n * np.sum((shrinkage * w) ** 2, axis=1) / np.sum(shrinkage, axis=1) ** 2
    return float(candidates[np.argmin(scores)])
