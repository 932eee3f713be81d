"""RBFNetwork: scattered values in, a smooth function out."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from numbers import Integral, Real
from typing import Any, Literal, Self, TypeAlias, overload

import numpy as np
import numpy.typing as npt

from common.errors import ParameterError, PointsError
from common.network.autoassociative import Lifted
from common.network.conventions import Conventions, finite, training_arrays
from common.network.expansion import Expansion
from common.network.fitting import Trained, Wanted, train, train_lifted
from common.network.partition import Partition
from common.network.selection import Samples
from common.surface import BoolArray, FloatArray, IntArray

Callback: TypeAlias = Callable[[str, float], None]

NARROWEST, WIDEST = 1e-9, 1e9
"""Spreads over the extent of the points: beyond them rounding is all that neurons differ by, or that they share."""

SMOOTHEST = 1e9
"""Greatest smoothing: the surface is as good as the mean of the values there."""

_KINDS: dict[str, type[Expansion | Partition | Lifted]] = {
    "expansion": Expansion,
    "partition": Partition,
    "lifted": Lifted,
}


class NetworkWarning(UserWarning):
    """The network was fitted, but not as asked; `notes_` says the same."""


class RBFNetwork(Conventions):
    """Gaussian radial basis function network for scattered data.

    f(x) = b + sum_l sum_j c_lj exp(-|x - x_j|^2 / 2 s_l^2)

    Of more than `fitting.DENSE` points in the plane the surface is a partition of unity of many such networks (see
    `Partition`), unless fewer centres than points are asked for. Noisy points of a smooth surface are merged, and their
    means are the centres of one network (see `coarsening`).

    Parameters
    ----------
    spread : "auto", "paper" or float
        Spread s of the neurons, in the units of X, from 1e-9 to 1e9 times the extent of the points. "auto" lets the
        data choose between one spread and a ladder of spreads; "paper" is twice the mean distance between neighbouring
        centres.
    smoothing : "auto" or float
        lambda >= 0 on the diagonal of the kernel matrix, whose diagonal is 1: the variance of the noise over that of
        the surface. 0 interpolates; at most 1e9.
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
        With the autoassociative mapping shape (n_centers, d + 1), the value last. Mean positions where points are
        merged.
    coefficients_ : ndarray, shape (n_centers,) or (n_centers, k); a leading axis of levels where there are several
        Of a partition: those of each patch in turn, the amplitudes of the levels left out.
    spread_ : float or ndarray, shape (levels,)
        Descending; of a partition, the median of the patches.
    smoothing_ : float
    bias_ : ndarray, shape (k,)
    history_ : ndarray
        Greatest error at the points after each round of chosen centres.
    stop_reason_ : str
        Why no more centres were added.
    patches_ : int
        Networks that are blended: 1, or those of a partition of unity.
    members_ : ndarray of int
        Row of `centers_` that each coefficient belongs to; the patches of a partition share centres.
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
    patches_: int
    members_: IntArray
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
            If X or y is not finite, above 1e302, of the wrong shape or of too few points.
        ParameterError
            If a setting is out of its bounds.
        TrainingError
            If no network can be trained on these points.
        """
        positions, values = training_arrays(X, y)
        self._check_settings()
        if self.mapping == "autoassociative" and values.shape[1] != 1:
            raise ParameterError(f"mapping 'autoassociative' takes one value a position, got {values.shape[1]}")
        self._check_spread(positions)
        unique, means, weights, group = merge_repeated(positions, values)
        scales = _Scales.of(unique, means)
        samples = Samples(
            scales.to_inner(unique),
            (means - scales.level) / scales.height,
            weights,
            float(np.sum(scales.squares(values - means[group]))),
            len(positions) - len(unique),
        )
        wanted = Wanted(
            None if self.spread == "auto" else "paper" if self.spread == "paper" else self.spread / scales.unit,
            None if self.smoothing == "auto" else self.smoothing,
            self.tolerance / float(scales.height.max()),
            self.max_centers,
        )
        start = train_lifted if self.mapping == "autoassociative" else train
        trained = start(samples, wanted, self._tick)
        self.n_features_in_ = positions.shape[1]
        self._single_output = np.asarray(y).ndim == 1
        self._scales, self._network = scales, trained.network
        self._publish(trained, group)
        for note in trained.notes:
            warnings.warn(note, NetworkWarning, stacklevel=2)
        return self

    def _check_settings(self) -> None:
        for name, words in (("spread", ("auto", "paper")), ("smoothing", ("auto",)), ("tolerance", ())):
            value = getattr(self, name)
            if isinstance(value, str) and value in words:
                continue
            if not _is_number(value, Real):
                raise ParameterError(f"{name} {value!r} is unknown; accepted is {' or '.join(('a number', *words))}")
            if not 0 <= value < np.inf or (name == "spread" and value == 0):
                raise ParameterError(f"{name} must be {'positive' if name == 'spread' else 'at least 0'}, got {value}")
        if self.smoothing != "auto" and self.smoothing > SMOOTHEST:
            raise ParameterError(f"smoothing must be at most {SMOOTHEST:g}, got {self.smoothing}")
        count = self.max_centers
        if count is not None and (not _is_number(count, Integral) or count < 1):
            raise ParameterError(f"max_centers must be a whole number of at least 1 or None, got {count!r}")
        if self.mapping not in ("height", "autoassociative"):
            raise ParameterError(f"mapping {self.mapping!r} is unknown; accepted are 'height', 'autoassociative'")

    def _check_spread(self, X: FloatArray) -> None:
        extent = float(np.ptp(X, axis=0).max()) or 1.0
        narrowest, widest = NARROWEST * extent, WIDEST * extent
        if not isinstance(self.spread, str) and not narrowest <= self.spread <= widest:
            raise ParameterError(
                f"spread must be from {narrowest:g} to {widest:g}, {NARROWEST:g} to {WIDEST:g} times the extent of the "
                f"points, got {self.spread}"
            )

    def _tick(self, stage: str, fraction: float) -> None:
        if self.callback is not None:
            self.callback(stage, fraction)

    def _publish(self, trained: Trained, group: IntArray) -> None:
        aside = np.isin(group, trained.outliers) if len(trained.outliers) else np.zeros(0, dtype=bool)
        self.outliers_ = np.flatnonzero(aside).astype(np.int64)
        self.history_ = trained.history * float(self._scales.height.max())
        self.stop_reason_ = trained.stop_reason
        self.notes_ = trained.notes
        self._describe()

    def _describe(self) -> None:
        """The learned attributes that follow from the network, in the caller's units."""
        network, scales = self._network, self._scales
        self.patches_, self.members_ = 1, np.arange(len(network.centers))
        if isinstance(network, Partition):
            self.patches_, self.members_ = len(network.spacings), network.members
        if isinstance(network, Lifted):
            units = np.append(np.full(self.n_features_in_, scales.unit), scales.height)
            origins = np.append(scales.origin, scales.level)
            self.centers_ = network.centers * units + origins
            self.coefficients_, self.bias_ = network.coefficients * units, network.bias * units + origins
            self.spread_, self.smoothing_ = network.spread * scales.unit, network.smoothing
            return
        self.centers_ = network.centers * scales.unit + scales.origin
        coefficients, bias, spreads = network.coefficients * scales.height, network.bias, network.spreads
        if isinstance(network, Partition):
            bias, spreads = bias.mean(axis=0), np.median(spreads, axis=0)
        elif len(spreads) == 1:
            coefficients = coefficients[0]
        self.bias_ = bias * scales.height + scales.level
        self.coefficients_ = coefficients[..., 0] if self._single_output else coefficients
        self.spread_ = float(spreads[0]) * scales.unit if len(spreads) == 1 else spreads * scales.unit
        self.smoothing_ = float(np.median(network.smoothing))

    @overload
    def predict(self, X: npt.ArrayLike, return_std: Literal[False] = False) -> FloatArray: ...

    @overload
    def predict(self, X: npt.ArrayLike, return_std: Literal[True]) -> tuple[FloatArray, FloatArray]: ...

    def predict(self, X: npt.ArrayLike, return_std: bool = False) -> FloatArray | tuple[FloatArray, FloatArray]:
        """Values at positions X (m, d), shape (m,) or (m, k); with `return_std` their deviation, too.

        The deviation is that of the surface, without the noise of a new measurement.
        """
        inner = self._inner(X)
        scales = self._scales
        values = self._shaped(self._network.predict(inner) * scales.height + scales.level)
        return (values, self._shaped(self._network.predict_std(inner) * scales.height)) if return_std else values

    @overload
    def predict_grid(self, x: npt.ArrayLike, y: npt.ArrayLike, return_std: Literal[False] = False) -> FloatArray: ...

    @overload
    def predict_grid(
        self, x: npt.ArrayLike, y: npt.ArrayLike, return_std: Literal[True]
    ) -> tuple[FloatArray, FloatArray]: ...

    def predict_grid(
        self, x: npt.ArrayLike, y: npt.ArrayLike, return_std: bool = False
    ) -> FloatArray | tuple[FloatArray, FloatArray]:
        """Values on a grid, shape (len(y), len(x)) or (len(y), len(x), k); with `return_std` their deviation, too.

        Positions must be in the plane.
        """
        self._check_fitted()
        if self.n_features_in_ != 2:
            raise PointsError(f"a grid needs positions in the plane; the network was fitted in {self.n_features_in_}")
        axis_x, axis_y = finite(x, "x"), finite(y, "y")
        if axis_x.ndim != 1 or axis_y.ndim != 1:
            raise PointsError(f"x and y must be one-dimensional, got the shapes {axis_x.shape} and {axis_y.shape}")
        scales = self._scales
        inner = ((axis - origin) / scales.unit for axis, origin in zip((axis_x, axis_y), scales.origin, strict=True))
        grid = self._shaped(self._network.predict_grid(*inner) * scales.height + scales.level)
        if not return_std:
            return grid
        nodes = np.stack(np.meshgrid(axis_x, axis_y), axis=-1).reshape(-1, 2)
        deviation = self._network.predict_std(self._inner(nodes)) * scales.height
        return grid, self._shaped(deviation).reshape(grid.shape)

    def predict_gradient(self, X: npt.ArrayLike) -> FloatArray:
        """Derivatives at X (m, d), shape (m, d) or (m, k, d), in units of y over units of X."""
        slopes = self._network.predict_gradient(self._inner(X))
        slopes = slopes * (self._scales.height / self._scales.unit)[:, None]
        return np.asarray(slopes[:, 0] if self._single_output else slopes)

    def _shaped(self, values: FloatArray) -> FloatArray:
        return np.ascontiguousarray(values[..., 0] if self._single_output else values)

    def _inner(self, X: npt.ArrayLike) -> FloatArray:
        self._check_fitted()
        positions = finite(X, "X")
        if positions.ndim != 2 or positions.shape[1] != self.n_features_in_:
            columns = positions.shape[1] if positions.ndim == 2 else 0
            raise PointsError(
                f"X has {columns} features, but {type(self).__name__} is expecting {self.n_features_in_} features as "
                f"input; X must have the shape (m, {self.n_features_in_}), got {positions.shape}. Reshape your data"
            )
        return self._scales.to_inner(positions)

    def to_state(self) -> dict[str, np.ndarray[Any, Any]]:
        """Everything that was learnt, as arrays that `numpy.savez` takes without pickling."""
        self._check_fitted()
        kind = next(name for name, known in _KINDS.items() if isinstance(self._network, known))
        scales = self._scales
        state = {
            "kind": np.array(kind),
            "mapping": np.array(self.mapping),
            "features": np.array(self.n_features_in_),
            "single_output": np.array(self._single_output),
            "origin": scales.origin,
            "unit": np.array(scales.unit),
            "level": scales.level,
            "height": scales.height,
            "outliers": self.outliers_,
            "history": self.history_,
            "stop_reason": np.array(self.stop_reason_),
            "notes": np.array(self.notes_, dtype=np.str_),
        }
        return state | {f"network_{name}": value for name, value in self._network.to_state().items()}

    @classmethod
    def from_state(cls, state: Mapping[str, np.ndarray[Any, Any]]) -> Self:
        """The network that `to_state` wrote; settings other than the mapping are the defaults."""
        made = cls().set_params(mapping=str(state["mapping"]))
        made.n_features_in_, made._single_output = int(state["features"]), bool(state["single_output"])
        made._scales = _Scales(
            np.array(state["origin"]), float(state["unit"]), np.array(state["level"]), np.array(state["height"])
        )
        made.outliers_, made.history_ = np.array(state["outliers"]), np.array(state["history"])
        made.stop_reason_, made.notes_ = str(state["stop_reason"]), tuple(state["notes"].tolist())
        prefix = "network_"
        made._network = _KINDS[str(state["kind"])].from_state(
            {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}
        )
        made._describe()
        return made


