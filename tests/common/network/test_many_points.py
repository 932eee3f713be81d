"""RBFNetwork where there are too many points for one dense network."""

from __future__ import annotations

import pickle
import warnings
from typing import Any

import numpy as np
import pytest

from common.errors import ParameterError, PointsError
from common.network import RBFNetwork
from common.network.fitting import DENSE
from common.surface import FloatArray
from tests.common.network.surfaces import sine

N = DENSE + 500


@pytest.fixture(scope="module")
def points() -> FloatArray:
    return np.random.default_rng(0).uniform(-2, 2, (N, 2))


@pytest.fixture(scope="module")
def network(points: FloatArray) -> RBFNetwork:
    return RBFNetwork().fit(points, 40 + 3 * sine(points))


def test_the_surface_is_found(network: RBFNetwork) -> None:
    Q = np.random.default_rng(1).uniform(-1.9, 1.9, (500, 2))
    z, std = network.predict(Q, return_std=True)
    truth = 40 + 3 * sine(Q)
    np.testing.assert_allclose(z, truth, atol=1e-4)
    assert std.shape == z.shape
    slopes = network.predict_gradient(Q)
    np.testing.assert_allclose(slopes, 6 * np.cos(2 * Q), atol=1e-2)


def test_grid_and_its_deviation(network: RBFNetwork) -> None:
    x, y = np.linspace(-2, 2, 30), np.linspace(-2, 2, 20)
    grid, std = network.predict_grid(x, y, return_std=True)
    assert grid.shape == std.shape == (20, 30)
    np.testing.assert_allclose(network.predict_grid(x, y), grid, atol=1e-6)


def test_learnt_attributes(network: RBFNetwork, points: FloatArray) -> None:
    assert network.centers_.shape == (N, 2)
    assert network.n_features_in_ == 2
    assert network.stop_reason_ == "every point is a centre"
    assert np.all(np.asarray(network.spread_) > 0)
    assert network.smoothing_ >= 0
    assert np.ndim(network.coefficients_) == 1
    assert network.bias_.shape == (1,)


def test_state_and_pickle_give_the_same_surface(network: RBFNetwork) -> None:
    Q = np.random.default_rng(1).uniform(-2, 2, (50, 2))
    for copy in (RBFNetwork.from_state(network.to_state()), pickle.loads(pickle.dumps(network))):
        np.testing.assert_array_equal(copy.predict(Q), network.predict(Q))
        assert copy.spread_ == pytest.approx(network.spread_)


def test_a_refit_forgets(points: FloatArray) -> None:
    few = points[:60]
    network = RBFNetwork().fit(points, sine(points)).fit(few, sine(few))
    np.testing.assert_array_equal(network.predict(few), RBFNetwork().fit(few, sine(few)).predict(few))


def test_several_values_a_position(points: FloatArray) -> None:
    network = RBFNetwork(smoothing=1e-8).fit(points, np.stack([sine(points), points[:, 0]], axis=1))
    x = np.linspace(-1, 1, 5)
    assert network.predict(points[:7]).shape == (7, 2)
    assert network.predict_grid(x, x[:3]).shape == (3, 5, 2)
    assert network.predict_gradient(points[:7]).shape == (7, 2, 2)


@pytest.mark.parametrize("spread", ["paper", 0.2])
def test_given_spreads(points: FloatArray, spread: float | str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        network = RBFNetwork(spread=spread, smoothing=1e-9).fit(points, sine(points))  # type: ignore[arg-type]
    assert np.isscalar(network.spread_)
    assert np.sqrt(np.mean((network.predict(0.9 * points) - sine(0.9 * points)) ** 2)) < 0.1


def test_refusals(network: RBFNetwork, points: FloatArray) -> None:
    with pytest.raises(PointsError):
        network.predict(np.zeros((3, 5)))
    with pytest.raises(PointsError):
        RBFNetwork().fit(np.where(points > 1.99, np.nan, points), sine(points))
    with pytest.raises(ParameterError):
        RBFNetwork(smoothing=-1.0).fit(points, sine(points))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("n", [400, N])
@pytest.mark.parametrize("settings", [{"tolerance": 100.0}, {"max_centers": 20}], ids=str)
def test_a_surface_without_centres_has_the_deviation_of_its_points(
    points: FloatArray, n: int, settings: dict[str, Any]
) -> None:
    X, flat = points[:n], "max_centers" in settings
    y = np.full(n, 3.0) if flat else 40 + sine(X)
    network = RBFNetwork(**settings).fit(X, y)
    z, std = network.predict(X[:200], return_std=True)
    assert len(network.centers_) == 0
    np.testing.assert_allclose(z, np.full(200, z[0]))
    np.testing.assert_allclose(std, 0.0 if flat else np.sqrt(np.mean((y - z[0]) ** 2)), rtol=0.01, atol=1e-12)
    restored = RBFNetwork.from_state(network.to_state())
    np.testing.assert_array_equal(restored.predict(X[:200], return_std=True)[1], std)


@pytest.mark.filterwarnings("error")
def test_many_points_within_rounding_of_a_few_places_are_fitted() -> None:
    rng = np.random.default_rng(4)
    X = np.repeat(rng.random((10, 2)), 600, axis=0)
    y = sine(X) + rng.normal(0, 0.1, len(X))
    z, std = RBFNetwork().fit(X + rng.normal(0, 1e-12, X.shape), y).predict(X[::600], return_std=True)
    np.testing.assert_allclose(z, sine(X[::600]), atol=0.1)
    assert np.isfinite(std).all()
