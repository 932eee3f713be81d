"""A partition of unity of small networks, for more points than one dense network can take.

Every cell of a balanced quadtree carries a patch: a network whose centres are the points of the cell and of a margin
around it. Patches are blended by smooth weights (Wendland 2002, "Fast evaluation of radial basis functions: methods
based on partition of unity"),

    f(x) = sum_p w_p(x) f_p(x) / sum_p w_p(x),    f_p(x) = b_p + sum_l a_l sum_j c_pj exp(-|x - x_j|^2 / 2 (s_l h_p)^2)

where w_p is a product of quintic steps, so f has two continuous derivatives and no seam. All patches share one kernel,
measured in the patch's own mean spacing h_p, and its smoothing; both are chosen from the data by a sample of patches,
each with its own amplitude. Where that makes patches or the surface explode, a ladder takes its place. Where a patch
has too few points in a quarter of its square, in a hole or beside one, it borrows the nearest points wherever they
are, so every place is covered.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, Self

import numpy as np
from scipy.spatial import KDTree

from common.errors import TrainingError
from common.network import calibration, local
from common.network.blending import BLEND_MARGIN, Blend
from common.network.calibration import Across, Calibration
from common.network.cover import NINE, Cover, Frame, frame_for, ragged
from common.network.dense import Dense
from common.network.kernel import Kernel
from common.network.local import FAR, Levels
from common.network.patches import Tick, points_of
from common.network.quadtree import DEEPEST, Quadtree
from common.network.selection import CALM, CLEAN, TINY, Kind, Samples, Spectra, believed, rounding_floor
from common.network.threads import parallel
from common.surface import BoolArray, FloatArray, IntArray

BATCH = 64
"""Patches factorised together."""

ROUNDS = ((5, 8), (8, 3))
"""Patches that have been asked after each round, and the kernels that more patches choose from."""

FEW, MORE = 16, 64
"""Patches that choose among the last of them: a quarter of all is enough, within these limits."""

CHECKED = 96
"""Patches whose points are held against the network without them."""

ACROSS = 8
"""Patches in which a side is told by the points of the other."""

LADDER: FloatArray = np.asarray(24.0 / 2.0 ** np.arange(7))
"""Spreads of the ladder in mean spacings; a patch is about ten spacings wide. A step of two is as good as the dense
ladder's square root of two here, at half the cost, and a finer spread would pass for noise."""

SINGLE = (1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 11.0, 16.0)
"""Single spreads tried, in mean spacings."""

ROUGHNESS = (0.25, 0.5, 0.7, 0.85, 1.0, 1.25, 1.5, 2.0, 3.0)
"""Exponents H of the ladder tried."""

SCALES = (0.35, 0.5, 0.7)
"""Scales of the multiquadrics, in mean spacings, on a ladder that begins a step further down: rougher than any of the
others, as the extrema of terrain are. Wider ones take what is rough for noise."""

SMOOTHINGS: FloatArray = np.logspace(-13, 1, 29)

MEMORY = 4 << 30
"""Bytes that a fit may take."""

BYTES_A_POINT = 400
"""Peak of a fit as measured, in bytes a point, rounded up."""

LOUD = 30.0
"""Times the usual amplitude, over the deviation of the values, that a kernel has in a patch that it does not suit."""

ASTRAY = 1.5
"""Half ranges about the middle of the values within which a surface is not doubted."""

BEYOND = 3.0
"""The same that a surface may reach between its points."""

NEARBY = 8.0
"""Mean spacings from the nearest point within which a place is between points: a patch is about ten wide."""

PROBES = 2000
"""Places at which a surface is probed."""

FAR_MORE = 16.0
"""Times a kernel's sum of squares that a calm ladder must leave at clean points for the kernel to stay."""

MORE_OR_LESS = 0.8
"""The same where the points are noisy."""

WORSE = 2.0
"""Mean square of the leave-one-out residuals, over the least of a ladder, beyond which a kernel is not believed; it is
that of a sample of the patches."""

FLAT = 1e-12
"""Deviation, in that of all values, below which the values of a patch are one value and rounding."""

_RAISES = 12

LONE = 4
"""Points in a cell and all that touch it below which they are lone, and tell nothing of the others."""

LEAST = 1e-9
"""Smoothing that is tried first, tenfold, where a patch in a gap leaves the range of the values."""


