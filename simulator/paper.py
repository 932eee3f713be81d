"""The paper's figures 2, 3 and 4, panel by panel, and the table that the paper does not print.

Source: Khanna, Rajpal, Dureja, Arora, "Surface Reconstruction using Feature based Approach with Radial Basis Function
Neural Network". The claims below are worded here, after the paper's abstract and its section "Analysis of results";
they are not quotations.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, TypeAlias

import matplotlib as mpl
import numpy as np
import typer
from matplotlib.figure import Figure
from rich.console import Console

from common.channel import Channel
from common.metrics import nrmse
from common.surface import FeatureSet, FloatArray
from common.wire import WireOptions
from sender.features import extract_features, piece_of
from sender.surfaces import Surface, find_surface
from simulator.campaign import Campaign, Trial
from simulator.folder import make_folder, write_whole
from simulator.methods import NETWORK, ON_CLOUD, parse_method
from simulator.page import STYLE, TableCell, data_script, page, png, table
from simulator.progress import progress_bar
from simulator.runner import Progress, Result, Row, Run, silent
from simulator.statistics import Quartiles, group, text
from simulator.trial import direct, run_trial

OURS = NETWORK
PRINTED = "network[spread=0.3,smoothing=0]"
LITERAL = "network[mapping=autoassociative]"
TRADITIONAL = "cubic"

METHODS: Mapping[str, str] = MappingProxyType(
    {
        OURS: "network, our settings",
        PRINTED: "network, printed settings",
        LITERAL: "network, point to point",
        "cubic": "cubic",
        "linear": "linear",
        "thin_plate": "thin plate",
        "cubic@cloud": "cubic, dense cloud",
        "network@cloud": "network, dense cloud",
    }
)
"""Method -> name on the page."""

NOISES: Mapping[str, tuple[str, str]] = MappingProxyType(
    {
        "clean": ("clean", ""),
        "z": ("noise in z", "gaussian:std={noise},axes=z"),
        "xyz": ("noise in x, y, z", "gaussian:std={noise},axes=xyz"),
        "uniform": ("uniform noise in x, y, z", "uniform:amplitude={noise},axes=xyz"),
    }
)
"""Axis -> (name on the page, channel). The paper says "noise of amplitude 0.1" and no more: all are readings of it."""


@dataclass(frozen=True)
class PaperFigure:
    """A figure of the paper: its number and the readings of its formula, the one it must mean first."""

    number: int
    readings: tuple[str, ...]


FIGURES = (
    PaperFigure(2, ("surface-1", "surface-1-printed")),
    PaperFigure(3, ("surface-2",)),
    PaperFigure(4, ("surface-3", "surface-3-squared")),
)

READINGS = tuple(reading for figure in FIGURES for reading in figure.readings)

PanelKind: TypeAlias = Literal["surface", "points", "plan"]

Limits: TypeAlias = tuple[float, float]
"""Least and greatest height drawn."""


@dataclass(frozen=True)
class Panel:
    """One panel: a surface (heights, shape (rows, columns)), points (n, 3) in space, or their xy projection."""

    letter: str
    title: str
    kind: PanelKind
    data: FloatArray
    error: str = ""


# The panels

SEED = 0
"""Of the cloud, the noise and the methods in the panels."""


def panels(surface: Surface, *, shape: tuple[int, int] = (42, 42)) -> list[Panel]:
    """The panels of one figure, lettered as in the paper; f* and i* are ours: the printed settings."""
    truth = surface.grid(shape)
    cloud = surface.sample(np.random.default_rng(SEED))
    clean = extract_features(cloud, gap=surface.gap, region=surface.region)
    options = WireOptions(precision="float64")
    channel = Channel.parse(NOISES["xyz"][1].format(noise=surface.noise), seed=SEED)
    noisy = direct(clean, transmission=f"paper-{surface.name}", channel=channel, options=options).features
    if noisy is None:  # a channel of noise alone loses nothing
        raise RuntimeError("the noise channel lost the features")

    def grown(method: str, features: FeatureSet) -> tuple[FloatArray, str]:
        z = parse_method(method).heights(features, truth, np.random.default_rng(SEED))
        return z, f"NRMSE {nrmse(truth.z, z):.4f}"

    low, high = _extrema(clean, surface)
    return [
        Panel("a", "original surface", "surface", truth.z),
        Panel("b", f"scattered points, {len(cloud)}", "points", cloud),
        Panel("c", f"xy projection, gap {surface.gap:g}", "plan", cloud),
        Panel("d", f"minima, one a piece, {len(low)}", "points", low),
        Panel("e", f"maxima, one a piece, {len(high)}", "points", high),
        Panel("f", "network, clean features", "surface", *grown(OURS, clean)),
        Panel("f*", "the same, printed settings", "surface", *grown(PRINTED, clean)),
        Panel("g", f"noisy features, {len(noisy)}", "points", noisy.points),
        Panel("h", "traditional, noisy features", "surface", *grown(TRADITIONAL, noisy)),
        Panel("i", "network, noisy features", "surface", *grown(OURS, noisy)),
        Panel("i*", "the same, printed settings", "surface", *grown(PRINTED, noisy)),
        Panel("j", "traditional, clean features", "surface", *grown(TRADITIONAL, clean)),
    ]


def _extrema(features: FeatureSet, surface: Surface) -> tuple[FloatArray, FloatArray]:
    """Least and greatest of each piece; a piece of one point gives it to both."""
    _, first = np.unique(piece_of(features.points, surface.region, surface.gap), return_index=True)
    last = np.append(first[1:], len(features)) - 1
    return features.points[first], features.points[last]


def _limits(surface: Surface, of: Sequence[Panel]) -> Limits:
    """Heights drawn: those of the surface; near a pole, those of the points."""
    if surface.name == "surface-1-printed":
        heights = of[1].data[:, 2]
        return float(heights.min()), float(np.quantile(heights, 0.95))
    heights = of[0].data
    return float(heights.min()), float(heights.max())


def draw_panel(panel: Panel, surface: Surface, limits: Limits, figure: Figure, place: tuple[int, int, int]) -> None:
    """Draw one panel into a figure at `place` (rows, columns, index)."""
    x, y = surface.region.axes(panel.data.shape if panel.kind == "surface" else (2, 2))
    low, high = limits
    title = f"({panel.letter}) {panel.title}" + (f"\n{panel.error}" if panel.error else "")
    look: dict[str, Any] = {"cmap": "viridis", "vmin": low, "vmax": high, "edgecolors": "#1c2430"}
    if panel.kind == "plan":
        axes = figure.add_subplot(*place)
        axes.scatter(panel.data[:, 0], panel.data[:, 1], s=7, c=panel.data[:, 2], linewidths=0.2, **look)
        for ends, rule in ((x, axes.axvline), (y, axes.axhline)):
            for tick in np.arange(ends[0], ends[-1] + surface.gap / 2, surface.gap):
                rule(float(tick), color="#9aa5b1", linewidth=0.6)
        axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]), aspect="equal")
        axes.locator_params(nbins=4)
        axes.tick_params(labelsize=6.5)
        axes.grid(visible=False)
        axes.set_title(title, fontsize=8.5, loc="center")
        return
    space: Any = figure.add_subplot(*place, projection="3d")
    if panel.kind == "surface":
        heights = np.clip(panel.data, low - 0.35 * (high - low), high + 0.35 * (high - low))
        look["edgecolors"] = "#00000022"
        space.plot_surface(*np.meshgrid(x, y), heights, rcount=60, ccount=60, linewidth=0.1, **look)
    else:
        space.scatter(*panel.data.T, s=9, c=panel.data[:, 2], depthshade=False, linewidths=0.25, **look)
    space.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]), zlim=(low, high))
    space.view_init(elev=30, azim=-127)
    space.set_box_aspect((1, 1, 0.62))
    space.tick_params(labelsize=6, pad=-3)
    space.locator_params(nbins=4)
    space.set_title(title, fontsize=8.5, loc="center", pad=-2)


def draw_figure(surface: Surface, of: Sequence[Panel], heading: str) -> Figure:
    """All panels of a figure of the paper on one sheet."""
    with mpl.rc_context(STYLE | {"figure.constrained_layout.use": False}):
        figure = Figure(figsize=(11.2, 9.4))
        limits = _limits(surface, of)
        for k, panel in enumerate(of):
            draw_panel(panel, surface, limits, figure, (3, 4, k + 1))
        figure.suptitle(heading, fontsize=11, fontweight="bold", y=0.985)
        figure.subplots_adjust(left=0.03, right=0.97, top=0.92, bottom=0.04, wspace=0.18, hspace=0.22)
        for axes in figure.axes:
            if axes.name == "rectilinear":  # flat panels fill their place, those in space leave a margin
                box = axes.get_position()
                axes.set_position(
                    (box.x0 + 0.16 * box.width, box.y0 + 0.1 * box.height, 0.72 * box.width, 0.72 * box.height)
                )
    return figure


def draw_single(surface: Surface, panel: Panel, limits: Limits) -> Figure:
    """One panel on a sheet of its own."""
    with mpl.rc_context(STYLE | {"figure.constrained_layout.use": False}):
        figure = Figure(figsize=(3.4, 3.2))
        draw_panel(panel, surface, limits, figure, (1, 1, 1))
        figure.subplots_adjust(left=0.12, right=0.92, top=0.86, bottom=0.13)
    return figure


# The table


def trials(seeds: int, grid: tuple[int, int], readings: Sequence[str]) -> list[Trial]:
    """What the table needs: every reading under every noise, `seeds` samples of each."""
    from_features = [method for method in METHODS if not method.endswith(ON_CLOUD)]

    def plan(noises: Sequence[str], methods: Sequence[str]) -> list[Trial]:
        channels = [
            {"spec": NOISES[axis][1], "axis": axis} | ({"levels": [1.0]} if NOISES[axis][1] else {}) for axis in noises
        ]
        common = {"name": "paper", "wire": [{"precision": "float64"}], "seeds": seeds, "grid": list(grid)}
        campaign = {"surfaces": list(readings), "channels": channels, "methods": list(methods)}
        return Campaign.build(common | campaign).trials()

    # The dense cloud meets no noise: it is fitted once, beside the clean features.
    return plan(["clean"], list(METHODS)) + plan([axis for axis in NOISES if axis != "clean"], from_features)


@dataclass(frozen=True)
class Errors:
    """Medians and quartiles over the seeds: of the NRMSE, and of the greatest error in units of z."""

    nrmse: Quartiles
    greatest: Quartiles


Key: TypeAlias = tuple[str, str, str]
"""(surface, noise, method)."""


def summarise(rows: Sequence[Row]) -> dict[Key, Errors]:
    """The errors of every (surface, noise, method)."""
    cells = group(rows, lambda row: (text(row, "surface"), text(row, "axis"), text(row, "method")))
    return {
        key: Errors(Quartiles.of([row["nrmse"] for row in of]), Quartiles.of([row["max_error"] for row in of]))
        for key, of in cells.items()
    }


# The claims

ENOUGH = 0.05
"""An error of a twentieth of the range is read as "reconstructed": in a figure of the paper it is a line's width."""
COMPARABLE = 2.0
"""Two errors within this factor are read as comparable, and an error beyond it as degraded."""


