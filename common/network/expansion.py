"""Evaluation of a sum of Gaussians on several spreads: points, gradients, grids; in chunks of bounded memory."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from common.network.kernel import level_matrices, squared_distances
from common.surface import FloatArray

CHUNK = 4_000_000
"""Kernel values held at once: 32 MB a matrix."""


def chunks(rows: int, columns: int) -> Iterator[slice]:
    """Slices of `rows` such that a matrix of slice by `columns` stays within `CHUNK` values."""
    step = max(1, CHUNK // max(1, columns))
    for start in range(0, rows, step):
        yield slice(start, min(rows, start + step))


def evaluate(X: FloatArray, centers: FloatArray, spreads: FloatArray, coefficients: FloatArray) -> FloatArray:
    """sum_l sum_j c_lj exp(-|x - c_j|^2 / 2 s_l^2), shape (m, k); coefficients (levels, n, k)."""
    values = np.zeros((len(X), coefficients.shape[2]))
    for part in chunks(len(X), len(centers) * len(spreads)):
        r2 = squared_distances(X[part], centers)
        for matrix, c in zip(level_matrices(r2, spreads), coefficients, strict=True):
            values[part] += matrix @ c
    return values


def gradient(X: FloatArray, centers: FloatArray, spreads: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Derivatives by each coordinate, shape (m, k, d)."""
    slopes = np.zeros((len(X), coefficients.shape[2], X.shape[1]))
    for part in chunks(len(X), len(centers) * len(spreads)):
        r2 = squared_distances(X[part], centers)
        for matrix, spread, c in zip(level_matrices(r2, spreads), spreads, coefficients, strict=True):
            for axis in range(X.shape[1]):
                offsets = centers[None, :, axis] - X[part, axis][:, None]
                slopes[part, :, axis] += (matrix * offsets) @ c / spread**2
    return slopes


def evaluate_grid(
    x: FloatArray, y: FloatArray, centers: FloatArray, spreads: FloatArray, coefficients: FloatArray
) -> FloatArray:
    """Values on a grid, shape (len(y), len(x), k): the Gaussian separates, one matrix product a spread and output."""
    grid = np.zeros((coefficients.shape[2], len(y), len(x)))
    for spread, c in zip(spreads, coefficients, strict=True):
        along_x = np.exp(-0.5 * ((x[:, None] - centers[:, 0]) / spread) ** 2)
        along_y = np.exp(-0.5 * ((y[:, None] - centers[:, 1]) / spread) ** 2)
        for k in range(c.shape[1]):
            grid[k] += (along_y * c[:, k]) @ along_x.T
    return np.moveaxis(grid, 0, 2)
