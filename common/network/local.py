"""Many small networks at once: kernel matrices, solutions and values of a batch of patches.

A batch holds patches of about the same number of points, padded to the largest. Padding lies so far away that no
Gaussian reaches it, with the value 0: its coefficients come out as 0, and no mask is needed. Arrays begin with the axis
of patches.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.network import lapack
from common.network.kernel import Kernel
from common.surface import BoolArray, FloatArray

CACHED = 1 << 17
"""Kernel values worked on at once: 1 MiB, about what a core's cache holds."""

FAR = 1e7
"""Distance of the padding, in mean spacings; each padded point has its own."""

_CORNER = 1e300
"""Below a matrix with its right-hand sides: so large that it stays positive, and what is below is not read."""

_SQUARINGS = 8
"""Levels taken by squaring before a fresh exponential: each squaring doubles the relative rounding error."""


class Levels:
    """The Gaussians of a kernel one after the other, from the widest, in place.

    Squares are cheaper than exponentials: halving the squared spread is one square.
    """

    def __init__(self, kernel: Kernel) -> None:
        self.amplitudes = kernel.amplitudes
        self.factors = -0.5 / kernel.spreads**2
        self.squarings: list[int | None] = [None]
        done = 0
        for ratio in np.square(kernel.spreads[:-1] / kernel.spreads[1:]):
            power = round(float(np.log2(ratio)))
            fresh = abs(ratio / 2.0**power - 1) > 1e-12 or not 1 <= power <= 3 or done + power > _SQUARINGS
            self.squarings.append(None if fresh else power)
            done = 0 if fresh else done + power

    def __len__(self) -> int:
        return len(self.amplitudes)

    def advance(self, level: int, r2: FloatArray, wider: FloatArray, out: FloatArray) -> None:
        """The Gaussians of `level` from those of the level before in `wider`, into `out`, which may be the same array.

        r2 holds squared distances.
        """
        squarings = self.squarings[level]
        if squarings is None:
            np.multiply(r2, self.factors[level], out=out)
            np.exp(out, out=out)
        else:
            np.square(wider, out=out)
            for _ in range(squarings - 1):
                np.square(out, out=out)

    def total(self, r2: FloatArray, out: FloatArray, current: FloatArray, share: FloatArray) -> None:
        """sum_l a_l exp(-r^2 / 2 s_l^2) into `out`; the last two are room of the shape of r2."""
        self.advance(0, r2, current, current)
        np.multiply(current, self.amplitudes[0], out=out)
        for level in range(1, len(self)):
            self.advance(level, r2, current, current)
            np.multiply(current, self.amplitudes[level], out=share)
            np.add(out, share, out=out)

    def matrix(self, a: FloatArray, b: FloatArray, out: FloatArray | None = None) -> FloatArray:
        """The kernel of (p, m, 2) and (p, k, 2), shape (p, m, k), a cache-full at a time."""
        p, m, k = len(a), a.shape[1], b.shape[1]
        result = np.empty((p, m, k)) if out is None else out
        rows = max(1, CACHED // max(1, m * k))
        room = np.empty((4, min(rows, p), m, k))
        for start in range(0, p, rows):
            part = slice(start, min(p, start + rows))
            r2, total, *scratch = room[:, : part.stop - start]
            squared_distances(a[part], b[part], r2)
            self.total(r2, total, *scratch)
            result[part] = total
        return result

    def slope(self, r2: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The kernel K and 2 dK / d(r^2), of the shape of r2."""
        value, slope = np.zeros_like(r2), np.zeros_like(r2)
        current = np.empty_like(r2)
        for level in range(len(self)):
            self.advance(level, r2, current, current)
            value += self.amplitudes[level] * current
            slope += (2 * self.amplitudes[level] * self.factors[level]) * current
        return value, slope


def squared_distances(a: FloatArray, b: FloatArray, out: FloatArray | None = None) -> FloatArray:
    """|a_i - b_j|^2 of (p, m, 2) and (p, k, 2), shape (p, m, k), as one matrix product.

    Coordinates are within a few mean spacings of the patch's middle: the squares cancel to 1e-14 of a spacing squared.
    """
    left = np.empty((*a.shape[:2], 4))
    np.multiply(a, -2.0, out=left[..., :2])
    left[..., 2] = np.einsum("pmi,pmi->pm", a, a)
    left[..., 3] = 1.0
    right = np.empty((len(b), 4, b.shape[1]))
    right[:, :2] = b.transpose(0, 2, 1)
    right[:, 2] = 1.0
    right[:, 3] = np.einsum("pmi,pmi->pm", b, b)
    return np.matmul(left, right, out=out)


def rectangles(
    points: FloatArray, across: FloatArray, up: FloatArray, coefficients: FloatArray, levels: Levels
) -> FloatArray:
    """Sums of Gaussians on rectangular grids: along each axis a Gaussian of its own, and a matrix product a level.

    Parameters
    ----------
    points : ndarray, shape (p, k, 2)
        Centres.
    across, up : ndarray, shapes (p, columns) and (p, rows)
        Coordinates of the grids' columns and rows.
    coefficients : ndarray, shape (p, k, outputs)
    levels : Levels

    Returns
    -------
    ndarray, shape (outputs, p, rows, columns)
    """
    (p, k, outputs), columns, rows = coefficients.shape, across.shape[1], up.shape[1]
    # Level after level in the same memory: it has to stay in the cache.
    r2 = np.empty(p * k * (columns + rows))
    gaussians = np.empty_like(r2)
    sides = [part.reshape(p, k, -1) for part in np.split(gaussians, [p * k * columns])]
    for axis, (at, side) in enumerate(zip((across, up), sides, strict=True)):
        np.subtract(points[:, :, None, axis], at[:, None, :], out=side)
    np.square(gaussians, out=r2)
    scale = np.repeat(coefficients.transpose(2, 0, 1)[..., None], rows, axis=3)
    scaled = np.empty((p, k, rows))
    values, share = np.zeros((outputs, p, rows, columns)), np.empty((p, rows, columns))
    for level in range(len(levels)):
        levels.advance(level, r2, gaussians, gaussians)
        scale *= levels.amplitudes[level] / (levels.amplitudes[level - 1] if level else 1.0)
        for output in range(outputs):
            np.multiply(sides[1], scale[output], out=scaled)
            np.matmul(scaled.transpose(0, 2, 1), sides[0], out=share)
            values[output] += share
    return values


def gram(points: FloatArray, diagonal: FloatArray, levels: Levels, out: FloatArray | None = None) -> FloatArray:
    """Lower triangles of K + diag, shape (p, k, k), of points (p, k, 2) and diagonals (p, k).

    What is above the diagonal is not to be read.
    """
    p, k, _ = points.shape
    matrix = np.zeros((p, k, k)) if out is None else out
    strips = max(1, k // 16)
    for strip in range(strips):
        top, bottom = k * strip // strips, k * (strip + 1) // strips
        levels.matrix(points[:, top:bottom], points[:, :bottom], matrix[:, top:bottom, :bottom])
    rows = np.arange(k)
    matrix[:, rows, rows] = 1.0 + diagonal
    return matrix


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """Networks of a batch of patches: coefficients (p, outputs, k), bias (p, outputs), and the quadratic form
    (y - b)' (K + diag)^-1 (y - b) of every output, shape (p, outputs)."""

    coefficients: FloatArray
    bias: FloatArray
    quadratic: FloatArray


def solve(points: FloatArray, diagonal: FloatArray, real: BoolArray, y: FloatArray, levels: Levels) -> Solved | None:
    """The networks (K + diag) c = y - b with 1' c = 0; None where a matrix is not positive definite.

    The ones and the values stand as rows below the matrix, so that its factorisation solves for them on the way.

    Parameters
    ----------
    points : ndarray, shape (p, k, 2)
    diagonal : ndarray, shape (p, k)
    real : ndarray of bool, shape (p, k)
        Which points are not padding.
    y : ndarray, shape (p, outputs, k)
        Values, 0 at the padding.
    levels : Levels
    """
    p, outputs, k = y.shape
    side = k + 1 + outputs
    bordered = np.zeros((p, side, side))
    gram(points, diagonal, levels, bordered[:, :k, :k])
    bordered[:, k, :k] = real
    bordered[:, k + 1 :, :k] = y
    below = np.arange(k, side)
    bordered[:, below, below] = _CORNER
    if not lapack.cholesky_each(bordered):
        return None
    half = np.ascontiguousarray(bordered[:, k:, :k])
    inner = half @ half.transpose(0, 2, 1)
    bias = inner[:, 0, 1:] / inner[:, 0, :1]
    quadratic = np.diagonal(inner, axis1=1, axis2=2)[:, 1:] - bias * inner[:, 0, 1:]
    coefficients = half[:, 1:] - bias[:, :, None] * half[:, :1]
    lapack.solve_transposed_each(bordered, coefficients)
    return Solved(coefficients, bias, quadratic)
