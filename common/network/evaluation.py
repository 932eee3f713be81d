"""Fast evaluation of sum_l sum_j c_lj exp(-|x - c_j|^2 / 2 s_l^2): on grids, at scattered positions, derivatives.

On a tensor grid the Gaussian separates, Z = (E_y * c) E_x': one matrix product a spread. Two things make it less:

- A Gaussian that is wide against the grid is a polynomial to rounding. Its product is taken on as many Chebyshev nodes
  as that needs and interpolated (Trefethen, "Approximation Theory and Approximation Practice", theorem 8.2).
- A Gaussian that is narrow against the grid ends after `REACH` spreads: the grid is cut into tiles, and each takes only
  the centres that reach it.

Scattered positions are taken in tiles, too, small enough for the processor's cache; from level to narrower level a tile
keeps the centres that still reach it. Errors of both cuts are below 1e-14 of the sum of |c|.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from scipy.spatial.distance import cdist

from common.network.threads import parallel
from common.surface import FloatArray, IntArray

REACH = 8.5
"""Spreads after which a Gaussian is below 3e-16."""

CACHED = 1 << 17
"""Kernel values held at once by a thread: 1 MiB, about what a core's cache holds."""

CENTERS = 4096
"""Centres in one matrix product: bounds the memory of the factors, and costs no speed."""

TILE = 64
"""Least side of a grid tile, in nodes: smaller tiles cost more in calls than they save in products."""

_SQUARINGS = 4
"""Levels taken by squaring before a fresh exponential: each squaring doubles the relative rounding error."""


def evaluate_grid(
    x: FloatArray, y: FloatArray, centers: FloatArray, spreads: FloatArray, coefficients: FloatArray
) -> FloatArray:
    """Values on a grid.

    Parameters
    ----------
    x, y : ndarray, shapes (columns,) and (rows,)
        Coordinates of the nodes, in any order.
    centers : ndarray, shape (n, 2)
    spreads : ndarray, shape (levels,)
        In the units of x and y; descending ones share the most work.
    coefficients : ndarray, shape (levels, n, k)

    Returns
    -------
    ndarray, shape (rows, columns, k)
    """
    grid = np.zeros((coefficients.shape[2], len(y), len(x)))
    if grid.size == 0:
        return np.moveaxis(grid, 0, 2)
    held: tuple[FloatArray, FloatArray, FloatArray] | None = None
    for spread, c in zip(spreads, coefficients, strict=True):
        along_x, along_y = _nodes(x, float(spread)), _nodes(y, float(spread))
        if along_x is None or along_y is None:
            _add_tiles(grid, x, y, centers, float(spread), c)
            continue
        values = np.zeros((grid.shape[0], len(along_y), len(along_x)))
        _add_product(values, along_x, along_y, centers, float(spread), c)
        if held is not None and len(held[0]) <= len(along_x) and len(held[1]) <= len(along_y):
            values += _refined(*held, along_x, along_y)
        elif held is not None:
            grid += _refined(*held, x, y)
        held = along_x, along_y, values
    if held is not None:
        grid += _refined(*held, x, y)
    return np.moveaxis(grid, 0, 2)


def _nodes(axis: FloatArray, spread: float) -> FloatArray | None:
    """Chebyshev nodes that carry a Gaussian of this spread over the axis, or None where they do not pay."""
    low, high = float(axis.min()), float(axis.max())
    half = (high - low) / 2
    count = chebyshev_count(half / spread)
    if count > 0.7 * len(axis):
        return None
    return (low + high) / 2 + half * np.cos(np.pi * (np.arange(count) + 0.5) / count)


def chebyshev_count(ratio: float) -> int:
    """Chebyshev nodes that interpolate a Gaussian to rounding where half the interval is `ratio` spreads.

    On the Bernstein ellipse of parameter rho the Gaussian is at most exp(ratio^2 (rho - 1/rho)^2 / 8), so the error of
    m nodes falls like that times rho^-m, for the best rho.
    """
    rho = np.exp(np.logspace(-3, 1.5, 200))
    return int(np.ceil(np.min((ratio**2 * (rho - 1 / rho) ** 2 / 8 + 39) / np.log(rho))))