@dataclass(slots=True, eq=False)
class Partition:
    """A surface of many small networks; made by `fit`.

    Attributes
    ----------
    cover : Cover
        The patches' squares.
    u : ndarray, shape (n, 2)
        Centres in cells (see `Frame`), sorted along the quadtree.
    weights : ndarray, shape (n,)
        Samples behind each centre.
    starts : ndarray of int, shape (patches + 1,)
        Where the centres of each patch begin in `members`.
    members : ndarray of int
        Rows of `u`.
    spacings : ndarray, shape (patches,)
        Mean spacing of each patch, in cells.
    kernel : Kernel
        Spreads in mean spacings of a patch.
    smoothing : ndarray, shape (patches,)
        On the diagonal of the kernel matrix of each patch, whose diagonal is 1.
    coefficients : ndarray, shape (len(members), k)
    bias : ndarray, shape (patches, k)
    amplitude : ndarray, shape (patches, k)
        Deviation of the surface about the bias of each patch, as its kernel explains it.
    calibration : Calibration
        Of the deviation.
    """

    cover: Cover
    u: FloatArray
    weights: FloatArray
    starts: IntArray
    members: IntArray
    spacings: FloatArray
    kernel: Kernel
    smoothing: FloatArray
    coefficients: FloatArray
    bias: FloatArray
    amplitude: FloatArray
    calibration: Calibration
    _growth: FloatArray | None = field(default=None, repr=False)

    @classmethod
    def fit(
        cls,
        X: FloatArray,
        y: FloatArray,
        *,
        spread: float | Literal["auto"] = "auto",
        smoothing: float | Literal["auto"] = "auto",
        weights: FloatArray | None = None,
        memory: int = MEMORY,
        tick: Tick | None = None,
    ) -> Self:
        """Fit to positions X (n, 2) and values y (n, k).

        Parameters
        ----------
        spread : "auto" or float
            One spread for all neurons in the units of X, or chosen with the smoothing.
        smoothing : "auto" or float
            lambda >= 0, the variance of the noise over that of the surface within a patch.
        weights : ndarray, shape (n,), optional
            Samples behind each value.
        memory : int
            Bytes that the fit may take.
        tick : callable, optional
            ``tick(stage, fraction)``; whatever it raises ends the fit.

        Raises
        ------
        TrainingError
            If the fit would take more than `memory`, or the points are all at one place.
        """
        n, outputs = y.shape
        needed = n * (BYTES_A_POINT + 40 * (outputs - 1))
        if needed > memory:
            raise TrainingError(
                f"{n} points need about {needed / 2**20:.0f} MiB; accepted are at most {memory / 2**20:.0f} MiB"
            )
        if not np.ptp(X, axis=0).any():
            raise TrainingError("all points are at one place")
        told = tick or (lambda _stage, _fraction: None)
        told("cells", 0.0)
        frame = frame_for(X)
        codes = frame.codes(X)
        order = np.argsort(codes, kind="stable")
        codes, u, values = codes[order], frame.scaled(X[order]), y[order]
        share = np.ones(n) if weights is None else weights[order]
        first = np.flatnonzero(np.append(True, codes[1:] != codes[:-1]))
        if len(first) < n:
            total = np.add.reduceat(share, first)
            u = np.add.reduceat(u * share[:, None], first) / total[:, None]
            values = np.add.reduceat(values * share[:, None], first) / total[:, None]
            codes, share = codes[first], total
        cover = Cover.over(frame, codes)
        runs = cover.runs(codes)
        starts, members, spacings = points_of(cover, u, runs, told)
        if spread != "auto":
            spacings[:] = spread / frame.side
        patches = len(cover)
        empty, unit = np.zeros((0, 0)), Kernel.single(1.0)
        unknown = Calibration.unknown(outputs)
        made = cls(cover, u, share, starts, members, spacings, unit, np.zeros(patches), empty, empty, empty, unknown)
        lone = made._lone(runs)
        among = np.setdiff1d(np.arange(patches), made._that_know(lone, runs))
        kernel, level = made._chosen(values, among, spread, smoothing, told)
        made.kernel, made.smoothing = kernel, np.full(patches, level)
        made._solve(values, told)
        if spread == smoothing == "auto":
            loud = np.intersect1d(made._loud(values), among)
            anywhere = frame.low + frame.side * frame.extent * np.random.default_rng(0).random((PROBES, 2))
            heights = made.predict(anywhere)
            if len(loud) or strays(heights, values):
                exploded = strays(heights, values, BEYOND)
                if exploded:
                    nearest = KDTree(X, balanced_tree=False, compact_nodes=False).query(anywhere)[0]
                    between = nearest < NEARBY * frame.side * float(np.median(spacings))
                    exploded = strays(heights[between], values, BEYOND)
                kernel, level = made._tempered(loud, np.setdiff1d(among, loud), values, exploded=exploded)
                if kernel is not made.kernel:
                    made.kernel, made.smoothing = kernel, np.full(patches, level)
                    made._solve(values, told)
            made._hold(np.union1d(made._in_gaps(np.flatnonzero(np.diff(runs) == 0)), lone), values)
        made.calibration = made._calibrated(values)
        return made

    def to_state(self) -> dict[str, np.ndarray[Any, Any]]:
        """Everything, as arrays that `numpy.savez` takes without pickling."""
        frame, tree = self.cover.frame, self.cover.tree
        state: dict[str, np.ndarray[Any, Any]] = {name: getattr(self, name) for name in _ARRAYS}
        state |= {"low": frame.low, "side": np.array(frame.side), "extent": frame.extent}
        state |= {"codes": tree.codes, "levels": tree.levels}
        state |= self.calibration.to_state()
        return state | {"spreads": self.kernel.spreads, "amplitudes": self.kernel.amplitudes}

    @classmethod
    def from_state(cls, state: dict[str, np.ndarray[Any, Any]]) -> Self:
        """The partition that `to_state` wrote."""
        frame = Frame(np.array(state["low"]), float(state["side"]), np.array(state["extent"]))
        tree = Quadtree(DEEPEST, np.array(state["codes"]), np.array(state["levels"]), frame.shape)
        arrays = {name: np.array(state[name]) for name in _ARRAYS}
        return cls(
            cover=Cover(frame, tree),
            kernel=Kernel(np.array(state["spreads"]), np.array(state["amplitudes"])),
            calibration=Calibration.from_state(state),
            **arrays,
        )

    @property
    def centers(self) -> FloatArray:
        """Centres in the units of X, shape (n, 2), sorted along the quadtree."""
        frame = self.cover.frame
        return np.asarray((self.u - frame.start) * frame.side + frame.low)

    @property
    def spreads(self) -> FloatArray:
        """Spreads of the patches in the units of X, shape (patches, levels), descending."""
        return np.asarray(self.cover.frame.side * self.spacings[:, None] * self.kernel.spreads)

    def __len__(self) -> int:
        return len(self.cover)

    @property
    def _blend(self) -> Blend:
        return Blend(self.cover, self.spacings, np.diff(self.starts))

    def _batch(self, patches: IntArray) -> tuple[FloatArray, IntArray, BoolArray]:
        """Centres (p, k, 2) in mean spacings about the patch's middle, their rows (p, k), and which are not padding."""
        first, counts = self.starts[patches], np.diff(self.starts)[patches]
        width = int(counts.max())
        at = np.arange(width)
        real = at < counts[:, None]
        slots = np.where(real, first[:, None] + at, 0)
        points = self.u.take(self.members.take(slots), axis=0)
        points -= self.cover.centres[patches, None]
        points /= self.spacings[patches, None, None]
        points = np.where(real[:, :, None], points, FAR * (1.0 + at)[:, None])
        return points, np.where(real, slots, -1), real

    def _coefficients_at(self, slots: IntArray) -> FloatArray:
        """Coefficients at the slots (p, k) of a batch, 0 at the padding, shape (p, k, outputs)."""
        return np.where(slots[:, :, None] >= 0, self.coefficients.take(slots, axis=0), 0.0)

    def _chosen(
        self, values: FloatArray, among: IntArray, spread: float | str, smoothing: float | str, tick: Tick
    ) -> tuple[Kernel, float]:
        """Kernel and smoothing that foretell the points of some among the patches best, each left out of its own."""
        rough, smooth = (_ladders(), _smooth()) if spread == "auto" else ([], [Kernel.single(1.0)])
        kernels = [*rough, *smooth]
        counts = np.diff(self.starts)
        floor = rounding_floor(int(counts.max()))
        if smoothing != "auto":
            smoothings = np.array([max(float(smoothing), floor)])
        else:
            smoothings = SMOOTHINGS[floor <= SMOOTHINGS]
        if len(kernels) == len(smoothings) == 1:
            return kernels[0], float(smoothings[0])
        usual = np.flatnonzero((counts >= min(40, counts.max())) & (counts <= 4 * np.median(counts)))
        usual = np.intersect1d(usual, among)
        drawn = np.random.default_rng(0).permutation(usual if len(usual) else np.arange(len(self)))
        tick("selection", 0.0)
        total, likely, asked = np.zeros((2, len(kernels), len(smoothings))), np.arange(len(kernels)), 0
        ladders = likely < len(rough)
        most = max(FEW, min(MORE, len(self) // 4))
        for until, kept in (*ROUNDS, (most, 1)):
            total[:, likely] += self._summed(drawn[asked:until], values, [kernels[i] for i in likely], smoothings)
            scores = believed(total[0, likely], total[1, likely], ladders[likely], WORSE)
            ordered = likely[np.argsort(scores.min(axis=1), kind="stable")]
            best = float(smoothings[int(np.argmin(scores[likely == ordered[0]]))])
            # One ladder stays, to hold the others against.
            ladder = ordered[ladders[ordered]][:1]
            likely, asked = np.append(ordered[:kept], np.setdiff1d(ladder, ordered[:kept])), until
            tick("selection", asked / most)
        return kernels[likely[0]], best

    def _summed(
        self, patches: IntArray, values: FloatArray, kernels: list[Kernel], smoothings: FloatArray
    ) -> FloatArray:
        """The `_scores` of several patches, added up."""
        found = parallel(lambda patch: self._scores(int(patch), values, kernels, smoothings), patches)
        return np.sum(found, axis=0) if found else np.zeros((2, len(kernels), len(smoothings)))

    def _scores(self, patch: int, values: FloatArray, kernels: list[Kernel], smoothings: FloatArray) -> FloatArray:
        """How badly each kernel and smoothing foretells the points of one patch, shape (2, kernels, smoothings).

        The leave-one-out density of `selection` counts by the deviation of the patch's values, since an error is
        measured in their units wherever it is made; beside it the sum of the squares.
        """
        rows = self.members[self.starts[patch] : self.starts[patch + 1]]
        y = values[rows]
        deviation = float(np.sqrt(y.var(axis=0).mean()))
        if len(rows) < 4 or not deviation:
            return np.zeros((2, len(kernels), len(smoothings)))
        points = self.u[rows] / self.spacings[patch]
        points -= points.mean(axis=0)
        grams = np.concatenate([Levels(kernel).matrix(points[None], points[None]) for kernel in kernels])
        samples = Samples(points, (y - y.mean(axis=0)) / deviation, self.weights[rows])
        _, density, square, _ = Spectra(grams, samples).criteria(smoothings)
        return np.stack([deviation * density, deviation**2 * len(rows) * square])

    def _solve(self, values: FloatArray, tick: Tick, patches: IntArray | None = None) -> None:
        """Coefficients, bias and amplitude of every patch, or of some, those of as many points together."""
        outputs = values.shape[1]
        if patches is None:
            patches = np.arange(len(self))
            self.coefficients = np.zeros((len(self.members), outputs))
            self.bias, self.amplitude = np.zeros((len(self), outputs)), np.zeros((len(self), outputs))
        levels = Levels(self.kernel)
        order = patches[np.argsort(np.diff(self.starts)[patches], kind="stable")]

        def work(patches: IntArray) -> None:
            points, slots, real = self._batch(patches)
            rows, many = self.members.take(slots), real.sum(axis=1)[:, None]
            y = values.take(rows, axis=0).transpose(0, 2, 1) * real[:, None]
            middle = y.sum(axis=2) / many
            y = (y - middle[:, :, None]) * real[:, None]
            share = np.where(real, self.weights.take(rows), 1.0)
            for _ in range(_RAISES):
                solved = local.solve(points, self.smoothing[patches, None] / share, real, y, levels)
                if solved is not None:
                    break
                if len(patches) > 1:
                    # Which of them it was is not known, and the others need no more smoothing.
                    for part in np.array_split(patches, 2):
                        work(part)
                    return
                self.smoothing[patches] = 10 * np.maximum(self.smoothing[patches], rounding_floor(points.shape[1]))
            else:
                raise TrainingError("the kernel matrix of a patch is not positive definite, whatever the smoothing")
            self.amplitude[patches] = np.sqrt(np.maximum(solved.quadratic, 0.0) / np.maximum(many - 1, 1))
            self.bias[patches] = middle + solved.bias
            self.coefficients[slots[real]] = solved.coefficients.transpose(0, 2, 1)[real]

        # The values stand below the matrix: many outputs make it larger.
        largest = int(np.diff(self.starts).max())
        size = max(1, round(BATCH * (largest / (largest + outputs)) ** 2))
        batches = [order[start : start + size] for start in range(0, len(order), size)]
        parallel(work, batches, tick=lambda fraction: tick("solve", fraction))

    def _loud(self, values: FloatArray) -> IntArray:
        """Patches that the kernel of the others makes explode.

        So does a cliff in a smooth surface: it takes a wide Gaussian an amplitude far beyond the heights.
        """
        counts, first = np.diff(self.starts)[:, None], self.starts[:-1]
        away = values[self.members]
        away -= np.repeat(np.add.reduceat(away, first) / counts, counts[:, 0], axis=0)
        deviations = np.sqrt(np.mean(np.add.reduceat(np.square(away, out=away), first) / counts, axis=1))
        alive = np.flatnonzero(deviations > FLAT)
        if not len(alive):
            return alive
        loudness = np.sqrt(np.mean(self.amplitude[alive] ** 2, axis=1)) / deviations[alive]
        return np.asarray(alive[loudness > LOUD * np.median(loudness)])

    def _tempered(self, loud: IntArray, calm: IntArray, values: FloatArray, *, exploded: bool) -> tuple[Kernel, float]:
        """The calm ladder, and its smoothing, that leaves least at the points of the loud patches and of the others.

        The kernel that is there stays where the ladder leaves `FAR_MORE`, since that kernel errs more between the
        points, where nothing tells; where noise hides what a kernel leaves, unless the ladder leaves clearly less. It
        goes where it `exploded` between the points.
        """
        kernels = [self.kernel, *_ladders(CALM)]
        smoothings = SMOOTHINGS[rounding_floor(int(np.diff(self.starts).max())) <= SMOOTHINGS]
        rng, total = np.random.default_rng(0), np.zeros((len(kernels), len(smoothings)))
        for patches in (loud, calm):
            asked = rng.permutation(patches)[:MORE]
            if len(asked):
                total += len(patches) / len(asked) * self._summed(asked, values, kernels, smoothings)[1]
        total[0] = np.inf if exploded else total[0] * tolerated(float(self.smoothing.max()))
        kernel, level = np.unravel_index(int(np.argmin(total)), total.shape)
        return kernels[kernel], float(smoothings[level])

    def _lone(self, runs: IntArray) -> IntArray:
        """The patches in whose cells there are points, but hardly any there and in the cells that touch them."""
        own = np.diff(runs)
        around = np.where(self.cover.touching >= 0, own[self.cover.touching], 0).sum(axis=1)
        return np.flatnonzero((own > 0) & (around < LONE))

    def _that_know(self, lone: IntArray, runs: IntArray) -> IntArray:
        """The patches that have one of the points in the cells of the lone ones."""
        if not len(lone):
            return lone
        known = np.isin(self.members, ragged(runs[lone], np.diff(runs)[lone]))
        return np.flatnonzero(np.logical_or.reduceat(known, self.starts[:-1]))

    def _in_gaps(self, patches: IntArray) -> IntArray:
        """Those of the patches in whose blended squares there is no point: all that they know is borrowed."""
        counts = np.diff(self.starts)[patches]
        rows = self.members[ragged(self.starts[patches], counts)]
        at = np.repeat(np.arange(len(patches)), counts)
        away = np.abs(self.u[rows] - self.cover.centres[patches][at])
        within = np.all(away <= (0.5 + BLEND_MARGIN) * self.cover.sides[patches][at, None], axis=1)
        return np.asarray(patches[np.bincount(at[within], minlength=len(patches)) == 0])

    def _hold(self, patches: IntArray, values: FloatArray) -> None:
        """Smooth those of the patches, about a lone point or none, that leave the range of the values.

        Far from its points a patch is its bias, which a smooth kernel puts as far off as a polynomial would be.
        """
        for _ in range(_RAISES):
            if not len(patches):
                break
            batches = np.array_split(patches, -(-len(patches) // BATCH))
            patches = patches[np.concatenate([self._astray(batch, values) for batch in batches])]
            self.smoothing[patches] = 10 * np.maximum(self.smoothing[patches], LEAST)
            self._solve(values, lambda _stage, _share: None, patches)

    def _astray(self, patches: IntArray, values: FloatArray) -> BoolArray:
        """Which of the patches leave the range of the values at one of nine places, shape (p,)."""
        points, slots, _ = self._batch(patches)
        reach = (1 + 2 * BLEND_MARGIN) * self.cover.sides[patches] / self.spacings[patches]
        places = (NINE - 0.5) * reach[:, None, None]
        heights = Levels(self.kernel).matrix(places, points) @ self._coefficients_at(slots) + self.bias[patches, None]
        return np.array([strays(each, values, BEYOND) for each in heights])

    def _calibrated(self, values: FloatArray) -> Calibration:
        """From the leave-one-out residuals in the cells of a sample of patches."""
        outputs = values.shape[1]
        sample = np.random.default_rng(0).permutation(len(self))[:CHECKED]
        found = parallel(self.left_out, sample.tolist())
        rows, _, residuals, deviations = (np.concatenate(part) for part in zip(*found, strict=True))
        ratios = residuals / np.maximum(deviations, TINY)
        patches = np.repeat(sample, [len(part[0]) for part in found])
        amplitude = np.maximum(self.amplitude[patches], TINY)
        smoothing = self.smoothing[patches, None]
        # What is flat is known to the last bit, and tells nothing of the rest.
        lively = np.any(deviations > FLAT, axis=1)
        ratios[~lively] = 0.0
        if not lively.any():
            return Calibration.unknown(outputs)
        factor, detail = calibration.factor(ratios[lively]), np.ones(outputs)
        noisy = np.median(smoothing * amplitude**2, axis=0) > calibration.DETAIL * values.var(axis=0)
        if noisy.any():
            told = ratios / np.maximum(factor, TINY)
            detail[noisy] = 1 - calibration.noise_share(self.u[rows], told)[noisy]
        variances = (deviations / amplitude) ** 2 - smoothing / self.weights[rows, None]
        most = calibration.TALLEST**2 * values.var(axis=0)
        return Calibration(factor, detail, calibration.usual_variance(variances[lively]), most)

    def _grown(self) -> FloatArray:
        """Exponents by which the deviation grows in gaps and beyond the edge, from the sides of some patches."""
        if self._growth is None:
            telling = (np.diff(self.starts) >= calibration.FEWEST) & np.any(self.amplitude > FLAT, axis=1)
            asked = np.random.default_rng(0).permutation(np.flatnonzero(telling))[:ACROSS]
            self._growth = self.calibration.growth(parallel(self._told_across, asked.tolist()))
        return self._growth

    def _told_across(self, patch: int) -> Across:
        """What the points of a patch tell of each other across it."""
        points, gram, noise, values = self._problem(patch)
        amplitude = np.where(self.amplitude[patch] > FLAT, self.amplitude[patch], np.inf)
        return calibration.told_across(points, values, gram, noise).over(amplitude)

    def _problem(self, patch: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """What a patch was solved for.

        Its points (m, 2) in mean spacings, the kernel (m, m), what is added to its diagonal (m,), the values (m, k).
        """
        points, slots, _ = self._batch(np.array([patch]))
        coefficients = self.coefficients[slots[0]]
        gram = Levels(self.kernel).matrix(points, points)[0]
        noise = self.smoothing[patch] / self.weights[self.members[slots[0]]]
        return points[0], gram, noise, gram @ coefficients + noise[:, None] * coefficients + self.bias[patch]

    def left_out(self, patch: int) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
        """The points in the cell of a patch, and what the patch says of each without it.

        Returns their rows (m,) of `u`, their values (m, k), the residuals (m, k), and the deviations (m, k) that these
        should have.
        """
        _, gram, _, values = self._problem(patch)
        mine = slice(*self.starts[patch : patch + 2])
        members = self.members[mine]
        dense = Dense(gram, self.weights[members], self.smoothing[patch])
        residuals, variances = dense.leave_one_out(self.coefficients[mine])
        deviations = np.maximum(self.amplitude[patch], TINY) * np.sqrt(np.maximum(variances, 0.0))[:, None]
        inside = np.all(np.abs(self.u[members] - self.cover.centres[patch]) <= self.cover.sides[patch] / 2, axis=1)
        return members[inside], values[inside], residuals[inside], deviations[inside]

    def predict_grid(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Values on a grid, shape (len(y), len(x), k): patch by patch, each a matrix product.

        Beyond the data's box the nearest patches go on.
        """
        levels = Levels(self.kernel)

        def values(patches: IntArray, across: FloatArray, up: FloatArray) -> FloatArray:
            points, slots, _ = self._batch(patches)
            found = local.rectangles(points, across, up, self._coefficients_at(slots), levels)
            found += self.bias[patches].T[:, :, None, None]
            return found

        return self._blend.grid(x, y, self.coefficients.shape[1], values)

    def predict(self, X: FloatArray) -> FloatArray:
        """Values at X (m, 2), shape (m, k)."""
        levels = Levels(self.kernel)

        def values(patches: IntArray, places: FloatArray) -> FloatArray:
            points, slots, _ = self._batch(patches)
            matrix = levels.matrix(places, points)
            return np.asarray(matrix @ self._coefficients_at(slots) + self.bias[patches, None])

        blended, _ = self._blend.scattered(X, self.coefficients.shape[1], values)
        return blended

    def predict_std(self, X: FloatArray) -> FloatArray:
        """Standard deviation of the surface at X (m, 2), without the noise of a new measurement, shape (m, k)."""
        levels, growth = Levels(self.kernel), self._grown()

        def deviations(patches: IntArray, places: FloatArray) -> FloatArray:
            points, slots, real = self._batch(patches)
            diagonal = self.smoothing[patches, None] / np.where(real, self.weights[self.members[slots]], 1.0)
            inverse = np.linalg.inv(np.linalg.cholesky(local.gram(points, diagonal, levels)))
            half = inverse @ levels.matrix(points, places)
            one = inverse @ real[:, :, None].astype(np.float64)
            gap = 1 - (one.transpose(0, 2, 1) @ half)[:, 0]
            variance = 1 - np.square(half).sum(axis=1) + gap**2 / np.square(one).sum(axis=1)
            surface, smoothing = self.amplitude[patches, None] ** 2, self.smoothing[patches, None]
            told = self.calibration.variance(np.maximum(variance, 0.0), growth, surface, smoothing)
            return np.asarray(np.sqrt(told))

        blended, _ = self._blend.scattered(X, self.amplitude.shape[1], deviations)
        return blended

    def predict_gradient(self, X: FloatArray) -> FloatArray:
        """Derivatives of the blended surface at X (m, 2), shape (m, k, 2), in units of y over units of X."""
        levels, outputs = Levels(self.kernel), self.coefficients.shape[1]

        def slopes(patches: IntArray, places: FloatArray) -> FloatArray:
            points, slots, _ = self._batch(patches)
            matrix, slope = levels.slope(local.squared_distances(places, points))
            c = self._coefficients_at(slots)
            parts = [matrix @ c + self.bias[patches, None]]
            for axis in range(2):
                away = places[:, :, None, axis] - points[:, None, :, axis]
                parts.append((slope * away) @ c / self.spacings[patches, None, None])
            return np.concatenate(parts, axis=2)

        blended, lean = self._blend.scattered(X, 3 * outputs, slopes)
        inner = blended[:, outputs:].reshape(-1, 2, outputs).transpose(0, 2, 1)
        return np.asarray((inner + lean[:, :outputs]) / self.cover.frame.side)


_ARRAYS = (
    *("u", "weights", "starts", "members", "spacings"),
    *("smoothing", "coefficients", "bias", "amplitude"),
)


def strays(heights: FloatArray, values: FloatArray, accepted: float = ASTRAY) -> bool:
    """Whether any of the heights (m, k) is more than `accepted` half ranges off the middle of the values (n, k)."""
    middle = (values.max(axis=0) + values.min(axis=0)) / 2
    return not np.all(np.abs(heights - middle) <= accepted * np.ptp(values, axis=0) / 2)


def tolerated(smoothing: float) -> float:
    """Times a kernel's sum of squares that a calm ladder must leave for the kernel, of this smoothing, to stay."""
    return FAR_MORE if smoothing < CLEAN else MORE_OR_LESS


def _ladders(most: float = np.inf) -> list[Kernel]:
    """Ladders of every roughness up to that."""
    return [Kind("ladder", roughness).kernel(LADDER) for roughness in ROUGHNESS if roughness <= most]


def _smooth() -> list[Kernel]:
    """Multiquadrics and single Gaussians."""
    multiquadrics = [Kind("multiquadric", scale).kernel(LADDER / 2) for scale in SCALES]
    return [*multiquadrics, *(Kernel.single(spread) for spread in SINGLE)]
