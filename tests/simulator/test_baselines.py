"""Every baseline under one battery: what a method promises must hold whatever the method."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from common.errors import MissingExtraError, NotFoundError, PointsError
from common.metrics import nrmse
from common.surface import FloatArray
from sender.surfaces import SURFACES
from simulator.baselines import BASELINES, reconstruct
from simulator.baselines.interpolation import gcv_smoothing

AVAILABLE = [
    pytest.param(
        name,
        marks=pytest.mark.skipif(not baseline.available, reason=f"needs {baseline.package}, of the extra 'baselines'"),
    )
    for name, baseline in BASELINES.items()
]
X, Y = np.linspace(-1.0, 1.0, 17), np.linspace(-0.5, 0.5, 9)


def cloud(n: int = 40, seed: int = 5) -> FloatArray:
    """Points of a smooth surface over the grid's rectangle, its corners among them."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-1, 1, n), rng.uniform(-0.5, 0.5, n)
    x[:4], y[:4] = [-1, 1, -1, 1][:n], [-0.5, -0.5, 0.5, 0.5][:n]
    return np.column_stack([x, y, 3 / (1 + x**2 + y**2)])


def again(name: str, points: FloatArray, seed: int = 0) -> FloatArray:
    return reconstruct(name, points, X, Y, np.random.default_rng(seed))


@pytest.mark.parametrize("name", AVAILABLE)
@pytest.mark.parametrize("n", [3, 4, 5, 7, 12, 40])
def test_finite_from_few_points_on(name: str, n: int) -> None:
    points = cloud(n)
    grid = again(name, points)
    assert grid.shape == (len(Y), len(X))
    assert np.isfinite(grid).all()


@pytest.mark.parametrize("name", AVAILABLE)
def test_same_whatever_the_order_and_deterministic_from_the_generator(name: str) -> None:
    points = cloud()
    grid = again(name, points)
    np.testing.assert_array_equal(again(name, points[::-1]), grid)
    np.testing.assert_array_equal(again(name, points), grid)


@pytest.mark.parametrize("name", ["kmeans_network", "random_network", "back_propagation"])
def test_the_generator_is_what_is_drawn_from(name: str) -> None:
    if not BASELINES[name].available:
        pytest.skip("needs the extra 'baselines'")
    assert np.abs(again(name, cloud(), seed=1) - again(name, cloud(), seed=2)).max() > 1e-9


@pytest.mark.parametrize("name", [p for p in AVAILABLE if BASELINES[str(p.values[0])].plane])
def test_a_plane_is_reproduced(name: str) -> None:
    points = cloud()
    points[:, 2] = 4 - 2 * points[:, 0] + 0.5 * points[:, 1]
    np.testing.assert_allclose(again(name, points), 4 - 2 * X[None, :] + 0.5 * Y[:, None], atol=1e-7)


@pytest.mark.parametrize("name", AVAILABLE)
def test_a_constant_is_reproduced(name: str) -> None:
    points = cloud()
    points[:, 2] = 7.0
    np.testing.assert_allclose(again(name, points), 7.0, atol=1e-6)


@pytest.mark.parametrize("name", AVAILABLE)
def test_shift_and_scale_of_the_coordinates_carry_over(name: str) -> None:
    points = cloud()
    moved = points * [1000.0, 1000.0, 50.0] + [5e5, -2e5, 300.0]
    grid = reconstruct(name, moved, X * 1000 + 5e5, Y * 1000 - 2e5, np.random.default_rng(0))
    # Rounding of the shifted coordinates is amplified where a system is ill-conditioned or a training is iterated.
    np.testing.assert_allclose((grid - 300) / 50, again(name, points), atol=0.02)


@pytest.mark.parametrize("name", AVAILABLE)
def test_it_is_a_reconstruction(name: str) -> None:
    """Closer to the truth than a flat mean plane by a factor of two, on a surface every method can follow."""
    edge = np.linspace(-1, 1, 9)
    rim = np.vstack([np.column_stack([edge, side * np.full(9, 0.5)]) for side in (-1, 1)])
    points = np.vstack([cloud(120), np.column_stack([rim, 3 / (1 + np.sum(rim**2, axis=1))])])
    truth = 3 / (1 + X[None, :] ** 2 + Y[:, None] ** 2)
    flat = nrmse(truth, np.full_like(truth, truth.mean()))
    assert nrmse(truth, again(name, points)) < flat / 2