def _refined(old_x: FloatArray, old_y: FloatArray, values: FloatArray, x: FloatArray, y: FloatArray) -> FloatArray:
    """Values on Chebyshev nodes (k, len(old_y), len(old_x)) interpolated to x and y, shape (k, len(y), len(x))."""
    return np.asarray((_interpolation(old_y, y) @ values) @ _interpolation(old_x, x).T)


def _interpolation(nodes: FloatArray, axis: FloatArray) -> FloatArray:
    """Matrix that takes values on Chebyshev nodes to the axis, shape (len(axis), len(nodes))."""
    count = len(nodes)
    # The nodes are cos((j + 1/2) pi / count) of the interval, so its ends lie a little beyond them.
    half = (nodes[0] - nodes[-1]) / (2 * np.cos(0.5 * np.pi / count)) if count > 1 else 0.0
    unit = (axis - (nodes[0] + nodes[-1]) / 2) / (half or 1.0)
    return np.asarray(np.polynomial.chebyshev.chebvander(unit, count - 1) @ _transform(count))


@lru_cache(maxsize=64)
def _transform(count: int) -> FloatArray:
    """Values on the nodes to Chebyshev coefficients, shape (count, count)."""
    angles = np.pi * (np.arange(count) + 0.5) / count
    matrix = np.cos(np.outer(np.arange(count), angles)) * (2 / count)
    matrix[0] /= 2
    matrix.setflags(write=False)
    return np.asarray(matrix)


def _add_product(
    out: FloatArray, x: FloatArray, y: FloatArray, centers: FloatArray, spread: float, coefficients: FloatArray
) -> None:
    """Add one spread to `out`, shape (k, len(y), len(x))."""
    for start in range(0, len(centers), CENTERS):
        part = slice(start, start + CENTERS)
        along_x = np.exp(-0.5 * ((x[:, None] - centers[part, 0]) / spread) ** 2)
        along_y = np.exp(-0.5 * ((y[:, None] - centers[part, 1]) / spread) ** 2)
        for k in range(len(out)):
            out[k] += (along_y * coefficients[part, k]) @ along_x.T


def _add_tiles(
    grid: FloatArray, x: FloatArray, y: FloatArray, centers: FloatArray, spread: float, coefficients: FloatArray
) -> None:
    """Add one narrow spread to the grid, tile by tile, each with the centres that reach it."""
    reach = REACH * spread
    columns, rows = _cuts(x, reach), _cuts(y, reach)
    for row in rows:
        low, high = y[row].min() - reach, y[row].max() + reach
        near = np.flatnonzero((centers[:, 1] >= low) & (centers[:, 1] <= high))
        band, c = centers[near], coefficients[near]
        for column in columns:
            low, high = x[column].min() - reach, x[column].max() + reach
            mine = np.flatnonzero((band[:, 0] >= low) & (band[:, 0] <= high))
            if len(mine):
                _add_product(grid[:, row, column], x[column], y[row], band[mine], spread, c[mine])


def _cuts(axis: FloatArray, reach: float) -> list[slice]:
    """Slices of the axis as wide as the reach, or the whole axis where tiles do not pay."""
    extent = float(np.ptp(axis))
    step = TILE if extent == 0 else max(TILE, int(len(axis) * min(1.0, reach / extent)))
    monotone = len(axis) < 2 or bool(np.all(np.diff(axis) > 0) or np.all(np.diff(axis) < 0))
    if not monotone or step > len(axis) / 2:
        return [slice(0, len(axis))]
    return [slice(start, min(len(axis), start + step)) for start in range(0, len(axis), step)]


