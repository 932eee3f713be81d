"""A sum of Gaussians with a bias, and how far it can be trusted."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np

from common.network import evaluation
from common.network.calibration import FEWEST, TOGETHER, Across, Calibration, told_across
from common.network.dense import Dense
from common.network.kernel import Kernel, chunks
from common.network.threads import parallel, single_threaded_blas
from common.surface import FloatArray


@dataclass(slots=True, eq=False)
class Expansion:
    """f(x) = b + sum_l sum_j c_lj exp(-|x - x_j|^2 / 2 s_l^2), with the posterior of one kernel for its deviation.

    Attributes
    ----------
    centers : ndarray, shape (n, d)
    spreads : ndarray, shape (levels,)
        Descending.
    coefficients : ndarray, shape (levels, n, k)
    bias : ndarray, shape (k,)
    support, values, weights : ndarray, shapes (m, d), (m, k) and (m,)
        The points that the deviation is conditioned on, their values, and the measurements behind each.
    kernel, smoothing, variance
        Of the candidate that the deviation is computed with.
    calibration : Calibration
        Of that deviation.
    excess : ndarray, shape (k,)
        Variance that it does not know of: what fewer centres than points leave.
    """

    centers: FloatArray
    spreads: FloatArray
    coefficients: FloatArray
    bias: FloatArray
    support: FloatArray
    values: FloatArray
    weights: FloatArray
    kernel: Kernel
    smoothing: float
    variance: float
    calibration: Calibration
    excess: FloatArray
    _factor: Dense | None = field(default=None, repr=False)
    _growth: FloatArray | None = field(default=None, repr=False)

    def predict(self, X: FloatArray) -> FloatArray:
        """Values at X (m, d), shape (m, k)."""
        return evaluation.evaluate(X, self.centers, self.spreads, self.coefficients) + self.bias

    def predict_grid(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Values on a grid, shape (len(y), len(x), k)."""
        return evaluation.evaluate_grid(x, y, self.centers, self.spreads, self.coefficients) + self.bias

    def predict_gradient(self, X: FloatArray) -> FloatArray:
        """Derivatives at X (m, d), shape (m, k, d)."""
        return evaluation.gradient(X, self.centers, self.spreads, self.coefficients)

    @single_threaded_blas()
    def predict_std(self, X: FloatArray) -> FloatArray:
        """Deviation of the surface at X (m, d), without the noise of a new measurement, shape (m, k)."""
        if self._growth is None:
            self._growth = self.calibration.growth([self._told_across()] if len(self.support) >= FEWEST else [])
        told = self.calibration.variance(self.posterior_variance(X), self._growth, self.variance, self.smoothing)
        return np.asarray(np.sqrt(told + self.excess))

    def _told_across(self) -> Across:
        """What the points tell of each other across the surface."""
        some = np.sort(np.random.default_rng(0).permutation(len(self.support))[:TOGETHER])
        X, noise = self.support[some], self.smoothing / self.weights[some]
        return told_across(X, self.values[some], self.kernel.gram(X), noise).over(np.sqrt(self.variance))

    def posterior_variance(self, X: FloatArray) -> FloatArray:
        """Variance at X (m, d) over that of the surface, as the kernel has it, shape (m,)."""
        if self._factor is None:
            self._factor = Dense(self.kernel.gram(self.support), self.weights, self.smoothing)
        factor, kernel = self._factor, self.kernel
        parts = parallel(
            lambda part: factor.posterior_variance(kernel.gram(self.support, X[part])),
            list(chunks(len(X), len(self.support))),
        )
        return np.concatenate([np.empty(0), *parts])

    def to_state(self) -> dict[str, np.ndarray[Any, Any]]:
        """Everything, as arrays that `numpy.savez` takes without pickling."""
        state = {name: np.asarray(getattr(self, name)) for name in (*_ARRAYS, *_NUMBERS)}
        state |= self.calibration.to_state()
        return state | {"kernel_spreads": self.kernel.spreads, "kernel_amplitudes": self.kernel.amplitudes}

    @classmethod
    def from_state(cls, state: dict[str, np.ndarray[Any, Any]]) -> Self:
        """The expansion that `to_state` wrote."""
        values: dict[str, Any] = {name: np.array(state[name]) for name in _ARRAYS}
        values |= {name: float(state[name]) for name in _NUMBERS}
        return cls(
            **values,
            calibration=Calibration.from_state(state),
            kernel=Kernel(np.array(state["kernel_spreads"]), np.array(state["kernel_amplitudes"])),
        )


_ARRAYS = ("centers", "spreads", "coefficients", "bias", "support", "values", "weights", "excess")
_NUMBERS = ("smoothing", "variance")
