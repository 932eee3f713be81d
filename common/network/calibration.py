"""How far a network can be trusted: its deviation, held against what it says of each point without that point.

A place drawn as the points were is exchangeable with them, so a band that holds the leave-one-out residuals as often as
it should holds the surface there, too, whatever the kernel (Barber, Candes, Ramdas and Tibshirani 2021, "Predictive
inference with the jackknife+"). The residuals carry the noise of their points as well, which is not the surface's; the
variance that the smoothing stands for counts in the band only where it cannot be noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.special import betaincinv, chdtri

from common.network.selection import TINY, Fit
from common.surface import FloatArray

SHARE, WIDTH = 0.95, 1.96
"""The share of the points that a band of this many deviations is to hold."""

FEWEST = 20
"""Points below which residuals do not tell such a quantile, and the factor is `UNSURE`."""

UNSURE = 1.5

ALLOWANCE = 7.0
"""Over the number of points, what is added to the factor: spread and smoothing were chosen with the point at hand."""

DETAIL = 1e-3
"""Variance, over that of the values, up to which smoothing is taken for detail finer than the points, not for noise."""

AROUND = 15
"""Points of a neighbourhood, an odd number."""

CALM = 0.25
"""Share of the neighbourhoods that are calmer than the one that tells of the noise."""

_CALM_SQUARE = float(chdtri(1, 1 - betaincinv((AROUND + 1) / 2, (AROUND + 1) / 2, CALM)))
"""Quantile `CALM` of the median of as many squared normal deviates as a neighbourhood has points."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """What makes the posterior variance v of a kernel that of the surface: factor^2 v + excess.

    Attributes
    ----------
    factor : ndarray, shape (k,)
    excess : ndarray, shape (k,)
        From what the smoothing stands for besides noise.
    """

    factor: FloatArray
    excess: FloatArray


def calibrated(X: FloatArray, fit: Fit) -> Calibration:
    """The calibration of the best candidate's posterior for the average of the candidates, fitted at X (n, d)."""
    outputs = fit.residuals.shape[1]
    if len(X) < FEWEST:
        return Calibration(np.full(outputs, UNSURE), np.zeros(outputs))
    ratios = fit.residuals / np.maximum(np.sqrt(fit.variance * fit.spread), TINY)[:, None]
    scale = factor(ratios)
    smoothed = fit.smoothing * fit.variance
    detail = np.full(outputs, smoothed)
    if smoothed > DETAIL:
        detail = smoothed * (1 - noise_share(X, ratios / np.maximum(scale, TINY)))
    return Calibration(scale, scale**2 * detail)


def factor(ratios: FloatArray) -> FloatArray:
    """Factor on deviations, shape (k,), from residuals over the deviations that they should have, shape (n, k)."""
    n = len(ratios)
    rank = min(n, int(np.ceil(SHARE * (n + 1))))
    return np.asarray(np.sort(np.abs(ratios), axis=0)[rank - 1] / WIDTH * (1 + ALLOWANCE / n))


def noise_share(X: FloatArray, ratios: FloatArray) -> FloatArray:
    """Greatest share of the smoothing that can be noise, shape (k,), from residuals over their deviations (n, k).

    Noise is as strong everywhere, so what is missing in the calm neighbourhoods is not noise. The median does not see
    a few large residuals, which noise does not have either.
    """
    _, near = KDTree(X).query(X, k=AROUND)
    calm = np.quantile(np.median(ratios[near] ** 2, axis=1), CALM, axis=0)
    return np.asarray(np.minimum(1.0, calm / _CALM_SQUARE))