@dataclass(frozen=True)
class Finding:
    """One claim on one surface: the numbers, and whether they bear it out."""

    surface: str
    numbers: str
    holds: bool


@dataclass(frozen=True)
class Claim:
    """A claim of the paper, how it is put to the test, and what came out with the printed settings and with ours."""

    statement: str
    test: str
    findings: Callable[[Mapping[Key, Errors], str], list[Finding]]
    settings: tuple[str, ...] = (PRINTED, OURS)


def _surfaces(errors: Mapping[Key, Errors]) -> list[str]:
    return [name for name in READINGS if (name, "clean", OURS) in errors]


def _enough(errors: Mapping[Key, Errors], method: str) -> list[Finding]:
    found = []
    for surface in _surfaces(errors):
        value = errors[surface, "clean", method].nrmse.median
        found.append(Finding(surface, f"{value:.4f}", value <= ENOUGH))
    return found


def _better(noise: str) -> Callable[[Mapping[Key, Errors], str], list[Finding]]:
    def findings(errors: Mapping[Key, Errors], network: str) -> list[Finding]:
        found = []
        for surface in _surfaces(errors):
            ours = errors[surface, noise, network].nrmse.median
            theirs = errors[surface, noise, TRADITIONAL].nrmse.median
            found.append(Finding(surface, f"{ours:.3f} against {theirs:.3f}", ours < theirs))
        return found

    return findings


