"""Many wrong points: found, and told from rough surfaces."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from common.network import RBFNetwork, contamination
from common.network.contamination import Reweighted, heavy, is_believed, reweighted
from common.surface import FloatArray
from tests.common.network.surfaces import sine

QUERIES = np.random.default_rng(1).uniform(-1.8, 1.8, (1500, 2))


def cliff(X: FloatArray) -> FloatArray:
    return np.asarray(np.where(X.sum(axis=1) > 0, 1.0, 0.0))


def islands(X: FloatArray) -> FloatArray:
    middles = np.random.default_rng(3).uniform(-2, 2, (6, 2))
    return np.asarray(np.max(60 * np.exp(-((X[:, None] - middles) ** 2).sum(axis=2) / 0.08), axis=1))


def rough_to_the_left(X: FloatArray) -> FloatArray:
    return np.asarray(np.where(X[:, 0] < -0.4, np.sin(15 * X[:, 0]) * np.cos(14 * X[:, 1]), 0.0))


def error(X: FloatArray, y: FloatArray) -> float:
    return float(np.sqrt(np.mean((RBFNetwork().fit(X, y).predict(QUERIES) - sine(QUERIES)) ** 2)))


@pytest.mark.parametrize("kind", ["gross", "wild"])
@pytest.mark.parametrize("noise", [0.0, 0.04])
@pytest.mark.parametrize(("n", "share"), [(400, 0.15), (400, 0.3), (1500, 0.3), (6000, 0.2)])
def test_the_surface_is_that_of_the_right_points(n: int, share: float, noise: float, kind: str) -> None:
    rng = np.random.default_rng(11)
    X = rng.uniform(-2, 2, (n, 2))
    y = sine(X) + noise * rng.normal(size=n)
    wrong = rng.random(n) < share
    spoilt = np.where(wrong, y + rng.uniform(-2, 2, n) if kind == "gross" else rng.uniform(-20, 20, n), y)
    assert error(X, spoilt) <= 1.5 * error(X[~wrong], y[~wrong])


def test_what_is_set_aside_is_named_and_what_is_right_stays() -> None:
    rng = np.random.default_rng(12)
    X = rng.uniform(-2, 2, (500, 2))
    y = sine(X) + 0.02 * rng.normal(size=500)
    wrong = np.sort(rng.permutation(500)[:125])
    y[wrong] += rng.choice([-1, 1], 125) * rng.uniform(1, 9, 125)
    assert RBFNetwork().fit(X, y).outliers_.tolist() == wrong.tolist()


def test_wrong_points_of_a_lattice_whose_neighbours_tell_most_points_exactly() -> None:
    axis = np.linspace(0, 10, 70)
    X = np.array(np.meshgrid(axis, axis)).reshape(2, -1).T
    y = np.sin(X[:, 0])
    y[::97] += 8.0
    assert RBFNetwork().fit(X, y).outliers_.tolist() == list(range(0, len(y), 97))


@pytest.mark.parametrize("noise", [0.0, 0.02])
@pytest.mark.parametrize("n", [200, 1000])
@pytest.mark.parametrize("surface", [cliff, islands, rough_to_the_left])
def test_a_rough_surface_is_not_taken_for_wrong_points(
    surface: Callable[[FloatArray], FloatArray], n: int, noise: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(14)
    X = rng.uniform(-2, 2, (n, 2))
    y = surface(X)
    y = y + noise * np.ptp(y) * rng.normal(size=n)
    asked = RBFNetwork().fit(X, y).predict(QUERIES)
    monkeypatch.setattr(contamination, "HEAVY", np.inf)
    assert np.array_equal(asked, RBFNetwork().fit(X, y).predict(QUERIES))


def test_normal_noise_is_not_asked_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(15)
    X = rng.uniform(-2, 2, (1000, 2))
    monkeypatch.delattr(contamination, "reweighted")
    RBFNetwork().fit(X, sine(X) + 0.2 * rng.normal(size=1000))


def test_weights_are_those_of_a_cauchy_location() -> None:
    rng = np.random.default_rng(16)
    values = np.append(rng.normal(3.0, 0.1, 600), rng.uniform(-50, 50, 400))[:, None]

    def refit(weights: FloatArray) -> FloatArray:
        return np.asarray(values - np.average(values[:, 0], weights=weights))

    found = reweighted(refit(np.ones(1000)), refit)
    assert abs(values[0, 0] - found.residuals[0, 0] - 3.0) < 0.05
    assert found.weights.min() > 0
    assert found.weights.max() <= 1
    assert np.median(found.weights[600:]) < 0.01 < 0.5 < np.median(found.weights[:600])
    np.testing.assert_allclose(found.sizes, np.abs(values[:, 0] - values[0, 0] + found.residuals[0, 0]))


def test_wrong_points_know_nothing_of_each_other() -> None:
    rng = np.random.default_rng(17)
    side = np.arange(400)
    near = (side[:, None] + np.arange(7)) % 400
    noise, values = rng.normal(size=(400, 1)), 10 * rng.normal(size=(400, 1))
    alone, together = noise.copy(), noise.copy()
    sides = alone.copy()
    alone[rng.permutation(400)[:40]] = 100.0
    sides[rng.permutation(400)[:40], 0] = rng.choice([-100, 100], 40)
    together[100:140] = 100.0
    for residuals, believed in ((alone, True), (sides, True), (together, False)):
        usual = float(np.median(np.abs(residuals))) / 0.6745
        found = Reweighted(residuals, np.ones(400), usual)
        assert is_believed(residuals, found, values, near, 0.0) is believed
    # Nor is it believed of a surface that explains nothing, or where a normal density foretells as much.
    found = Reweighted(alone, np.ones(400), float(np.median(np.abs(alone))) / 0.6745)
    assert not is_believed(alone, found, 0.1 * values, near, 0.0)
    assert not is_believed(noise, found, values, near, 0.0)


def test_tails_are_told_where_fourth_powers_have_no_double() -> None:
    residuals = np.where(np.arange(100) == 3, 1.0, 1e-3)[:, None] * [1.0, 0.5]
    normal = np.random.default_rng(0).normal(size=(100, 1))
    for scale in (1.0, 1e100, 1e-100):
        assert heavy(scale * residuals)
        assert not heavy(scale * normal)
