"""The estimator: exact where it should be, invariant, robust, calibrated, clear about bad input."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline
from sklearn.base import clone
from sklearn.utils.estimator_checks import check_estimator

from common.errors import NotReadyError, ParameterError, PointsError, TrainingError
from common.network import NetworkWarning, RBFNetwork, robust
from common.network import fitting as fitting_module
from common.network.estimator import merge_repeated
from common.network.partition import Partition
from common.surface import FloatArray
from tests.common.network.surfaces import rough, sine


def cloud(n: int, seed: int = 3) -> tuple[FloatArray, FloatArray]:
    X = np.random.default_rng(seed).uniform(-2, 2, (n, 2))
    return X, sine(X)


def crags(X: FloatArray) -> FloatArray:
    """Waves of every length down to less than the points' spacing, each as steep as the others."""
    return rough(X, finest=0.1)


def dome(X: FloatArray) -> FloatArray:
    return np.asarray(3 / (1 + np.square(X).sum(axis=1)))


def rounded(X: FloatArray) -> FloatArray:
    return np.round(30 * dome(X)) / 30


QUERIES = np.random.default_rng(99).uniform(-1.8, 1.8, (300, 2))


def error(network: RBFNetwork, Q: FloatArray = QUERIES) -> float:
    return float(np.sqrt(np.mean((network.predict(Q) - sine(Q)) ** 2)))


@pytest.mark.parametrize("mapping", ["height", "autoassociative"])
def test_a_network_without_smoothing_passes_through_the_points(mapping: Any) -> None:
    X, y = cloud(80)
    network = RBFNetwork(spread=0.5, smoothing=0, mapping=mapping).fit(X, y)
    np.testing.assert_allclose(network.predict(X), y, atol=1e-6)


def test_attributes_are_the_network() -> None:
    X, y = cloud(40)
    network = RBFNetwork().fit(X, y)
    values = np.full(len(QUERIES), network.bias_[0])
    coefficients = network.coefficients_.reshape(-1, len(X))
    for spread, c in zip(np.atleast_1d(network.spread_), coefficients, strict=True):
        r2 = ((QUERIES[:, None] - network.centers_) ** 2).sum(axis=2)
        values += np.exp(-r2 / (2 * spread**2)) @ c
    np.testing.assert_allclose(values, network.predict(QUERIES), atol=1e-6)


@pytest.mark.parametrize("settings", [{}, {"max_centers": 20}, {"mapping": "autoassociative", "spread": 1.0}])
def test_grid_and_gradient_agree_with_the_points(settings: dict[str, Any]) -> None:
    X, _ = cloud(60)
    network = RBFNetwork(**settings).fit(X, np.sin(X[:, 0]) + 0.2 * X[:, 1] ** 2)
    x, y = np.linspace(-1, 1, 7), np.linspace(-1.5, 1, 5)
    nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    grid, deviation = network.predict_grid(x, y, return_std=True)
    np.testing.assert_allclose(grid.ravel(), network.predict(nodes), atol=1e-7)
    assert deviation.shape == (5, 7)
    step = 1e-5
    for axis, slope in enumerate(network.predict_gradient(nodes).T):
        offset = step * np.eye(2)[axis]
        np.testing.assert_allclose(
            slope, (network.predict(nodes + offset) - network.predict(nodes - offset)) / (2 * step), atol=1e-3
        )


@pytest.mark.parametrize("scale", [1e-9, 1e9, 1e100])
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_shift_and_scale_change_nothing_else(scale: float, offset: float) -> None:
    X, y = cloud(100)
    y = y + 0.05 * np.random.default_rng(1).normal(size=100)
    plain = RBFNetwork().fit(X, y).predict(QUERIES)
    moved = RBFNetwork().fit(scale * (X + offset), scale * (y + offset)).predict(scale * (QUERIES + offset))
    np.testing.assert_allclose(moved / scale - offset, plain, atol=1e-6)