def _comparable(errors: Mapping[Key, Errors], network: str) -> list[Finding]:
    found = []
    for surface in _surfaces(errors):
        ours = errors[surface, "clean", network].nrmse.median
        dense = errors[surface, "clean", f"{TRADITIONAL}{ON_CLOUD}"].nrmse.median
        found.append(Finding(surface, f"{ours:.4f} against {dense:.4f}", ours <= COMPARABLE * dense))
    return found


def _degrades(errors: Mapping[Key, Errors], method: str) -> list[Finding]:
    found = []
    for surface in _surfaces(errors):
        clean, noisy = (errors[surface, noise, method].nrmse.median for noise in ("clean", "xyz"))
        found.append(Finding(surface, f"{clean:.4f} to {noisy:.4f}", noisy >= COMPARABLE * clean))
    return found


CLAIMS = (
    Claim(
        "The feature points alone are enough to reconstruct the surface.",
        f"Median NRMSE of the network from clean features at most {ENOUGH:g}.",
        _enough,
    ),
    *(
        Claim(
            "From noisy feature points the network reconstructs better than traditional fitting does "
            f"({NOISES[noise][0]}).",
            "Median NRMSE of the network below that of cubic interpolation of the same noisy features.",
            _better(noise),
        )
        for noise in ("z", "xyz", "uniform")
    ),
    Claim(
        "The network from clean features is comparable with traditional fitting of the dense cloud.",
        f"Median NRMSE of the network at most {COMPARABLE:g} times that of cubic interpolation of the whole cloud.",
        _comparable,
    ),
    Claim(
        "Traditional fitting of the clean features is acceptable.",
        f"Median NRMSE of cubic interpolation of the clean features at most {ENOUGH:g}.",
        _enough,
        (TRADITIONAL,),
    ),
    Claim(
        "Traditional fitting degrades when the features are noisy.",
        f"Median NRMSE of cubic interpolation grows at least {COMPARABLE:g} times under noise in x, y and z.",
        _degrades,
        (TRADITIONAL,),
    ),
)


