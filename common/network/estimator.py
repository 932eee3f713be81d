"""RBFNetwork: scattered values in, a smooth function out."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, Literal, Self, TypeAlias

import numpy as np
import numpy.typing as npt

from common.errors import NotReadyError, ParameterError, PointsError, TrainingError
from common.network import autoassociative, evaluation, greedy, robust, search
from common.network.dense import Dense
from common.network.kernel import Kernel, chunks, ladder_spreads, mean_spacing, nearest_distance
from common.network.partition import Partition
from common.network.selection import SMOOTHINGS, Fit, Samples, families, rounding_floor
from common.surface import FloatArray, IntArray

Callback: TypeAlias = Callable[[str, float], None]

DENSE = 6000
"""Distinct positions up to which one matrix holds the kernel: 288 MB a copy."""

PATCHES = 2500
"""Points in the plane above which many small networks take over: as accurate, and the faster the more points there
are."""

EXPLODED = 2.0
"""A fit whose leave-one-out error is this many times the deviation of the values is far worse than their mean."""


class NetworkWarning(UserWarning):
    """The network was fitted, but not as asked; `notes_` says the same."""


class RBFNetwork:
    """Gaussian radial basis function network for scattered data.

    f(x) = b + sum_l sum_j c_lj exp(-|x - x_j|^2 / 2 s_l^2)

    Of more than `PATCHES` points in the plane the surface is a partition of unity of many such networks (see
    `Partition`), unless fewer centres than points are asked for. In other dimensions, with `tolerance`, `max_centers`
    or the autoassociative mapping there is one network of at most `DENSE` points.

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
        Of patches: those of each patch in turn, the amplitudes of the levels left out.
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
        TrainingError
            If no network can be trained on these points.
        """
        positions, values = _training_arrays(X, y)
        self._check_settings()
        if self.mapping == "autoassociative" and values.shape[1] != 1:
            raise ParameterError(f"mapping 'autoassociative' takes one value a position, got {values.shape[1]}")
        self._patches: Partition | None = None
        all_centers = not self.tolerance and self.max_centers is None
        if len(positions) > PATCHES and positions.shape[1] == 2 and self.mapping == "height" and all_centers:
            return self._fit_patches(positions, values, single_output=np.ndim(y) == 1)
        notes: list[str] = []
        unique, means, weights, scatter, group = merge_repeated(positions, values)
        self._origin, self._unit = unique.mean(axis=0), float(np.sqrt(np.var(unique, axis=0).sum())) or 1.0
        self._level = means.mean(axis=0)
        self._height = np.where((deviation := means.std(axis=0)) > 0, deviation, 1.0)
        samples = Samples(
            (unique - self._origin) / self._unit,
            (means - self._level) / self._height,
            weights,
            float(np.sum(scatter / self._height**2)),
            len(positions) - len(unique),
        )
        self._single_output = np.ndim(y) == 1
        self._lifted = self.mapping == "autoassociative"
        if len(samples) > DENSE:
            raise TrainingError(f"{len(samples)} distinct positions; at most {DENSE} are accepted")
        if self._lifted:
            self._fit_lifted(samples)
        else:
            self._fit_heights(samples, notes)
        out = self._set_aside
        self.n_features_in_ = positions.shape[1]
        self.outliers_ = np.flatnonzero(np.isin(group, out)).astype(np.int64)
        self._publish()
        self.notes_ = tuple(notes)
        for note in notes:
            warnings.warn(note, NetworkWarning, stacklevel=2)
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

    def _fit_heights(self, samples: Samples, notes: list[str]) -> None:
        """Positions to values; `samples` in units of their own extent."""
        self._tick("selection", 0.0)
        smoothing = None if self.smoothing == "auto" else float(self.smoothing)
        fit = self._select(samples, smoothing)
        if smoothing is not None and _exploded(fit):
            notes.append(
                f"smoothing {smoothing:g} with this spread leaves the fit unstable (leave-one-out error "
                f"{float(np.sqrt(np.mean(fit.residuals**2))):.3g} times the deviation of the values); "
                "the smoothing was chosen from the data instead"
            )
            smoothing = None
            fit = self._select(samples, None)
        fit, self._set_aside = robust.set_aside(
            samples, fit, lambda part, quick: self._select(part, smoothing, quick=quick)
        )
        samples = samples.without(self._set_aside)
        self._support, self._weights = samples.X, samples.weights
        self._kernel, self._lambda, self._variance = fit.kernel, fit.smoothing, fit.variance
        self._calibration = _calibration(fit)
        self._factor: Dense | None = None
        if self.tolerance or self.max_centers is not None:
            self._choose_centers(samples, fit)
        else:
            self._neurons, self._spreads, self._coefficients, self._bias = (
                samples.X,
                fit.spreads,
                fit.coefficients,
                fit.bias,
            )
            self.history_, self.stop_reason_ = np.zeros(0), "every point is a centre"
        self._tick("solve", 1.0)

    def _fit_patches(self, positions: FloatArray, values: FloatArray, *, single_output: bool) -> Self:
        """Many points in the plane: a partition of unity."""
        spread = 2 * nearest_distance(np.unique(positions, axis=0)) if self.spread == "paper" else self.spread
        self._level, deviation = values.mean(axis=0), values.std(axis=0)
        self._height = np.where(deviation > 0, deviation, 1.0)
        patches = Partition.fit(
            positions,
            (values - self._level) / self._height,
            spread=spread if spread == "auto" else float(spread),
            smoothing=self.smoothing if isinstance(self.smoothing, str) else float(self.smoothing),
            tick=self._tick,
        )
        self._patches, self._single_output, self._lifted = patches, single_output, False
        self.n_features_in_ = positions.shape[1]
        self.outliers_ = np.zeros(0, dtype=np.int64)
        self.history_, self.stop_reason_, self.notes_ = np.zeros(0), "every point is a centre", ()
        self._publish_patches(patches)
        return self

    def _publish_patches(self, patches: Partition) -> None:
        self.centers_ = patches.centers
        self.coefficients_ = self._shaped(patches.coefficients * self._height)
        spreads = np.median(patches.spreads, axis=0)
        self.spread_ = float(spreads[0]) if len(spreads) == 1 else spreads
        self.bias_ = self._level + np.mean(patches.bias, axis=0) * self._height
        self.smoothing_ = float(np.median(patches.smoothing))

    def _select(self, samples: Samples, smoothing: float | None, *, quick: bool = False) -> Fit:
        extent = float(np.ptp(samples.X, axis=0).max()) or 1.0
        spreads = ladder_spreads(mean_spacing(samples.X) or 1.0, 2 * extent)
        if self.spread == "auto":
            kinds = families(spreads, extent)
        else:
            given = 2 * nearest_distance(samples.X) if self.spread == "paper" else float(self.spread) / self._unit
            spreads = np.array([given or 1.0])
            kinds = [("single", float(spreads[0]))]
        floor = rounding_floor(len(samples))
        smoothings = SMOOTHINGS[floor <= SMOOTHINGS] if smoothing is None else np.array([max(smoothing, floor)])
        return search.fit(
            samples, kinds, spreads, smoothings, lambda share: self._tick("selection", share), quick=quick
        )

    def _choose_centers(self, samples: Samples, fit: Fit) -> None:
        """Fewer neurons than points: the kernel of the best candidate, centres by the Newton basis."""
        chosen = greedy.select(
            samples.X,
            samples.y - fit.bias,
            fit.kernel.gram,
            smoothing=fit.smoothing,
            weights=samples.weights,
            tolerance=self.tolerance / float(self._height.max()),
            max_centers=self.max_centers,
            tick=lambda share: self._tick("centres", share),
        )
        self._neurons = samples.X[chosen.indices]
        self._spreads, self._bias = fit.kernel.spreads, fit.bias
        self._coefficients = fit.kernel.amplitudes[:, None, None] * chosen.coefficients
        self.history_ = chosen.history * float(self._height.max())
        self.stop_reason_ = chosen.stop_reason

    def _fit_lifted(self, samples: Samples) -> None:
        """Points to points: the value is one more coordinate, in units of its own deviation."""
        self._tick("selection", 0.0)
        points = np.column_stack([samples.X, samples.y])
        spread = {"auto": None, "paper": 2 * nearest_distance(points) or 1.0}.get(
            str(self.spread), None if isinstance(self.spread, str) else float(self.spread) / self._unit
        )
        smoothing = None if isinstance(self.smoothing, str) else float(self.smoothing)
        spread, smoothing = autoassociative.choose(
            points, samples.weights, spread, smoothing, lambda share: self._tick("selection", share)
        )
        coefficients, self._bias, dense = autoassociative.fit(points, samples.weights, spread, smoothing)
        residuals, deviations = dense.leave_one_out(coefficients)
        self._variance = float(np.mean(residuals[:, -1] ** 2 / deviations))
        self._neurons = self._support = points
        self._weights, self._factor, self._calibration = samples.weights, dense, 1.0
        self._kernel, self._lambda = Kernel.single(spread), dense.smoothing
        self._spreads, self._coefficients = self._kernel.spreads, coefficients[None]
        self._set_aside = np.zeros(0, dtype=np.int64)
        self.history_, self.stop_reason_ = np.zeros(0), "every point is a centre"
        self._tick("solve", 1.0)

    def _publish(self) -> None:
        """The learned attributes, in the caller's units."""
        origin, height = self._origin, self._height
        if self._lifted:
            origin = np.append(origin, 0.0)
        centers = self._neurons * self._unit + origin
        bias = self._bias
        if self._lifted:
            centers[:, -1] = self._neurons[:, -1] * self._height[0] + self._level[0]
            scale = np.append(np.full(len(self._origin), self._unit), self._height)
            self.bias_ = bias * scale + np.append(self._origin, self._level)
            coefficients = self._coefficients * scale
        else:
            self.bias_ = self._level + bias * height
            coefficients = self._coefficients * height
            if self._single_output:
                coefficients = coefficients[:, :, 0]
        self.centers_ = centers
        spreads = self._spreads * self._unit
        single = len(spreads) == 1
        self.spread_ = float(spreads[0]) if single else spreads
        self.coefficients_ = coefficients[0] if single else coefficients
        self.smoothing_ = self._lambda

    def predict(self, X: npt.ArrayLike, return_std: bool = False) -> Any:
        """Values at positions X (m, d), shape (m,) or (m, k); with `return_std` their deviation, too.

        The deviation is that of the surface, without the noise of a new measurement.
        """
        self._check_fitted()
        if self._patches is not None:
            positions = self._positions(X)
            heights = self._shaped(self._patches.predict(positions) * self._height + self._level)
            if not return_std:
                return heights
            return heights, self._shaped(self._patches.predict_std(positions) * self._height)
        scaled = self._scaled(X)
        if self._lifted:
            values, slope = self._lifted_heights(scaled)
        else:
            values = evaluation.evaluate(scaled, self._neurons, self._spreads, self._coefficients) + self._bias
            slope = np.zeros(len(scaled))
        result = self._shaped(values * self._height + self._level)
        if not return_std:
            return result
        where = np.column_stack([scaled, values]) if self._lifted else scaled
        return result, self._shaped(
            self._deviation(where) / np.maximum(np.abs(1 - slope), autoassociative.LEAST_SLOPE)[:, None]
        )

    def predict_grid(self, x: npt.ArrayLike, y: npt.ArrayLike, return_std: bool = False) -> Any:
        """Values on a grid, shape (len(y), len(x)) or (len(y), len(x), k); positions must be in the plane."""
        self._check_fitted()
        if self.n_features_in_ != 2:
            raise PointsError(f"a grid needs positions in the plane; the network was fitted in {self.n_features_in_}")
        axis_x, axis_y = _finite(x, "x"), _finite(y, "y")
        if axis_x.ndim != 1 or axis_y.ndim != 1:
            raise PointsError(f"x and y must be one-dimensional, got the shapes {axis_x.shape} and {axis_y.shape}")
        if return_std or self._lifted:
            nodes = np.stack(np.meshgrid(axis_x, axis_y), axis=-1).reshape(-1, 2)
            shape = (len(axis_y), len(axis_x)) + (() if self._single_output else (len(self._height),))
            found = self.predict(nodes, return_std)
            if return_std:
                return found[0].reshape(shape), found[1].reshape(shape)
            return found.reshape(shape)
        if self._patches is not None:
            grid = self._patches.predict_grid(axis_x, axis_y) * self._height + self._level
            return np.ascontiguousarray(grid[:, :, 0]) if self._single_output else grid
        values = evaluation.evaluate_grid(
            (axis_x - self._origin[0]) / self._unit,
            (axis_y - self._origin[1]) / self._unit,
            self._neurons,
            self._spreads,
            self._coefficients,
        )
        grid = (values + self._bias) * self._height + self._level
        return np.ascontiguousarray(grid[:, :, 0]) if self._single_output else grid

    def predict_gradient(self, X: npt.ArrayLike) -> FloatArray:
        """Derivatives at X (m, d), shape (m, d) or (m, k, d), in units of y over units of X."""
        self._check_fitted()
        if self._patches is not None:
            slopes = self._patches.predict_gradient(self._positions(X)) * self._height[:, None]
            return np.asarray(slopes[:, 0] if self._single_output else slopes)
        scaled = self._scaled(X)
        if self._lifted:
            values, slope = self._lifted_heights(scaled)
            scaled = np.column_stack([scaled, values])
        slopes = evaluation.gradient(scaled, self._neurons, self._spreads, self._coefficients)
        if self._lifted:
            # The fixed point z = f_z(x, z) has the derivative f_zx / (1 - f_zz).
            least = autoassociative.LEAST_SLOPE
            steep = np.where(np.abs(1 - slope) > least, 1 - slope, least)
            slopes = slopes[:, -1:, :-1] / steep[:, None, None]
        slopes = slopes * (self._height / self._unit)[:, None]
        return np.asarray(slopes[:, 0] if self._single_output else slopes)

    def _lifted_heights(self, scaled: FloatArray) -> tuple[FloatArray, FloatArray]:
        z, slope = autoassociative.heights(
            scaled, self._neurons, float(self._spreads[0]), self._coefficients[0], self._bias
        )
        return z[:, None], slope

    def _deviation(self, scaled: FloatArray) -> FloatArray:
        if self._factor is None:
            self._factor = Dense(self._kernel.gram(self._support), self._weights, self._lambda)
        variance = np.empty(len(scaled))
        for part in chunks(len(scaled), len(self._support)):
            variance[part] = self._factor.posterior_variance(self._kernel.gram(self._support, scaled[part]))
        return np.asarray(np.sqrt(self._variance * variance)[:, None] * (self._calibration * self._height))

    def _shaped(self, values: FloatArray) -> FloatArray:
        return np.asarray(values[:, 0] if self._single_output else values)

    def _scaled(self, X: npt.ArrayLike) -> FloatArray:
        return np.asarray((self._positions(X) - self._origin) / self._unit, dtype=np.float64)

    def _positions(self, X: npt.ArrayLike) -> FloatArray:
        self._check_fitted()
        positions = _finite(X, "X")
        if positions.ndim != 2 or positions.shape[1] != self.n_features_in_:
            raise PointsError(f"X has the shape {positions.shape}; the network expects (m, {self.n_features_in_})")
        return positions

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
        if self._patches is not None:
            state = {name: np.asarray(getattr(self, key)) for name, key in _PATCHES_STATE.items()}
            return state | {f"patches_{name}": value for name, value in self._patches.to_state().items()}
        for name, key in _STATE.items():
            state[name] = np.asarray(getattr(self, key))
        state["kernel_spreads"], state["kernel_amplitudes"] = self._kernel.spreads, self._kernel.amplitudes
        return state

    @classmethod
    def from_state(cls, state: dict[str, np.ndarray[Any, Any]]) -> Self:
        """The network that `to_state` wrote."""
        network = cls()
        patched = {name.removeprefix("patches_"): value for name, value in state.items() if name.startswith("patches_")}
        for name, key in (_PATCHES_STATE if patched else _STATE).items():
            value = state[name]
            setattr(network, key, value.item() if value.ndim == 0 else np.array(value))
        network.notes_ = tuple(np.atleast_1d(network.notes_).tolist())
        network._patches = Partition.from_state(patched) if patched else None
        if network._patches is not None:
            network._lifted = False
            network._publish_patches(network._patches)
            return network
        network._kernel = Kernel(np.array(state["kernel_spreads"]), np.array(state["kernel_amplitudes"]))
        network._factor = None
        network._publish()
        return network


