"""How far a reconstruction is from the truth.

Every function takes `truth` and `estimate`, arrays of one shape, and raises PointsError where the shapes differ,
the arrays are empty or the truth is not finite. A NaN in the estimate is an error too: a metric that skips the cells
where a method failed would reward the failure.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from common.errors import PointsError
from common.surface import FloatArray, finite_array


def _pair(truth: npt.ArrayLike, estimate: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    a, b = finite_array(truth, "truth"), finite_array(estimate, "estimate")
    if a.shape != b.shape or not a.size:
        raise PointsError(f"truth and estimate must be of one shape and not empty, got {a.shape} and {b.shape}")
    return a, b


def _range(truth: FloatArray) -> float:
    extent = float(np.ptp(truth))
    if extent <= 0:
        raise PointsError("the truth is flat; an error relative to its range is not defined")
    return extent


def rmse(truth: npt.ArrayLike, estimate: npt.ArrayLike) -> float:
    """Root mean square error, in the unit of z.

    >>> rmse([0.0, 0.0], [3.0, -3.0])
    3.0
    """
    a, b = _pair(truth, estimate)
    return float(np.sqrt(np.mean(np.square(a - b))))


def nrmse(truth: npt.ArrayLike, estimate: npt.ArrayLike) -> float:
    """RMSE over the range (max - min) of the truth, dimensionless.

    >>> nrmse([0.0, 2.0], [0.5, 2.5])
    0.25
    """
    a, b = _pair(truth, estimate)
    return rmse(a, b) / _range(a)


def max_error(truth: npt.ArrayLike, estimate: npt.ArrayLike) -> float:
    """Greatest absolute error, in the unit of z.

    >>> max_error([0.0, 1.0], [0.0, 3.0])
    2.0
    """
    a, b = _pair(truth, estimate)
    return float(np.max(np.abs(a - b)))


def psnr(truth: npt.ArrayLike, estimate: npt.ArrayLike) -> float:
    """Peak signal-to-noise ratio, 20 log10(range / RMSE), in dB; infinite where the two are equal.

    >>> psnr([0.0, 10.0], [1.0, 11.0])
    20.0
    """
    a, b = _pair(truth, estimate)
    error = rmse(a, b)
    return float("inf") if error == 0 else float(20 * np.log10(_range(a) / error))