def verdict(findings: Sequence[Finding]) -> tuple[str, bool | None]:
    """In words, and True, False or None for confirmed, contradicted or neither, over the three surfaces.

    The readings of a formula that the paper cannot have meant, or need not, are shown but do not vote.
    """
    meant = {figure.readings[0] for figure in FIGURES}
    votes = [finding.holds for finding in findings if finding.surface in meant]
    if all(votes):
        return "confirmed", True
    if not any(votes):
        return "contradicted", False
    holding = [finding.surface for finding in findings if finding.surface in meant and finding.holds]
    return f"confirmed on {', '.join(holding)} only", None


# The page


def _claims_html(errors: Mapping[Key, Errors]) -> str:
    surfaces = _surfaces(errors)
    blocks = []
    for number, claim in enumerate(CLAIMS, 1):
        rows: list[list[TableCell | str]] = []
        for method in claim.settings:
            findings = claim.findings(errors, method)
            words, holds = verdict(findings)
            tone = {True: "yes", False: "no", None: ""}[holds]
            rows.append(
                [
                    METHODS[method],
                    TableCell(f'<span class="verdict {tone}">{escape(words)}</span>', "name"),
                    *(TableCell(escape(f.numbers), "yes" if f.holds else "no") for f in findings),
                ]
            )
        blocks.append(
            f"<h3>{number}. {escape(claim.statement)}</h3><p class='soft'>Test: {escape(claim.test)}</p>"
            + table(["", "verdict", *surfaces], rows)
        )
    return "\n".join(blocks)


