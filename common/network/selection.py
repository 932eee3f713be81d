"""Spread and smoothing from the data.

A candidate is a kernel K with a smoothing lambda. Its network solves (K + lambda W^-1) c = y - b, W the weights of the
points, b the bias. Three families of kernels, each with one parameter, share one ladder of spreads:

- *single*: one Gaussian, for surfaces that are infinitely smooth; the parameter is its spread.
- *multiquadric*: (1 + r^2 / l^2)^(-1/4) as a scale mixture of Gaussians, for smooth surfaces with a peak; l.
- *ladder*: amplitudes s^(2H) exp(-H s^2 / L^2), for rough surfaces; the roughness H, and a reach L, infinite or not.
  With a reach it is the Matern kernel of order H: its spectral density is a mixture of Gaussians whose s^2 follow a
  gamma distribution (Rasmussen and Williams 2006, section 4.2.1).

One eigendecomposition of W^1/2 K W^1/2 gives two criteria for every smoothing at once:

- the restricted likelihood (REML; Patterson and Thompson 1971), the bias integrated out;
- the leave-one-out predictive density (Sundararajan and Keerthi 2001), from the residuals r_i = c_i / P_ii and their
  variances 1 / P_ii (Rippa 1999), P the inverse with the bias projected out, so that the bias, too, is fitted without
  the point. A point that has a twin, another within a tenth of the mean spacing, is left out with it: what one of them
  tells of the other says nothing of the places between the points (Mila, Mateu, Pebesma and Meyer 2022, "Nearest
  neighbour distance matching leave-one-out cross-validation for map validation").

Candidates are averaged with weights exp(-0.7 nll_LOO) lambda: the leave-one-out density at less than full strength,
since few points tell less than it claims, and noise-to-signal ratios lambda between 0.0003 and 0.1 held for equally
likely beforehand (on a logarithmic scale a flat density is lambda). Candidates share their centres, so the average is
one network again: coefficients per spread add up. What leaves far more than a ladder at the points has no weight. REML,
which is sure of itself even where no kernel is right, serves to compare readings of the data (`common.network.robust`).
docs/network.md has the table behind the choice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
import scipy.linalg
from scipy.spatial import KDTree

from common.errors import ParameterError, TrainingError
from common.network.kernel import Kernel, level_matrices, mean_spacing, squared_distances
from common.network.threads import parallel
from common.surface import BoolArray, FloatArray, IntArray

Family: TypeAlias = Literal["single", "multiquadric", "ladder"]

ROUGHNESS = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
CALM = 1.0
"""Roughness up to which a ladder explodes nowhere."""

ORDERS = (0.5, 1.0, 2.0, 4.0)
"""Roughnesses of the ladders that have a reach."""

REACHES = (0.25, 0.5, 1.0)
"""Reaches that are tried, as shares of the extent of the points."""

SMOOTHINGS: FloatArray = np.concatenate([np.logspace(-13, -7, 7), np.logspace(-6, 0, 13)])
TRUST = 0.7
"""Exponent of the leave-one-out density in a candidate's weight."""

LIKELY = (3e-4, 0.1)
"""Smoothings that are held for equally likely beforehand; below and above them it is their logarithms that are."""

COUNTED = 12
"""Kinds of kernels up to which all are tried."""

BEHIND = 8.0
"""Score by which a kernel may lie behind and those beside it are still worth a trial."""

COARSE = 4
"""Steps from kernel to kernel among those that are tried first."""

REFINEMENTS = ((2, 3 * BEHIND), (1, BEHIND))
"""Finer steps from kernel to kernel, and the score by which one may lie behind and those so near are tried."""

FEW = 30
"""Points below which that belief fades: three points are worth little, but all there is."""

NEGLIGIBLE = 0.03
"""Share of the heaviest weight that is taken off every weight, so that those of less fade out of the average."""

WORSE = 4.0
"""Mean square of the leave-one-out residuals, over the least of a ladder, beyond which a candidate is not believed."""

CLEAN = 1e-6
"""Smoothing below which the points may have no noise at all."""

NOISY = 1e-4
"""Smoothing from which the points are taken for noisy."""

TINY = float(np.finfo(np.float64).tiny)
CLOSE = 0.1
"""Mean spacings within which two points are twins: one tells the other, and neither what is between the points."""