def _is_number(value: object, kind: type) -> bool:
    """Whether a setting is a number of this kind, which a bool is not."""
    return isinstance(value, kind) and not isinstance(value, bool)


@dataclass(frozen=True, slots=True, eq=False)
class _Scales:
    """Units in which the network works: positions of unit scatter about zero, values of unit deviation."""

    origin: FloatArray
    unit: float
    level: FloatArray
    height: FloatArray

    @classmethod
    def of(cls, X: FloatArray, y: FloatArray) -> Self:
        # One factor for all axes, so that a rotation stays a rotation. Divided by the largest first: squares of 1e200
        # have no double.
        origin, level = X.mean(axis=0), y.mean(axis=0)
        return cls(origin, float(_deviation((X - origin).ravel(), len(X))), level, _column_deviations(y - level))

    def to_inner(self, X: FloatArray) -> FloatArray:
        return np.ascontiguousarray((X - self.origin) / self.unit)

    def squares(self, left: FloatArray) -> FloatArray:
        """Sums of squares, shape (k,), of differences of values (n, k), over the square of the height."""
        # Divided by a power of two first, which does not round: squares of 1e200 and of 1e-200 have no double.
        height, exponent = np.frexp(self.height)
        return np.asarray(np.sum(np.ldexp(left, -exponent) ** 2, axis=0) / height**2)