def _errors_html(errors: Mapping[Key, Errors], surface: Surface, seeds: int) -> str:
    shown = [noise for noise in NOISES if (surface.name, noise, OURS) in errors]
    sent = [method for method in METHODS if not method.endswith(ON_CLOUD)]
    best = {noise: min(errors[surface.name, noise, method].nrmse.median for method in sent) for noise in shown}

    def cell(method: str, noise: str) -> TableCell:
        if method not in sent and noise != "clean":
            return TableCell("·")
        found = errors[surface.name, noise, method]
        top = "best" if method in sent and found.nrmse.median == best[noise] else ""
        return TableCell(f"{_quartiles(found.nrmse)}<br><small>max. {_quartiles(found.greatest)}</small>", top)

    rows: list[list[TableCell | str]] = [
        [name, *(cell(method, noise) for noise in shown)] for method, name in METHODS.items()
    ]
    caption = (
        f"NRMSE, and below it the maximum error in units of z: median over {seeds} seeds, quartiles in brackets. "
        "Lowest NRMSE from features in bold. The dense cloud is not sent, so it meets no noise."
    )
    return table(["", *(NOISES[noise][0] for noise in shown)], rows, caption=caption)


def _quartiles(value: Quartiles) -> str:
    if math.isinf(value.median):
        return f"fails ({value.failed} of {value.count})"
    return f"{_short(value.median)} <span class='soft'>({_short(value.low)} – {_short(value.high)})</span>"


def _short(value: float) -> str:
    if math.isinf(value):
        return "∞"
    return f"{value:.4f}" if abs(value) < 0.1 else f"{value:.3g}"


def _panel_html(panel: Panel, surface: Surface, limits: Limits) -> str:
    identifier = f"{surface.name}-{panel.letter.replace('*', '-printed')}"
    low, high = limits
    data: dict[str, object] = {"range": [*surface.region.bounds, low, high], "surface": None}
    if panel.kind == "surface":
        rows, columns = panel.data.shape
        data["surface"] = {"rows": rows, "columns": columns, "z": _rounded(panel.data.ravel())}
    else:
        data |= {"points": [_rounded(point) for point in panel.data], "flat": panel.kind == "plan"}
    error = f"<br><span class='soft'>{escape(panel.error)}</span>" if panel.error else ""
    return (
        f'<figure class="panel"><canvas tabindex="0" role="img" aria-label="{escape(panel.title, quote=True)}" '
        f'data-group="{surface.name}" data-source="{identifier}"></canvas>{data_script(identifier, data)}'
        f"<figcaption><b>({panel.letter})</b> {escape(panel.title)}{error}</figcaption></figure>"
    )


def _rounded(values: FloatArray) -> list[float]:
    return [float(f"{value:.4g}") for value in values]


def _reading_html(surface: Surface, of: Sequence[Panel], errors: Mapping[Key, Errors], seeds: int) -> str:
    limits = _limits(surface, of)
    controls = (
        f'<p class="controls"><label><input type="checkbox" data-link="{surface.name}" checked> turn all together'
        "</label>"
        f'<button type="button" data-reset="{surface.name}">reset</button>'
        "<span>Drag to turn; click, then wheel or + and - to zoom; arrow keys turn, 0 resets.</span></p>"
    )
    grid = "\n".join(_panel_html(panel, surface, limits) for panel in of)
    return f'{controls}<div class="panels">\n{grid}\n</div>\n{_errors_html(errors, surface, seeds)}'


