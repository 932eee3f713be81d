"""The estimator: exact where it should be, the same function after a round trip, clear about bad input."""

from __future__ import annotations

import numpy as np
import pytest

from common.errors import NotReadyError, ParameterError, PointsError
from common.network import RBFNetwork
from common.surface import FloatArray

RNG_SEED = 3


def waves(X: FloatArray) -> FloatArray:
    return np.asarray(np.sin(2 * X[:, 0]) + np.sin(2 * X[:, 1]))


@pytest.fixture
def samples() -> tuple[FloatArray, FloatArray]:
    X = np.random.default_rng(RNG_SEED).uniform(-2, 2, (120, 2))
    return X, waves(X)


def test_a_network_without_smoothing_passes_through_the_points(samples: tuple[FloatArray, FloatArray]) -> None:
    X, y = samples
    network = RBFNetwork(spread=0.5, smoothing=0).fit(X, y)
    np.testing.assert_allclose(network.predict(X), y, atol=1e-8)


def test_the_grid_equals_the_points(samples: tuple[FloatArray, FloatArray]) -> None:
    network = RBFNetwork().fit(*samples)
    x, y = np.linspace(-2, 2, 7), np.linspace(-1, 1, 5)
    nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(network.predict_grid(x, y).ravel(), network.predict(nodes), atol=1e-8)


def test_a_network_outlives_its_state(samples: tuple[FloatArray, FloatArray]) -> None:
    X, y = samples
    network = RBFNetwork().fit(X, y)
    again = RBFNetwork.from_state(network.to_state())
    for a, b in zip(network.predict(X, return_std=True), again.predict(X, return_std=True), strict=True):
        np.testing.assert_array_equal(a, b)


def test_bad_input_is_named() -> None:
    with pytest.raises(PointsError, match="finite"):
        RBFNetwork().fit([[0.0, np.nan], [1.0, 1.0]], [0.0, 1.0])
    with pytest.raises(PointsError, match="n = 2"):
        RBFNetwork().fit([[0.0, 0.0], [1.0, 1.0]], [0.0, 1.0, 2.0])
    with pytest.raises(ParameterError, match="spread must be positive"):
        RBFNetwork(spread=-1.0).fit([[0.0, 0.0], [1.0, 1.0]], [0.0, 1.0])
    with pytest.raises(NotReadyError, match="not fitted"):
        RBFNetwork().predict([[0.0, 0.0]])
