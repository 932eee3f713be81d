"""From samples to a network: which way for how many points, and what to do when it goes wrong.

Everything here is in units of the samples' own extent (`selection.Samples`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial import KDTree

from common.errors import TrainingError
from common.network import coarsening, evaluation, greedy, robust, search
from common.network.autoassociative import Lifted
from common.network.calibration import calibrated
from common.network.expansion import Expansion
from common.network.kernel import ladder_spreads, mean_spacing, nearest_distance, span
from common.network.partition import BEYOND, PROBES, Partition, strays, tolerated
from common.network.patches import Tick
from common.network.selection import (
    CALM,
    CLEAN,
    NOISY,
    ROUGHNESS,
    SMOOTHINGS,
    Fit,
    Kind,
    Samples,
    blend,
    families,
    rounding_floor,
)
from common.network.threads import single_threaded_blas
from common.surface import FloatArray, IntArray

DENSE = 4000
"""Points up to which one network holds them all; more are cut into a partition of unity."""

EXPLODED = 2.0
"""A fit whose leave-one-out error is this many times the deviation of the values is far worse than their mean."""

TELLING = 10
"""Points below which nothing can be said about their noise, and the surface passes through them."""

LIKE = 12
"""Kernels that are fitted once more, allowing for noise in the positions."""

MOVED = 2.5
"""Odds beforehand that noisy points are noisy in their positions, too, over that only their heights are."""

LOOKS = 256
"""Places between the points at which their surface is probed."""

APART = 8
"""Neighbours between which and a point such a place lies: half a gap away where points are dense on one side of it."""

MISSED = 0.01
"""Deviations of the values by which a surface without smoothing may be off the points."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What the network is asked to be; None is chosen from the data.

    Attributes
    ----------
    spread : float, "paper" or None
    smoothing : float or None
    tolerance : float
        Greatest error at the samples at which no more centres are added; 0 makes every sample a centre.
    max_centers : int or None
        None is as many as there are samples.
    """

    spread: float | Literal["paper"] | None = None
    smoothing: float | None = None
    tolerance: float = 0.0
    max_centers: int | None = None

    @property
    def free(self) -> bool:
        """Whether spread and smoothing come from the data."""
        return self.spread is None and self.smoothing is None

    @property
    def sparse(self) -> bool:
        """Whether fewer centres than points are asked for."""
        return self.tolerance > 0 or self.max_centers is not None


@dataclass(slots=True, eq=False)
class Trained:
    """A network, and what happened on the way.

    Attributes
    ----------
    network : Expansion, Partition or Lifted
    outliers : ndarray of int
        Rows of the samples that were set aside.
    history : ndarray
        Greatest error at the points, before the first centre and after each round.
    stop_reason : str
    notes : tuple of str
        What was done differently than asked.
    """

    network: Expansion | Partition | Lifted
    outliers: IntArray
    history: FloatArray
    stop_reason: str = "every point is a centre"
    notes: tuple[str, ...] = ()


@single_threaded_blas()
def train(samples: Samples, wanted: Wanted, tick: Tick) -> Trained:
    """The network of the samples."""
    if len(samples) <= DENSE:
        return _train_dense(samples, wanted, tick)
    if wanted.sparse:
        return _train_sparse(samples, wanted, tick)
    if samples.X.shape[1] != 2:
        raise TrainingError(
            f"{len(samples)} distinct positions in {samples.X.shape[1]} dimensions; outside of the plane at most "
            f"{DENSE} are accepted, or as many centres as max_centers says"
        )
    return _train_partition(samples, wanted, tick)


@single_threaded_blas()
def train_lifted(samples: Samples, wanted: Wanted, tick: Tick) -> Trained:
    """The autoassociative network of the samples."""
    if len(samples) > DENSE:
        raise TrainingError(f"{len(samples)} distinct positions; the autoassociative mapping takes at most {DENSE}")
    if wanted.sparse:
        raise TrainingError("tolerance and max_centers need the mapping height; the other makes every point a centre")
    points = np.column_stack([samples.X, samples.y])
    spread = (2 * nearest_distance(points) or 1.0) if wanted.spread == "paper" else wanted.spread
    network = Lifted.fit(points, samples.weights, spread, wanted.smoothing, lambda share: tick("selection", share))
    return Trained(network, _none(), np.zeros(0))


def _none() -> IntArray:
    return np.zeros(0, dtype=np.int64)


def _chosen(
    samples: Samples, wanted: Wanted, tick: Tick, *, quick: bool = False, kinds: Sequence[Kind] | None = None
) -> Fit:
    """Spread and smoothing, as asked or from the data, with every point a centre; of these kinds, if any are named."""
    extent = span(samples.X) or 1.0
    spreads = ladder_spreads(mean_spacing(samples.X) or 1.0, 2 * extent)
    if wanted.spread is not None:
        given = _given(samples, wanted)
        spreads, kinds = np.array([given]), [Kind("single", given)]
    elif kinds is None:
        kinds = families(spreads, extent)
    floor = rounding_floor(len(samples))
    chosen = wanted.smoothing
    if chosen is None and len(samples) < TELLING:
        chosen = 0.0
    smoothings = SMOOTHINGS[floor <= SMOOTHINGS] if chosen is None else np.array([max(chosen, floor)])
    return search.fit(samples, kinds, spreads, smoothings, lambda share: tick("selection", share), quick=quick)


def _select(samples: Samples, wanted: Wanted, tick: Tick, *, quick: bool = False) -> Fit:
    """The same, averaged with a fit that allows for noise in the positions where the points are few and noisy.

    A noise of the positions moves a value by the slope times as much, so points on slopes weigh less (McHutchon and
    Rasmussen 2011, "Gaussian process training with input noise"). Here a position's noise counts, on the mean over the
    points, for as much as a value's; the criteria say how much of that fit is believed.
    """
    fit = _chosen(samples, wanted, tick, quick=quick)
    few = TELLING <= len(samples) <= search.AVERAGED
    if quick or not few or wanted.smoothing is not None or fit.smoothing < NOISY:
        return fit
    slopes = evaluation.gradient(samples.X, samples.X, fit.spreads, fit.coefficients)
    steepness = np.sum(slopes**2, axis=(1, 2))
    if not steepness.any():
        return fit
    weights = 1 / (1 + steepness / steepness.mean())
    weights *= samples.weights / np.exp(np.mean(np.log(weights)))
    moved = _chosen(replace(samples, weights=weights), wanted, tick, kinds=fit.scored.heaviest(LIKE))
    return blend([fit, moved], [1.0, MOVED])


def _given(samples: Samples, wanted: Wanted) -> float:
    if wanted.spread == "paper":
        return 2 * nearest_distance(samples.X) or 1.0
    return float(wanted.spread or 1.0)


def _unstable(wanted: Wanted, why: str) -> str:
    return (
        f"smoothing {wanted.smoothing:g} with this spread leaves the surface unstable ({why}); the smoothing was "
        "chosen from the data instead"
    )


def _train_dense(samples: Samples, wanted: Wanted, tick: Tick) -> Trained:
    tick("selection", 0.0)
    notes: tuple[str, ...] = ()
    fit = _select(samples, wanted, tick)
    error = float(np.sqrt(np.mean(fit.residuals**2)))
    if wanted.smoothing is not None and not error <= EXPLODED:
        notes = (_unstable(wanted, f"leave-one-out error {error:.3g} times the deviation of the values"),)
        wanted = replace(wanted, smoothing=None)
        fit = _select(samples, wanted, tick)
    cleaned = robust.set_aside(samples, fit, lambda part, quick: _select(part, wanted, tick, quick=quick))
    samples, fit = cleaned.samples, cleaned.fit
    network = _expansion(samples, fit)
    if wanted.free and strays(network.predict(_between(samples.X)), samples.y):
        network = _expansion(samples, _tempered(samples, fit, wanted, tick))
    trained = Trained(network, cleaned.outliers, np.zeros(0), notes=notes)
    if wanted.sparse:
        _thin(trained, network, samples, wanted, tick)
    tick("solve", 1.0)
    return trained


def _between(X: FloatArray) -> FloatArray:
    """Places halfway between points X (n, d) and neighbours of theirs, at most `LOOKS`."""
    some = X[np.random.default_rng(0).permutation(len(X))[:LOOKS]]
    far = np.asarray(KDTree(X).query(some, k=[min(1 + APART, len(X))])[1])[:, 0]
    return np.asarray((some + X[far]) / 2)


def _tempered(samples: Samples, fit: Fit, wanted: Wanted, tick: Tick) -> Fit:
    """Calm ladders instead of a fit whose surface leaves the range of the values, unless they leave far more.

    As in a partition, what is left at each point without itself counts.
    """
    calm = _chosen(samples, wanted, tick, kinds=[Kind("ladder", h) for h in ROUGHNESS if h <= CALM])
    there, here = (float(np.sum(each.residuals**2)) for each in (fit, calm))
    return calm if here < tolerated(fit.smoothing) * there else fit


def _expansion(samples: Samples, fit: Fit) -> Expansion:
    """The fit of these samples, every one a centre."""
    return Expansion(
        centers=samples.X,
        spreads=fit.spreads,
        coefficients=fit.coefficients,
        bias=fit.bias,
        support=samples.X,
        values=samples.y,
        weights=fit.weights,
        kernel=fit.kernel,
        smoothing=fit.smoothing,
        variance=fit.variance,
        calibration=calibrated(samples.X, fit),
        excess=np.zeros(samples.y.shape[1]),
    )


def _train_sparse(samples: Samples, wanted: Wanted, tick: Tick) -> Trained:
    """Few centres among many points: a sample chooses the kernel, all points the centres."""
    rows = np.sort(np.random.default_rng(0).permutation(len(samples))[: search.CLIMBED])
    tick("selection", 0.0)
    suspects = robust.screen(robust.tree_of(samples.X), samples.y)
    rows = np.setdiff1d(rows, suspects)
    few = samples.take(rows)
    fit = _select(few, wanted, tick)
    samples = samples.without(suspects)
    none = np.zeros((0, 0))
    network = Expansion(
        centers=none,
        spreads=none,
        coefficients=none,
        bias=fit.bias,
        support=none,
        values=none,
        weights=none,
        kernel=fit.kernel,
        smoothing=fit.smoothing,
        variance=fit.variance,
        calibration=calibrated(few.X, fit),
        excess=np.zeros(samples.y.shape[1]),
    )
    trained = Trained(network, suspects, np.zeros(0))
    chosen = _thin(trained, network, samples, wanted, tick)
    # Where a constant is enough there are no centres; how sure it is, the sample tells.
    known = samples.take(chosen) if len(chosen) else few
    network.support, network.values, network.weights = known.X, known.y, known.weights
    tick("solve", 1.0)
    return trained


def _thin(trained: Trained, network: Expansion, samples: Samples, wanted: Wanted, tick: Tick) -> IntArray:
    """Fewer centres than points, with the kernel of the best candidate; returns their rows."""

    def choice() -> greedy.Selection:
        return greedy.select(
            samples.X,
            samples.y - network.bias,
            network.kernel.gram,
            smoothing=network.smoothing,
            weights=samples.weights,
            tolerance=wanted.tolerance,
            max_centers=wanted.max_centers,
            tick=lambda share: tick("centres", share),
        )

    chosen, middle = choice(), np.average(samples.y, axis=0, weights=samples.weights)
    if chosen.history[-1] > max(wanted.tolerance, EXPLODED * float(np.abs(samples.y - middle).max())):
        # Where all points were interpolated the bias may be far off the values, and few centres do not make up for it.
        network.bias = middle
        chosen = choice()
    network.centers, network.spreads = samples.X[chosen.indices], network.kernel.spreads
    network.coefficients = network.kernel.amplitudes[:, None, None] * chosen.coefficients
    left = np.abs(network.predict(samples.X) - samples.y)
    network.excess = np.maximum(0.0, np.mean(left**2, axis=0) - network.smoothing * network.variance)
    trained.history, trained.stop_reason = chosen.history, chosen.stop_reason
    error = float(left.max())
    if chosen.stop_reason == "rounding" or (chosen.stop_reason == "tolerance" and error > wanted.tolerance):
        # The coefficients are less exact than the basis that they were chosen by.
        trained.history[-1], trained.stop_reason = error, "rounding"
    return chosen.indices


def _train_partition(samples: Samples, wanted: Wanted, tick: Tick) -> Trained:
    notes: tuple[str, ...] = ()

    def cut(part: Samples) -> Partition:
        return _partition(part, wanted, tick)

    tree = robust.tree_of(samples.X)
    many = robust.weighed(samples, tree, lambda part, quick: _select(part, wanted, tick, quick=quick), cut)
    if many is not None and many.noisy:
        return _partitioned(many.of(samples), many.outliers, None, wanted, tick)
    outliers = robust.screen(tree, samples.y) if many is None else many.outliers
    network: Partition | None = None
    if wanted.smoothing is not None:
        kept = samples.without(outliers)
        network = cut(kept)
        why = f"it leaves {BEYOND:g} times the range of the values" if not _bounded(network, kept) else ""
        if not why and wanted.smoothing < CLEAN and _misses(network, kept):
            why = "rounding keeps it off the points"
        if why:
            notes = (_unstable(wanted, why),)
            wanted, network = replace(wanted, smoothing=None), None
    if len(outliers):
        # Where some points are wild there are others that the neighbours could not tell.
        rows = np.setdiff1d(np.arange(len(samples)), outliers)
        more = robust.cross_checked(samples.take(rows), cut)
        outliers, network = np.union1d(outliers, rows[more]), None
    if len(outliers):
        network = cut(samples.without(outliers))
        agreed = robust.agreeing(network, samples, outliers)
        if agreed.any():
            outliers, network = outliers[~agreed], None
    trained = _partitioned(samples.without(outliers), outliers, network, wanted, tick)
    trained.notes = notes
    return trained


def _partitioned(
    samples: Samples, outliers: IntArray, network: Partition | None, wanted: Wanted, tick: Tick
) -> Trained:
    """The partition of the samples, if there is none yet, or one network of merged ones."""
    if network is None:
        network = _partition(samples, wanted, tick)
    trained = Trained(network, outliers, np.zeros(0))
    if wanted.free:
        _coarsen(trained, network, samples, wanted, tick)
    return trained


def _coarsen(trained: Trained, network: Partition, samples: Samples, wanted: Wanted, tick: Tick) -> None:
    """One network of merged samples instead of the partition, where that is more accurate."""
    reached = 0.0

    def step(share: float) -> None:
        nonlocal reached
        reached = share
        tick("merging", reached)

    def told(_stage: str, _share: float) -> None:
        tick("merging", reached)

    trained.network = coarsening.coarsened(
        network,
        samples,
        lambda part, quick: _expansion(part, _select(part, wanted, told, quick=quick)),
        lambda part: _partition(part, wanted, told),
        step,
    )
    if trained.network is not network:
        trained.stop_reason = "every mean of merged points is a centre"


def _partition(samples: Samples, wanted: Wanted, tick: Tick) -> Partition:
    return Partition.fit(
        samples.X,
        samples.y,
        spread="auto" if wanted.spread is None else _given(samples, wanted),
        smoothing="auto" if wanted.smoothing is None else wanted.smoothing,
        weights=samples.weights,
        tick=tick,
    )


def _bounded(network: Partition, samples: Samples) -> bool:
    """Whether the surface stays near the values between the points."""
    pairs = np.random.default_rng(0).integers(len(samples), size=PROBES)
    distances = np.abs(np.diff(samples.X[np.sort(pairs)], axis=0)).mean(axis=0) / len(samples) ** 0.5
    return not strays(network.predict(samples.X[pairs] + distances), samples.y, BEYOND)


def _misses(network: Partition, samples: Samples) -> bool:
    """Whether the surface is further off the points than next to no smoothing allows."""
    some = samples.take(np.random.default_rng(0).permutation(len(samples))[:PROBES])
    return float(np.sqrt(np.mean((network.predict(some.X) - some.y) ** 2))) > MISSED
