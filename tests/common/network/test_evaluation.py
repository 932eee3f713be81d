from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.network import evaluation
from common.surface import FloatArray


def direct(X: FloatArray, centers: FloatArray, spreads: FloatArray, coefficients: FloatArray) -> FloatArray:
    r2 = ((X[:, None] - centers) ** 2).sum(axis=2)
    return np.asarray(sum(np.exp(-r2 / (2 * s**2)) @ c for s, c in zip(spreads, coefficients, strict=True)))


def network(spreads: FloatArray, n: int, k: int = 1, d: int = 2) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(0)
    return rng.uniform(-2, 2, (n, d)), rng.normal(size=(len(spreads), n, k))


LADDER = 0.01 * 2 ** (np.arange(17)[::-1] / 2)


@pytest.mark.parametrize(
    "spreads",
    [np.array([0.3]), np.array([1e-3]), np.array([0.05]), np.array([50.0]), np.array([0.4, 0.02, 0.7]), LADDER],
    ids=["medium", "narrow", "small", "wide", "mixed", "ladder"],
)
@pytest.mark.parametrize("shape", [(300, 257), (40, 400), (1, 5), (3, 1)])
def test_a_grid_holds_what_scattered_evaluation_gives(spreads: FloatArray, shape: tuple[int, int]) -> None:
    centers, c = network(spreads, 150, k=2)
    x, y = np.linspace(-2.5, 2, shape[1]), np.linspace(-2, 2.2, shape[0])
    grid = evaluation.evaluate_grid(x, y, centers, spreads, c)
    nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    values = evaluation.evaluate(nodes, centers, spreads, c)
    assert grid.shape == (*shape, 2)
    np.testing.assert_allclose(grid.reshape(-1, 2), values, atol=1e-14 * np.abs(c).sum(), rtol=0)
    pick = np.arange(0, len(nodes), 97)
    np.testing.assert_allclose(values[pick], direct(nodes[pick], centers, spreads, c), atol=1e-14 * np.abs(c).sum())


@settings(max_examples=40, deadline=None)
@given(ratio=st.floats(1e-6, 60), centre=st.floats(-2, 2))
def test_as_many_chebyshev_nodes_as_a_gaussian_needs(ratio: float, centre: float) -> None:
    spread = 1 / ratio
    count = evaluation.chebyshev_count(ratio)
    x = np.linspace(-1, 1, 2 * count + 50)
    nodes = evaluation._chebyshev_nodes(x, count)
    matrix = evaluation._interpolation(nodes, x)
    found = matrix @ np.exp(-0.5 * ((nodes - centre) / spread) ** 2)
    np.testing.assert_allclose(found, np.exp(-0.5 * ((x - centre) / spread) ** 2), atol=2e-13)


def test_descending_or_shuffled_axes_and_offsets() -> None:
    spreads = np.array([0.3, 0.01])
    centers, c = network(spreads, 80)
    x, y = np.linspace(-2, 2, 200), np.linspace(-2, 2, 150)
    straight = evaluation.evaluate_grid(x, y, centers, spreads, c)
    order = np.random.default_rng(1).permutation(200)
    np.testing.assert_allclose(
        evaluation.evaluate_grid(x[order], y[::-1], centers, spreads, c), straight[::-1, order], atol=1e-11
    )
    moved = evaluation.evaluate_grid(x + 1e6, y + 1e6, centers + 1e6, spreads, c)
    np.testing.assert_allclose(moved, straight, atol=1e-6)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("spreads", [np.array([0.3]), LADDER], ids=["single", "ladder"])
@pytest.mark.parametrize("width", [1e5, 1e7, 1e12, 1e300])
def test_a_grid_far_wider_than_the_spread_takes_no_more_memory(width: float, spreads: FloatArray) -> None:
    centers, c = network(spreads, 150)
    x, y = np.append(np.linspace(-2, 2, 200), width), np.linspace(-2, 2, 130)
    tracemalloc.start()
    grid = evaluation.evaluate_grid(x, y, centers, spreads, c)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 20e6
    near = evaluation.evaluate_grid(x[:-1], y, centers, spreads, c)
    np.testing.assert_allclose(grid[:, :-1], near, atol=1e-14 * np.abs(c).sum(), rtol=0)
    np.testing.assert_array_equal(grid[:, -1], np.zeros((130, 1)))


@pytest.mark.parametrize("d", [1, 2, 3])
@pytest.mark.parametrize("spreads", [np.array([0.5]), LADDER, np.array([0.01])], ids=["single", "ladder", "narrow"])
def test_gradient_is_the_derivative(d: int, spreads: FloatArray) -> None:
    centers, c = network(spreads, 60, k=2, d=d)
    X = np.random.default_rng(3).uniform(-2, 2, (50, d))
    slopes = evaluation.gradient(X, centers, spreads, c)
    assert slopes.shape == (50, 2, d)
    step = 1e-5 * spreads.min()
    for axis in range(d):
        shift = step * np.eye(d)[axis]
        difference = direct(X + shift, centers, spreads, c) - direct(X - shift, centers, spreads, c)
        np.testing.assert_allclose(slopes[:, :, axis], difference / (2 * step), atol=2e-6 * np.abs(slopes).max())


def test_no_positions_and_no_centres() -> None:
    spreads = np.array([0.3])
    centers, c = network(spreads, 10)
    assert evaluation.evaluate(np.zeros((0, 2)), centers, spreads, c).shape == (0, 1)
    assert evaluation.gradient(np.zeros((0, 2)), centers, spreads, c).shape == (0, 1, 2)
    assert evaluation.evaluate_grid(np.zeros(0), np.zeros(3), centers, spreads, c).shape == (3, 0, 1)
    none = evaluation.evaluate(np.ones((4, 2)), centers[:0], spreads, c[:, :0])
    np.testing.assert_array_equal(none, np.zeros((4, 1)))


def test_tiles_hold_every_row_once() -> None:
    X = np.random.default_rng(0).normal(size=(1000, 3))
    for compact in (True, False):
        groups = evaluation.tiles(X, 37, compact)
        assert max(map(len, groups)) <= 37
        np.testing.assert_array_equal(np.sort(np.concatenate(groups)), np.arange(1000))