@pytest.mark.parametrize("name", AVAILABLE)
def test_repeated_and_nearly_repeated_positions(name: str) -> None:
    points = cloud()
    twins = points + np.array([1e-13, -1e-13, 0.1])
    grid = again(name, np.vstack([points, points[:10], twins[:10]]))
    assert np.abs(grid).max() < 100


@pytest.mark.parametrize("name", AVAILABLE)
def test_points_on_a_line(name: str) -> None:
    t = np.linspace(-1, 1, 9)
    assert np.isfinite(again(name, np.column_stack([t, t / 2, t**2]))).all()


@pytest.mark.parametrize("name", [n for n, b in BASELINES.items() if not b.raw and b.available])
def test_one_point_is_a_level_surface(name: str) -> None:
    np.testing.assert_array_equal(again(name, np.array([[0.0, 0.0, 2.5]])), 2.5)


@pytest.mark.parametrize("name", ["linear", "cubic", "natural_neighbour"])
def test_outside_of_the_hull_the_nearest_height_stands(name: str) -> None:
    if not BASELINES[name].available:
        pytest.skip("needs the extra 'baselines'")
    points = np.array([[0, 0, 1.0], [0.2, 0, 2.0], [0, 0.2, 3.0], [0.2, 0.2, 4.0]])
    assert reconstruct(name, points, [-1.0, 1.0], [-1.0, 1.0], np.random.default_rng(0)).tolist() == [[1, 2], [3, 4]]


@pytest.mark.parametrize("name", AVAILABLE)
def test_more_points_than_the_dense_methods_take(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The limits, lowered so that the test is quick, change the way and not the outcome."""
    for module, limits in {
        "interpolation": ("DENSE_LIMIT", "GCV_LIMIT"),
        "statistical": ("LIKELIHOOD_LIMIT", "KRIGING_LIMIT"),
        "networks": ("EXACT_LIMIT", "GRNN_LIMIT"),
    }.items():
        for limit in limits:
            monkeypatch.setattr(f"simulator.baselines.{module}.{limit}", 70)
    test_it_is_a_reconstruction(name)


def test_the_smoothing_follows_the_noise() -> None:
    """Generalised cross-validation finds next to none in clean heights and more in noisier ones."""
    points = cloud(150)
    noise = np.random.default_rng(3).standard_normal(150)[:, None] * [0, 0, 1.0]
    smoothings = [gcv_smoothing(points + amplitude * noise) for amplitude in (0.0, 0.05, 0.3)]
    assert smoothings[0] < smoothings[1] / 100
    assert smoothings[1] < smoothings[2]


def test_a_smoothed_plate_is_closer_under_noise() -> None:
    surface = SURFACES["franke"]
    rng = np.random.default_rng(0)
    points = surface.sample(rng, 200)
    truth = surface.grid((21, 21))
    noisy = points + rng.normal(0, 0.1, (200, 1)) * [0, 0, 1]
    errors = {
        name: nrmse(truth.z, reconstruct(name, noisy, truth.x, truth.y, rng))
        for name in ("thin_plate", "thin_plate_gcv")
    }
    assert errors["thin_plate_gcv"] < 0.7 * errors["thin_plate"]


def test_unknown_names_and_unusable_input_are_typed() -> None:
    rng = np.random.default_rng(0)
    with pytest.raises(NotFoundError, match="accepted are nearest, linear"):
        reconstruct("bilinear", cloud(), X, Y, rng)
    with pytest.raises(PointsError, match="finite"):
        reconstruct("linear", [(0, 0, np.nan)], X, Y, rng)
    with pytest.raises(PointsError, match="one-dimensional"):
        reconstruct("linear", cloud(), X[None, :], Y, rng)


def test_a_missing_package_is_a_typed_error_that_names_the_extra() -> None:
    absent = dataclasses.replace(BASELINES["kriging"], package="surfacelink_absent")
    assert not absent.available
    with pytest.raises(MissingExtraError, match=r"surfacelink\[baselines\]"):
        absent.reconstruct(cloud(), X, Y, np.random.default_rng(0))
