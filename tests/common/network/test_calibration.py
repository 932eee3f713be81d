"""How far a network can be trusted: at places like the points', in gaps, and beyond the edge."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from common.network import RBFNetwork
from common.network.calibration import SIDES, STEEPEST, WIDTH, Across, Calibration, told_across
from common.network.kernel import Kernel
from common.surface import FloatArray


def sines(X: FloatArray) -> FloatArray:
    return np.asarray(np.sin(8 * X[:, 0]) + np.sin(8 * X[:, 1]))


def growth(told: Across, *, factor: float = 1.0, usual: float) -> FloatArray:
    outputs = told.errors.shape[1]
    return Calibration(np.full(outputs, factor), np.zeros(outputs), usual, np.ones(outputs)).growth([told])


@pytest.mark.parametrize("exponent", [0.0, 0.2, 0.7])
def test_the_growth_is_the_exponent_of_the_errors(exponent: float) -> None:
    v, usual = np.logspace(-6, 0, 200), 1e-7
    errors = WIDTH * 2 * np.sqrt(v * (v / usual) ** exponent)
    told = Across(errors[:, None], v, np.zeros(200), np.full(200, 1 / 200))
    assert growth(told, factor=2.0, usual=usual) == pytest.approx(exponent, abs=1e-9)


def test_the_growth_stays_within_its_bounds() -> None:
    v = np.logspace(-6, 0, 200)
    told = Across(np.column_stack([np.full(200, 1e9), np.zeros(200)]), v, np.zeros(200), np.ones(200))
    np.testing.assert_array_equal(growth(told, usual=1e-7), [STEEPEST, 0.0])
    np.testing.assert_array_equal(growth(told, usual=1.0), [0.0, 0.0])
    np.testing.assert_array_equal(Calibration.unknown(2).growth([told]), [0.0, 0.0])
    np.testing.assert_array_equal(Calibration.unknown(2).growth([]), [0.0, 0.0])


def test_noise_is_not_taken_for_growth() -> None:
    v, one = np.logspace(-4, 0, 4000), np.ones(4000)
    errors = np.sqrt(v + 0.1) * np.random.default_rng(3).normal(size=4000)
    assert growth(Across(errors[:, None], v, 0.1 * one, one), usual=1e-5) < 0.1
    assert growth(Across(errors[:, None], v, 0 * one, one), usual=1e-5) > 0.3


def test_the_variance_grows_only_where_it_is_more_than_usual() -> None:
    exponents, most = np.array([0.5, 0.0]), np.array([9.0, 9.0])
    made = Calibration(np.array([2.0, 1.0]), np.array([0.0, 0.5]), 0.01, most)
    told = made.variance(np.array([0.001, 0.01, 0.04]), exponents, 1.0, 0.2)
    np.testing.assert_allclose(told, np.transpose([[0.004, 0.04, 0.32], [0.101, 0.11, 0.14]]))
    surface, smoothing = np.array([[[1.0, 1.0]], [[4.0, 9.0]]]), np.array([[0.0], [0.2]])
    patches = made.variance(np.full((2, 1), 0.01), exponents, surface, smoothing)
    np.testing.assert_allclose(patches, [[[0.04, 0.01]], [[0.16, 0.99]]])


def test_nothing_grows_beyond_a_few_deviations_of_the_values() -> None:
    made = Calibration(np.ones(1), np.zeros(1), 1e-6, np.array([9.0]))
    told = made.variance(np.array([1e-3, 1e-1, 20.0]), np.ones(1), 1.0, 0.0)
    np.testing.assert_allclose(told[:, 0], [1.0, 9.0, 20.0])


@pytest.mark.parametrize("n", [300, 6000])
def test_the_deviation_of_a_hole_is_no_more_than_a_few_of_the_values(n: int) -> None:
    angle = 2 * np.pi * np.arange(n) / n
    X, y = np.column_stack([np.cos(angle), np.sin(angle)]), np.sin(3 * angle)
    mean, deviation = RBFNetwork().fit(X, y).predict([[0.0, 0.0], [0.5, 0.3], [-0.2, 0.8]], return_std=True)
    assert np.all(deviation < 5)
    assert np.all(np.abs(mean) < 1.96 * deviation + 1)


def test_a_side_is_told_by_the_others_as_if_it_were_missing() -> None:
    rng = np.random.default_rng(0)
    X = rng.random((60, 2))
    kernel, noise = Kernel.single(0.2), np.full(60, 1e-3)
    y = np.column_stack([sines(X), X[:, 0]])
    told = told_across(X, y, kernel.gram(X), noise)
    sides = np.cumsum([round(share * 60) for share in SIDES])
    assert len(told.variances) == sides[-1]
    assert told.shares.sum() == pytest.approx(len(SIDES))

    # The last side is half of the points: by hand, with the bias as in ordinary kriging.
    errors, variances = told.errors[sides[-2] :], told.variances[sides[-2] :]
    away = X - X.mean(axis=0)
    clear = np.sum(away**2, axis=1)
    for _ in SIDES:
        towards = np.argmax(clear)
        clear = np.minimum(clear, np.sum((X - X[towards]) ** 2, axis=1))
    order = np.argsort(away @ away[towards])
    rest, side = order[:30], order[30:]
    inverse = np.linalg.inv(kernel.gram(X[rest]) + np.diag(noise[rest]))
    cross, one = kernel.gram(X[rest], X[side]), np.ones(30)
    bias = one @ inverse @ y[rest] / (one @ inverse @ one)
    np.testing.assert_allclose(errors, y[side] - bias - cross.T @ inverse @ (y[rest] - bias), atol=1e-9)
    gap = 1 - one @ inverse @ cross
    np.testing.assert_allclose(
        variances, 1 - np.sum(cross * (inverse @ cross), axis=0) + gap**2 / (one @ inverse @ one), atol=1e-9
    )
    np.testing.assert_allclose(told.over(np.array([2.0, 4.0])).errors, told.errors / [2, 4])


def test_a_surface_drawn_from_the_kernel_has_hardly_any_growth() -> None:
    rng = np.random.default_rng(1)
    kernel, found = Kernel.single(0.15), []
    for _ in range(20):
        X = rng.random((120, 2))
        gram = kernel.gram(X)
        y = np.linalg.cholesky(gram + 1e-8 * np.eye(120)) @ rng.normal(size=(120, 1))
        told = told_across(X, y, gram, np.full(120, 1e-8))
        found.append(float(growth(told, usual=1e-6)[0]))
    assert np.median(found) < 0.05


@pytest.mark.parametrize(("n", "noise"), [(60, 0.0), (400, 0.0), (400, 0.05), (1500, 0.0), (6000, 0.0), (6000, 0.05)])
def test_the_band_holds_the_surface_where_no_points_are(n: int, noise: float) -> None:
    shares = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        X, Q = rng.random((2 * n, 2)), rng.random((1000, 2))
        X = X[X[:, 0] > 0.4][:n]
        mean, deviation = RBFNetwork().fit(X, sines(X) + noise * rng.normal(size=len(X))).predict(Q, return_std=True)
        far = KDTree(X).query(Q)[0] > 2 * n**-0.5
        held = np.abs(mean - sines(Q)) <= 1.96 * deviation
        shares.append((np.mean(held[far]), np.mean(held[~far])))
    assert np.all(np.mean(shares, axis=0) > 0.85)


@pytest.mark.parametrize("centers", [1, 2, 5, 40])
@pytest.mark.parametrize("n", [60, 4500])
def test_few_centres_have_a_deviation_everywhere(centers: int, n: int) -> None:
    rng = np.random.default_rng(1)
    X, Q = rng.random((n, 2)), 4 * rng.random((100, 2)) - 1.5
    _, deviation = RBFNetwork(max_centers=centers).fit(X, sines(X)).predict(Q, return_std=True)
    assert np.all(np.isfinite(deviation))
    assert np.all(deviation > 0)


def test_outputs_grow_each_by_themselves() -> None:
    rng = np.random.default_rng(3)
    X, Q = rng.random((6000, 2)), rng.random((100, 2)) - [1.0, 0.0]
    X[:, 0] **= 2
    y = np.column_stack([sines(X), np.full(len(X), 3.0), np.abs(X[:, 0] - X[:, 1])])
    for rows in (slice(200), slice(None)):
        _, together = RBFNetwork().fit(X[rows], y[rows]).predict(Q, return_std=True)
        assert np.all(np.isfinite(together))
        assert np.all(together[:, 1] < 1e-9)
        assert np.all(together[:, [0, 2]] > 0)
