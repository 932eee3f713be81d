"""scikit-learn's conventions, kept without importing it: it is asked for only where it is the caller."""

from __future__ import annotations

import sys
from inspect import signature
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from scipy.sparse import issparse

from common.errors import NotReadyError, ParameterError, PointsError
from common.surface import FloatArray

LARGEST = 1e302
"""Greatest number of a point: a million of them add up to a double."""


class Conventions:
    """Parameters by name, tags and score of a regressor; the settings are those of the class's ``__init__``."""

    @classmethod
    def _settings(cls) -> list[str]:
        return sorted(name for name in signature(cls.__init__).parameters if name != "self")

    def get_params(self, deep: bool = True) -> dict[str, Any]:  # noqa: ARG002 - the name is scikit-learn's
        """The settings, by name."""
        return {name: getattr(self, name) for name in self._settings()}

    def set_params(self, **params: Any) -> Self:
        """Change settings by name; returns self. Raises ParameterError for an unknown name."""
        for name, value in params.items():
            if name not in self._settings():
                raise ParameterError(f"Invalid parameter {name!r}; accepted are {', '.join(self._settings())}")
            setattr(self, name, value)
        return self

    def __repr__(self) -> str:
        defaults = signature(type(self).__init__).parameters
        changed = {
            name: value for name, value in self.get_params().items() if repr(value) != repr(defaults[name].default)
        }
        return f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in changed.items())})"

    def score(self, X: npt.ArrayLike, y: npt.ArrayLike, sample_weight: npt.ArrayLike | None = None) -> float:
        """Coefficient of determination of the prediction, the mean of the outputs'; 1 is perfect."""
        truth = np.asarray(y, dtype=np.float64)
        weights = np.ones(len(truth)) if sample_weight is None else np.asarray(sample_weight, dtype=np.float64)
        found = np.asarray(self.predict(X)).reshape(len(truth), -1)  # type: ignore[attr-defined]
        truth = truth.reshape(len(truth), -1)
        left = np.average((truth - found) ** 2, axis=0, weights=weights)
        total = np.average((truth - np.average(truth, axis=0, weights=weights)) ** 2, axis=0, weights=weights)
        return float(np.mean(np.where(total > 0, 1 - left / np.where(total > 0, total, 1), np.where(left > 0, 0, 1))))

    def __sklearn_is_fitted__(self) -> bool:
        return hasattr(self, "n_features_in_")

    def __sklearn_tags__(self) -> Any:
        from sklearn.utils import InputTags, RegressorTags, Tags, TargetTags

        return Tags(
            estimator_type="regressor",
            target_tags=TargetTags(required=True, multi_output=True),
            regressor_tags=RegressorTags(),
            input_tags=InputTags(),
        )

    def _check_fitted(self) -> None:
        if not self.__sklearn_is_fitted__():
            # Who works with scikit-learn waits for its own error.
            theirs = getattr(sys.modules.get("sklearn.exceptions"), "NotFittedError", None)
            raised = type("NotFittedError", (NotReadyError, theirs), {}) if theirs else NotReadyError
            raise raised(f"this {type(self).__name__} is not fitted yet; call fit(X, y) first")


class NotNumbersError(PointsError, TypeError):
    """An array of something else than numbers."""


def finite(values: npt.ArrayLike, name: str) -> FloatArray:
    """`values` as C-ordered float64; raises PointsError unless they are real, finite numbers."""
    if issparse(values):
        raise PointsError(f"sparse input is not supported; {name} must be dense")
    try:
        array = np.asarray(values)
        if not np.iscomplexobj(array):
            array = array.astype(np.float64, order="C")
    except TypeError as error:
        raise NotNumbersError(f"{name} must be an array of numbers: {error}") from error
    except ValueError as error:
        raise PointsError(f"{name} must be an array of numbers: {error}") from error
    if np.iscomplexobj(array):
        raise PointsError(f"Complex data not supported: {name} must be real")
    if not np.all(np.isfinite(array)):
        raise PointsError(f"{name} must be finite; it contains NaN or infinity")
    return array


def training_arrays(X: npt.ArrayLike, y: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Positions (n, d) and values (n, k), checked; raises PointsError."""
    if y is None:
        raise PointsError("requires y to be passed, but the target y is None")
    positions, values = finite(X, "X"), finite(y, "y")
    if positions.ndim != 2:
        raise PointsError(f"X must have the shape (n, d), got {positions.shape}. Reshape your data")
    if not positions.shape[1]:
        raise PointsError(f"0 feature(s) (shape={positions.shape}) while a minimum of 1 is required.")
    if values.ndim not in (1, 2) or len(values) != len(positions) or 0 in values.shape[1:]:
        raise PointsError(
            f"y must have the shape (n,) or (n, k) with n = {len(positions)} and k of at least 1, got {values.shape}"
        )
    if len(positions) < 2:
        raise PointsError(f"at least 2 points are needed, got n_samples = {len(positions)}")
    for name, array in (("X", positions), ("y", values)):
        largest = float(np.max(np.abs(array)))
        if largest > LARGEST:
            raise PointsError(f"{name} must be within {LARGEST:g} of zero, or sums overflow; it reaches {largest:g}")
    return positions, values.reshape(len(values), -1)
