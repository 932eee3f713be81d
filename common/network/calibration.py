"""How far a network can be trusted: its deviation, held against what it says of each point without that point.

A place drawn as the points were is exchangeable with them, so a band that holds the leave-one-out residuals as often as
it should holds the surface there, too, whatever the kernel (Barber, Candes, Ramdas and Tibshirani 2021, "Predictive
inference with the jackknife+"). The residuals carry the noise of their points as well, which is not the surface's; the
variance that the smoothing stands for counts in the band only where it cannot be noise.

A gap, or what lies beyond the edge, is not a place like the points'. A smooth kernel holds what it carries on there for
almost as sure as what it interpolates. So points on one side are told by all others, as if they were missing: how much
faster the errors grow than the deviation that the kernel gives them is the growth of the deviation (Roberts and others
2017, "Cross-validation strategies for data with temporal, spatial, hierarchical, or phylogenetic structure": what is to
be foretold far away is left out in blocks).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

import numpy as np
from scipy.spatial import KDTree
from scipy.special import betaincinv, chdtri

from common.network.dense import Dense
from common.network.selection import NOTHING, TINY, Fit
from common.surface import FloatArray

SHARE, WIDTH = 0.95, 1.96
"""The share of the points that a band of this many deviations is to hold."""

FEWEST = 20
"""Points below which residuals tell no such quantile, and the factor is `UNSURE`; nor do sides tell a growth."""

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

SIDES = (1 / 8, 1 / 4, 1 / 2, 1 / 8, 1 / 4, 1 / 2)
"""Shares of the points that are left out together, each on a side of its own."""

TOGETHER = 250
"""Points that are told by those on the other side, and tell them, at most."""

USUAL = 0.9
"""Share of the points of which the variance is usual: what is sparse, or at the rim, has more."""

FAR = 1.5
"""Variance, over the usual one, from where on its growth is told: less tells hardly anything of an exponent."""

STEEPEST = 1.5
"""Greatest growth: beyond it a band holds everything and tells nothing."""

TALLEST = 3.0
"""Deviation, over that of the values, beyond which nothing grows."""


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """What makes the posterior variance v of a kernel, over that of the surface, the variance of what is predicted.

    Attributes
    ----------
    factor : ndarray, shape (k,)
        On the deviation.
    detail : ndarray, shape (k,)
        Share of the smoothing that is detail finer than the points, not noise.
    usual : float
        What v exceeds at few points, each left out.
    most : ndarray, shape (k,)
        Variance beyond which nothing grows.
    """

    factor: FloatArray
    detail: FloatArray
    usual: float
    most: FloatArray

    @classmethod
    def unknown(cls, outputs: int, factor: float = 1.0) -> Self:
        """The variance that the kernel says, but for a factor on the deviation."""
        return cls(np.full(outputs, factor), np.zeros(outputs), np.inf, np.zeros(outputs))

    def variance(
        self, v: FloatArray, growth: FloatArray, surface: FloatArray | float, smoothing: FloatArray | float
    ) -> FloatArray:
        """Of what is predicted, shape (..., k), where the kernel says v (...).

        `growth` (k,) is told by `growth`; `surface` (..., k) is the variance of the surface, `smoothing` (...) lambda.
        """
        scale = self.factor**2 * surface
        own = scale * v[..., None]
        grown = own * np.maximum(v[..., None] / self.usual, 1.0) ** growth
        detail = scale * np.asarray(smoothing)[..., None] * self.detail
        return np.asarray(np.minimum(grown, np.maximum(own, self.most)) + detail)

    def growth(self, told: Sequence[Across]) -> FloatArray:
        """Exponents, shape (k,), by which the variance grows faster than v where this is more than usual.

        They make a band of `WIDTH` deviations hold `SHARE` of the points that are told by those on the other side. Each
        counts by the logarithm of how far its variance is beyond the usual one.
        """
        if not told:
            return np.zeros(len(self.factor))
        errors, variances, noise, shares = (np.concatenate(part) for part in zip(*told, strict=True))
        far = variances > FAR * self.usual
        if not far.any():
            return np.zeros(len(self.factor))
        ways = np.log(variances[far] / self.usual)
        wanted = (errors[far] / (WIDTH * np.maximum(self.factor, TINY))) ** 2 - noise[far, None]
        exponents = np.log(np.maximum(wanted / variances[far, None], TINY)) / ways[:, None]
        order = np.argsort(exponents, axis=0, kind="stable")
        held = np.cumsum((shares[far] * ways)[order], axis=0)
        at = np.argmax(held >= SHARE * held[-1], axis=0)
        found = np.take_along_axis(exponents, order, axis=0)[at, np.arange(len(self.factor))]
        return np.asarray(np.clip(found, 0.0, STEEPEST))

    def to_state(self) -> dict[str, FloatArray]:
        """Everything, as arrays."""
        return {name: np.asarray(getattr(self, name)) for name in _FIELDS}

    @classmethod
    def from_state(cls, state: Mapping[str, np.ndarray[Any, Any]]) -> Self:
        """The calibration that `to_state` wrote."""
        factor, detail, usual, most = (np.array(state[name]) for name in _FIELDS)
        return cls(factor, detail, float(usual), most)


_FIELDS = ("factor", "detail", "usual", "most")


def calibrated(X: FloatArray, fit: Fit) -> Calibration:
    """The calibration of the best candidate's posterior for the average of the candidates, fitted at X (n, d).

    Values have unit deviation.
    """
    n, outputs = fit.residuals.shape
    if n < FEWEST:
        return Calibration.unknown(outputs, UNSURE)
    ratios = fit.residuals / np.maximum(np.sqrt(fit.variance * fit.spread), TINY)[:, None]
    scale = factor(ratios)
    detail = np.ones(outputs)
    if fit.smoothing * fit.variance > DETAIL:
        detail = 1 - noise_share(X, ratios / np.maximum(scale, TINY))
    usual = usual_variance(fit.spread - fit.smoothing / fit.weights)
    return Calibration(scale, detail, usual, np.full(outputs, TALLEST**2))


def usual_variance(variances: FloatArray) -> float:
    """What few points exceed, from the variance that the kernel gives each without it, noise taken off."""
    return max(float(np.quantile(variances, USUAL)), NOTHING)


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
    _, near = KDTree(X).query(X, k=range(1, min(AROUND, len(X)) + 1))
    calm = np.quantile(np.median(ratios[near] ** 2, axis=1), CALM, axis=0)
    return np.asarray(np.minimum(1.0, calm / _CALM_SQUARE))


class Across(NamedTuple):
    """What points tell of others that are on one side of them.

    Attributes
    ----------
    errors : ndarray, shape (m, k)
    variances, noise : ndarray, shape (m,)
        What the kernel says of them, over the variance of the surface, and how much of the errors may be noise.
    shares : ndarray, shape (m,)
        What each counts; every side counts the same.
    """

    errors: FloatArray
    variances: FloatArray
    noise: FloatArray
    shares: FloatArray

    def over(self, amplitude: FloatArray | float) -> Across:
        """The same of a surface whose deviation is `amplitude`, (k,) or for all."""
        return self._replace(errors=self.errors / np.maximum(amplitude, TINY))


def told_across(X: FloatArray, y: FloatArray, gram: FloatArray, noise: FloatArray) -> Across:
    """Points X (n, d) of values y (n, k) told by the others, a side at a time.

    `gram` (n, n) is the kernel at X and `noise` (n,) what is added to its diagonal. A side is seen from the middle
    towards the points that are furthest from it and from each other, so that it turns with them.
    """
    n, away = len(X), X - X.mean(axis=0)
    clear, parts = np.sum(away**2, axis=1), []
    for share in SIDES:
        towards = int(np.argmax(clear))
        clear = np.minimum(clear, np.sum((X - X[towards]) ** 2, axis=1))
        order = np.argsort(away @ away[towards], kind="stable")
        rest, side = np.split(order, [n - max(1, round(share * n))])
        dense = Dense(gram[np.ix_(rest, rest)], 1 / noise[rest], 1.0)
        coefficients, bias = dense.solve(y[rest])
        cross = gram[np.ix_(rest, side)]
        parts.append(
            Across(
                y[side] - cross.T @ coefficients - bias,
                dense.posterior_variance(cross),
                dense.smoothing * noise[side],
                np.full(len(side), 1 / len(side)),
            )
        )
    return Across(*(np.concatenate(part) for part in zip(*parts, strict=True)))
