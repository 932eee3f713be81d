"""Spread and smoothing from the data.

A candidate is a kernel K (single Gaussian or ladder) with a smoothing lambda. Its network solves
(K + lambda W^-1) c = y - b, W the weights of the points (how many samples stand behind each), b the bias. One
eigendecomposition of W^1/2 K W^1/2 gives every smoothing two criteria at once:

- the restricted likelihood (REML; Patterson and Thompson 1971), the bias integrated out;
- the leave-one-out residuals r_i = c_i / P_ii (Rippa 1999; Craven and Wahba 1979), P the inverse with the bias
  projected out, so that the bias, too, is fitted without the point.

The candidates are averaged with weights exp(-nll / 2) times (leave-one-out mean square)^(-n/4), the geometric mean of
the two criteria. Candidates share their centres, so the average is one network again: coefficients per spread add up.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from common.network.kernel import Kernel, level_matrices, rough_amplitudes, squared_distances
from common.surface import FloatArray

ROUGHNESS = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
SMOOTHINGS: FloatArray = np.logspace(-13, 1, 43)
NEGLIGIBLE = 1e-3
"""Candidates of less weight than this share of the heaviest one are left out of the average."""


def rounding_floor(n: int) -> float:
    """The least smoothing that a kernel matrix of `n` points with unit diagonal can be told from rounding by."""
    return float(4 * n * np.finfo(np.float64).eps)


class Spectrum:
    """W^1/2 K W^1/2 in its eigenbasis: every smoothing at the cost of a product.

    Parameters
    ----------
    gram : ndarray, shape (n, n)
        K at the positions.
    y : ndarray, shape (n, k)
        Values.
    weights : ndarray, shape (n,)
        Samples behind each value.
    scatter : float
        Sum of squares of those samples about `y`, over all outputs; it tells of the noise alone.
    samples : int
        Number of samples in all.
    """

    def __init__(self, gram: FloatArray, y: FloatArray, weights: FloatArray, scatter: float, samples: int) -> None:
        self.root = np.sqrt(weights)
        values, self.basis = scipy.linalg.eigh(gram * np.outer(self.root, self.root), driver="evd", check_finite=False)
        self.values = np.clip(values, 0, None)
        self.y = self.basis.T @ (self.root[:, None] * y)
        self.one = self.basis.T @ self.root
        self.scatter, self.samples = scatter, samples

    def criteria(self, smoothings: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Restricted nll (m,), leave-one-out mean square (m,) and signal variance (m,) of m smoothings."""
        inverse = 1 / (self.values[:, None] + smoothings)
        one_one = self.one**2 @ inverse
        one_y = (self.one[:, None] * self.y).T @ inverse
        quadratic = (self.y**2).T @ inverse - one_y**2 / one_one
        outputs, free = self.y.shape[1], self.samples - 1
        extra = self.samples - len(self.values)
        variance = (np.clip(quadratic, np.finfo(float).tiny, None).sum(axis=0) + self.scatter / smoothings) / (
            free * outputs
        )
        log_det = -np.log(inverse).sum(axis=0) + np.log(one_one) + extra * np.log(smoothings)
        nll = 0.5 * outputs * (free * np.log(variance) + log_det)
        residuals = self.leave_one_out(inverse)
        return nll, np.mean(residuals**2, axis=(0, 1)), variance

    def leave_one_out(self, inverse: FloatArray) -> FloatArray:
        """Value minus the prediction without it, shape (n, k, m)."""
        one_one = self.one**2 @ inverse
        along_one = self.basis @ (self.one[:, None] * inverse)
        diagonal = self.basis**2 @ inverse - along_one**2 / one_one
        residuals = np.empty((*self.y.shape, inverse.shape[1]))
        for k in range(self.y.shape[1]):
            column = self.y[:, k : k + 1] * inverse
            bias = (self.one @ column) / one_one
            residuals[:, k] = (self.basis @ column - along_one * bias) / diagonal
        return residuals / self.root[:, None, None]

    def solve(self, smoothings: FloatArray, shares: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Coefficients (n, k) and bias (k,), averaged over the smoothings with the given shares (m,)."""
        inverse = 1 / (self.values[:, None] + smoothings)
        bias = ((self.one[:, None] * self.y).T @ inverse) / (self.one**2 @ inverse)
        averaged = self.y * (inverse @ shares)[:, None] - self.one[:, None] * (inverse @ (shares * bias).T)
        return self.root[:, None] * (self.basis @ averaged), bias @ shares


@dataclass(frozen=True, slots=True, eq=False)
class Average:
    """What the data say: candidates, their shares, and the network they add up to.

    `coefficients` has the shape (levels, n, k) over `spreads` (levels,); `bias` (k,); `kernel`, `smoothing` and
    `variance` are those of the candidate of the greatest share.
    """

    spreads: FloatArray
    coefficients: FloatArray
    bias: FloatArray
    kernel: Kernel
    smoothing: float
    variance: float


def candidate_kernels(spreads: FloatArray, roughness: Sequence[float] = ROUGHNESS) -> FloatArray:
    """Amplitudes (candidates, levels): each spread alone, and the whole ladder for each roughness."""
    return np.vstack([np.eye(len(spreads)), *(rough_amplitudes(spreads, h)[None] for h in roughness)])


def average(
    X: FloatArray,
    y: FloatArray,
    spreads: FloatArray,
    kernels: FloatArray,
    smoothings: FloatArray,
    *,
    weights: FloatArray,
    scatter: float,
    samples: int,
    tick: Callable[[float], None],
) -> Average:
    """Average all kernels (amplitudes, one a row) and smoothings on the positions X (n, d) and values y (n, k)."""
    levels = np.array(level_matrices(squared_distances(X), spreads))
    kernels = kernels / kernels.sum(axis=1, keepdims=True)
    spectra: list[Spectrum] = []
    scores = np.empty((len(kernels), len(smoothings)))
    variances = np.empty_like(scores)
    for index, amplitudes in enumerate(kernels):
        used = np.flatnonzero(amplitudes)
        gram = np.tensordot(amplitudes[used], levels[used], axes=1)
        spectra.append(Spectrum(gram, y, weights, scatter, samples))
        nll, mean_square, variances[index] = spectra[-1].criteria(smoothings)
        scores[index] = nll / 2 + 0.25 * y.size * np.log(np.clip(mean_square, np.finfo(float).tiny, None))
        tick((index + 1) / len(kernels))
    shares = np.exp(scores.min() - scores)
    shares[shares < NEGLIGIBLE] = 0
    shares /= shares.sum()
    coefficients = np.zeros((len(spreads), *y.shape))
    bias = np.zeros(y.shape[1])
    for index in np.flatnonzero(shares.sum(axis=1)).tolist():
        c, b = spectra[index].solve(smoothings, shares[index])
        coefficients += kernels[index][:, None, None] * c
        bias += b
    best_kernel, best_smoothing = np.unravel_index(int(np.argmax(shares)), shares.shape)
    present = np.flatnonzero(np.any(coefficients != 0, axis=(1, 2)))
    return Average(
        spreads[present],
        coefficients[present],
        bias,
        Kernel.mixture(spreads, kernels[best_kernel]),
        float(smoothings[best_smoothing]),
        float(variances[best_kernel, best_smoothing]),
    )