def render(errors: Mapping[Key, Errors], drawn: Mapping[str, Sequence[Panel]], *, seeds: int, command: str) -> str:
    """The page, as HTML."""
    parts = [
        "<h1>The paper's figures 2, 3 and 4, regenerated</h1>",
        '<p class="lead">A surface is sampled, the least and the greatest point of each piece are kept and sent, noise '
        "harms them, and a network of Gaussian neurons grows the surface back. Every panel below can be turned; the "
        "tables give the errors that the paper does not print.</p>",
        "<p>Source of the method: Khanna, Rajpal, Dureja, Arora, “Surface Reconstruction using Feature based Approach "
        "with Radial Basis Function Neural Network”. <b>Printed settings</b>: spread 0.3, no smoothing. <b>Our "
        "settings</b>: spread and smoothing from the data. <b>Point to point</b>: the network as the paper draws it, "
        "(x, y, z) to (x, y, z), with spread and smoothing from the data. <b>Traditional</b> is piecewise cubic "
        "interpolation over triangles. <b>NRMSE</b>: RMSE over the range of the true heights on a regular grid.</p>",
        f"<pre>{escape(command)}</pre>",
        "<h2>Analysis of results, tested</h2>",
        "<p>Each claim is worded after the paper and put to a test that a number can fail. The verdict is over the "
        "three surfaces as the paper must mean them; the other readings of two formulas are shown beside them.</p>",
        _claims_html(errors),
    ]
    for figure in FIGURES:
        for reading in filter(drawn.__contains__, figure.readings):
            surface = find_surface(reading)
            other = "" if reading == figure.readings[0] else ", the other reading"
            parts += [
                f'<h2 id="{reading}">Figure {figure.number}{other}: {escape(surface.title)}</h2>',
                f"<p class='soft'>{surface.points} points, segment gap {surface.gap:g}, noise of deviation "
                f"{surface.noise:g} in x, y and z in panels g, h and i; * marks a panel the paper does not have.</p>",
                _reading_html(surface, drawn[reading], errors, seeds),
            ]
    return page("The paper, regenerated", "\n".join(parts), script="surface3d.js")


@dataclass(frozen=True)
class Regenerated:
    """What `regenerate` wrote, and the errors in it."""

    page: Path
    pictures: tuple[Path, ...]
    errors: Mapping[Key, Errors]


def regenerate(
    out: Path,
    *,
    seeds: int = 20,
    workers: int = 2,
    grid: tuple[int, int] = (64, 64),
    dpi: int = 140,
    readings: Sequence[str] = READINGS,
    progress: Progress = silent,
) -> Regenerated:
    """Write the page, a sheet for every reading and a picture for every panel into the folder `out`.

    Raises ParameterError where the folder cannot be made.
    """
    make_folder(out)
    plan = trials(seeds, grid, readings)
    results: list[Result] = Run(plan, run_trial, workers).collect(progress=progress)
    errors = summarise([row for result in results for row in result.rows])
    drawn: dict[str, list[Panel]] = {}
    pictures: list[Path] = []
    for figure in FIGURES:
        for reading in filter(readings.__contains__, figure.readings):
            surface = find_surface(reading)
            drawn[reading] = panels(surface)
            limits = _limits(surface, drawn[reading])
            stem = f"figure-{figure.number}" + ("" if reading == figure.readings[0] else f"-{reading}")
            sheet = draw_figure(surface, drawn[reading], f"Figure {figure.number}: {surface.title}")
            pictures.append(write_whole(out / f"{stem}.png", png(sheet, dpi=dpi)))
            for panel in drawn[reading]:
                name = f"{stem}-{panel.letter.replace('*', '-printed')}.png"
                pictures.append(write_whole(out / name, png(draw_single(surface, panel, limits), dpi=dpi)))
    command = f"simulate paper --seeds {seeds}"
    target = write_whole(out / "paper.html", render(errors, drawn, seeds=seeds, command=command))
    return Regenerated(target, tuple(pictures), errors)


def paper_command(
    out: Annotated[Path, typer.Option(help="Folder for the page and the pictures.")] = Path("surfacelink-paper"),
    seeds: Annotated[int, typer.Option(min=1, help="Samples of each surface; fewer are quicker.")] = 20,
    workers: Annotated[int | None, typer.Option(min=1, help="Worker processes; by default one a core.")] = None,
) -> None:
    """Regenerate the paper's figures 2, 3 and 4, and the table of errors that it does not print."""
    console = Console(stderr=True)
    with progress_bar(console, "paper") as progress:
        made = regenerate(out, seeds=seeds, workers=workers or os.cpu_count() or 1, progress=progress)
    for number, claim in enumerate(CLAIMS, 1):
        for method in claim.settings:
            words, _ = verdict(claim.findings(made.errors, method))
            console.print(f"{number}. {claim.statement} {METHODS[method]}: {words}", highlight=False)
    console.print(f"{made.page} and {len(made.pictures)} pictures", highlight=False, soft_wrap=True)
