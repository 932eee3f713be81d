"""Many wrong points: a network in which each point counts the less the further it is off.

A network that was fitted to many wrong points is as far off the right ones as off the wrong. So the points are weighed
by what a Cauchy distribution of the errors makes of their left-out residuals, the network is fitted again, and so on:
from a blurred surface, off which the wrong points are furthest, to that of the right ones (iteratively reweighted least
squares; Holland and Welsch 1977, "Robust regression using iteratively reweighted least-squares"). At 2.385 deviations
normal noise loses a twentieth of its efficiency.

Rough terrain has heavy tails, too, and so has a cliff in a plain. The reading is believed where the Cauchy density
foretells the points better than the normal one of the first network, where its surface explains most of them, and where
what is far off is so on its own: wrong points know nothing of each other.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from common.network.selection import NOISY, Fit
from common.surface import FloatArray, IntArray

HEAVY = 4.0
"""Kurtosis of the residuals, 3 for normal noise, beyond which there may be many wrong points."""

UPPER = 1.5
"""The same of their upper decile, over what normal noise makes of it: many wrong points at one height have no tail."""

CAUCHY = 2.385
"""Usual deviations at which a point counts for half."""

ROUNDS = 15
"""Weighings, at most; each but the last costs a fit."""

SETTLED = 0.05
"""Change of a weight below which no further round is worth its fit."""

MOST = 0.45
"""Share of the points that may be wrong."""

GAIN = 0.1
"""What the Cauchy density must gain a point, in nats."""

EXPLAINED = 0.8
"""The usual deviation of the points from the surface, over that from their median, up to which it explains them."""

FAR = 4.0
"""Usual deviations from which points are asked for what is beside them."""

MANY = 8
"""So many of them; fewer are looked for one by one."""

BESIDE = 6
"""Nearest points that are asked for it."""

COMPANY = 1 / 3
"""Share of what a point is off that one beside it must be off on the same side to be its company."""

CHANCE = 2.0
"""Standard errors beyond chance to which those that are far off may have company."""

ROUNDING = 1e-12
"""Least usual deviation, in that of the values."""

NORMAL_MEDIAN, NORMAL_UPPER = 0.6745, 1.645
"""Median and upper decile of the sizes of normal errors of deviation one."""


class Reweighted(NamedTuple):
    """What is known at the end.

    Attributes
    ----------
    residuals : ndarray, shape (n, k)
    weights : ndarray, shape (n,)
        Of the points, from 0 to 1.
    usual : float
        Deviation that is usual among the residuals.
    """

    residuals: FloatArray
    weights: FloatArray
    usual: float

    @property
    def sizes(self) -> FloatArray:
        """Greatest residual of each point, shape (n,)."""
        return np.asarray(np.max(np.abs(self.residuals), axis=1))


def suspected(fit: Fit) -> bool:
    """Whether the residuals of points that pass for noisy have heavier tails than noise has."""
    return fit.smoothing >= NOISY and heavy(fit.residuals / fit.deviations[:, None])


def heavy(residuals: FloatArray, kurtosis: float = HEAVY) -> bool:
    """Whether any column of residuals (n, k) has heavier tails than that, or a heavier side."""
    # Divided by a power of two first, which does not round: where most is flat, fourth powers have no double.
    residuals = np.ldexp(residuals, -np.frexp(np.max(np.abs(residuals)))[1])
    squares, sizes = np.mean(residuals**2, axis=0), np.abs(residuals)
    tails = np.mean(residuals**4, axis=0) > kurtosis * squares**2
    usual = np.median(sizes, axis=0) / NORMAL_MEDIAN
    return bool(np.any(tails | (np.quantile(sizes, 0.9, axis=0) > UPPER * NORMAL_UPPER * usual)))


def reweighted(residuals: FloatArray, refit: Callable[[FloatArray], FloatArray]) -> Reweighted:
    """From residuals (n, k) of a first network, by networks of weights (n,), of which `refit` tells the residuals."""
    weights = np.ones(len(residuals))
    for rounds in range(ROUNDS):
        sizes = np.max(np.abs(residuals), axis=1)
        # Where most are told exactly, on a lattice or a plain, those that are not tell what is usual.
        usual = max(float(np.median(sizes)) / NORMAL_MEDIAN or float(np.sqrt(np.mean(sizes**2))), ROUNDING)
        before, weights = weights, weights_of(sizes, usual)
        if rounds == ROUNDS - 1 or np.max(np.abs(weights - before)) < SETTLED:
            break
        residuals = refit(weights)
    return Reweighted(residuals, weights, usual)


def weights_of(sizes: FloatArray, usual: float) -> FloatArray:
    """What points count for whose errors have these sizes (n,), `usual` being the deviation of most."""
    return np.asarray(1 / (1 + (sizes / (CAUCHY * usual)) ** 2))


def is_believed(first: FloatArray, found: Reweighted, values: FloatArray, near: IntArray, least: float) -> bool:
    """Whether some of the points are wrong rather than the surface rough.

    Parameters
    ----------
    first : ndarray, shape (n, k)
        Residuals of the first network.
    found : Reweighted
    values : ndarray, shape (n, k)
    near : ndarray of int, shape (n, 1 + m)
        The rows of the points, and of their nearest neighbours.
    least : float
        Residual up to which nothing is wrong.
    """
    n, sizes = len(first), found.sizes
    normal = 0.5 * np.log(2 * np.pi * np.mean(np.max(np.abs(first), axis=1) ** 2)) + 0.5
    scale = NORMAL_MEDIAN * found.usual
    gained = normal - np.mean(np.log(np.pi * scale) + np.log1p((sizes / scale) ** 2))
    about = np.max(np.abs(values - np.median(values, axis=0)), axis=1)
    explained = found.usual <= EXPLAINED * np.median(about) / NORMAL_MEDIAN
    if gained < GAIN or not explained:
        return False
    far = np.flatnonzero(sizes > max(FAR * found.usual, least))
    if len(far) < MANY or len(far) > MOST * n:
        return False
    away, around = beside(found.residuals, far, near[:, : 1 + BESIDE])
    above = np.count_nonzero(away > 0) / n
    share = np.where(away > 0, above, len(far) / n - above)
    chance = 1 - (1 - share) ** BESIDE
    beyond = np.count_nonzero(company(away, around)) - chance.sum()
    return bool(beyond <= CHANCE * np.sqrt(np.sum(chance * (1 - chance))))


def beside(residuals: FloatArray, rows: IntArray, near: IntArray) -> tuple[FloatArray, FloatArray]:
    """Greatest residuals at the rows (m,), and those of the same value at the points near them, shape (m, k)."""
    column = np.argmax(np.abs(residuals[rows]), axis=1)
    return residuals[rows, column], residuals[near[rows, 1:], column[:, None]]


def company(away: FloatArray, around: FloatArray) -> IntArray:
    """How many of those around (m, k) are company to values that are so far off (m,), shape (m,)."""
    return np.asarray(
        np.count_nonzero(around * np.sign(away)[:, None] >= COMPANY * np.abs(away)[:, None], axis=1), dtype=np.int64
    )
