from __future__ import annotations

import io
from typing import Any, get_args

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.figure import Figure
from PIL import Image

from common.surface import HeightGrid, Units
from receiver.picture import Palette, Style, picture, relief

X, Y = np.linspace(0, 2, 40), np.linspace(0, 1, 20)


def surface(z: np.ndarray) -> HeightGrid:
    return HeightGrid(X, Y, np.broadcast_to(z, (20, 40)), Units("m", "m"))


def luminance(pixels: np.ndarray) -> np.ndarray:
    linear = (pixels / 255.0) ** 2.2
    return np.asarray(linear @ np.array([0.2126, 0.7152, 0.0722]))


def opened(data: bytes) -> Image.Image:
    return Image.open(io.BytesIO(data))


@pytest.mark.parametrize("palette", get_args(Palette))
def test_without_shading_brighter_is_higher_in_every_palette(palette: Palette) -> None:
    pixels = relief(surface(X), Style(palette, shading=False))
    row = luminance(pixels)[0]
    assert np.all(np.diff(row) > -1e-3)
    assert row[-1] - row[0] > 0.3
    assert np.all(pixels == pixels[0])


def test_the_first_row_is_the_greatest_y() -> None:
    pixels = luminance(relief(surface(Y[:, None]), Style("gray", shading=False)))
    assert np.all(pixels[0] > pixels[-1])


def test_light_comes_from_the_upper_left() -> None:
    cone = surface(-np.hypot(X - 1, Y[:, None] - 0.5))
    plain, lit = (luminance(relief(cone, Style("gray", shading))) for shading in (False, True))
    change = lit - plain
    assert change[3, 13] > 0 > change[-4, -14]


@pytest.mark.parametrize("palette", get_args(Palette))
def test_no_slope_is_so_dark_that_it_reads_as_a_hole(palette: Palette) -> None:
    spike = surface(np.exp(-((X - 1) ** 2 + (Y[:, None] - 0.5) ** 2) / 0.01))
    plain, lit = (relief(spike, Style(palette, shading)).astype(float) for shading in (False, True))
    assert np.all(lit >= 0.55 * plain - 1)
    assert np.any(lit < 0.7 * plain - 1)


def test_level_ground_keeps_its_colour() -> None:
    step = np.where(X < 1, 0.0, 1.0)
    pixels = relief(surface(step), Style("viridis"))
    expected = np.array(colormaps["viridis"]([0.0, 1.0]))[:, :3] * 255
    np.testing.assert_allclose(pixels[10, 2], expected[0], atol=1)
    np.testing.assert_allclose(pixels[10, -3], expected[1], atol=1)


def test_the_unit_of_height_makes_no_difference() -> None:
    z = np.sin(3 * X) * np.cos(4 * Y[:, None])
    np.testing.assert_allclose(
        relief(surface(z), Style()).astype(int), relief(surface(1e6 * z + 1e9), Style()).astype(int), atol=2
    )


def test_every_setting_changes_the_picture() -> None:
    grid = surface(np.sin(3 * X) * np.cos(4 * Y[:, None]))
    styles = [Style(), Style("magma"), Style(shading=False), Style(colorbar=False)]
    assert len({picture(grid, "hills", style) for style in styles}) == len(styles)
    assert picture(grid, "dales", Style()) != picture(grid, "hills", Style())


@pytest.mark.parametrize("colorbar", [True, False])
@pytest.mark.parametrize(
    "z",
    [
        np.zeros((20, 1)),
        np.full((20, 1), 1e300),
        np.full((20, 1), -1e-300),
        np.where(X < 1, 0.0, 1e-300),
        np.where(X < 1, -1e300, 1e300),
        1e9 + 1e-7 * X,
    ],
)
def test_odd_heights_give_a_picture(z: np.ndarray, colorbar: bool) -> None:
    image = opened(picture(surface(z), "odd", Style(colorbar=colorbar)))
    assert image.size == ((1_000, image.height) if colorbar else (40, 20))


def test_a_name_is_no_markup() -> None:
    picture(surface(X), r"$\frac{1}$_^", Style())


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """What is saved from now on."""
    kept: list[Figure] = []
    save = Figure.savefig

    def keep(figure: Figure, *arguments: Any, **options: Any) -> None:
        kept.append(figure)
        save(figure, *arguments, **options)

    monkeypatch.setattr(Figure, "savefig", keep)
    return kept


def test_survey_coordinates_are_written_in_full_and_within_the_picture(figures: list[Figure]) -> None:
    survey = HeightGrid(500_000 + 2 * X, 4_100_000 + 3 * Y, 1_200 + 0.1 * np.sin(3 * X) * np.cos(4 * Y[:, None]))
    pixels = np.asarray(opened(picture(survey, "plot", Style())))
    assert np.all(pixels[:, [0, -1], :3] == 255)
    axes, bar = figures[0].axes
    for axis, low, high in (
        (axes.xaxis, 500_000, 500_004),
        (axes.yaxis, 4_100_000, 4_100_003),
        (bar.yaxis, 1199, 1201),
    ):
        assert axis.get_offset_text().get_text() == ""
        labels = [float(label.get_text()) for label in axis.get_ticklabels()]
        assert len(labels) >= 3
        assert all(low <= label <= high for label in labels)


def test_a_node_is_drawn_where_it_lies(figures: list[Figure]) -> None:
    plane = HeightGrid(np.array([0.0, 2.0]), np.array([5.0, 6.0]), np.array([[0.0, 1.0], [0.0, 1.0]]))
    pixels = np.asarray(opened(picture(plane, "plane", Style("gray", shading=False))))[:, :, 0]
    axes = figures[0].axes[0]
    assert (axes.get_xlim(), axes.get_ylim()) == ((0, 2), (5, 6))
    box = axes.get_window_extent()
    for share in (0.05, 0.15, 0.35, 0.65, 0.85, 0.95):  # off the contour lines
        drawn = pixels[pixels.shape[0] - round(box.y0 + box.height / 2), round(box.x0 + share * box.width)]
        assert abs(int(drawn) - 255 * share) < 4, share
