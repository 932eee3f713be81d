"""Region, FeatureSet, HeightGrid: what they accept, and what they say of what they do not."""

from __future__ import annotations

import numpy as np
import pytest

from common.errors import ParameterError, PointsError
from common.surface import FeatureSet, HeightGrid, Region, Units

SQUARE = Region(-1.0, 1.0, -1.0, 1.0)


@pytest.mark.parametrize(
    ("bounds", "gap", "expected"),
    [
        ((-1, 1, -1, 1), 0.4, (5, 5)),  # the paper's surface 1: 25 pieces
        ((-2, 2, -2, 2), 1.0, (4, 4)),  # the paper's surfaces 2 and 3: 16 pieces
        ((0, 1, 0, 3), 1.0, (3, 1)),
        ((0, 1, 0, 1), 0.3, (4, 4)),
        ((0, 10, 0, 1), 5.0, (1, 2)),
    ],
)
def test_pieces_cover_the_region(
    bounds: tuple[float, float, float, float], gap: float, expected: tuple[int, int]
) -> None:
    assert Region(*bounds).pieces(gap) == expected


@pytest.mark.parametrize(
    ("gap", "message"),
    [
        (0.0, "positive"),
        (-1.0, "positive"),
        (float("nan"), "positive"),
        (2.1, "larger than the region"),
        (1e-6, "at most 16000000"),
        (1e-300, "at most 16000000"),
    ],
)
def test_a_gap_out_of_bounds_says_what_is_accepted(gap: float, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        SQUARE.pieces(gap)


@pytest.mark.parametrize("bounds", [(1, 0, 0, 1), (0, 0, 0, 1), (0, float("inf"), 0, 1), (-1e308, 1e308, 0, 1)])
def test_a_region_without_area_is_refused(bounds: tuple[float, float, float, float]) -> None:
    with pytest.raises(ParameterError):
        Region(*bounds)


def test_the_region_of_points_in_one_place_is_refused() -> None:
    with pytest.raises(PointsError, match="span no area"):
        Region.of([[1.0, 2.0, 3.0]] * 5)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (np.empty((0, 3)), "empty"),
        (np.zeros((4, 2)), r"\(n, 3\)"),
        ([[0.0, 0.0, np.nan]], "1 of 3 values are NaN or infinite"),
        ([["a", "b", "c"]], "numbers"),
    ],
)
def test_points_that_are_none_are_refused(points: object, message: str) -> None:
    with pytest.raises(PointsError, match=message):
        FeatureSet(points, SQUARE)  # type: ignore[arg-type]


def test_a_feature_set_does_not_follow_the_array_it_was_made_from() -> None:
    source = np.zeros((3, 3))
    features = FeatureSet(source, SQUARE)
    source[:] = 7.0
    assert not features.points.any()
    with pytest.raises(ValueError, match="read-only"):
        features.points[0, 0] = 1.0


def test_the_nodes_of_a_region_lie_on_its_edges_or_in_the_middle_of_its_cells() -> None:
    region = Region(0.0, 3.0, 0.0, 1.0)
    for centred, x, y in (
        (False, [0.0, 1.0, 2.0, 3.0], [0.0, 1.0]),
        (True, [0.375, 1.125, 1.875, 2.625], [0.25, 0.75]),
    ):
        for found, expected in zip(region.axes((2, 4), centred=centred), (x, y), strict=True):
            np.testing.assert_array_equal(found, expected)


def test_grid_rows_run_along_y() -> None:
    x, y = Region(0.0, 3.0, 0.0, 1.0).axes((2, 4))
    grid = HeightGrid(x, y, 10 * y[:, None] + x[None, :])
    assert grid.shape == (2, 4)
    assert grid.z[1, 3] == 13.0
    assert grid.region == Region(0.0, 3.0, 0.0, 1.0)
    np.testing.assert_array_equal(grid.points()[5], [1.0, 1.0, 11.0])


@pytest.mark.parametrize(
    ("x", "y", "z"),
    [
        ([0, 1], [0, 1], np.zeros((2, 3))),
        ([1, 0], [0, 1], np.zeros((2, 2))),
        ([0, 0], [0, 1], np.zeros((2, 2))),
        ([0, 1], [0, 1], np.full((2, 2), np.inf)),
    ],
)
def test_a_grid_that_does_not_fit_is_refused(x: list[float], y: list[float], z: np.ndarray) -> None:
    with pytest.raises(PointsError):
        HeightGrid(x, y, z)  # type: ignore[arg-type]


def test_an_unknown_unit_lists_the_known_ones() -> None:
    with pytest.raises(ParameterError, match=r"'furlong'.*'m'"):
        Units(xy="furlong")  # type: ignore[arg-type]
