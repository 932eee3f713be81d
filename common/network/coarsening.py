"""Fewer points of more weight: what a partition of noisy points can gain from one network of their means.

A patch smooths noise over the hundred points that it has. Of a smooth surface a whole region tells: the points of each
square of a lattice are merged into their mean, which weighs as much as they do together, and one dense network is
fitted to the few means. Three questions decide, the cheap ones first:

- What would be left, by the kernel and the smoothing that the partition has chosen? The posterior variance of a lattice
  of means is held against that of a patch. Of clean points, or of a rough surface, it is greater, and nothing is done.
- Does the network know single points better than the patches do? The residuals of points left out are compared, patch
  by patch (Efron and Tibshirani 1993, "An introduction to the bootstrap", chapter 17).
- Does it miss anything anywhere? Means of a finer lattice show a detail that the sample of patches may not see.

The mean of the values in a square is not the value at the mean position where the surface is curved. The difference is
taken off by the network's own values at four places of the same mean and covariance (Julier and Uhlmann 1997, "A new
extension of the Kalman filter to nonlinear systems").
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.spatial import KDTree

from common.network.cover import CELL_POINTS
from common.network.dense import Dense
from common.network.expansion import Expansion
from common.network.kernel import Kernel
from common.network.partition import Partition
from common.network.patches import FIT_MARGIN
from common.network.selection import TINY, Samples, rounding_floor
from common.network.threads import parallel
from common.surface import BoolArray, FloatArray, IntArray

SQUARES = (600, 1200, 2400)
"""Squares over the box of the points, coarse ones first: as many points as a search settles its candidates on, and as a
dense network is still quickly fitted to."""

WORTH = 90_000
"""Cube of the squares for each point, at most: a dense network is to cost about what the patches did."""

HOPEFUL = 2.5
"""Share of a patch's variance up to which a network is tried as a last resort: kernels of patches reach less far than
they could."""

PATCH = round((1 + 2 * FIT_MARGIN) * CELL_POINTS**0.5)
"""Rows of points in a patch of even density."""

LATTICE = 16
"""Rows of means that stand for a network: what is further off tells the middle no more."""

EXACT = 1e-10
"""Smoothing up to which points have no noise: a thousand times what rounding needs."""

LEAST = 4
"""Points merged into one at least: where that many promise nothing more do not either."""

SCALE = 16
"""Points merged into one where the kernel of the patches does not reach far enough to tell."""

FAR = 64
"""Points merged into one up to which the kernel of the patches is believed where it speaks against it."""

ASKED = 160
"""Patches whose points are held against the network."""

UNTOLD = 0.01
"""Least share of a residual that is taken for what is left of it; less is rounding."""

CERTAIN = 3.0
"""Deviations by which the network must know the points better than the patches do."""

TOLD = 0.1
"""Share of the smoothing above which it is detail: a sample of patches tells it from none so exactly."""

AIMED = 12
"""Trials of a lattice most of whose squares are empty."""

FINER = 4
"""Squares of the closer look in one square, at most."""

AVERAGED = 16
"""Points that a square of the closer look holds in the mean, unless that makes it larger than a merged one."""

MISSED = 6.0
"""Deviations of a mean that is not explained by noise: of ten thousand normal ones none is so far off."""


def coarsened(
    partition: Partition,
    samples: Samples,
    fit: Callable[[Samples, bool], Expansion],
    cut: Callable[[Samples], Partition],
    tick: Callable[[float], None],
) -> Expansion | Partition:
    """One network of merged samples where that is better than the partition of all, else the partition.

    Parameters
    ----------
    partition : Partition
        Fitted to the samples, kernel and smoothing chosen from the data.
    samples : Samples
    fit : callable
        ``fit(samples, quick)``: a dense network of them; a quick one may be less accurate.
    cut : callable
        ``cut(samples)``: a partition of them.
    tick : callable
        ``tick(fraction)`` of what is tried, if anything is.
    """
    if partition.smoothing.min() <= EXACT or _share(partition, LEAST) >= 1:
        return partition
    afforded = [squares for squares in SQUARES if squares**3 <= WORTH * len(samples)]
    # Of a constant output there is nothing to know, and rounding is its noise.
    varying = np.ptp(samples.y, axis=0) > 0
    for done, squares in enumerate(afforded):
        tick(done / len(afforded))
        bound = HOPEFUL if squares == afforded[-1] else 1.0
        if not _promising(partition, samples, squares, bound, cut):
            continue
        bins = Bins.of(samples, squares)
        network = fit(bins.straightened(fit(bins.samples, True)), False)
        if _better(network, partition, varying) and not _misses(network, samples, bins, varying):
            # What is finer than the points is told by the points, not by their means.
            detail = partition.calibration.detail
            network.calibration = replace(network.calibration, detail=np.where(detail > TOLD, detail, 0.0))
            tick(1.0)
            return network
    tick(1.0)
    return partition


@dataclass(frozen=True, slots=True, eq=False)
class Bins:
    """Samples merged by the squares of a lattice.

    Attributes
    ----------
    samples : Samples
        Means of the samples in each square that has any, with the sums of their weights.
    offsets : ndarray, shape (2, n, 2)
        Two vectors for each: the places at plus and minus both have the mean and the covariance of what was merged.
    scatter : ndarray, shape (n, k)
        Weighted sums of squares of the values about their means.
    counts : ndarray of int, shape (n,)
        Samples merged into each.
    """

    samples: Samples
    offsets: FloatArray
    scatter: FloatArray
    counts: IntArray

    @classmethod
    def of(cls, samples: Samples, squares: int) -> Self:
        """Merge the samples by about so many squares that hold any."""
        X, low, box = samples.X, samples.X.min(axis=0), np.ptp(samples.X, axis=0)
        aimed = squares
        for _ in range(AIMED):
            side = max(float(np.sqrt(box[0] * box[1] / aimed)), float(box.max()) / aimed)
            columns, rows = np.maximum((box / side + 1e-9).astype(np.int64), 1).tolist()
            place = (X - low) / np.where(box > 0, box, 1.0) * (columns, rows)
            column, row = np.minimum(place.astype(np.int64), (columns - 1, rows - 1)).T
            _, square, counts = np.unique(column * rows + row, return_inverse=True, return_counts=True)
            if squares / 2 <= len(counts) <= squares or len(counts) == len(X):
                break
            # Where most of the box is empty, or a single point is far away, the squares have to be smaller.
            aimed = min(round(aimed * squares / len(counts)), 1 << 60)
        weights = np.asarray(np.bincount(square, samples.weights), dtype=np.float64)

        def mean(column: FloatArray) -> FloatArray:
            return np.asarray(np.bincount(square, samples.weights * column) / weights)

        middle = np.column_stack([mean(column) for column in X.T])
        values = np.column_stack([mean(column) for column in samples.y.T])
        x, y = (X - middle[square]).T
        xx, xy, yy = mean(x * x), mean(x * y), mean(y * y)
        # The Cholesky factor of the covariance, a column each.
        offsets = np.zeros((2, len(weights), 2))
        offsets[0, :, 0] = np.sqrt(xx)
        offsets[0, :, 1] = xy / np.maximum(offsets[0, :, 0], TINY)
        offsets[1, :, 1] = np.sqrt(np.maximum(yy - offsets[0, :, 1] ** 2, 0.0))
        scatter = weights[:, None] * np.column_stack([mean(c) for c in ((samples.y - values[square]) ** 2).T])
        merged = Samples(middle, values, weights, samples.scatter, samples.repeats)
        return cls(merged, np.sqrt(2) * offsets, scatter, counts)

    def means(self, network: Expansion) -> FloatArray:
        """Means of the network's values over what was merged, shape (n, k)."""
        X = self.samples.X
        return np.asarray(sum(network.predict(X + side * offset) for offset in self.offsets for side in (-1, 1)) / 4)

    def straightened(self, network: Expansion) -> Samples:
        """The merged samples with values at their positions instead of means, by how the network is curved."""
        curved = self.means(network) - network.predict(self.samples.X)
        return replace(self.samples, y=self.samples.y - curved)


