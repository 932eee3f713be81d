"""The heights of the autoassociative mapping: its fixed points, and the derivatives of their surface."""

from __future__ import annotations

import numpy as np
import pytest

from common.network import RBFNetwork, evaluation
from common.network.autoassociative import Lifted
from common.surface import FloatArray

QUERIES = np.random.default_rng(99).random((200, 2))


def slope(X: FloatArray) -> FloatArray:
    return np.asarray(np.sin(3 * X[:, 0]) + X[:, 1])


def lifted(n: int, noise: float = 0.0) -> Lifted:
    rng = np.random.default_rng(1)
    X = rng.random((n, 2))
    points = np.column_stack([X, slope(X) + noise * rng.normal(size=n)])
    return Lifted.fit(points, np.ones(n), None, None, lambda share: None)


@pytest.mark.parametrize("n", [60, 300])
def test_heights_of_a_surface_without_noise_are_fixed_points_of_the_mapping(n: int) -> None:
    network = lifted(n)
    z = network.predict(QUERIES)
    spreads = np.array([network.spread])
    mapped = evaluation.evaluate(np.column_stack([QUERIES, z]), network.centers, spreads, network.coefficients[None])
    np.testing.assert_allclose((mapped + network.bias)[:, -1:], z, atol=1e-9)
    assert np.sqrt(np.mean((z[:, 0] - slope(QUERIES)) ** 2)) < 0.02


def test_the_gradient_is_the_one_of_the_heights() -> None:
    network, h = lifted(60), 1e-4
    numeric = np.column_stack([network.predict(QUERIES + e) - network.predict(QUERIES - e) for e in h * np.eye(2)]) / (
        2 * h
    )
    np.testing.assert_allclose(network.predict_gradient(QUERIES)[:, 0], numeric, atol=1e-2)


def test_where_no_fixed_point_is_near_height_and_deviation_stay_finite() -> None:
    network = lifted(60, noise=0.05)
    heights = network.predict(QUERIES)[:, 0]
    assert np.sqrt(np.mean((heights - slope(QUERIES)) ** 2)) < 0.3
    assert np.isfinite(network.predict_std(QUERIES)).all()
    assert np.isfinite(network.predict_gradient(QUERIES)).all()


def test_values_at_one_place_are_their_mean() -> None:
    network = RBFNetwork(mapping="autoassociative").fit(np.ones((20, 2)), np.arange(20.0))
    heights, deviations = network.predict([[1.0, 1.0], [2.0, 2.0]], return_std=True)
    np.testing.assert_allclose(heights, 9.5)
    assert np.isfinite(deviations).all()