_SETTINGS = ("callback", "mapping", "max_centers", "smoothing", "spread", "tolerance")
_STATE = {
    "features": "n_features_in_",
    "single_output": "_single_output",
    "history": "history_",
    "stop_reason": "stop_reason_",
    "outliers": "outliers_",
    "notes": "notes_",
    "support": "_support",
    "neurons": "_neurons",
    "lifted": "_lifted",
    "calibration": "_calibration",
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
_PATCHES_STATE = {
    name: _STATE[name]
    for name in ("features", "single_output", "history", "stop_reason", "outliers", "notes", "level", "height")
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


def merge_repeated(X: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray]:
    """One row for each distinct position, in the order of their first appearance.

    Returns the positions (m, d), their mean values (m, k), the samples behind each (m,), the sum of squares about the
    means (k,), and the row of each sample among the m (n,).
    """
    distinct, first, inverse, counts = np.unique(X, axis=0, return_index=True, return_inverse=True, return_counts=True)
    if len(distinct) == len(X):
        return X, y, np.ones(len(X)), np.zeros(y.shape[1]), np.arange(len(X))
    order = np.argsort(first)
    group = np.argsort(order)[inverse.ravel()]
    weights = counts[order].astype(np.float64)
    means = np.column_stack([np.bincount(group, column) for column in y.T]) / weights[:, None]
    return distinct[order], means, weights, np.sum((y - means[group]) ** 2, axis=0), group


def _exploded(fit: Fit) -> bool:
    return not np.all(np.isfinite(fit.coefficients)) or float(np.sqrt(np.mean(fit.residuals**2))) > EXPLODED


def _calibration(fit: Fit) -> float:
    """Factor on the deviations that makes 95 % of the leave-one-out residuals fall within 1.96 of them."""
    ratios = np.max(np.abs(fit.residuals), axis=1) / fit.deviations
    return float(np.clip(np.quantile(ratios, 0.95) / 1.96, 0.1, 10.0)) if len(ratios) >= 20 else 1.0
