"""The criteria against brute force: refits without each point, the likelihood of the contrasts."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import gamma, kv
from scipy.stats import multivariate_normal

from common.errors import TrainingError
from common.network import selection
from common.network.dense import Dense
from common.network.kernel import Kernel, ladder_spreads, mean_spacing, squared_distances
from common.network.selection import (
    LIKELY,
    SMOOTHINGS,
    Kind,
    Samples,
    Spectra,
    _eigenbases,
    amplitudes,
    average,
    believed,
    families,
    rounding_floor,
    score,
    twins,
)
from common.surface import FloatArray

SMOOTHING = 0.01
KERNEL = Kernel.mixture(np.array([0.9, 0.5, 0.2]), np.array([1.0, 0.7, 0.3]))


@pytest.fixture
def samples() -> Samples:
    rng = np.random.default_rng(11)
    X = rng.uniform(-1, 1, (14, 2))
    y = np.column_stack([np.sin(3 * X[:, 0]) + X[:, 1], np.cos(2 * X[:, 1])]) + 0.05 * rng.normal(size=(14, 2))
    return Samples(X, y, rng.integers(1, 4, 14).astype(np.float64))


def solved(samples: Samples) -> tuple[FloatArray, FloatArray]:
    """Coefficients and bias from the bordered system, solved plainly."""
    n = len(samples)
    system = np.zeros((n + 1, n + 1))
    system[:n, :n] = KERNEL.gram(samples.X) + np.diag(SMOOTHING / samples.weights)
    system[:n, n] = system[n, :n] = 1
    solution = np.linalg.solve(system, np.vstack([samples.y, np.zeros((1, samples.y.shape[1]))]))
    return np.asarray(solution[:n]), np.asarray(solution[n])


def left_out(samples: Samples) -> FloatArray:
    residuals = np.empty_like(samples.y)
    for i in range(len(samples)):
        rest = samples.without(np.array([i]))
        c, b = solved(rest)
        residuals[i] = samples.y[i] - (KERNEL.gram(samples.X[i : i + 1], rest.X) @ c + b)[0]
    return residuals


def test_spectra_and_cholesky_solve_the_bordered_system(samples: Samples) -> None:
    c, b = solved(samples)
    spectral = Spectra(KERNEL.gram(samples.X)[None], samples).solve(0, np.array([SMOOTHING]), np.ones(1))
    dense = Dense(KERNEL.gram(samples.X), samples.weights, SMOOTHING).solve(samples.y)
    for coefficients, bias in ((spectral.coefficients, spectral.bias), dense):
        np.testing.assert_allclose(coefficients, c, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(bias, b, rtol=1e-8)


def test_leave_one_out_residuals_are_those_of_refits_without_the_point(samples: Samples) -> None:
    expected = left_out(samples)
    spectral = Spectra(KERNEL.gram(samples.X)[None], samples).solve(0, np.array([SMOOTHING]), np.ones(1))
    dense = Dense(KERNEL.gram(samples.X), samples.weights, SMOOTHING)
    residuals, variance = dense.leave_one_out(dense.solve(samples.y)[0])
    np.testing.assert_allclose(spectral.residuals, expected, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(residuals, expected, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(variance, spectral.spread, rtol=1e-8)
    lent = Dense(KERNEL.gram(samples.X), samples.weights, SMOOTHING, np.empty((len(samples), len(samples))))
    np.testing.assert_array_equal(lent.leave_one_out(lent.solve(samples.y)[0])[0], residuals)
    with pytest.raises(AttributeError, match="factor"):
        lent.solve(samples.y)


def test_the_restricted_likelihood_is_that_of_contrasts(samples: Samples) -> None:
    """REML is the likelihood of any contrasts that remove the bias, up to a constant."""
    n = len(samples)
    contrasts = np.linalg.qr(np.column_stack([np.ones(n), np.eye(n)[:, 1:]]))[0][:, 1:]
    spectra = Spectra(KERNEL.gram(samples.X)[None], samples)
    levels = np.array([SMOOTHING, 0.3])
    ours, _, _, variance = spectra.criteria(levels)
    brute = []
    for level, v in zip(levels, variance[0], strict=True):
        covariance = v * contrasts.T @ (KERNEL.gram(samples.X) + np.diag(level / samples.weights)) @ contrasts
        brute.append(-sum(multivariate_normal(cov=covariance).logpdf(contrasts.T @ y) for y in samples.y.T))
    assert ours[0, 1] - ours[0, 0] == pytest.approx(brute[1] - brute[0], rel=1e-8)


def test_the_leave_one_out_density_uses_the_residuals_own_variance(samples: Samples) -> None:
    spectra = Spectra(KERNEL.gram(samples.X)[None], samples)
    solution = spectra.solve(0, np.array([SMOOTHING]), np.ones(1))
    own = np.mean(solution.residuals**2 / solution.spread[:, None])
    expected = sum(
        0.5 * np.sum(np.log(own * solution.spread) + residuals**2 / (own * solution.spread) - 1)
        for residuals in solution.residuals.T
    )
    _, density, square, _ = spectra.criteria(np.array([SMOOTHING]))
    assert density[0, 0] == pytest.approx(expected, rel=1e-8)
    assert square[0, 0] == pytest.approx(np.mean(solution.residuals**2), rel=1e-8)


def test_a_point_with_a_twin_is_left_out_with_it() -> None:
    rng = np.random.default_rng(5)
    X = rng.uniform(-1, 1, (40, 2))
    X[1], X[7] = X[0] + 0.001, X[6] - 0.001
    given = Samples(X, np.sin(3 * X[:, :1]) + 0.05 * rng.normal(size=(40, 1)), rng.integers(1, 4, 40).astype(float))
    rows, partners = twins(X)
    assert {(0, 1), (1, 0), (6, 7), (7, 6)} <= set(zip(rows.tolist(), partners.tolist(), strict=True))
    c, _ = solved(given)
    _, (residuals, variances) = Dense(KERNEL.gram(X), given.weights, SMOOTHING).left_out(c, rows, partners)
    alone, _ = Dense(KERNEL.gram(X), given.weights, SMOOTHING).leave_one_out(c)
    for row, twin in zip(rows.tolist(), partners.tolist(), strict=True):
        rest = given.without(np.array([row, twin]))
        again, bias = solved(rest)
        expected = given.y[row] - (KERNEL.gram(X[row : row + 1], rest.X) @ again + bias)[0]
        np.testing.assert_allclose(residuals[row], expected, atol=1e-9)
    others = np.setdiff1d(np.arange(40), rows)
    np.testing.assert_array_equal(residuals[others], alone[others])
    own = np.mean(residuals[:, 0] ** 2 / variances)
    density = 0.5 * (40 * np.log(own) + np.log(variances).sum())
    found = Spectra(KERNEL.gram(X)[None], given).criteria(np.array([SMOOTHING]))[1]
    assert found[0, 0] == pytest.approx(density, rel=1e-9)


def test_repeats_count_as_if_every_measurement_stood_alone() -> None:
    """Means with weights and a scatter have the likelihood of the measurements, up to a constant."""
    rng = np.random.default_rng(2)
    X = rng.uniform(-1, 1, (12, 2))
    y = np.sin(3 * X[:, :1])
    noise = 0.1 * rng.normal(size=(12, 1))
    merged = Samples(X, y, np.full(12, 2.0), float(2 * np.sum(noise**2)), 12)
    apart = Samples(np.vstack([X, X + 1e-9]), np.vstack([y + noise, y - noise]), np.ones(24))
    levels = np.array([1e-3, 1e-1])
    together = Spectra(KERNEL.gram(merged.X)[None], merged).criteria(levels)[0][0]
    single = Spectra(KERNEL.gram(apart.X)[None], apart).criteria(levels)[0][0]
    assert together[1] - together[0] == pytest.approx(single[1] - single[0], rel=1e-4)


def test_the_multiquadric_family_is_a_multiquadric() -> None:
    spreads = ladder_spreads(0.05, 50.0)
    r = np.linspace(0, 2, 50)
    kernel = Kernel.mixture(spreads, amplitudes(Kind("multiquadric", 0.4), spreads))
    values = kernel.gram(np.zeros((1, 1)), r[:, None])[0]
    wanted = (1 + (r / 0.4) ** 2) ** -0.25
    # The ladder ends, so the widest part of the mixture is missing: a constant, which the bias takes.
    slope, offset = np.polyfit(wanted, values, 1)
    np.testing.assert_allclose(values, slope * wanted + offset, atol=0.01)


@pytest.mark.parametrize("order", [0.5, 1.0, 2.0])
def test_a_ladder_with_a_reach_is_the_matern_kernel(order: float) -> None:
    spreads = np.geomspace(20.0, 1e-4, 160)
    r = np.linspace(0.01, 2, 50)
    kernel = Kernel.mixture(spreads, amplitudes(Kind("ladder", order, 0.6), spreads))
    scaled = np.sqrt(2 * order) * r / 0.6
    wanted = 2 ** (1 - order) / gamma(order) * scaled**order * kv(order, scaled)
    np.testing.assert_allclose(kernel.gram(np.zeros((1, 1)), r[:, None])[0], wanted, atol=2e-3)


def test_averaging_sums_coefficients_per_spread() -> None:
    rng = np.random.default_rng(4)
    X = rng.uniform(-1, 1, (25, 2))
    samples = Samples(X, np.sin(2 * X[:, :1]) + 0.1 * rng.normal(size=(25, 1)), np.ones(25))
    spreads = ladder_spreads(0.4, 4.0)
    smoothings = SMOOTHINGS[rounding_floor(25) <= SMOOTHINGS]
    kinds = families(spreads, 2.0)
    fit = average(samples, kinds, spreads, smoothings, lambda share: None)
    at = rng.uniform(-1, 1, (9, 2))
    expected = np.zeros((9, 1))
    for candidate, share in zip(fit.scored.candidates, fit.scored.shares, strict=True):
        if share:
            kernel = candidate.kind.kernel(spreads)
            c, b = Dense(kernel.gram(X), samples.weights, candidate.smoothing).solve(samples.y)
            expected += share * (kernel.gram(at, X) @ c + b)
    found = sum(
        np.exp(squared_distances(at, X) / (-2 * s**2)) @ c for s, c in zip(fit.spreads, fit.coefficients, strict=True)
    )
    np.testing.assert_allclose(found + fit.bias, expected, atol=1e-6)
    assert fit.scored.shares.sum() == pytest.approx(1)


def test_the_score_prefers_smoothing_only_among_noises() -> None:
    least, most = LIKELY
    tiny, small, some, large, huge = score(100, np.zeros(1), np.array([1e-12, least, 2 * least, most, 1.0]))
    assert tiny == small
    # A flat density in lambda: twice the smoothing, twice the share.
    assert small - some == pytest.approx(np.log(2))
    assert large == huge < some


def test_a_kind_of_one_spread_has_it() -> None:
    assert Kind("single", 0.7).kernel(np.array([1.0, 0.5])).spreads.tolist() == [0.7]


def test_eigenvalues_are_found_where_divide_and_conquer_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    X = rng.uniform(size=(20, 2))
    grams = np.stack([Kernel.single(spread).gram(X) for spread in (0.1, 0.5)])
    expected, _ = _eigenbases(grams)

    def fail(_matrices: object) -> None:
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    monkeypatch.setattr(np.linalg, "eigh", fail)
    values, vectors = _eigenbases(grams)
    np.testing.assert_allclose(values, expected, atol=1e-12)
    np.testing.assert_allclose(vectors @ (values[:, :, None] * np.swapaxes(vectors, 1, 2)), grams, atol=1e-12)
    with pytest.raises(TrainingError, match="no eigenvalues"):
        _eigenbases(np.full((1, 3, 3), np.nan))


@pytest.mark.parametrize("f", ["plane", "saddle", "waves"])
@pytest.mark.parametrize("n", [30, 90])
def test_trying_every_fourth_kernel_first_misses_none_that_counts(
    f: str, n: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    X = np.random.default_rng(n).uniform(-1, 1, (n, 2))
    x, y = X.T
    values = {"plane": x + 2 * y, "saddle": x**2 - y**2 + x, "waves": np.sin(4 * x) + np.sin(4 * y)}[f]
    some = Samples(X, ((values - values.mean()) / values.std())[:, None], np.ones(n))
    spreads = ladder_spreads(mean_spacing(X), 4.0)
    kinds = families(spreads, 2.0)
    told: list[float] = []
    smoothings = SMOOTHINGS[rounding_floor(n) <= SMOOTHINGS]
    few = average(some, kinds, spreads, smoothings, told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0
    monkeypatch.setattr(selection, "COUNTED", len(kinds))
    every = average(some, kinds, spreads, smoothings, told.append)
    assert len(few.scored.candidates) <= 0.75 * len(every.scored.candidates)
    assert few.scored.best == every.scored.best
    np.testing.assert_allclose(few.residuals, every.residuals, atol=0.05 * np.sqrt(np.mean(every.residuals**2)))


def test_what_errs_far_more_than_a_ladder_is_not_believed() -> None:
    scores = np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]])
    squares = np.array([[9.0, 3.9], [1.0, 2.0], [0.5, 0.1]])
    ladders = np.array([False, True, False])
    np.testing.assert_array_equal(believed(scores, squares, ladders), [[np.inf, 1.0], [2.0, 3.0], [4.0, 5.0]])
    np.testing.assert_array_equal(believed(scores, squares, ladders, 0.3)[2], [np.inf, 5.0])
    np.testing.assert_array_equal(believed(scores, squares, np.zeros(3, dtype=bool)), scores)