def _deviation(centred: FloatArray, count: int) -> float:
    """Root of the sum of squares over the count, 1 where it is zero; safe from overflow."""
    largest = float(np.max(np.abs(centred), initial=0.0))
    return largest * float(np.sqrt(np.sum((centred / largest) ** 2) / count)) if largest > 0 else 1.0


def _column_deviations(centred: FloatArray) -> FloatArray:
    return np.array([_deviation(column, len(column)) for column in centred.T])


def _sorted(X: FloatArray) -> tuple[IntArray, BoolArray]:
    """Rows of positions (n, d) in the order of their coordinates, and which of them begins a run of equal ones."""
    order = np.lexsort(X.T[::-1])
    return order, np.append(np.ones(min(1, len(X)), dtype=bool), np.any(np.diff(X[order], axis=0) != 0, axis=1))


def merge_repeated(X: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """One row for each distinct position, in the order of their first appearance.

    Returns the positions (m, d), their mean values (m, k), the samples behind each (m,), and the row of each sample
    among the m (n,).
    """
    # Equal positions have equal shadows in any direction, and in a crooked one hardly any others do.
    shadow = np.zeros(len(X))
    for k, column in enumerate(X.T):
        shadow += np.sqrt(k + 2.0) * column
    ordered = np.sort(shadow)
    shared = ordered[1:][ordered[1:] == ordered[:-1]]
    if _sorted(X[np.isin(shadow, shared)])[1].all():
        return X, y, np.ones(len(X)), np.arange(len(X))
    order, first = _sorted(X)
    group = np.empty(len(X), dtype=np.int64)
    group[order] = np.cumsum(first) - 1
    # The sort is stable, so the first of each run is the first to appear.
    appearance = np.argsort(order[first])
    group = np.argsort(appearance)[group]
    distinct, weights = X[order[first][appearance]], np.bincount(group).astype(np.float64)
    means = np.column_stack([np.bincount(group, column) for column in y.T]) / weights[:, None]
    return distinct, means, weights, group
