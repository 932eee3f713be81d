"""The Gaussian kernel, alone and as a ladder of spreads.

A kernel is a positive sum of Gaussians, K(r) = sum_l a_l exp(-r^2 / 2 s_l^2), with amplitudes a_l that add up to one,
so that K(0) = 1. One level is the network of the paper. A ladder, s_l = 0.2 h 2^(l/2) with a_l proportional to
s_l^(2H), is a scale mixture that imitates the power-law variogram r^(2H) of a rough surface (h: mean spacing).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from common.surface import FloatArray

LADDER_STEP = float(np.sqrt(2.0))
"""Ratio of neighbouring spreads: a level is the square of the next wider one, a product instead of an exponential."""

LADDER_LEVELS = 17
FINEST = 0.2
"""The finest spread, in mean spacings: a Gaussian that does not reach the next point any more."""

SQUARINGS = 4
"""Levels taken by squaring before a fresh exponential: each squaring doubles the relative rounding error."""

_CACHED = 16_384
"""Kernel values summed over all levels at once: what a core's cache holds of them and their levels."""

_UNDERFLOW = -700.0
"""Exponents below this are as good as none, and an exponential that underflows takes ten times as long."""


@dataclass(frozen=True, slots=True, eq=False)
class Kernel:
    """A positive sum of Gaussians.

    Parameters
    ----------
    spreads : ndarray, shape (levels,)
        Descending, in the units of the positions.
    amplitudes : ndarray, shape (levels,)
        Positive, adding up to one.
    """

    spreads: FloatArray
    amplitudes: FloatArray

    @classmethod
    def single(cls, spread: float) -> Kernel:
        """One Gaussian of the given spread."""
        return cls(np.array([float(spread)]), np.ones(1))

    @classmethod
    def mixture(cls, spreads: FloatArray, amplitudes: FloatArray) -> Kernel:
        """The levels of positive amplitude, scaled so that K(0) = 1."""
        order = np.argsort(-spreads)
        keep = order[amplitudes[order] > 0]
        return cls(spreads[keep], amplitudes[keep] / amplitudes[keep].sum())

    def gram(self, X: FloatArray, C: FloatArray | None = None) -> FloatArray:
        """K(|x_i - c_j|), shape (n, m), of positions (n, d) and (m, d); C is X where it is left out."""
        return sum_of_levels(squared_distances(X, C), self.spreads, self.amplitudes)


def squared_distances(X: FloatArray, C: FloatArray | None = None) -> FloatArray:
    """|x_i - c_j|^2, shape (n, m), from the differences: exact zeros on the diagonal, no cancellation."""
    return np.asarray(cdist(X, X if C is None else C, "sqeuclidean"))


def level_matrices(r2: FloatArray, spreads: FloatArray) -> list[FloatArray]:
    """exp(-r^2 / 2 s^2) for each of the descending spreads, shape of `r2` each."""
    matrices: list[FloatArray] = []
    squared = 0
    for level, spread in enumerate(spreads):
        if level and squared < SQUARINGS and _is_one_step(spreads[level - 1], spread):
            matrices.append(np.square(matrices[-1]))
            squared += 1
        else:
            matrices.append(np.exp(r2 * (-0.5 / spread**2)))
            squared = 0
    return matrices


def sum_of_levels(r2: FloatArray, spreads: FloatArray, amplitudes: FloatArray) -> FloatArray:
    """sum_l a_l exp(-r^2 / 2 s_l^2), shape of `r2`."""
    flat = np.ravel(r2)
    total = np.empty(flat.shape)
    for start in range(0, len(flat), _CACHED):
        part = slice(start, start + _CACHED)
        total[part] = _levels(flat[part], spreads, amplitudes)
    return total.reshape(r2.shape)


def upper_sum_of_levels(r2: FloatArray, spreads: FloatArray, amplitudes: FloatArray, out: FloatArray) -> None:
    """The same in the upper triangle of `out`, for symmetric `r2`, shape (n, n) both; what is below may be anything."""
    start = 0
    while start < len(r2):
        part = slice(start, start + max(1, _CACHED // (len(r2) - start)))
        out[part, start:] = _levels(r2[part, start:].copy(), spreads, amplitudes)
        start = part.stop


def _levels(r2: FloatArray, spreads: FloatArray, amplitudes: FloatArray) -> FloatArray:
    """The sum at a contiguous piece of `r2`; levels next to each other share an exponential."""
    current, scratch, total = np.empty_like(r2), np.empty_like(r2), np.zeros_like(r2)
    squared = SQUARINGS
    for level, (spread, amplitude) in enumerate(zip(spreads, amplitudes, strict=True)):
        if level and squared < SQUARINGS and _is_one_step(spreads[level - 1], spread):
            np.square(current, out=current)
            squared += 1
        else:
            np.multiply(r2, -0.5 / spread**2, out=current)
            np.maximum(current, _UNDERFLOW, out=current)
            np.exp(current, out=current)
            squared = 0
        np.multiply(current, amplitude, out=scratch)
        total += scratch
    return total


def _is_one_step(wide: float, narrow: float) -> bool:
    return bool(abs(wide / narrow / LADDER_STEP - 1) < 1e-12)


def span(X: FloatArray) -> float:
    """Side of a cube whose corners are as far from the middle as the furthest of X (n, d) is, however these turn."""
    return 2 * float(np.sqrt(np.sum((X - X.mean(axis=0)) ** 2, axis=1).max() / X.shape[1]))


def mean_spacing(X: FloatArray) -> float:
    """Side of the cell that each of the n positions (n, d) would have if they filled a box evenly.

    The box has the covariance of the positions, hence the same volume after a rotation; directions in which they do
    not extend do not count. Zero where all positions are one.
    """
    deviations = np.sqrt(12 * np.clip(np.linalg.eigvalsh(np.atleast_2d(np.cov(X.T, bias=True))), 0, None))
    widest = float(deviations.max())
    if widest == 0:
        return 0.0
    sides = deviations[deviations > 1e-6 * widest]
    return float(np.prod(sides / widest) ** (1 / len(sides)) * widest * len(X) ** (-1 / len(sides)))


def ladder_spreads(spacing: float, widest: float) -> FloatArray:
    """0.2 h 2^(l/2) for l = 0, 1, ... up to `LADDER_LEVELS` levels or the first beyond `widest`; descending."""
    spreads = FINEST * spacing * LADDER_STEP ** np.arange(LADDER_LEVELS)
    keep = max(2, int(np.searchsorted(spreads, widest)) + 1)
    return np.ascontiguousarray(spreads[:keep][::-1])


def nearest_distance(X: FloatArray) -> float:
    """Mean distance from a position to its nearest neighbour; zero for fewer than two."""
    if len(X) < 2:
        return 0.0
    distances = np.asarray(KDTree(X).query(X, k=2)[0])
    return float(np.mean(distances[:, 1]))


CHUNK = 4_000_000
"""Kernel values held at once: 32 MB a matrix."""


def chunks(rows: int, columns: int) -> Iterator[slice]:
    """Slices of `rows` such that a matrix of slice by `columns` stays within `CHUNK` values."""
    step = max(1, CHUNK // max(1, columns))
    for start in range(0, rows, step):
        yield slice(start, min(rows, start + step))