def evaluate(X: FloatArray, centers: FloatArray, spreads: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Values at scattered positions.

    Parameters
    ----------
    X : ndarray, shape (m, d)
    centers : ndarray, shape (n, d)
    spreads : ndarray, shape (levels,)
    coefficients : ndarray, shape (levels, n, k)

    Returns
    -------
    ndarray, shape (m, k)
    """
    values = np.zeros((len(X), coefficients.shape[2]))

    def work(rows: IntArray) -> None:
        total = np.zeros((len(rows), coefficients.shape[2]))
        for level, near, matrix, _ in _levels(X[rows], centers, spreads):
            total += matrix @ coefficients[level][near]
        values[rows] = total

    parallel(work, tiles(X, _rows(centers), _compact(X, spreads)))
    return values


def gradient(X: FloatArray, centers: FloatArray, spreads: FloatArray, coefficients: FloatArray) -> FloatArray:
    """Derivatives by each coordinate at X (m, d), shape (m, k, d); the other arguments as for `evaluate`."""
    slopes = np.zeros((len(X), coefficients.shape[2], X.shape[1]))

    def work(rows: IntArray) -> None:
        total = np.zeros((len(rows), coefficients.shape[2], X.shape[1]))
        for level, near, matrix, spread in _levels(X[rows], centers, spreads):
            c = coefficients[level][near] / spread**2
            for axis in range(X.shape[1]):
                offsets = centers[None, near, axis] - X[rows, axis][:, None]
                total[:, :, axis] += (matrix * offsets) @ c
        slopes[rows] = total

    parallel(work, tiles(X, _rows(centers), _compact(X, spreads)))
    return slopes


def _rows(centers: FloatArray) -> int:
    return max(16, CACHED // max(1, len(centers)))


def _compact(X: FloatArray, spreads: FloatArray) -> bool:
    """Whether some spread is so narrow that tiles leave centres out."""
    return len(X) > 1 and REACH * float(np.min(spreads)) < 0.25 * float(np.ptp(X, axis=0).max())


def tiles(X: FloatArray, size: int, compact: bool = True) -> list[IntArray]:
    """Rows of X (m, d) in groups of at most `size`; compact groups by halving at the median of the longest side."""
    if not compact:
        return [np.arange(start, min(len(X), start + size)) for start in range(0, len(X), size)]
    done: list[IntArray] = []
    waiting = [np.arange(len(X))] if len(X) else []
    while waiting:
        rows = waiting.pop()
        if len(rows) <= size:
            done.append(rows)
            continue
        axis = int(np.argmax(np.ptp(X[rows], axis=0)))
        half = len(rows) // 2
        rows = rows[np.argpartition(X[rows, axis], half)]
        waiting += [rows[half:], rows[:half]]
    return done


def _levels(
    X: FloatArray, centers: FloatArray, spreads: FloatArray
) -> Iterator[tuple[int, IntArray, FloatArray, float]]:
    """Level, centres that reach the tile X, kernel matrix (len(X), len(centres)), spread; one level after the other."""
    beyond = np.maximum(np.maximum(X.min(axis=0) - centers, centers - X.max(axis=0)), 0.0)
    distance = np.einsum("nd,nd->n", beyond, beyond)
    near = np.arange(len(centers))
    r2 = np.asarray(cdist(X, centers, "sqeuclidean"))
    matrix: FloatArray | None = None
    squared, wider = 0, np.inf
    for level in np.argsort(-spreads, kind="stable"):
        spread = float(spreads[level])
        reached = distance[near] <= (REACH * spread) ** 2
        if np.count_nonzero(reached) < 0.8 * len(near):
            near, r2 = near[reached], r2[:, reached]
            matrix = None if matrix is None else matrix[:, reached]
        if matrix is not None and squared < _SQUARINGS and abs((wider / spread) ** 2 - 2) < 1e-12:
            np.square(matrix, out=matrix)
            squared += 1
        else:
            matrix = np.exp(r2 * (-0.5 / spread**2))
            squared = 0
        wider = spread
        yield int(level), near, matrix, spread