def _promising(
    partition: Partition, samples: Samples, squares: int, bound: float, cut: Callable[[Samples], Partition]
) -> bool:
    """Whether so many means leave less than the bound times what a patch of samples does, by the patches' kernel."""
    merged = len(samples) / squares
    if _share(partition, merged) < bound:
        return True
    if merged <= FAR or _share(partition, SCALE) >= 1:
        return False
    # Patches do not see how far beyond them the surface is smooth; those of fewer means do.
    means = Bins.of(samples, len(samples) // SCALE).samples
    return _promising(cut(means), means, squares, bound, cut)


def _share(partition: Partition, merged: float) -> float:
    """Variance that a network of points merged by so many leaves, over what a patch does."""
    level = float(partition.smoothing.min())
    kernel = partition.kernel
    narrower = Kernel(kernel.spreads * merged**-0.5, kernel.amplitudes)
    return _left(narrower, level / merged, LATTICE) / max(_left(kernel, level, PATCH), TINY)


def _left(kernel: Kernel, smoothing: float, rows: int) -> float:
    """Posterior variance, over that of the surface, in the middle of a lattice of unit spacing."""
    axis = np.arange(rows) - (rows - 1) // 2
    X = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2).astype(np.float64)
    places = np.array([[0.0, 0.0], [0.5, 0.0], [0.5, 0.5]])
    dense = Dense(kernel.gram(X), np.ones(len(X)), max(smoothing, rounding_floor(len(X))))
    return float(dense.posterior_variance(kernel.gram(X, places)).mean())


def _better(network: Expansion, partition: Partition, varying: BoolArray) -> bool:
    """Whether the network knows the points of a sample of patches better than these do, each without the point."""
    patches = np.random.default_rng(0).permutation(len(partition))[:ASKED]
    left_out = parallel(partition.left_out, patches.tolist())
    rows, values, residuals, _ = (np.concatenate(part) for part in zip(*left_out, strict=True))
    X, weights = partition.centers[rows], partition.weights[rows]
    # How much of the network's value at a point is the point's own: its share in the nearest mean.
    means = KDTree(network.support).query(X)[1]
    own = weights * network.posterior_variance(network.support)[means] / network.smoothing
    alone = (values - network.predict(X)) / np.maximum(1 - own, UNTOLD)[:, None]
    gains = weights[:, None] * (residuals**2 - alone**2)
    gain = np.zeros((len(patches), gains.shape[1]))
    np.add.at(gain, np.repeat(np.arange(len(patches)), [len(part[0]) for part in left_out]), gains)
    sure = gain.sum(axis=0) > CERTAIN * np.sqrt(np.square(gain).sum(axis=0))
    return bool(np.all(sure[varying]))


def _misses(network: Expansion, samples: Samples, bins: Bins, varying: BoolArray) -> bool:
    """Whether means of finer squares are further off the network than noise explains."""
    squares = len(bins.samples)
    finer = Bins.of(samples, int(np.clip(len(samples) // AVERAGED, squares, FINER * squares)))
    noise = finer.scatter.sum(axis=0) / max(1, int((finer.counts - 1).sum()))
    away = np.abs(finer.samples.y - finer.means(network)) * np.sqrt(finer.samples.weights)[:, None]
    return bool(np.any((away > MISSED * np.sqrt(noise))[:, varying]))
