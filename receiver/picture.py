"""A height grid as a picture that reads as a landscape: a perceptual colour for the height, light for the slope."""

from __future__ import annotations

import io
import threading
from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LightSource, Normalize
from matplotlib.figure import Figure
from PIL import Image

from common.surface import FloatArray, HeightGrid

Palette: TypeAlias = Literal["viridis", "cividis", "magma", "inferno", "plasma", "gray"]
"""Colour maps whose steps look as large as they are, from low to high."""

PALETTES: tuple[Palette, ...] = get_args(Palette)

SUN = LightSource(azdeg=315, altdeg=45)
"""From the upper left, where readers of maps expect the light."""

STEEP = 95.0
"""The percentile of slopes that is drawn as 45 degrees, so that any unit of height gives a readable relief."""

WIDTH_INCHES, DPI = 8.0, 125
"""Size of a framed picture: 1,000 pixels across."""

_drawing = threading.Lock()  # matplotlib's text layout keeps caches that are not for threads

Pixels: TypeAlias = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Style:
    """How a picture looks: colours, whether slopes are shaded, and a frame with axes and colour bar around it."""

    palette: Palette = "viridis"
    shading: bool = True
    colorbar: bool = True


def relief(grid: HeightGrid, style: Style) -> Pixels:
    """One pixel a node, shape (rows, columns, 3), the first row at the greatest y."""
    z = grid.z[::-1]
    low, high = float(z.min()), float(z.max())
    scaled = np.full(z.shape, 0.5) if low == high else (z - low) / (high - low)
    colors: FloatArray = mpl.colormaps[style.palette](scaled)[:, :, :3]
    if style.shading and min(z.shape) > 1 and low < high:
        step_x, step_y = float(np.ptp(grid.x)) / (grid.x.size - 1), float(np.ptp(grid.y)) / (grid.y.size - 1)
        along_y, along_x = np.gradient(scaled, step_y, step_x)
        steep = float(np.percentile(np.hypot(along_x, along_y), STEEP))
        if steep > 0:
            colors = SUN.shade_rgb(
                colors, scaled, blend_mode="soft", vert_exag=1 / steep, dx=step_x, dy=step_y, fraction=1.1
            )
    return (np.clip(colors, 0, 1) * 255 + 0.5).astype(np.uint8)


def write_png(pixels: Pixels) -> bytes:
    """Pixels (rows, columns, 3) as PNG."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, format="PNG")
    return buffer.getvalue()


def _with_unit(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name


def framed(grid: HeightGrid, name: str, style: Style) -> bytes:
    """The relief with axes, title and colour bar, as PNG."""
    region, units = grid.region, grid.units
    low, high = float(grid.z.min()), float(grid.z.max())
    aspect = float(np.clip(region.height / region.width, 0.3, 3.0))
    with _drawing:
        figure = Figure(figsize=(WIDTH_INCHES, WIDTH_INCHES * (0.8 * aspect + 0.14)), dpi=DPI, layout="constrained")
        axes = figure.add_subplot()
        axes.imshow(
            relief(grid, style),
            extent=region.bounds,
            aspect="equal" if aspect == region.height / region.width else "auto",
            interpolation="bilinear",
        )
        axes.set_title(name, loc="left", fontweight="bold", parse_math=False)
        axes.set_xlabel(_with_unit("x", units.xy))
        axes.set_ylabel(_with_unit("y", units.xy))
        axes.tick_params(direction="out", length=3, color="0.5")
        for spine in axes.spines.values():
            spine.set_visible(False)
        span = Normalize(low, high) if low < high else Normalize(low - 0.5, high + 0.5)
        bar = figure.colorbar(
            mpl.cm.ScalarMappable(span, style.palette), ax=axes, label=_with_unit("height", units.z), pad=0.02
        )
        bar.outline.set_visible(False)
        bar.ax.tick_params(length=3, color="0.5")
        buffer = io.BytesIO()
        FigureCanvasAgg(figure)
        figure.savefig(buffer, format="png", metadata={"Software": "surfacelink"})
    return buffer.getvalue()


def picture(grid: HeightGrid, name: str, style: Style) -> bytes:
    """The grid as PNG: framed, or one pixel a node where the style wants no colour bar."""
    return framed(grid, name, style) if style.colorbar else write_png(relief(grid, style))
