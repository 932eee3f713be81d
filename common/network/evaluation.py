"""Fast evaluation of sum_l sum_j c_lj exp(-|x - c_j|^2 / 2 s_l^2): on grids, at scattered positions, derivatives.

On a tensor grid the Gaussian separates, Z = (E_y * c) E_x': one matrix product a spread. Two things make it less:

- A Gaussian that is wide against the grid is a polynomial to rounding. Its product is taken on as many Chebyshev nodes
  as that needs and interpolated (Trefethen, "Approximation Theory and Approximation Practice", theorem 8.2).
- A Gaussian that is narrow against the grid ends after `REACH` spreads: the grid is cut into tiles, and each takes only
  the centres that reach it.

The cheaper of the two is taken, by the multiplications that each needs. Both go over all cores by strips and tiles of
fixed size, so the sums are the same to the last bit whatever the number of cores.

Scattered positions are taken in tiles, too, small enough for the processor's cache; from level to narrower level a tile
keeps the centres that still reach it. Errors of both cuts are below 1e-14 of the sum of |c|.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from common.network.kernel import SQUARINGS, squared_distances
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

STRIP = 128
"""Rows of a product that a thread takes at once: enough for the full rate of a product, few enough for every core."""

CALL = 1_000_000
"""Multiplications that take as long as what a tile costs besides its product."""

CROWDED = 1e6
"""Spreads in half an axis from where on its Chebyshev nodes are not counted: on no grid would so many pay."""

FAITHFUL = 39
"""Minus the logarithm of the error of Chebyshev nodes: exp(-39) is 1e-17, below rounding."""


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
        nodes = _nodes(x, y, len(centers), float(spread))
        if nodes is None:
            _add_tiles(grid, x, y, centers, float(spread), c)
            continue
        along_x, along_y = nodes
        values = np.zeros((grid.shape[0], len(along_y), len(along_x)))
        _add_product(values, along_x, along_y, centers, float(spread), c)
        if held is not None and len(held[0]) <= len(along_x) and len(held[1]) <= len(along_y):
            _add_refined(values, *held, along_x, along_y)
        elif held is not None:
            _add_refined(grid, *held, x, y)
        held = along_x, along_y, values
    if held is not None:
        _add_refined(grid, *held, x, y)
    return np.moveaxis(grid, 0, 2)


def _nodes(x: FloatArray, y: FloatArray, centers: int, spread: float) -> tuple[FloatArray, FloatArray] | None:
    """Chebyshev nodes that carry a Gaussian of this spread over both axes, or None where tiles are cheaper."""
    halves = [float(axis.max() - axis.min()) / 2 for axis in (x, y)]
    # Counted first: nodes that do not pay may be more than the memory holds.
    columns, rows = (chebyshev_count(min(half / spread, CROWDED)) for half in halves)
    interpolation = len(x) * columns**2 + len(y) * rows**2 + len(y) * columns * (rows + len(x))
    tiles, products = 1, float(len(x) * len(y) * centers)
    for axis, half in zip((x, y), halves, strict=True):
        cuts = len(_cuts(axis, REACH * spread))
        tiles *= cuts
        products *= min(1.0, 1 / cuts + REACH * spread / half) if cuts > 1 else 1.0
    chebyshev_is_cheaper = rows * columns * centers + interpolation < products + CALL * tiles
    return (_chebyshev_nodes(x, columns), _chebyshev_nodes(y, rows)) if chebyshev_is_cheaper else None


def _chebyshev_nodes(axis: FloatArray, count: int) -> FloatArray:
    """So many Chebyshev nodes over the axis."""
    low, high = float(axis.min()), float(axis.max())
    return (low + high) / 2 + (high - low) / 2 * np.cos(np.pi * (np.arange(count) + 0.5) / count)


def chebyshev_count(ratio: float) -> int:
    """Chebyshev nodes that interpolate a Gaussian to rounding where half the interval is `ratio` spreads.

    On the Bernstein ellipse of parameter rho the Gaussian is at most exp(ratio^2 (rho - 1/rho)^2 / 8), so the error of
    m nodes falls like that times rho^-m, for the best rho.
    """
    rho = np.exp(np.logspace(-3, 1.5, 200))
    return int(np.ceil(np.min((ratio**2 * (rho - 1 / rho) ** 2 / 8 + FAITHFUL) / np.log(rho))))


def _add_refined(
    out: FloatArray, old_x: FloatArray, old_y: FloatArray, values: FloatArray, x: FloatArray, y: FloatArray
) -> None:
    """Add values on Chebyshev nodes (k, len(old_y), len(old_x)), interpolated to x and y, to `out`."""
    along_x, along_y = _interpolation(old_x, x).T, _interpolation(old_y, y)

    def work(strip: slice) -> None:
        for k in range(len(out)):
            out[k, strip] += (along_y[strip] @ values[k]) @ along_x

    parallel(work, _strips(len(y)))


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


def _strips(rows: int) -> list[slice]:
    return [slice(start, min(rows, start + STRIP)) for start in range(0, rows, STRIP)]


def _add_product(
    out: FloatArray, x: FloatArray, y: FloatArray, centers: FloatArray, spread: float, coefficients: FloatArray
) -> None:
    """Add one spread to `out`, shape (k, len(y), len(x))."""
    for start in range(0, len(centers), CENTERS):
        part = slice(start, start + CENTERS)
        along_x = _along(x, centers[part, 0], spread).T

        def work(strip: slice, part: slice = part, along_x: FloatArray = along_x) -> None:
            along_y = _along(y[strip], centers[part, 1], spread)
            for k in range(len(out)):
                out[k, strip] += (along_y * coefficients[part, k]) @ along_x

        parallel(work, _strips(len(y)))


def _along(axis: FloatArray, centers: FloatArray, spread: float) -> FloatArray:
    """Gaussians along one axis, shape (len(axis), len(centers))."""
    # What overflows is so far away that nothing reaches it.
    with np.errstate(over="ignore"):
        away = (axis[:, None] - centers) / spread
        np.square(away, out=away)
    away *= -0.5
    return np.asarray(np.exp(away, out=away))


def _add_tiles(
    grid: FloatArray, x: FloatArray, y: FloatArray, centers: FloatArray, spread: float, coefficients: FloatArray
) -> None:
    """Add one narrow spread to the grid, tile by tile, each with the centres that reach it."""
    reach = REACH * spread
    columns, rows = _cuts(x, reach), _cuts(y, reach)
    if len(columns) == len(rows) == 1:
        _add_product(grid, x, y, centers, spread, coefficients)
        return

    def work(row: slice) -> None:
        near = _within(centers[:, 1], y[row], reach)
        across, along_y, c = centers[near, 0], _along(y[row], centers[near, 1], spread), coefficients[near]
        for column in columns:
            mine = _within(across, x[column], reach)
            if len(mine):
                along_x = _along(x[column], across[mine], spread).T
                for k in range(len(grid)):
                    grid[k, row, column] += (along_y[:, mine] * c[mine, k]) @ along_x

    parallel(work, rows)


def _within(centers: FloatArray, axis: FloatArray, reach: float) -> IntArray:
    """Centres along one axis that reach a part of it."""
    return np.flatnonzero((centers >= axis.min() - reach) & (centers <= axis.max() + reach))


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
    r2 = squared_distances(X, centers)
    matrix: FloatArray | None = None
    squared, wider = 0, np.inf
    for level in np.argsort(-spreads, kind="stable"):
        spread = float(spreads[level])
        reached = distance[near] <= (REACH * spread) ** 2
        if np.count_nonzero(reached) < 0.8 * len(near):
            near, r2 = near[reached], r2[:, reached]
            matrix = None if matrix is None else matrix[:, reached]
        if matrix is not None and squared < SQUARINGS and abs((wider / spread) ** 2 - 2) < 1e-12:
            np.square(matrix, out=matrix)
            squared += 1
        else:
            matrix = np.exp(r2 * (-0.5 / spread**2))
            squared = 0
        wider = spread
        yield int(level), near, matrix, spread
