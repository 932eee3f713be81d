"""Many small networks at once: kernel matrices, solutions and values of a batch of patches.

A batch holds patches of about the same number of points, padded to the largest. Padding lies so far away that no
Gaussian reaches it, with the value 0: its coefficients come out as 0, and no mask is needed. Arrays begin with the axis
of patches.
"""

from __future__ import annotations

import numpy as np

from common.network import lapack
from common.network.kernel import Kernel
from common.surface import FloatArray

CACHED = 1 << 17
"""Kernel values worked on at once: 1 MiB, about what a core's cache holds."""

FAR = 1e7
"""Distance of the padding, in mean spacings; each padded point has its own."""

TINY = float(np.finfo(np.float64).tiny)

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

    def total(self, r2: FloatArray, out: FloatArray, scratch: FloatArray) -> None:
        """sum_l a_l exp(-r^2 / 2 s_l^2) into `out`; `scratch` (2, ...) is room for two more of the shape of r2."""
        if len(self) == 1:
            self.advance(0, r2, out, out)
            return
        current, share = scratch
        for level in range(len(self)):
            self.advance(level, r2, current, current)
            if level:
                np.multiply(current, self.amplitudes[level], out=share)
                np.add(out, share, out=out)
            else:
                np.multiply(current, self.amplitudes[0], out=out)

    def matrix(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """The kernel of (p, m, 2) and (p, k, 2), shape (p, m, k), a cache-full at a time."""
        p, m, k = len(a), a.shape[1], b.shape[1]
        result = np.empty((p, m, k))
        rows = max(1, CACHED // max(1, m * k))
        room = np.empty((3, min(rows, p), m, k))
        for start in range(0, p, rows):
            part = slice(start, min(p, start + rows))
            r2, scratch = room[0, : part.stop - start], room[1:, : part.stop - start]
            squared_distances(a[part], b[part], r2)
            self.total(r2, result[part], scratch)
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


def gram(points: FloatArray, diagonal: FloatArray, levels: Levels) -> FloatArray:
    """Lower triangles of K + diag, shape (p, k, k), of points (p, k, 2) and diagonals (p, k).

    What is above the diagonal is not to be read.
    """
    p, k, _ = points.shape
    matrix = np.zeros((p, k, k))
    strips = max(1, k // 16)
    for strip in range(strips):
        top, bottom = k * strip // strips, k * (strip + 1) // strips
        matrix[:, top:bottom, :bottom] = levels.matrix(points[:, top:bottom], points[:, :bottom])
    rows = np.arange(k)
    matrix[:, rows, rows] = 1.0 + diagonal
    return matrix


def solve(matrix: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """K^-1 B by Cholesky, and B' K^-1 B; None where a matrix of the batch is not positive definite.

    Parameters
    ----------
    matrix : ndarray, shape (p, k, k)
        Lower triangles; overwritten.
    right : ndarray, shape (p, m, k)

    Returns
    -------
    solution : ndarray, shape (p, m, k)
    inner : ndarray, shape (p, m, m)
    """
    if not lapack.cholesky_each(matrix):
        return None
    solution = right.copy()
    lapack.solve_lower_each(matrix, solution)
    inner = solution @ solution.transpose(0, 2, 1)
    lapack.solve_lower_each(matrix, solution, transposed=True)
    return solution, inner


def scores(grams: FloatArray, y: FloatArray, weights: FloatArray, smoothings: FloatArray) -> FloatArray:
    """How well kernels with smoothings explain the values of one patch; less is better.

    The mean of the restricted negative log likelihood and of n/2 log of the leave-one-out mean square: the likelihood
    alone is poor for clean values, leaving one out alone for noisy ones. One eigendecomposition of W^1/2 K W^1/2 serves
    all smoothings.

    Parameters
    ----------
    grams : ndarray, shape (g, n, n)
        Kernel matrices.
    y : ndarray, shape (n, k)
        Values.
    weights : ndarray, shape (n,)
        Samples behind each value.
    smoothings : ndarray, shape (s,)

    Returns
    -------
    ndarray, shape (g, s)
    """
    n, outputs = y.shape
    root = np.sqrt(weights)
    values, basis = np.linalg.eigh(grams * np.outer(root, root))
    inverse = 1 / (np.maximum(values, 0.0)[:, :, None] + smoothings)
    one = root @ basis
    one_one = np.einsum("gn,gns->gs", one**2, inverse)
    log_det = np.log(one_one) - np.log(inverse).sum(axis=1)
    diagonal = np.square(basis) @ inverse - (basis @ (one[:, :, None] * inverse)) ** 2 / one_one[:, None]
    score = np.zeros((len(grams), len(smoothings)))
    for k in range(outputs):
        z = (root * y[:, k]) @ basis
        one_z = np.einsum("gn,gns->gs", one * z, inverse)
        quadratic = np.einsum("gn,gns->gs", z**2, inverse) - one_z**2 / one_one
        variance = np.maximum(quadratic, TINY) / (n - 1)
        coefficients = basis @ (z[:, :, None] * inverse) - (one_z / one_one)[:, None] * (
            basis @ (one[:, :, None] * inverse)
        )
        left_out = np.mean((coefficients / diagonal / root[:, None]) ** 2, axis=1)
        score += ((n - 1) * np.log(variance) + log_det + n * np.log(np.maximum(left_out, TINY))) / 4
    return score