@pytest.mark.parametrize("n", [12, 30, 100, 240])
def test_a_rotation_changes_nothing_else(n: int) -> None:
    X, y = cloud(n)
    X *= [1.0, 0.6]
    y = y + 0.05 * np.random.default_rng(1).normal(size=n)
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    as_they_are = RBFNetwork().fit(X, y).predict(QUERIES, return_std=True)
    turned = RBFNetwork().fit(X @ turn.T + 5, y).predict(QUERIES @ turn.T + 5, return_std=True)
    np.testing.assert_allclose(turned, as_they_are, rtol=1e-6, atol=1e-8)


def test_a_surface_stays_near_its_values_where_points_are_few_beyond_a_cliff() -> None:
    for seed in range(2):
        rng = np.random.default_rng(seed)
        X = np.empty((0, 2))
        while len(X) < 400:
            tried = rng.random((1600, 2))
            X = np.vstack([X, tried[rng.random(1600) < np.exp(-6 * tried[:, 0])]])[:400]
        network = RBFNetwork().fit(X, np.tanh(80 * (X[:, 0] - 0.5 - 0.08 * np.sin(8 * X[:, 1]))))
        assert np.abs(network.predict(rng.random((2000, 2)))).max() < 3


@pytest.mark.parametrize("side", [20, 40])
def test_waves_of_three_points_on_a_lattice_are_no_noise(side: int) -> None:
    def waves(X: FloatArray) -> FloatArray:
        turns = 2 * np.pi * (side - 1) / 3
        return np.asarray(np.sin(turns * X[:, 0] + 0.3) * np.cos(0.9 * turns * X[:, 1]))

    axis = np.linspace(0, 1, side)
    X, Q = np.array(np.meshgrid(axis, axis)).reshape(2, -1).T, np.random.default_rng(0).random((1000, 2))
    spline = RectBivariateSpline(axis, axis, waves(X).reshape(side, side).T)
    theirs = np.mean((spline.ev(*Q.T) - waves(Q)) ** 2)
    assert np.mean((RBFNetwork().fit(X, waves(X)).predict(Q) - waves(Q)) ** 2) < theirs / 4


def test_noise_is_smoothed_whatever_the_number_of_points() -> None:
    for n, most in ((60, 0.2), (400, 0.04), (1200, 0.025)):
        X, y = cloud(n)
        noisy = y + 0.1 * np.random.default_rng(n).normal(size=n)
        assert error(RBFNetwork().fit(X, noisy)) < most


def test_more_points_than_one_matrix_holds_become_a_partition(monkeypatch: pytest.MonkeyPatch) -> None:
    X, y = cloud(1500)
    monkeypatch.setattr(fitting_module, "DENSE", 1000)
    network = RBFNetwork().fit(X, y)
    assert isinstance(network._network, Partition)
    assert error(network) < 1e-4
    again = RBFNetwork.from_state(network.to_state())
    np.testing.assert_array_equal(again.predict(QUERIES), network.predict(QUERIES))
    wild = y.copy()
    wild[::50] = 40.0
    spoilt = RBFNetwork().fit(X, wild)
    assert set(range(0, 1500, 50)) <= set(spoilt.outliers_.tolist())
    assert error(spoilt) < 1e-3
    few = RBFNetwork(max_centers=60).fit(X, y)
    assert few.centers_.shape == (60, 2)
    assert error(few) < 0.05
    with pytest.raises(TrainingError, match="3 dimensions"):
        RBFNetwork().fit(np.column_stack([X, X[:, 0]]), y)


