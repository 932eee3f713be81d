"""One candidate solved by Cholesky: coefficients, likelihood, leave-one-out residuals, posterior deviation."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from common.errors import TrainingError
from common.network import lapack
from common.network.selection import NO_TWINS, TINY, Samples, without_twins
from common.surface import FloatArray, IntArray

_MAX_RAISES = 12

Residuals: TypeAlias = tuple[FloatArray, FloatArray]
"""Residuals (n, k) and their variances over the signal variance (n,)."""


class Dense:
    """(K + lambda W^-1) c = y - b, factorised once.

    Where rounding makes the matrix indefinite, the smoothing is raised tenfold until it is not; `smoothing` tells what
    was used.

    Parameters
    ----------
    gram : ndarray, shape (n, n)
        K at the positions; its upper triangle is read, its diagonal overwritten.
    weights : ndarray, shape (n,)
        Samples behind each value.
    smoothing : float
        lambda, positive.
    room : ndarray, shape (n, n), optional
        Where the factor stands: who factorises often saves more than a third of the time. There `left_out` inverts it,
        and is the last that can be asked.
    """

    def __init__(self, gram: FloatArray, weights: FloatArray, smoothing: float, room: FloatArray | None = None) -> None:
        n = len(gram)
        self._lent = room is not None
        own_room = None if room is None else room.T
        self.weights = weights
        diagonal = np.diag_indices(n)
        own = gram[diagonal]
        for _ in range(_MAX_RAISES):
            gram[diagonal] = own + smoothing / weights
            # What is above the diagonal in rows is below it in columns, as LAPACK wants it.
            factor = lapack.cholesky(gram.T, own_room)
            if factor is not None:
                break
            smoothing = 10 * max(smoothing, n * float(np.finfo(np.float64).eps))
        else:
            raise TrainingError(f"the kernel matrix of {n} points is not positive definite, whatever the smoothing")
        self.factor: FloatArray = factor
        self.smoothing = smoothing
        self.one = self.inverse_times(np.ones((n, 1)))[:, 0]

    def inverse_times(self, right: FloatArray) -> FloatArray:
        """(K + lambda W^-1)^-1 B for B (n, k)."""
        return lapack.solve(self.factor, right)

    def solve(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Coefficients (n, k) and bias (k,) for values (n, k)."""
        plain = self.inverse_times(y)
        bias = plain.sum(axis=0) / self.one.sum()
        return plain - np.outer(self.one, bias), bias

    def leave_one_out(self, coefficients: FloatArray) -> Residuals:
        """`Residuals` at the samples, each left out by itself; coefficients (n, k) as `solve` gave them."""
        alone, _ = self.left_out(coefficients, *NO_TWINS)
        return alone

    def left_out(self, coefficients: FloatArray, rows: IntArray, twins: IntArray) -> tuple[Residuals, Residuals]:
        """The residuals of `leave_one_out`, and those of the rows (p,) without their twins (p,), too, else the same."""
        diagonal, elements = lapack.inverse_elements(self.factor, rows, twins, in_place=self._lent)
        if self._lent:
            del self.factor
        diagonal -= self.one**2 / self.one.sum()
        alone = coefficients / diagonal[:, None], 1 / diagonal
        if not len(rows):
            return alone, alone
        between = elements - self.one[rows] * self.one[twins] / self.one.sum()
        solved, left = without_twins(coefficients.T[..., None], diagonal[:, None], rows, twins, between[:, None])
        return alone, (solved[..., 0].T / left, 1 / left[:, 0])

    def restricted(self, samples: Samples, coefficients: FloatArray) -> tuple[float, float]:
        """Restricted negative log likelihood and the signal variance that minimises it."""
        n, outputs = samples.y.shape
        free = n - 1 + samples.repeats
        squares = float(np.sum(samples.y * coefficients)) + samples.scatter / self.smoothing
        variance = max(squares, TINY) / (free * outputs)
        log_det = 2 * float(np.log(np.diag(self.factor)).sum()) + float(np.log(self.one.sum()))
        log_det += samples.repeats * float(np.log(self.smoothing))
        return 0.5 * outputs * (free * float(np.log(variance)) + log_det), variance

    def posterior_variance(self, cross: FloatArray) -> FloatArray:
        """Variance over the signal variance, shape (m,), where the kernel to the centres is `cross` (n, m)."""
        half = lapack.solve_lower(self.factor, cross)
        bias_gap = 1 - self.one @ cross
        variance = 1 - np.einsum("nm,nm->m", half, half) + bias_gap**2 / self.one.sum()
        return np.asarray(np.clip(variance, 0, None))
