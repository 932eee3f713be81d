"""RBFNetwork: scattered values in, a smooth function out."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt

from common.errors import NotReadyError, ParameterError, PointsError
from common.network import expansion
from common.network.dense import Dense
from common.network.kernel import Kernel, ladder_spreads, mean_spacing, nearest_distance
from common.network.selection import SMOOTHINGS, average, candidate_kernels, rounding_floor
from common.surface import FloatArray, IntArray

Callback: TypeAlias = Callable[[str, float], None]

AVERAGED = 400
"""Points up to which all candidates are averaged; of more points, a sample this large chooses one candidate."""

EXPLODED = 1.0
"""A fit whose leave-one-out error is this many times the deviation of the values is worse than their mean."""


class NetworkWarning(UserWarning):
    """The network was fitted, but not as asked; `notes_` says the same."""


class RBFNetwork:
    """Gaussian radial basis function network for scattered data.

    f(x) = b + sum_l sum_j c_lj exp(-|x - x_j|^2 / 2 s_l^2)

    Parameters
    ----------
    spread : "auto", "paper" or float
        Spread s of the neurons, in the units of X. "auto" lets the data choose between one spread and a ladder of
        spreads; "paper" is twice the mean distance between neighbouring centres.
    smoothing : "auto" or float
        lambda >= 0 on the diagonal of the kernel matrix, whose diagonal is 1: the variance of the noise over that of
        the surface. 0 interpolates.
    tolerance : float
        Greatest error at the points, in the units of y, at which no more centres are added. 0 makes every point a
        centre.
    max_centers : int or None
        Most centres chosen.
    mapping : "height" or "autoassociative"
        "height" maps a position to its value. "autoassociative" maps a point onto the surface,
        (x, y, z) -> (x, y, z); a value is then the fixed point in z.
    callback : callable or None
        ``callback(stage, fraction)`` is called during `fit`; whatever it raises ends the fit.

    Attributes
    ----------
    centers_ : ndarray, shape (n_centers, d)
    coefficients_ : ndarray, shape (n_centers,) or (n_centers, k); a leading axis of levels where there are several
    spread_ : float or ndarray, shape (levels,)
        Descending.
    smoothing_ : float
    bias_ : ndarray, shape (k,)
    history_ : ndarray
        Greatest error at the points after each round of chosen centres.
    stop_reason_ : str
        Why no more centres were added.
    outliers_ : ndarray of int
        Rows of X that were set aside.
    notes_ : tuple of str
        What was done differently than asked.
    """

    centers_: FloatArray
    coefficients_: FloatArray
    spread_: float | FloatArray
    smoothing_: float
    bias_: FloatArray
    history_: FloatArray
    stop_reason_: str
    outliers_: IntArray
    notes_: tuple[str, ...]
    n_features_in_: int

    def __init__(
        self,
        *,
        spread: float | Literal["auto", "paper"] = "auto",
        smoothing: float | Literal["auto"] = "auto",
        tolerance: float = 0.0,
        max_centers: int | None = None,
        mapping: Literal["height", "autoassociative"] = "height",
        callback: Callback | None = None,
    ) -> None:
        self.spread = spread
        self.smoothing = smoothing
        self.tolerance = tolerance
        self.max_centers = max_centers
        self.mapping = mapping
        self.callback = callback

    def fit(self, X: npt.ArrayLike, y: npt.ArrayLike) -> Self:
        """Fit to positions X (n, d) and values y (n,) or (n, k); returns self.

        Raises
        ------
        PointsError
            If X or y is not finite, of the wrong shape or of too few points.
        ParameterError
            If a setting is out of its bounds.
        """
        positions, values = _training_arrays(X, y)
        self._check_settings()
        self.n_features_in_ = positions.shape[1]
        self._single_output = np.ndim(y) == 1
        self._notes: list[str] = []
        self.outliers_ = np.zeros(0, dtype=np.int64)
        self.history_ = np.zeros(0)
        self.stop_reason_ = "every point is a centre"
        if self.mapping == "autoassociative" or self.tolerance or self.max_centers is not None:
            raise ParameterError("accepted for now are mapping 'height', tolerance 0 and max_centers None")

        unique, means, weights, scatter = merge_repeated(positions, values)
        self._origin, self._unit = unique.mean(axis=0), float(np.sqrt(np.var(unique, axis=0).sum())) or 1.0
        self._level = means.mean(axis=0)
        self._height = np.where((deviation := means.std(axis=0)) > 0, deviation, 1.0)
        scaled = (unique - self._origin) / self._unit
        heights = (means - self._level) / self._height
        self._fit_dense(scaled, heights, weights, scatter / self._height**2, len(values))
        self.centers_ = unique
        for note in self._notes:
            warnings.warn(note, NetworkWarning, stacklevel=2)
        self.notes_ = tuple(self._notes)
        return self

    def _check_settings(self) -> None:
        for name, words in (("spread", ("auto", "paper")), ("smoothing", ("auto",))):
            value = getattr(self, name)
            if isinstance(value, str):
                if value not in words:
                    raise ParameterError(f"{name} {value!r} is unknown; accepted are a number or {' or '.join(words)}")
            elif not np.isfinite(value) or value < 0 or (name == "spread" and value == 0):
                raise ParameterError(f"{name} must be {'positive' if name == 'spread' else 'at least 0'}, got {value}")
        if not (np.isfinite(self.tolerance) and self.tolerance >= 0):
            raise ParameterError(f"tolerance must be at least 0, got {self.tolerance}")
        if self.max_centers is not None and self.max_centers < 1:
            raise ParameterError(f"max_centers must be at least 1 or None, got {self.max_centers}")
        if self.mapping not in ("height", "autoassociative"):
            raise ParameterError(f"mapping {self.mapping!r} is unknown; accepted are 'height', 'autoassociative'")

    def _tick(self, stage: str, fraction: float) -> None:
        if self.callback is not None:
            self.callback(stage, fraction)

    def _fit_dense(self, X: FloatArray, y: FloatArray, weights: FloatArray, scatter: FloatArray, samples: int) -> None:
        """Every point a centre; X and y in units of their own extent."""
        n = len(X)
        self._tick("selection", 0.0)
        spacing = mean_spacing(X) or 1.0
        if self.spread == "auto":
            spreads = ladder_spreads(spacing, 2 * float(np.ptp(X, axis=0).max()) or 1.0)
            kernels = candidate_kernels(spreads)
        else:
            given = 2 * nearest_distance(X) if self.spread == "paper" else float(self.spread) / self._unit
            spreads, kernels = np.array([given or 1.0]), np.ones((1, 1))
        floor = rounding_floor(n)
        if self.smoothing == "auto":
            smoothings = SMOOTHINGS[floor <= SMOOTHINGS]
        else:
            smoothings = np.array([max(float(self.smoothing), floor)])
        rows = np.arange(n)
        if n > AVERAGED:
            rows = np.sort(np.random.default_rng(0).permutation(n)[:AVERAGED])
        chosen = average(
            X[rows],
            y[rows],
            spreads,
            kernels,
            smoothings,
            weights=weights[rows],
            scatter=float(scatter.sum()) * len(rows) / n,
            samples=len(rows) + (samples - n) * len(rows) // n,
            tick=lambda fraction: self._tick("selection", fraction),
        )
        self._kernel, self._lambda, self._variance = chosen.kernel, chosen.smoothing, chosen.variance
        coefficients, bias, levels = chosen.coefficients, chosen.bias, chosen.spreads
        if n > AVERAGED:
            self._tick("solve", 0.0)
            dense = Dense(self._kernel.gram(X), weights, self._lambda)
            c, bias = dense.solve(y)
            self._lambda, levels = dense.smoothing, self._kernel.spreads
            _, self._variance = dense.likelihood(y, c)
            coefficients = self._kernel.amplitudes[:, None, None] * c
        self._tick("solve", 1.0)
        self._X, self._weights = X, weights
        self._spreads, self._coefficients, self._bias = levels, coefficients, bias
        self._factor: Dense | None = None
        self._publish()

    def _publish(self) -> None:
        spreads = self._spreads * self._unit
        coefficients = self._coefficients * self._height
        if self._single_output:
            coefficients = coefficients[:, :, 0]
        single = len(spreads) == 1
        self.spread_ = float(spreads[0]) if single else spreads
        self.coefficients_ = coefficients[0] if single else coefficients
        self.bias_ = self._level + self._bias * self._height
        self.smoothing_ = self._lambda

    def predict(self, X: npt.ArrayLike, return_std: bool = False) -> Any:
        """Values at positions X (m, d), shape (m,) or (m, k); with `return_std` also their deviation, (m,) or (m, k).

        The deviation is that of the surface, without the noise of a new measurement.
        """
        scaled = self._scaled(X)
        values = expansion.evaluate(scaled, self._X, self._spreads, self._coefficients) + self._bias
        heights = self._shaped(values * self._height + self._level)
        return (heights, self._shaped(self._deviation(scaled))) if return_std else heights

    def predict_grid(self, x: npt.ArrayLike, y: npt.ArrayLike, return_std: bool = False) -> Any:
        """Values on a grid, shape (len(y), len(x)) or (len(y), len(x), k); positions must be in the plane."""
        self._check_fitted()
        if self.n_features_in_ != 2:
            raise PointsError(f"a grid needs positions in the plane; the network was fitted in {self.n_features_in_}")
        axis_x, axis_y = (np.asarray(a, dtype=np.float64) for a in (x, y))
        values = expansion.evaluate_grid(
            (axis_x - self._origin[0]) / self._unit,
            (axis_y - self._origin[1]) / self._unit,
            self._X,
            self._spreads,
            self._coefficients,
        )
        grid = (values + self._bias) * self._height + self._level
        grid = grid[:, :, 0] if self._single_output else grid
        if not return_std:
            return grid
        nodes = np.stack(np.meshgrid(axis_x, axis_y), axis=-1).reshape(-1, 2)
        return grid, self._shaped(self._deviation(self._scaled(nodes))).reshape(grid.shape)

    def predict_gradient(self, X: npt.ArrayLike) -> FloatArray:
        """Derivatives at X (m, d), shape (m, d) or (m, k, d), in units of y over units of X."""
        scaled = self._scaled(X)
        slopes = expansion.gradient(scaled, self._X, self._spreads, self._coefficients)
        slopes *= (self._height / self._unit)[:, None]
        return np.asarray(slopes[:, 0] if self._single_output else slopes)

    def _deviation(self, scaled: FloatArray) -> FloatArray:
        if self._factor is None:
            self._factor = Dense(self._kernel.gram(self._X), self._weights, self._lambda)
        variance = np.empty(len(scaled))
        for part in expansion.chunks(len(scaled), len(self._X)):
            variance[part] = self._factor.posterior_variance(self._kernel.gram(self._X, scaled[part]))
        return np.asarray(np.sqrt(self._variance * variance)[:, None] * self._height)

    def _shaped(self, values: FloatArray) -> FloatArray:
        return np.asarray(values[:, 0] if self._single_output else values)

    def _scaled(self, X: npt.ArrayLike) -> FloatArray:
        self._check_fitted()
        positions = _finite(X, "X")
        if positions.ndim != 2 or positions.shape[1] != self.n_features_in_:
            raise PointsError(f"X has the shape {positions.shape}; the network expects (m, {self.n_features_in_})")
        return np.asarray((positions - self._origin) / self._unit, dtype=np.float64)

    def _check_fitted(self) -> None:
        if not hasattr(self, "centers_"):
            raise NotReadyError(f"this {type(self).__name__} is not fitted yet; call fit(X, y) first")

    def get_params(self, deep: bool = True) -> dict[str, Any]:  # noqa: ARG002 - scikit-learn's signature
        """The settings, by name."""
        return {name: getattr(self, name) for name in _SETTINGS}

    def set_params(self, **params: Any) -> Self:
        """Change settings by name; returns self. Raises ParameterError for an unknown name."""
        for name, value in params.items():
            if name not in _SETTINGS:
                raise ParameterError(f"Invalid parameter {name!r}; accepted are {', '.join(_SETTINGS)}")
            setattr(self, name, value)
        return self

    def to_state(self) -> dict[str, np.ndarray[Any, Any]]:
        """Everything that was learnt, as arrays that `numpy.savez` takes without pickling."""
        self._check_fitted()
        state: dict[str, np.ndarray[Any, Any]] = {}
        for name, key in _STATE.items():
            state[name] = np.asarray(getattr(self, key))
        state["kernel_spreads"], state["kernel_amplitudes"] = self._kernel.spreads, self._kernel.amplitudes
        return state

    @classmethod
    def from_state(cls, state: dict[str, np.ndarray[Any, Any]]) -> Self:
        """The network that `to_state` wrote."""
        network = cls()
        for name, key in _STATE.items():
            value = state[name]
            setattr(network, key, value.item() if value.ndim == 0 else np.array(value))
        network.notes_ = tuple(np.atleast_1d(network.notes_).tolist())
        network._kernel = Kernel(np.array(state["kernel_spreads"]), np.array(state["kernel_amplitudes"]))
        network._factor = None
        network._publish()
        return network


_SETTINGS = ("callback", "mapping", "max_centers", "smoothing", "spread", "tolerance")
_STATE = {
    "centers": "centers_",
    "features": "n_features_in_",
    "single_output": "_single_output",
    "history": "history_",
    "stop_reason": "stop_reason_",
    "outliers": "outliers_",
    "notes": "notes_",
    "positions": "_X",
    "weights": "_weights",
    "spreads": "_spreads",
    "coefficients": "_coefficients",
    "bias": "_bias",
    "origin": "_origin",
    "unit": "_unit",
    "level": "_level",
    "height": "_height",
    "smoothing": "_lambda",
    "variance": "_variance",
}


def _finite(values: npt.ArrayLike, name: str) -> FloatArray:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise PointsError(f"{name} must be an array of numbers: {error}") from error
    if not np.all(np.isfinite(array)):
        raise PointsError(f"{name} must be finite; it contains NaN or infinity")
    return np.ascontiguousarray(array)


def _training_arrays(X: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    positions, values = _finite(X, "X"), _finite(y, "y")
    if positions.ndim != 2 or not positions.shape[1]:
        raise PointsError(f"X must have the shape (n, d), got {positions.shape}")
    if values.ndim not in (1, 2) or len(values) != len(positions):
        raise PointsError(f"y must have the shape (n,) or (n, k) with n = {len(positions)}, got {values.shape}")
    if len(positions) < 2:
        raise PointsError(f"at least 2 points are needed, got {len(positions)}")
    return positions, values.reshape(len(values), -1)


def merge_repeated(X: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Distinct positions (m, d), their mean values (m, k), samples behind each (m,), sum of squares about them (k,)."""
    distinct, first, inverse, counts = np.unique(X, axis=0, return_index=True, return_inverse=True, return_counts=True)
    order = np.argsort(first)
    if len(distinct) == len(X):
        return X, y, np.ones(len(X)), np.zeros(y.shape[1])
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    group = rank[inverse.ravel()]
    weights = counts[order].astype(np.float64)
    means = np.column_stack([np.bincount(group, column) for column in y.T]) / weights[:, None]
    return distinct[order], means, weights, np.sum((y - means[group]) ** 2, axis=0)
