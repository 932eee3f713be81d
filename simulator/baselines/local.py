"""Fits of the neighbourhood of each node; same arguments as in `interpolation`."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from common.network.kernel import chunks
from common.surface import FloatArray, IntArray
from simulator.baselines.interpolation import nodes

QUADRATIC_NEIGHBORS = 18
"""Three times the six coefficients of a quadratic."""

LINEAR_NEIGHBORS = 9
"""Three times the three coefficients of a plane."""

PLANE_NEIGHBORS = 8
"""Neighbours behind one principal-component plane."""

STEEPEST = 0.1
"""Least vertical part of a plane's normal: a plane that stands upright has no height."""


def _weights(distances: FloatArray) -> FloatArray:
    """Gaussian weights that have fallen to 1 % at the farthest neighbour; shape of `distances` (m, k)."""
    reach = distances[:, -1:] / 3.0
    return np.asarray(np.exp(-0.5 * (distances**2 - distances[:, :1] ** 2) / np.maximum(reach, 1e-12) ** 2))


def _neighbors(tree: KDTree, at: FloatArray, k: int) -> tuple[FloatArray, IntArray]:
    """Distances and indices of the k >= 2 nearest points, both of shape (m, k)."""
    distances, index = tree.query(at, k=k)
    return np.asarray(distances, dtype=np.float64), np.asarray(index, dtype=np.int64)


def moving_least_squares(points: FloatArray, x: FloatArray, y: FloatArray, _: np.random.Generator) -> FloatArray:
    """At each node the polynomial that fits its neighbours best, weighted by distance; quadratic, or a plane of few."""
    quadratic = len(points) >= QUADRATIC_NEIGHBORS
    k = QUADRATIC_NEIGHBORS if quadratic else min(len(points), LINEAR_NEIGHBORS)
    at = nodes(x, y)
    distances, index = _neighbors(KDTree(points[:, :2]), at, k)
    grid = np.empty(len(at))
    for part in chunks(len(at), k * 6):
        reach = distances[part, -1]
        u, v = np.moveaxis((points[index[part], :2] - at[part, None, :]) / reach[:, None, None], -1, 0)
        columns = [np.ones_like(u), u, v] + ([u * u, u * v, v * v] if quadratic else [])
        design = np.stack(columns, axis=-1)
        root = np.sqrt(_weights(distances[part]))
        # The pseudo-inverse drops directions that the neighbours (on a line, say) do not determine.
        solution = np.linalg.pinv(design * root[:, :, None], rcond=1e-6)
        grid[part] = np.einsum("mk,mk->m", solution[:, 0], root * points[index[part], 2])
    return grid.reshape(len(y), len(x))


def principal_component(points: FloatArray, x: FloatArray, y: FloatArray, _: np.random.Generator) -> FloatArray:
    """The plane of least squared distance at each point, from its neighbours; at a node the planes near it, blended."""
    tree = KDTree(points[:, :2])
    k = min(len(points), PLANE_NEIGHBORS)
    index = _neighbors(tree, points[:, :2], k)[1]
    middle = points[index].mean(axis=1)
    offsets = points[index] - middle[:, None, :]
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", offsets, offsets))[1][:, :, 0]
    normals *= np.where(normals[:, 2:] < 0, -1.0, 1.0)
    slopes = -normals[:, :2] / np.maximum(normals[:, 2:], STEEPEST)
    at = nodes(x, y)
    distances, near = _neighbors(tree, at, k)
    heights = middle[near, 2] + np.einsum("mki,mki->mk", slopes[near], at[:, None, :] - middle[near, :2])
    weights = _weights(distances)
    return np.asarray((np.sum(weights * heights, axis=1) / weights.sum(axis=1)).reshape(len(y), len(x)))