@pytest.mark.parametrize("n", [100, 400])
def test_wrong_points_are_set_aside_and_named(n: int) -> None:
    X, y = cloud(n)
    rng = np.random.default_rng(8)
    y = y + 0.02 * rng.normal(size=n)
    wrong = rng.permutation(n)[: n // 20]
    spoilt = y.copy()
    spoilt[wrong] += rng.choice([-1, 1], len(wrong)) * rng.uniform(2, 8, len(wrong))
    network = RBFNetwork().fit(X, spoilt)
    assert network.outliers_.tolist() == sorted(wrong.tolist())
    assert error(network) < 1.5 * error(RBFNetwork().fit(X, y))


@pytest.mark.parametrize("surface", [sine, dome])
@pytest.mark.parametrize(("n", "seed"), [(100, 0), (100, 1), (400, 0), (400, 1)])
def test_wild_values_leave_no_trace_on_a_surface_without_noise(
    surface: Callable[[FloatArray], FloatArray], n: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    X = rng.uniform(-2, 2, (n, 2))
    wrong = np.zeros(n, dtype=bool)
    wrong[rng.permutation(n)[: n // 20]] = True
    wild = np.where(wrong, rng.uniform(-20, 20, n), surface(X))
    without = RBFNetwork().fit(X[~wrong], surface(X[~wrong])).predict(QUERIES) - surface(QUERIES)
    left = RBFNetwork().fit(X, wild).predict(QUERIES) - surface(QUERIES)
    assert np.sqrt(np.mean(left**2)) <= 1.5 * np.sqrt(np.mean(without**2))


def test_heavy_tails_do_not_cost_a_fit_for_each_suspect(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    X = rng.random((900, 2))
    look, looks = robust._look, []

    def counted(*args: Any) -> Any:
        looks.append(1)
        return look(*args)

    monkeypatch.setattr(robust, "_look", counted)
    RBFNetwork().fit(X, np.exp(5 * rng.normal(size=900)))
    assert len(looks) < 20


@pytest.mark.parametrize(
    "edge",
    [
        lambda X: X[:, 0] > 0.5,
        lambda X: X.sum(axis=1) > 1,
        lambda X: np.sum((X - 0.5) ** 2, axis=1) < 0.09,
        lambda X: np.floor(3 * X).sum(axis=1),
    ],
    ids=["step", "diagonal", "disc", "terraces"],
)
@pytest.mark.parametrize("n", [700, 1000])
def test_clean_edges_cost_one_fit(
    edge: Callable[[FloatArray], FloatArray], n: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    X = np.random.default_rng(0).random((n, 2))
    select, fits = fitting_module._select, []

    def counted(*args: Any, **kwargs: Any) -> Any:
        fits.append(1)
        return select(*args, **kwargs)

    monkeypatch.setattr(fitting_module, "_select", counted)
    network = RBFNetwork().fit(X, edge(X).astype(np.float64))
    assert len(fits) == 1
    assert len(network.outliers_) == 0


@pytest.mark.parametrize("wrong", [[0.2, 0.2], [0.2, 0.2, 0.2]], ids=["two", "three"])
def test_wrong_points_of_one_height_are_no_plain(wrong: list[float]) -> None:
    X = np.random.default_rng(0).random((300, 2))
    y = np.where(X[:, 0] > 0.5, 1.0, 0.0)
    rows = np.argsort(np.sum((X - [0.25, 0.5]) ** 2, axis=1))[: len(wrong)]
    near = robust._near(robust.tree_of(X), np.arange(300))
    assert robust._flat(y[:, None], near)
    y[rows] = wrong
    assert not robust._flat(y[:, None], near)


def test_noise_of_the_positions_costs_less_than_ignoring_it(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = []
    for blind in (False, True):
        monkeypatch.setattr(fitting_module, "NOISY", np.inf if blind else 1e-4)
        total = 0.0
        for seed in range(12):
            X, _ = cloud(60, seed)
            rng = np.random.default_rng(seed)
            # A plateau and a cliff: noise of the positions shows on the cliff alone.
            cliff = np.tanh(2 * X[:, 0])
            network = RBFNetwork().fit(X + 0.2 * rng.normal(size=X.shape), cliff)
            total += float(np.mean((network.predict(QUERIES) - np.tanh(2 * QUERIES[:, 0])) ** 2))
        errors.append(total)
    assert errors[0] < errors[1]


def test_a_narrow_peak_is_no_outlier() -> None:
    X, y = cloud(200)
    peak = y + 3 * np.exp(-np.sum((X - 0.3) ** 2, axis=1) / 0.4)
    assert not len(RBFNetwork().fit(X, peak).outliers_)
    peak[7] = -30.0
    assert RBFNetwork().fit(X, peak).outliers_.tolist() == [7]


@pytest.mark.parametrize("d", [1, 2, 3])
def test_repeated_positions_are_found_among_those_that_look_alike(d: int) -> None:
    rng = np.random.default_rng(d)
    # On a lattice many positions share coordinates; some are there several times.
    X = rng.integers(0, 9, (200, d)).astype(np.float64)
    y = rng.normal(size=(200, 1))
    distinct, means, weights, group = merge_repeated(X, y)
    assert len(np.unique(X, axis=0)) == len(distinct) == len(np.unique(distinct, axis=0))
    np.testing.assert_array_equal(distinct[group], X)
    np.testing.assert_array_equal(weights, np.bincount(group))
    np.testing.assert_allclose(means[:, 0] * weights, np.bincount(group, y[:, 0]))


def test_repeated_positions_are_averaged_and_tell_the_noise() -> None:
    X, y = cloud(60)
    rng = np.random.default_rng(0)
    noisy = np.concatenate([y, y]) + 0.1 * rng.normal(size=120)
    network = RBFNetwork().fit(np.vstack([X, X]), noisy)
    assert len(network.centers_) == 60
    assert network.smoothing_ > 1e-4
    wild = noisy.copy()
    wild[5] = wild[65] = 60.0
    assert network.set_params().fit(np.vstack([X, X]), wild).outliers_.tolist() == [5, 65]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("exponent", [-1000, -700, 520, 990])
def test_repeated_values_may_be_of_any_size(exponent: int) -> None:
    X, y = cloud(60)
    X, y = np.vstack([X, X]), np.concatenate([y + 0.05, y - 0.05])
    scale = 2.0**exponent
    network, huge = RBFNetwork().fit(X, y), RBFNetwork().fit(X, y * scale)
    assert huge.smoothing_ == network.smoothing_
    expected = np.multiply(network.predict(QUERIES, return_std=True), scale)
    np.testing.assert_array_equal(huge.predict(QUERIES, return_std=True), expected)


@pytest.mark.parametrize("surface", [sine, dome, crags, rounded])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_the_band_covers_the_truth(surface: Callable[[FloatArray], FloatArray], noise: float) -> None:
    shares = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        X, Q = rng.uniform(-2, 2, (200, 2)), rng.uniform(-2, 2, (500, 2))
        y = surface(X) + noise * np.ptp(surface(Q)) * rng.normal(size=200)
        mean, deviation = RBFNetwork().fit(X, y).predict(Q, return_std=True)
        shares.append(np.mean(np.abs(mean - surface(Q)) <= 1.96 * deviation))
    assert 0.9 <= np.mean(shares) <= 0.98


@pytest.mark.parametrize("seed", range(8))
def test_points_on_steep_islands_are_not_taken_for_wrong_ones(seed: int) -> None:
    rng = np.random.default_rng(seed)
    X, islands = rng.uniform(-1, 1, (800, 2)), rng.uniform(-1, 1, (12, 2))
    heights, radii = rng.uniform(2, 8, 12), rng.uniform(0.04, 0.12, 12)
    away = np.linalg.norm(X[:, None] - islands, axis=2)
    y = 0.3 * np.sin(3 * X[:, 0]) + (heights / (1 + np.exp((away - radii) / 0.01))).sum(axis=1)
    assert not len(RBFNetwork().fit(X, y).outliers_)


@pytest.mark.parametrize("n", [100, 150, 200])
def test_an_island_in_flat_water_is_terrain_and_a_lone_spike_is_not(n: int) -> None:
    X = np.random.default_rng(3).uniform(0, 1000, (n, 2))
    y = np.maximum(0, 50 - 0.3 * np.hypot(*(X - 500).T))
    assert np.count_nonzero(y) > 7
    assert not len(RBFNetwork().fit(X, y).outliers_)
    spike = int(np.argmin(np.hypot(*(X - [150, 400]).T)))
    y[spike] = 60.0
    assert RBFNetwork().fit(X, y).outliers_.tolist() == [spike]


@pytest.mark.parametrize("n", [3, 10, 60, 251, 1500, 4500])
def test_a_flat_surface_is_flat_and_known(n: int) -> None:
    rng = np.random.default_rng(1)
    network = RBFNetwork().fit(rng.uniform(0, 1000, (n, 2)), np.full(n, 372.4))
    mean, deviation = network.predict(rng.uniform(0, 1000, (50, 2)), return_std=True)
    np.testing.assert_allclose(mean, 372.4)
    np.testing.assert_allclose(deviation, 0.0, atol=1e-6)


def test_the_band_widens_where_there_are_no_points() -> None:
    X, y = cloud(200)
    hole = np.sum(X**2, axis=1) > 1
    network = RBFNetwork().fit(X[hole], y[hole])
    _, deviation = network.predict([[0.0, 0.0], [1.5, 1.0]], return_std=True)
    assert deviation[0] > 5 * deviation[1]


def test_an_unstable_request_is_refused_with_a_warning() -> None:
    rng = np.random.default_rng(0)
    X = rng.uniform(0, 1, (400, 2))
    rough = np.cumsum(rng.normal(size=400))[np.argsort(np.argsort(X[:, 0]))]
    with pytest.warns(NetworkWarning, match="unstable"):
        network = RBFNetwork(spread=0.15, smoothing=0.0).fit(X, rough)
    assert network.notes_
    assert np.max(np.abs(network.predict(rng.uniform(0, 1, (500, 2))))) < 3 * np.max(np.abs(rough))


def test_centres_are_added_until_the_tolerance_is_met() -> None:
    X, y = cloud(300)
    network = RBFNetwork(tolerance=0.05).fit(X, y)
    assert network.stop_reason_ == "tolerance"
    assert len(network.centers_) < 150
    assert np.max(np.abs(network.predict(X) - y)) <= 0.05
    assert network.history_[-1] <= 0.05 < network.history_[-2]


@pytest.mark.parametrize("n", [1000, 5000])
def test_a_tolerance_that_rounding_keeps_from_the_points_is_not_said_to_be_met(n: int) -> None:
    X, y = cloud(n)
    network = RBFNetwork(spread=1.0, smoothing=0.0, tolerance=1e-9).fit(X, y)
    error = np.max(np.abs(network.predict(X) - y))
    assert error > 1e-9
    assert network.stop_reason_ == "rounding"
    assert network.history_[-1] == pytest.approx(error, rel=1e-3)


@pytest.mark.parametrize("n", [1000, 5000])
def test_few_centres_of_noisy_points_without_smoothing_stay_near_the_values(n: int) -> None:
    X, y = cloud(n)
    y += np.random.default_rng(1).normal(0, 0.1, n)
    network = RBFNetwork(spread=0.8, smoothing=0.0, max_centers=5).fit(X, y)
    assert np.max(np.abs(network.predict(X) - y)) < np.max(np.abs(y))


@pytest.mark.parametrize(
    "change",
    [
        {"spread": 0.3},
        {"spread": "paper"},
        {"smoothing": 0.1},
        {"tolerance": 0.1},
        {"max_centers": 9},
        {"mapping": "autoassociative"},
    ],
)
def test_every_setting_changes_the_surface(change: dict[str, Any]) -> None:
    X, y = cloud(60)
    plain, changed = RBFNetwork().fit(X, y).predict(QUERIES), RBFNetwork(**change).fit(X, y).predict(QUERIES)
    assert np.max(np.abs(plain - changed)) > 1e-6


def test_the_paper_spread_is_twice_the_distance_between_centres() -> None:
    side = np.arange(8.0)
    X = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    assert RBFNetwork(spread="paper").fit(X, sine(X)).spread_ == pytest.approx(2.0)


def test_outputs_and_dimensions_of_any_number() -> None:
    rng = np.random.default_rng(0)
    u = rng.uniform(0, 1, (150, 2))
    sphere = np.column_stack([np.cos(u[:, 0]) * np.cos(u[:, 1]), np.sin(u[:, 0]) * np.cos(u[:, 1]), np.sin(u[:, 1])])
    network = RBFNetwork().fit(u, sphere)
    values, deviation = network.predict(u[:7], return_std=True)
    np.testing.assert_allclose(values, sphere[:7], atol=1e-4)
    assert deviation.shape == (7, 3)
    assert network.predict_grid([0.2, 0.4], [0.1, 0.2, 0.3]).shape == (3, 2, 3)
    assert network.predict_gradient(u[:7]).shape == (7, 3, 2)
    line = RBFNetwork().fit(u[:, :1], np.sin(6 * u[:, 0]))
    np.testing.assert_allclose(line.predict([[0.5]]), np.sin(3.0), atol=1e-4)
    with pytest.raises(PointsError, match="in the plane"):
        line.predict_grid([0.0], [0.0])


def test_scikit_learn_finds_its_conventions_kept() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of checks that are skipped
        results = check_estimator(RBFNetwork(), on_skip=None)
    assert len(results) > 40


def test_a_network_outlives_pickle_clone_and_state() -> None:
    X, y = cloud(80)
    for settings in ({}, {"mapping": "autoassociative", "spread": 1.0, "smoothing": 1e-6}, {"max_centers": 12}):
        network = RBFNetwork(**settings).fit(X, y)
        for again in (pickle.loads(pickle.dumps(network)), RBFNetwork.from_state(network.to_state())):
            for a, b in zip(
                network.predict(QUERIES, return_std=True), again.predict(QUERIES, return_std=True), strict=True
            ):
                np.testing.assert_array_equal(a, b)
            np.testing.assert_array_equal(again.coefficients_, network.coefficients_)
        assert not hasattr(clone(network), "centers_")


def test_a_refit_forgets() -> None:
    X, y = cloud(80)
    spoilt = y.copy()
    spoilt[3] = 50.0
    network = RBFNetwork().fit(X, spoilt)
    assert network.outliers_.tolist() == [3]
    network.predict(QUERIES, return_std=True)
    fresh = RBFNetwork().fit(X[:50], y[:50])
    again = network.fit(X[:50], y[:50])
    for a, b in zip(again.predict(QUERIES, return_std=True), fresh.predict(QUERIES, return_std=True), strict=True):
        np.testing.assert_array_equal(a, b)
    assert not len(again.outliers_)


def test_the_callback_hears_of_the_fit_and_can_end_it() -> None:
    heard: list[tuple[str, float]] = []
    RBFNetwork(callback=lambda stage, share: heard.append((stage, share))).fit(*cloud(300))
    assert {stage for stage, _ in heard} == {"selection", "solve"}
    assert all(0 <= share <= 1 for _, share in heard)

    def stop(stage: str, share: float) -> None:
        raise InterruptedError(stage)

    with pytest.raises(InterruptedError):
        RBFNetwork(callback=stop).fit(*cloud(30))


@pytest.mark.parametrize("n", [2, 3, 5])
def test_a_surface_passes_through_a_handful_of_points(n: int) -> None:
    X, y = cloud(n)
    network = RBFNetwork().fit(X, y)
    np.testing.assert_allclose(network.predict(X), y, atol=1e-6)
    mean, deviation = network.predict(QUERIES, return_std=True)
    assert np.all(np.isfinite(mean))
    assert np.all(deviation >= 0)


def test_points_on_a_line_or_in_one_place_give_something_finite() -> None:
    x = np.linspace(0, 1, 20)
    assert np.all(np.isfinite(RBFNetwork().fit(np.column_stack([x, 2 * x]), np.sin(x)).predict(QUERIES)))
    np.testing.assert_allclose(RBFNetwork().fit(np.zeros((4, 2)), [1.0, 2.0, 3.0, 4.0]).predict([[0.0, 0.0]]), 2.5)
    np.testing.assert_allclose(RBFNetwork().fit(*cloud(20)).fit(cloud(20)[0], np.full(20, 7.0)).predict(QUERIES), 7.0)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "settings",
    [{"spread": np.float32(1e-7)}, {"spread": 5e7}, {"smoothing": 1e9}, {"max_centers": np.int8(3), "tolerance": 0}],
    ids=str,
)
def test_settings_just_within_their_bounds_give_something_finite(settings: dict[str, Any]) -> None:
    network = RBFNetwork(**settings).fit(*cloud(40))
    assert np.all(np.isfinite(network.predict(QUERIES, return_std=True)))
    assert np.all(np.isfinite(network.predict_grid([-1, 0, 1], [0, 1])))


def test_bad_input_is_named() -> None:
    X, y = cloud(10)
    spoilt = X.copy()
    spoilt[3, 1] = np.nan
    with pytest.raises(PointsError, match="finite"):
        RBFNetwork().fit(spoilt, y)
    with pytest.raises(PointsError, match="n = 10"):
        RBFNetwork().fit(X, y[:9])
    with pytest.raises(PointsError, match="at least 2"):
        RBFNetwork().fit(X[:1], y[:1])
    with pytest.raises(PointsError, match=r"k of at least 1, got \(10, 0\)"):
        RBFNetwork().fit(X, np.zeros((10, 0)))
    for far in ((5e307 * X, y), (X, 5e307 * y)):
        with pytest.raises(PointsError, match="sums overflow"):
            RBFNetwork().fit(*far)
    for settings, message in (
        ({"spread": -1.0}, "spread must be positive"),
        ({"spread": "wide"}, "unknown"),
        ({"smoothing": -1e-3}, "smoothing must be at least 0"),
        ({"smoothing": np.nan}, "smoothing must be at least 0"),
        ({"tolerance": -1.0}, "tolerance"),
        ({"max_centers": 0}, "max_centers"),
        ({"mapping": "depth"}, "mapping"),
        ({"spread": None}, "spread None is unknown; accepted is a number or auto or paper"),
        ({"spread": True}, "spread True"),
        ({"spread": [1.0, 2.0]}, "spread"),
        ({"smoothing": [0.0]}, "smoothing .* accepted is a number or auto"),
        ({"tolerance": None}, "tolerance None is unknown; accepted is a number"),
        ({"tolerance": "a"}, "tolerance 'a'"),
        ({"max_centers": "all"}, "whole number"),
        ({"max_centers": 2.5}, "whole number"),
        ({"max_centers": np.nan}, "whole number"),
        ({"max_centers": True}, "whole number"),
        ({"spread": 1e-160}, "times the extent of the points, got 1e-160"),
        ({"spread": 1e300}, "times the extent"),
        ({"smoothing": 1e300}, "smoothing must be at most 1e.09"),
    ):
        with pytest.raises(ParameterError, match=message):
            RBFNetwork(**settings).fit(X, y)
    with pytest.raises(ParameterError, match="one value"):
        RBFNetwork(mapping="autoassociative").fit(X, np.column_stack([y, y]))
    with pytest.raises(NotReadyError, match="not fitted"):
        RBFNetwork().predict(X)
    with pytest.raises(PointsError, match="expecting 2"):
        RBFNetwork().fit(X, y).predict(X[:, :1])
