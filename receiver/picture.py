"""A height grid as a picture that reads as a landscape: a perceptual colour for the height, light for the slope."""

from __future__ import annotations

import io
import threading
from dataclasses import dataclass
from typing import Literal, TypeAlias

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from PIL import Image

from common.surface import FloatArray, HeightGrid

Palette: TypeAlias = Literal["viridis", "cividis", "magma", "inferno", "plasma", "gray"]
"""Colour maps whose steps look as large as they are, from low to high."""

SUN = (-0.5, 0.5, float(np.sqrt(0.5)))
"""Direction of the light: from the upper left, where readers of maps expect it, at 45 degrees."""

STEEP_PERCENTILE, STEEP = 95.0, 0.7
"""This percentile of the slopes is drawn as this slope, so that any unit of height gives a readable relief."""

SHADE, GLOW = 0.75, 0.5
"""How much gentle slopes that turn away from the light darken, and those that face it lighten."""

DARKEST = 0.45
"""Share of its colour that no slope loses more of: black is in no colour bar, and reads as a hole."""

LEVELS = 10
"""Contour lines, about."""

WIDTH, DPI = 8.0, 125
"""Size of a framed picture: inches, and pixels of one; 1,000 pixels across."""

MARGINS = (0.85, 1.25, 0.62, 0.45)
"""Inches left, right, below and above the map; more at the sides where numbers are long."""

EDGE = 0.08
"""Inches that stay free at the sides."""

_drawing = threading.Lock()  # matplotlib's text layout keeps caches that are not for threads

Pixels: TypeAlias = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Style:
    """How a picture looks: colours, whether slopes are shaded, and a frame with axes and colour bar around it."""

    palette: Palette = "viridis"
    shading: bool = True
    colorbar: bool = True


def _light(heights: FloatArray, step_x: float, step_y: float) -> FloatArray:
    """Light on a relief, 1 on level ground; `heights` with the first row at the greatest y."""
    along_y, along_x = np.gradient(heights, -step_y, step_x)
    steep = float(np.percentile(np.hypot(along_x, along_y), STEEP_PERCENTILE))
    if steep == 0:
        return np.ones_like(heights)
    slope_x, slope_y = along_x * (STEEP / steep), along_y * (STEEP / steep)
    toward = SUN[2] - SUN[0] * slope_x - SUN[1] * slope_y
    return np.asarray(np.maximum(toward, 0) / np.sqrt(1 + slope_x**2 + slope_y**2) / SUN[2])


def relief(grid: HeightGrid, style: Style) -> Pixels:
    """One pixel a node, shape (rows, columns, 3), the first row at the greatest y.

    Level ground has exactly the colour that its height has in the palette; slopes are lighter or darker.
    """
    z = grid.z[::-1]
    low, high = float(z.min()), float(z.max())
    scaled = np.full(z.shape, 0.5) if low == high else (z - low) / (high - low)
    colors: FloatArray = mpl.colormaps[style.palette](scaled)[:, :, :3]
    if style.shading and min(z.shape) > 1:
        step_x, step_y = float(np.ptp(grid.x)) / (grid.x.size - 1), float(np.ptp(grid.y)) / (grid.y.size - 1)
        light = _light(scaled, step_x, step_y)[:, :, None]
        darker = colors * (1 - DARKEST * np.tanh(SHADE / DARKEST * (1 - light)))
        lighter = colors + (1 - colors) * (GLOW * (light - 1))
        colors = np.where(light < 1, darker, lighter)
    return (np.clip(colors, 0, 1) * 255 + 0.5).astype(np.uint8)


def write_png(pixels: Pixels) -> bytes:
    """Pixels (rows, columns, 3) as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()


def _with_unit(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name


def _plain(axes: Axes) -> None:
    """No frame, quiet ticks, and numbers in full: survey coordinates are far from the origin."""
    axes.ticklabel_format(useOffset=False, scilimits=(-4, 9))
    axes.yaxis.get_offset_text().set_horizontalalignment("right")  # not across the title
    axes.tick_params(length=3, color="0.6", labelcolor="0.25", labelsize=9)
    for spine in axes.spines.values():
        spine.set_visible(False)


def framed(grid: HeightGrid, name: str, style: Style, quantity: str = "height") -> bytes:
    """The relief with axes, contour lines, title and a colour bar of the `quantity`, as PNG."""
    region, units = grid.region, grid.units
    low, high = float(grid.z.min()), float(grid.z.max())
    left, right, below, above = MARGINS
    width = WIDTH - left - right
    height = width * float(np.clip(region.height / region.width, 0.25, 2.0))
    total = height + below + above
    with _drawing:
        figure = Figure(figsize=(WIDTH, total), dpi=DPI)
        axes = figure.add_axes((left / WIDTH, below / total, width / WIDTH, height / total))
        # A pixel is a node: those at the edge stand on it, and half of each is beyond.
        over_x, over_y = region.width / (grid.x.size - 1) / 2, region.height / (grid.y.size - 1) / 2
        extent = (region.x_min - over_x, region.x_max + over_x, region.y_min - over_y, region.y_max + over_y)
        axes.imshow(relief(grid, style), extent=extent, aspect="auto", interpolation="bilinear")
        axes.set(xlim=region.bounds[:2], ylim=region.bounds[2:])
        if low < high:
            levels = MaxNLocator(LEVELS).tick_values(low, high)
            axes.contour(
                grid.x, grid.y, grid.z, levels=levels, colors="black", linestyles="solid", linewidths=0.5, alpha=0.25
            )
        title = figure.text(
            left / WIDTH,
            1 - 0.3 / total,
            name,
            fontsize=12,
            fontweight="bold",
            parse_math=False,
        )
        axes.set_xlabel(_with_unit("x", units.xy), color="0.25")
        axes.set_ylabel(_with_unit("y", units.xy), color="0.25")
        _plain(axes)
        bar = figure.add_axes(((WIDTH - right + 0.18) / WIDTH, below / total, 0.2 / WIDTH, height / total))
        span = Normalize(low, high) if low < high else Normalize(low - 0.5, high + 0.5)
        figure.colorbar(mpl.cm.ScalarMappable(span, style.palette), cax=bar)
        bar.set_ylabel(_with_unit(quantity, units.z), color="0.25")
        _plain(bar)
        buffer = io.BytesIO()
        FigureCanvasAgg(figure)
        shift = max(0.0, EDGE - (axes.get_tightbbox() or axes.bbox).x0 / DPI)
        cut = max(0.0, EDGE - WIDTH + (bar.get_tightbbox() or bar.bbox).x1 / DPI)
        title.set_x((left + shift) / WIDTH)
        axes.set_position(((left + shift) / WIDTH, below / total, (width - shift - cut) / WIDTH, height / total))
        bar.set_position(((WIDTH - right - cut + 0.18) / WIDTH, below / total, 0.2 / WIDTH, height / total))
        figure.savefig(buffer, format="png", metadata={"Software": "surfacelink"})
    return buffer.getvalue()


def picture(grid: HeightGrid, name: str, style: Style, quantity: str = "height") -> bytes:
    """The grid as PNG: framed, or one pixel a node where the style wants no colour bar."""
    return framed(grid, name, style, quantity) if style.colorbar else write_png(relief(grid, style))
