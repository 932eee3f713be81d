"""Pictures of surfaces: shaded relief with contours, on one scale of heights throughout a figure."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LightSource, Normalize, TwoSlopeNorm
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import MaxNLocator

from common.metrics import nrmse
from common.surface import FloatArray, HeightGrid
from simulator.demo import Exhibit
from simulator.folder import write_whole

HEIGHTS = "viridis"
ERRORS = "RdBu_r"
INK = "#1b1b1b"
MARK = "#d6006c"
"""A hue that viridis does not contain, for points drawn on it."""

RELIEF = 0.30
"""The range of heights is drawn as this share of the region's extent: steep enough to shade, for hills and plains."""

SMOOTH_CELLS = 40_000
"""Contours are drawn on grids up to this size; on a large grid of real terrain they would hide it."""

FEW = 500
"""Up to so many feature points each is marked, and the centres with them."""


def relief(ax: Axes, grid: HeightGrid, z: FloatArray, norm: Normalize) -> None:
    """Draw heights `z`, shape of `grid`, as shaded relief."""
    region = grid.region
    extent = max(region.width, region.height)
    span = float(norm.vmax or 0) - float(norm.vmin or 0) or 1.0
    colours = LightSource(azdeg=315, altdeg=50).shade(
        np.asarray(z),
        cmap=colormaps[HEIGHTS],
        norm=norm,
        blend_mode="soft",
        vert_exag=RELIEF * extent / span,
        dx=region.width / max(1, grid.shape[1] - 1),
        dy=region.height / max(1, grid.shape[0] - 1),
    )
    ax.imshow(colours, origin="lower", extent=region.bounds, interpolation="bilinear", aspect="equal")
    if grid.z.size > SMOOTH_CELLS:
        return
    levels = MaxNLocator(9).tick_values(float(norm.vmin or 0), float(norm.vmax or 0))
    ax.contour(grid.x, grid.y, z, levels=levels, colors="white", linestyles="solid", linewidths=0.5, alpha=0.55)


def exhibit_picture(exhibit: Exhibit) -> Figure:
    """Original, features and centres, network clean and noisy, traditional noisy, error map."""
    truth, surface = exhibit.truth, exhibit.surface
    norm = Normalize(float(truth.z.min()), float(truth.z.max()))
    figure = Figure(figsize=(12.6, 8.6), layout=ConstrainedLayoutEngine(h_pad=0.07), facecolor="white")
    axes = figure.subplots(2, 3, sharex=True, sharey=True)
    figure.suptitle(f"{surface.name}:  {surface.title}", fontsize=15, fontweight="bold", color=INK)

    relief(axes[0, 0], truth, truth.z, norm)
    _title(axes[0, 0], "Original", f"cloud of {surface.points:,} points")

    _features(axes[0, 1], exhibit, norm)
    _title(
        axes[0, 1],
        "Feature points and centres" if _few(exhibit) else "Feature points",
        f"{len(exhibit.clean.features):,} points, {exhibit.clean.sent_bytes:,} bytes on the air",
    )

    for ax, name, arrived, z in (
        (axes[0, 2], "Network, clean channel", exhibit.clean, exhibit.clean.grid.z),
        (axes[1, 0], "Network, noisy channel", exhibit.noisy, exhibit.noisy.grid.z),
        (axes[1, 1], "Traditional (cubic), noisy channel", exhibit.noisy, exhibit.noisy.cubic),
    ):
        relief(ax, arrived.grid, z, norm)
        _title(ax, name, f"NRMSE {nrmse(truth.z, z):.4f}")

    error = exhibit.noisy.grid.z - truth.z
    bound = float(np.quantile(np.abs(error), 0.995)) or 1.0
    shown = axes[1, 2].imshow(
        error,
        origin="lower",
        extent=truth.region.bounds,
        cmap=ERRORS,
        norm=TwoSlopeNorm(0.0, -bound, bound),
        interpolation="bilinear",
    )
    _title(axes[1, 2], "Error of the network, noisy channel", "reconstruction minus original")

    unit = f" ({surface.units.z})" if surface.units.z else ""
    heights = figure.colorbar(ScalarMappable(norm, HEIGHTS), ax=axes[:, :2], shrink=0.5, pad=0.015, location="left")
    heights.set_label(f"height z{unit}")
    errors = figure.colorbar(shown, ax=axes[:, 2], shrink=0.4, anchor=(0.0, 0.04), pad=0.03, extend="both")
    errors.set_label(f"error{unit}")
    for ax in axes.flat:
        ax.tick_params(labelsize=8, colors=INK)
        ax.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
        ax.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 2.5, 5, 10]))
    for ax in axes[1]:
        ax.set_xlabel(f"x{f' ({surface.units.xy})' if surface.units.xy else ''}")
    for ax in axes[:, 0]:
        ax.set_ylabel(f"y{f' ({surface.units.xy})' if surface.units.xy else ''}")
    rings = "   ·   rings: centres of the network" if _few(exhibit) else ""
    figure.supxlabel(
        f"noisy channel: {exhibit.noisy.channel}   ·   dots: feature points{rings}",
        fontsize=8,
        color="#555555",
    )
    return figure


def write_pictures(exhibits: Iterable[Exhibit], folder: Path) -> list[Path]:
    """One picture a surface, as PNG, into a folder that is there; the paths."""
    paths = []
    for exhibit in exhibits:
        buffer = io.BytesIO()
        exhibit_picture(exhibit).savefig(buffer, format="png", dpi=140)
        paths.append(write_whole(folder / f"{exhibit.surface.name}.png", buffer.getvalue()))
    return paths


def _few(exhibit: Exhibit) -> bool:
    return len(exhibit.clean.features) <= FEW


def _features(ax: Axes, exhibit: Exhibit, norm: Normalize) -> None:
    relief(ax, exhibit.truth, exhibit.truth.z, norm)
    few = _few(exhibit)
    size = 22.0 if few else 1.2
    points = exhibit.clean.features
    ax.scatter(points[:, 0], points[:, 1], s=size, c="white", edgecolors=INK, linewidths=0.7 if few else 0.0, zorder=3)
    if few:
        centers = exhibit.clean.centers
        ax.scatter(centers[:, 0], centers[:, 1], s=70, facecolors="none", edgecolors=MARK, linewidths=0.9, zorder=2)
    if exhibit.surface.gap * 40 > exhibit.truth.region.width:
        region, gap = exhibit.truth.region, exhibit.surface.gap
        for x in np.arange(region.x_min + gap, region.x_max - gap / 2, gap):
            ax.axvline(x, color="white", linewidth=0.6, alpha=0.5)
        for y in np.arange(region.y_min + gap, region.y_max - gap / 2, gap):
            ax.axhline(y, color="white", linewidth=0.6, alpha=0.5)
    ax.set_xlim(exhibit.truth.region.x_min, exhibit.truth.region.x_max)
    ax.set_ylim(exhibit.truth.region.y_min, exhibit.truth.region.y_max)


def _title(ax: Axes, name: str, detail: str) -> None:
    ax.set_title(f"{name}\n", fontsize=11, color=INK, fontweight="bold", pad=6)
    ax.text(0.5, 1.015, detail, transform=ax.transAxes, ha="center", va="bottom", fontsize=9, color="#555555")
