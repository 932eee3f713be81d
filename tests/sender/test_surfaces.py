"""The named surfaces: formulas at known places, clouds that repeat from a seed, names that are wrong."""

from __future__ import annotations

import numpy as np
import pytest

from common.errors import NotFoundError, ParameterError
from sender.surfaces import SURFACES, find_surface


@pytest.mark.parametrize(
    ("name", "x", "y", "z"),
    [
        ("surface-1", 0.0, 0.0, 3.0),
        ("surface-1", 1.0, 1.0, 1.0),
        ("surface-1-printed", 1.0, 0.0, 3.0),
        ("surface-2", 0.0, 0.0, -5.0),
        ("surface-2", 2.0, 0.0, -1.0),
        ("surface-3", np.pi / 4, np.pi / 4, 2.0),
        ("surface-3-squared", np.pi / 2, 0.0, 1.0),
        ("franke", 0.5, 0.5, 0.32576),
        ("peaks", 0.0, 0.0, 0.981),
    ],
)
def test_the_formulas(name: str, x: float, y: float, z: float) -> None:
    surface = SURFACES[name]
    height = surface.height(np.array([x]), np.array([y]))  # type: ignore[attr-defined]
    assert height[0] == pytest.approx(z, abs=2e-4)


@pytest.mark.parametrize("name", SURFACES)
def test_a_cloud_lies_in_its_region_and_repeats_from_its_seed(name: str) -> None:
    surface = SURFACES[name]
    cloud = surface.sample(np.random.default_rng(5), 50)
    assert cloud.shape == (50, 3)
    np.testing.assert_array_equal(cloud, surface.sample(np.random.default_rng(5), 50))
    assert not np.array_equal(cloud, surface.sample(np.random.default_rng(6), 50))
    assert (cloud[:, 0] >= surface.region.x_min).all()
    assert (cloud[:, 1] <= surface.region.y_max).all()


def test_the_elevation_grid_has_north_up_and_is_in_metres() -> None:
    grid = SURFACES["elevation"].grid()
    assert grid.shape == (344, 403)
    assert (grid.z.min(), grid.z.max()) == (236.0, 1076.0)
    assert grid.units.xy == grid.units.z == "m"
    assert grid.x[1] == pytest.approx(74.3, abs=0.1)  # 3 arc-seconds at 36.7 degrees north
    thin = SURFACES["elevation"].grid((10, 20))
    assert thin.shape == (10, 20)
    assert thin.z[-1, -1] == grid.z[-1, -1]


def test_a_wrong_name_lists_the_right_ones() -> None:
    with pytest.raises(NotFoundError, match=r"did you mean 'surface-1'\?.*elevation"):
        find_surface("surface1")


def test_more_points_than_nodes_and_finer_grids_than_measured_are_refused() -> None:
    with pytest.raises(ParameterError, match="1 to 138632"):
        SURFACES["elevation"].sample(np.random.default_rng(0), 200_000)
    with pytest.raises(ParameterError, match="invent heights"):
        SURFACES["elevation"].grid((1000, 1000))
    with pytest.raises(ParameterError, match="1 to 10000000"):
        SURFACES["surface-1"].sample(np.random.default_rng(0), 0)