NO_TWINS: tuple[IntArray, IntArray] = (np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
"""Rows that have a twin, and their twins, where there are none."""

NOTHING = 1e-30
"""What a point may at least tell of itself; less is rounding, or a point alone."""


def rounding_floor(n: int) -> float:
    """The least smoothing that a kernel matrix of `n` points with unit diagonal can be told from rounding by."""
    return float(4 * n * np.finfo(np.float64).eps)


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """What the network is fitted to, in units of its own extent.

    Parameters
    ----------
    X : ndarray, shape (n, d)
        Distinct positions.
    y : ndarray, shape (n, k)
        Values.
    weights : ndarray, shape (n,)
        The noise of a value has the variance lambda / weight; the number of measurements behind it.
    scatter : float
        Sum of squares of those measurements about `y`, over all outputs; it tells of the noise alone.
    repeats : int
        Measurements beyond the first at each position.
    """

    X: FloatArray
    y: FloatArray
    weights: FloatArray
    scatter: float = 0.0
    repeats: int = 0

    def __len__(self) -> int:
        return len(self.X)

    def take(self, rows: IntArray) -> Samples:
        """The samples at `rows`; what repeats there are is shared out evenly."""
        share = len(rows) / len(self.X)
        return Samples(
            self.X[rows], self.y[rows], self.weights[rows], self.scatter * share, round(self.repeats * share)
        )

    def without(self, rows: IntArray) -> Samples:
        """All samples but those at `rows`."""
        return self.take(np.setdiff1d(np.arange(len(self)), rows)) if len(rows) else self


class Kind(NamedTuple):
    """A kernel of one of the families, by its parameter and, for a ladder, its reach."""

    family: Family
    parameter: float
    reach: float = math.inf

    def kernel(self, spreads: FloatArray) -> Kernel:
        """The kernel, a mixture on the ladder of descending spreads, shape (levels,)."""
        if self.family == "single":
            return Kernel.single(self.parameter)
        return Kernel.mixture(spreads, amplitudes(self, spreads))


class Candidate(NamedTuple):
    """A kernel and a smoothing."""

    kind: Kind
    smoothing: float


def amplitudes(kind: Kind, spreads: FloatArray) -> FloatArray:
    """Amplitudes of a mixture on the spreads, shape (levels,), adding up to one; zero where negligible."""
    family, parameter, reach = kind
    if family == "ladder":
        logs = 2 * parameter * np.log(spreads) - parameter * (spreads / reach) ** 2
        shares = np.exp(logs - logs.max())
    elif family == "multiquadric":
        # (1 + r^2 / l^2)^(-1/4) is the mean of exp(-t r^2 / l^2) over t of density t^(-3/4) exp(-t); with
        # t = l^2 / 2 s^2 the density on a logarithmic ladder of s is t^(1/4) exp(-t).
        t = 0.5 * (parameter / spreads) ** 2
        shares = t**0.25 * np.exp(-t)
    else:
        raise ParameterError(f"family {family!r} has one spread, no mixture")
    shares[shares < FAINT * shares.max()] = 0
    return np.asarray(shares / shares.sum())


FAINT = 1e-10
"""Amplitudes below this share of the greatest are left out."""

WIDEST = 0.5
"""Greatest parameter of a kernel that is no ladder, as a share of the extent of the points: beyond it a Gaussian is a
polynomial, which fits the points and runs away between them."""


def families(spreads: FloatArray, extent: float) -> list[Kind]:
    """Every kind of kernel worth a trial; `spreads` descending, `extent` the points' (`kernel.span`)."""
    finest = float(spreads.min())
    narrow = [s for s in spreads.tolist() if s <= max(finest, WIDEST * extent)]
    return [
        *(Kind("single", s) for s in narrow),
        *(Kind("multiquadric", s) for s in narrow),
        *(Kind("ladder", h) for h in ROUGHNESS),
        *(Kind("ladder", h, reach * extent) for h in ORDERS for reach in REACHES if reach * extent > finest),
    ]


def _eigenbases(matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues (c, n) and eigenvectors (c, n, n) of symmetric matrices (c, n, n); raises TrainingError."""
    try:
        values, vectors = np.linalg.eigh(matrices)
    except np.linalg.LinAlgError:
        # Divide and conquer can fail on clustered eigenvalues, of which a wide Gaussian has many; QL iteration goes on.
        try:
            pairs = [scipy.linalg.eigh(matrix, driver="ev") for matrix in matrices]
        except (np.linalg.LinAlgError, ValueError) as error:
            raise TrainingError(f"the kernel matrix of these points has no eigenvalues to be found: {error}") from error
        values, vectors = np.stack([pair[0] for pair in pairs]), np.stack([pair[1] for pair in pairs])
    return values, vectors


def twins(X: FloatArray) -> tuple[IntArray, IntArray]:
    """Rows of points (n, d) that have another within `CLOSE` mean spacings, and the rows of their nearest."""
    if len(X) < FEW:
        return NO_TWINS
    distances, nearest = (np.asarray(found) for found in KDTree(X).query(X, k=2))
    rows = np.flatnonzero(distances[:, 1] < CLOSE * mean_spacing(X))
    return rows, nearest[rows, 1]


def without_twins(
    solved: FloatArray, diagonal: FloatArray, rows: IntArray, partners: IntArray, between: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """P y (..., k, n, m) and the diagonal of P (..., n, m) at each of the rows (p,) as if its twin were not there.

    What is left of P without a twin is its Schur complement; `between` (..., p, m) are its elements between the two.
    """
    share = between / diagonal[..., partners, :]
    apart, left = solved.copy(), diagonal.copy()
    apart[..., rows, :] -= share[..., None, :, :] * solved[..., partners, :]
    left[..., rows, :] = np.clip(diagonal[..., rows, :] - share * between, NOTHING, None)
    return apart, left


class Spectra:
    """W^1/2 K W^1/2 of several kernels in their eigenbases: every smoothing at the cost of a product.

    Parameters
    ----------
    grams : ndarray, shape (c, n, n)
        K at the positions, one for each kernel.
    samples : Samples
    close : tuple of two ndarrays of int, optional
        `twins` of the samples, where they are known already.
    """

    def __init__(self, grams: FloatArray, samples: Samples, close: tuple[IntArray, IntArray] | None = None) -> None:
        self.samples = samples
        self.twins = twins(samples.X) if close is None else close
        self.root = np.sqrt(samples.weights)
        values, self.basis = _eigenbases(grams * np.outer(self.root, self.root))
        self.values = np.clip(values, 0, None)
        turned = np.swapaxes(self.basis, 1, 2)
        self.y = turned @ (self.root[:, None] * samples.y)
        self.one = turned @ self.root

    def criteria(self, smoothings: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """What tells of m smoothings, shape (c, m) each.

        Restricted nll, leave-one-out nll, mean square of the leave-one-out residuals, signal variance. The
        leave-one-out density has a variance of its own, the one that suits its residuals best.
        """
        n, outputs = self.samples.y.shape
        inverse = 1 / (self.values[:, :, None] + smoothings)
        one_one = np.einsum("cn,cnm->cm", self.one**2, inverse)
        one_y = np.swapaxes(self.one[:, :, None] * self.y, 1, 2) @ inverse
        quadratic = np.clip(np.einsum("cnk,cnm->cm", self.y**2, inverse) - np.sum(one_y**2, 1) / one_one, TINY, None)
        free = n - 1 + self.samples.repeats
        variance = (quadratic + self.samples.scatter / smoothings) / (free * outputs)
        log_det = np.log(one_one) - np.log(inverse).sum(axis=1) + self.samples.repeats * np.log(smoothings)
        restricted = 0.5 * outputs * (free * np.log(variance) + log_det - np.log(self.samples.weights).sum())

        along_one = self.basis @ (self.one[:, :, None] * inverse)
        solved, diagonal = self._projected(inverse, one_one, one_y, along_one)
        rows, partners = self.twins
        if len(rows):
            between = (self.basis[:, rows] * self.basis[:, partners]) @ inverse
            between -= along_one[:, rows] * along_one[:, partners] / one_one[:, None]
            solved, diagonal = without_twins(solved, diagonal, rows, partners, between)
        squares = np.clip(np.square(solved).sum(axis=1) / diagonal, TINY, None)
        own = squares.mean(axis=1) / outputs
        spread = np.log(diagonal).sum(axis=1) + np.log(self.samples.weights).sum()
        square = ((squares / diagonal) / self.samples.weights[:, None]).mean(axis=1) / outputs
        return restricted, left_out_nll(n, outputs, own, -spread), square, variance

    def _projected(
        self, inverse: FloatArray, one_one: FloatArray, one_y: FloatArray, along_one: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """P y (c, k, n, m) and the diagonal of P (c, n, m), both in weighted units."""
        diagonal = np.clip(self.basis**2 @ inverse - along_one**2 / one_one[:, None], NOTHING, None)
        solved = np.stack(
            [
                self.basis @ (self.y[:, :, k : k + 1] * inverse) - along_one * (one_y[:, k] / one_one)[:, None]
                for k in range(self.y.shape[2])
            ],
            axis=1,
        )
        return solved, diagonal

    def solve(self, index: int, smoothings: FloatArray, shares: FloatArray) -> Solution:
        """The network of one kernel, summed over the smoothings with the given shares (m,)."""
        one, y, basis = self.one[index], self.y[index], self.basis[index]
        inverse = 1 / (self.values[index][:, None] + smoothings)
        one_one = one**2 @ inverse
        bias = ((one[:, None] * y).T @ inverse) / one_one
        summed = y * (inverse @ shares)[:, None] - one[:, None] * (inverse @ (shares * bias).T)
        along_one = basis @ (one[:, None] * inverse)
        diagonal = np.clip(basis**2 @ inverse - along_one**2 / one_one, NOTHING, None)
        left_out = [
            (basis @ (y[:, k : k + 1] * inverse) - along_one * bias[k]) / diagonal @ shares for k in range(y.shape[1])
        ]
        return Solution(
            self.root[:, None] * (basis @ summed),
            bias @ shares,
            np.column_stack(left_out) / self.root[:, None],
            (1 / diagonal) @ shares / self.samples.weights,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """A network and how it fares without each point.

    Attributes
    ----------
    coefficients : ndarray, shape (n, k)
    bias : ndarray, shape (k,)
    residuals : ndarray, shape (n, k)
        Values less what the network says without them.
    spread : ndarray, shape (n,)
        Variance of the residuals over that of the surface.
    """

    coefficients: FloatArray
    bias: FloatArray
    residuals: FloatArray
    spread: FloatArray

    def scaled(self, share: float) -> Solution:
        """The part of the solution in an average."""
        return Solution(share * self.coefficients, share * self.bias, share * self.residuals, share * self.spread)


@dataclass(frozen=True, slots=True, eq=False)
class Scored:
    """Candidates and their scores; a share is exp(-score) less what is negligible, scaled to add up to one.

    Attributes
    ----------
    candidates : list of Candidate
    scores : ndarray, shape (candidates,)
        Less is better; infinite for one that is not believed.
    variances : ndarray, shape (candidates,)
        Of the surface, as each explains it.
    restricted : ndarray, shape (candidates,)
        Negative logarithms of the restricted likelihood.
    """

    candidates: list[Candidate]
    scores: FloatArray
    variances: FloatArray
    restricted: FloatArray

    @property
    def shares(self) -> FloatArray:
        """Shape (candidates,); adding up to one, zero where negligible."""
        shares = np.maximum(np.exp(self.scores.min() - self.scores) - NEGLIGIBLE, 0)
        return np.asarray(shares / shares.sum())

    def heaviest(self, most: int) -> list[Kind]:
        """The kinds of greatest share, at most so many, heaviest first."""
        total: dict[Kind, float] = {}
        for candidate, share in zip(self.candidates, self.shares.tolist(), strict=True):
            if share:
                total[candidate.kind] = total.get(candidate.kind, 0.0) + share
        return sorted(total, key=lambda kind: -total[kind])[:most]

    @property
    def least(self) -> int:
        """Where the least score is."""
        return int(np.argmin(self.scores))

    @property
    def best(self) -> Candidate:
        """The candidate of the least score."""
        return self.candidates[self.least]


def left_out_nll(n: int, outputs: int, own: FloatArray, logs: FloatArray) -> FloatArray:
    """Negative logarithm of the leave-one-out density of n points.

    From the mean square of the residuals over their deviations, `own`, and the sum of the logarithms of their
    variances, which are known up to a factor: it is the one that suits the residuals best.
    """
    return np.asarray(0.5 * outputs * (n * np.log(own) + logs))


def score(n: int, leave_one_out: FloatArray, smoothings: FloatArray) -> FloatArray:
    """What a candidate is worth on n points: less is better."""
    return TRUST * leave_one_out - min(1.0, n / FEW) * np.log(np.clip(smoothings, *LIKELY))


def believed(scores: FloatArray, squares: FloatArray, ladders: BoolArray, worse: float = WORSE) -> FloatArray:
    """Scores (c, ...), infinite where the mean square is `worse` than the least of a ladder; `ladders` (c,).

    Where a surface is smooth almost everywhere, a smooth kernel foretells most points so well that the density forgives
    it what it does at a ridge, a cliff or in a gap. A ladder errs there no more than it has to.
    """
    return np.where(squares > worse * squares[ladders].min(initial=np.inf), np.inf, scores)


def are_ladders(kinds: Sequence[Kind]) -> BoolArray:
    """Which of the kinds are ladders, shape (c,)."""
    return np.array([kind.family == "ladder" for kind in kinds], dtype=bool)


def average(
    samples: Samples,
    kinds: Sequence[Kind],
    spreads: FloatArray,
    smoothings: FloatArray,
    tick: Callable[[float], None],
) -> Fit:
    """Score kinds of kernels with every smoothing, and average them.

    Of many kinds every fourth one is tried, and the ends of every run of one family, then those between two of which
    one is not far behind: kinds are in the order of their parameter, so what stands between two that count for nothing
    does not count either.
    """
    r2 = squared_distances(samples.X)
    levels = np.array(level_matrices(r2, spreads))
    kernels = [kind.kernel(spreads) for kind in kinds]
    close = twins(samples.X)
    tried: dict[int, _Tried] = {}

    def trial(rows: Sequence[int]) -> None:
        before, values = len(tried), max(1, len(samples) ** 2)
        batch = max(1, min(_BATCH // values, max(_LEAST // values, -(-len(rows) // _PARTS))))

        def work(start: int) -> list[_Tried]:
            part = [kernels[i] for i in rows[start : start + batch]]
            spectra = Spectra(_grams(part, r2, spreads, levels), samples, close)
            restricted, left_out, squares, variances = spectra.criteria(smoothings)
            scores = score(len(samples), left_out, smoothings)
            found = zip(range(len(part)), scores, squares, variances, restricted, strict=True)
            return [_Tried(spectra, *one) for one in found]

        def tell(share: float) -> None:
            tick((before + share * len(rows)) / len(kinds))

        found = parallel(work, range(0, len(rows), batch), tick=tell)
        tried.update(zip(rows, chain(*found), strict=True))

    def scores_of(rows: Sequence[int]) -> FloatArray:
        scores, squares = (np.array(part) for part in zip(*(tried[i][2:4] for i in rows), strict=True))
        return believed(scores, squares, are_ladders([kinds[i] for i in rows]))

    first = _every(COARSE, kinds) if len(kinds) > COUNTED else range(len(kinds))
    trial(first)
    for step, behind in REFINEMENTS:
        rows = sorted(tried)
        worth = scores_of(rows).min(axis=1)
        hot = np.flatnonzero(worth <= worth.min() + behind).tolist()
        about = {i for k in hot for i in range(rows[max(0, k - 1)] + 1, rows[min(k + 1, len(rows) - 1)])}
        trial(sorted(about.intersection(_every(step, kinds)) - tried.keys()))
    tick(1.0)

    rows = sorted(tried)
    scored = Scored(
        [Candidate(kinds[i], s) for i in rows for s in smoothings.tolist()],
        scores_of(rows).ravel(),
        *(np.concatenate(part) for part in zip(*(tried[i][4:] for i in rows), strict=True)),
    )
    by_kind = dict(zip(rows, scored.shares.reshape(len(rows), -1), strict=True))
    used = [i for i in rows if by_kind[i].any()]
    best = tried[rows[scored.least // len(smoothings)]]
    return combine(
        scored,
        best.spectra.solve(best.row, np.array([scored.best.smoothing]), np.ones(1)).spread,
        [kernels[i] for i in used],
        [tried[i].spectra.solve(tried[i].row, smoothings, by_kind[i]) for i in used],
        spreads,
        samples.weights,
    )


def _every(step: int, kinds: Sequence[Kind]) -> list[int]:
    """Rows of kinds so many steps apart, and of the ends of every run of one family, with a reach or without."""
    runs = [(kind.family, kind.reach == math.inf) for kind in kinds]
    last = len(kinds) - 1
    ends = {i for i in range(len(kinds)) if i in (0, last) or runs[i - 1] != runs[i] or runs[i + 1] != runs[i]}
    return sorted({*range(0, len(kinds), step), *ends})


class _Tried(NamedTuple):
    """A kernel in its eigenbasis, and for every smoothing, shape (m,) each, what `Scored` has of it."""

    spectra: Spectra
    row: int
    scores: FloatArray
    squares: FloatArray
    variances: FloatArray
    restricted: FloatArray


def _grams(kernels: Sequence[Kernel], r2: FloatArray, spreads: FloatArray, levels: FloatArray) -> FloatArray:
    """The kernel matrices (c, n, n), from the levels of the ladder where a kernel stands on them."""
    grams = np.empty((len(kernels), *r2.shape))
    single = np.array([len(kernel.spreads) == 1 for kernel in kernels])
    if single.any():
        factors = np.array([-0.5 / kernel.spreads[0] ** 2 for kernel in kernels if len(kernel.spreads) == 1])
        grams[single] = np.exp(factors[:, None, None] * r2)
    if not single.all():
        mixed = [kernel for kernel in kernels if len(kernel.spreads) > 1]
        shares = np.zeros((len(mixed), len(spreads)))
        for share, kernel in zip(shares, mixed, strict=True):
            share[np.searchsorted(-spreads, -kernel.spreads)] = kernel.amplitudes
        grams[~single] = np.tensordot(shares, levels, axes=1)
    return grams


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A fitted network: the average of candidates.

    Attributes
    ----------
    scored : Scored
        The candidates tried.
    spreads : ndarray, shape (levels,)
        Descending.
    coefficients : ndarray, shape (levels, n, k)
    bias : ndarray, shape (k,)
    kernel : Kernel
        Of the best candidate, as is `variance`, that of the surface.
    smoothing, variance : float
    residuals : ndarray, shape (n, k)
        Values less what the network says without them.
    deviations : ndarray, shape (n,)
        Standard deviations that the residuals should have.
    spread : ndarray, shape (n,)
        Variance that the best candidate's residuals should have, over its `variance`.
    weights : ndarray, shape (n,)
        Of the points, as the best candidate has them.
    """

    scored: Scored
    spreads: FloatArray
    coefficients: FloatArray
    bias: FloatArray
    kernel: Kernel
    smoothing: float
    variance: float
    residuals: FloatArray
    deviations: FloatArray
    spread: FloatArray
    weights: FloatArray


def combine(
    scored: Scored,
    spread: FloatArray,
    kernels: Sequence[Kernel],
    solutions: Sequence[Solution],
    ladder: FloatArray,
    weights: FloatArray,
) -> Fit:
    """Add up solutions that carry their shares already; the coefficients per spread add up.

    What `Fit` calls `spread` is the best candidate's alone.
    """
    parts = [
        (level, amplitude * solution.coefficients)
        for kernel, solution in zip(kernels, solutions, strict=True)
        for level, amplitude in zip(kernel.spreads.tolist(), kernel.amplitudes.tolist(), strict=True)
    ]
    spreads, coefficients = _summed(parts)
    variance = float(scored.variances[scored.least])
    return Fit(
        scored=scored,
        spreads=spreads,
        coefficients=coefficients,
        bias=np.sum([s.bias for s in solutions], axis=0),
        kernel=scored.best.kind.kernel(ladder),
        smoothing=scored.best.smoothing,
        variance=variance,
        residuals=np.sum([s.residuals for s in solutions], axis=0),
        deviations=np.sqrt(variance * np.sum([s.spread for s in solutions], axis=0)),
        spread=spread,
        weights=weights,
    )


def blend(fits: Sequence[Fit], odds: Sequence[float]) -> Fit:
    """The average of several fits of the same points, each with the share that its best candidate has, by the odds."""
    scores = np.array([fit.scored.scores.min() for fit in fits]) - np.log(odds)
    shares = np.exp(scores.min() - scores)
    shares /= shares.sum()
    best = fits[int(np.argmax(shares))]
    weighed = list(zip(shares.tolist(), fits, strict=True))
    spreads, coefficients = _summed(
        [
            (spread, share * c)
            for share, fit in weighed
            for spread, c in zip(fit.spreads.tolist(), fit.coefficients, strict=True)
        ]
    )
    return replace(
        best,
        spreads=spreads,
        coefficients=coefficients,
        bias=np.sum([share * fit.bias for share, fit in weighed], axis=0),
        residuals=np.sum([share * fit.residuals for share, fit in weighed], axis=0),
    )


def _summed(parts: Sequence[tuple[float, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Spreads (levels,), descending, and the sum of the coefficients (n, k) of each."""
    levels: dict[float, FloatArray] = {}
    for spread, c in parts:
        levels[spread] = levels[spread] + c if spread in levels else c
    spreads = sorted(levels, reverse=True)
    return np.array(spreads), np.array([levels[spread] for spread in spreads])


_BATCH = 2_000_000
"""Kernel values decomposed at once: 16 MB an array."""

_LEAST = 100_000
"""Kernel values below which a part is not worth a thread."""

_PARTS = 4
"""Parts that the kernels are decomposed in, at least, side by side, where they are large enough."""
