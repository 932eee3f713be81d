"""`simulate rivals`: features against raster codecs at equal bytes on the air, through the same channels.

The codecs are given the ready raster, and the best setting that fits the bytes. The network is given the extrema of
pieces of the same nodes, in as many pieces as fit, or, since there is a raster, a lattice of points whose positions
are implied. Protection is paid for out of the same bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Literal, NamedTuple, TypeAlias

import matplotlib as mpl
import numpy as np
import typer
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.console import Console
from scipy.interpolate import RectBivariateSpline
from threadpoolctl import threadpool_limits

from common.channel import Channel
from common.errors import ParameterError, TrainingError
from common.metrics import nrmse
from common.surface import FeatureSet, FloatArray, HeightGrid
from common.wire import WireOptions, encode
from simulator.campaign import FeatureSettings
from simulator.choice import choose_features
from simulator.codecs import CODECS, Failure, Sandbox, best
from simulator.codecs.protection import PROTECTIONS
from simulator.codecs.survival import expose
from simulator.fields import field
from simulator.folder import make_folder, write_whole
from simulator.methods import NETWORK, parse_method
from simulator.page import STYLE, TableCell, illustration, line_style, page, png, svg, table
from simulator.progress import progress_bar
from simulator.runner import Progress, Row, silent
from simulator.statistics import Quartiles, group
from simulator.table import to_csv
from simulator.trial import direct


class Contest(NamedTuple):
    """What all rivals send: a field of `simulator.fields`, in so many bytes on the air, in datagrams of so many."""

    field: str
    budget: int
    datagram: int


CONTESTS = (Contest("elevation", 2048, 256), Contest("franke", 512, 64))
"""Rough terrain, where a transform codec is at home, and a smooth surface in a few small datagrams."""


class Axis(NamedTuple):
    """A kind of harm: its name on the page, the channel (``{level}`` stands for the level), the levels tried."""

    label: str
    channel: str
    levels: tuple[float, ...]


AXES: Mapping[str, Axis] = MappingProxyType(
    {
        "ber": Axis("bit-error rate", "bit_errors:ber={level}", (1e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2)),
        "loss": Axis("share of packets lost", "erasure:p={level}", (0.0, 0.05, 0.1, 0.2, 0.3, 0.5)),
    }
)

COLUMNS = ("field", "bytes", "rival", "axis", "level", "seed", "sent", "nrmse")
"""Of the table; an empty nrmse is no surface."""

TRANSMISSION = "rivals"
"""Of every rival: with a seed, the k-th datagram of each meets the same luck."""

NO_SURFACE = 1.0
"""Where a median that is a failure is drawn; the mean of the heights alone scores 0.13 to 0.24."""

PRECISION = 10
"""Bits of the height of a feature."""

BITS = (5, 6, 7, 8, 10)
"""Bits of a height of a lattice that are tried."""

SECONDS = 300.0
"""Longest training in a child process, on a machine that does other things."""

MEMORY = 4 << 30


@dataclass(frozen=True)
class Rival:
    """A way to send a field: points for the network, with or without protection, or a codec under a protection."""

    label: str
    points: Literal["extrema", "lattice"] | None = None
    protected: bool = False
    codec: str = ""
    protection: str = "none"

    def wire(self, datagram: int, precision: int) -> WireOptions:
        """How points are written: a third of the packets is parity, and half of the bytes of a small datagram."""
        inner: Literal[16, 32, 64] = 16 if datagram < 128 else 32
        return WireOptions(
            datagram=datagram,
            precision=precision,
            coding="compact",
            inner=inner if self.protected else 0,
            parity=0.34 if self.protected else 0.0,
        )


RIVALS: tuple[Rival, ...] = (
    Rival("features, network", points="extrema"),
    Rival("features protected, network", points="extrema", protected=True),
    Rival("lattice, network", points="lattice"),
    Rival("lattice protected, network", points="lattice", protected=True),
    Rival("scattered samples, spline", codec="scattered_samples"),
    Rival("JPEG 2000", codec="jpeg2000"),
    Rival("JPEG 2000, RS (255,223)", codec="jpeg2000", protection="rs223"),
    Rival("JPEG 2000, RS (255,127)", codec="jpeg2000", protection="rs127"),
    Rival("SPERR", codec="sperr"),
    Rival("SPERR, RS (255,223)", codec="sperr", protection="rs223"),
    Rival("SPERR, RS (255,127)", codec="sperr", protection="rs127"),
)


def run_rivals(
    out: Path,
    *,
    seeds: int,
    workers: int,
    contests: Sequence[Contest] = CONTESTS,
    rivals: Sequence[Rival] = RIVALS,
    progress: Progress = silent,
) -> list[Row]:
    """Run every rival in every contest; write ``rivals.csv``, ``rivals.html`` and a picture of each contest.

    Rows have `COLUMNS`: bytes are those allowed, sent those used, nrmse is None for no surface.
    Rivals whose package is not installed, or that cannot be written in the bytes allowed, are left out.
    """
    make_folder(out)
    entered = [rival for rival in rivals if rival.points or CODECS[rival.codec].available]
    total = len(contests) * len(entered) * sum(len(axis.levels) for axis in AXES.values())
    rows: list[Row] = []
    with Sandbox(workers=workers, seconds=SECONDS, memory=MEMORY) as box:
        done = 0
        for contest in contests:
            for rival in entered:
                run = _prepared(rival, contest, box)
                for name, axis in AXES.items():
                    for level in axis.levels:
                        if run is not None:
                            rows += _rows(rival, contest, name, level, seeds, run)
                        done += 1
                        progress(done, total)
    write_whole(out / "rivals.csv", to_csv(rows, COLUMNS))
    write_whole(out / "rivals.html", _page(rows, contests, seeds))
    for name, budget, _ in contests:
        write_whole(out / f"rivals-{name}.png", png(figure(rows, name, budget)))
    return rows


Run: TypeAlias = Callable[[Channel, Sequence[int]], tuple[int, Sequence[float | None]]]
"""(channel, seeds) -> bytes sent and the NRMSE of each seed."""


def _prepared(rival: Rival, contest: Contest, box: Sandbox) -> Run | None:
    """What sends the contest's field as the rival does; None where the bytes are too few for it."""
    try:
        return (_by_points if rival.points is not None else _by_codec)(rival, contest, box)
    except ParameterError:
        return None


def _by_points(rival: Rival, contest: Contest, box: Sandbox) -> Run:
    grid = field(contest.field)
    choose = _extrema if rival.points == "extrema" else _lattice
    features, options = choose(rival, grid, contest.budget, contest.datagram)
    sent = sum(map(len, encode(features, transmission=TRANSMISSION, options=options)))
    known: dict[bytes, float] = {}

    def run(channel: Channel, seeds: Sequence[int]) -> tuple[int, Sequence[float | None]]:
        arrivals = [_arrived(features, options, Channel(channel.impairments, seed)) for seed in seeds]
        # The same points arrive again and again: each set is trained on once.
        fresh = {points.tobytes(): points for points in arrivals if points is not None}
        calls = [(points, grid) for key, points in fresh.items() if key not in known]
        for call, error in zip(calls, box.map(network_error, calls), strict=True):
            if isinstance(error, Failure):
                raise TrainingError(f"a network on {contest.field} ended by {error.kind}: {error.detail}")
            known[call[0].tobytes()] = error
        return sent, [None if points is None else known[points.tobytes()] for points in arrivals]

    return run


def _by_codec(rival: Rival, contest: Contest, box: Sandbox) -> Run:
    z = field(contest.field).z
    message = best(rival.codec, z, PROTECTIONS[rival.protection].payload(contest.budget))

    def run(channel: Channel, seeds: Sequence[int]) -> tuple[int, Sequence[float | None]]:
        survival = expose(
            z,
            message,
            channel,
            seeds,
            transmission=TRANSMISSION,
            protection=rival.protection,
            datagram=contest.datagram,
            sandbox=box,
        )
        return survival.sent, survival.errors

    return run


def _extrema(rival: Rival, grid: HeightGrid, budget: int, datagram: int) -> tuple[FeatureSet, WireOptions]:
    """Extrema of the pieces of a grid, as many pieces as fit."""
    options = rival.wire(datagram, PRECISION)
    return choose_features(grid.points(), grid.region, FeatureSettings(budget=budget), options, None), options


def _lattice(rival: Rival, grid: HeightGrid, budget: int, datagram: int) -> tuple[FeatureSet, WireOptions]:
    """Heights at the nodes of a regular lattice, positions implied: of all that fit, the one a spline likes best.

    (A spline, because it is quick; the network that is trained on them afterwards has no say.)
    """
    found: list[tuple[float, FeatureSet, WireOptions]] = []
    for bits in BITS:
        options = rival.wire(datagram, bits)
        low, high = 1, min(grid.shape)
        while high - low > 1:
            side = (low + high) // 2
            packets = encode(_nodes(grid, side), transmission=TRANSMISSION, options=options)
            low, high = (side, high) if sum(map(len, packets)) <= budget else (low, side)
        if low >= 4:
            points = _nodes(grid, low)
            steps = 2**bits - 1
            heights = points.z.reshape(low, low)
            extent = float(np.ptp(heights)) or 1.0
            rounded = np.rint((heights - heights.min()) / extent * steps) / steps * extent + heights.min()
            x, y = grid.region.axes((low, low))
            error = nrmse(grid.z, RectBivariateSpline(y, x, rounded)(grid.y, grid.x))
            found.append((error, points, options))
    if not found:
        raise ParameterError(f"not even 4 x 4 nodes fit into {budget} bytes")
    _, points, options = min(found, key=lambda each: each[0])
    return points, options


def _nodes(grid: HeightGrid, side: int) -> FeatureSet:
    x, y = grid.region.axes((side, side))
    z = RectBivariateSpline(grid.y, grid.x, grid.z)(y, x)
    return FeatureSet(HeightGrid(x, y, z).points(), grid.region, None, "lattice", grid.units)


def _arrived(features: FeatureSet, options: WireOptions, channel: Channel) -> FloatArray | None:
    """The points that arrive, or None where they are no surface."""
    arrived = direct(features, transmission=TRANSMISSION, channel=channel, options=options).features
    return None if arrived is None or len(arrived) < 3 else arrived.points


def network_error(points: FloatArray, grid: HeightGrid) -> float:
    """NRMSE of the network trained on points (n, 3); held to one thread, as the workers share the machine's cores."""
    with threadpool_limits(1):
        z = parse_method(NETWORK).heights(FeatureSet(points, grid.region), grid, np.random.default_rng(0))
    return nrmse(grid.z, z)


def _rows(rival: Rival, contest: Contest, axis: str, level: float, seeds: int, run: Run) -> list[Row]:
    channel = Channel.parse(AXES[axis].channel.format(level=level))
    # A channel that does nothing does it for every seed.
    sent, errors = run(channel, range(seeds if level else 1))
    return [
        {
            "field": contest.field,
            "bytes": contest.budget,
            "rival": rival.label,
            "axis": axis,
            "level": level,
            "seed": seed,
            "sent": sent,
            "nrmse": error,
        }
        for seed, error in enumerate(errors)
    ]


def summarise(rows: Sequence[Row], name: str, axis: str) -> dict[str, dict[float, Quartiles]]:
    """Median and quartiles by rival and level."""
    chosen = [row for row in rows if row["field"] == name and row["axis"] == axis]
    return {
        rival: {
            level: Quartiles.of([row["nrmse"] for row in cell])
            for level, cell in group(part, lambda row: float(row["level"] or 0.0)).items()
        }
        for rival, part in group(chosen, lambda row: str(row["rival"])).items()
    }


def winners(found: Mapping[str, Mapping[float, Quartiles]]) -> dict[float, tuple[str, ...]]:
    """The rival with the least median at each level; all of them where several tie, as in a campaign's report, and none
    where none has a surface at least half of the time."""
    levels = sorted({level for cells in found.values() for level in cells})
    best_at: dict[float, tuple[str, ...]] = {}
    for level in levels:
        medians = {rival: cells[level].median for rival, cells in found.items() if level in cells}
        least = min(medians.values())
        best_at[level] = tuple(rival for rival, median in medians.items() if median == least < np.inf)
    return best_at


def verdict(found: Mapping[str, Mapping[float, Quartiles]], axis: str) -> str:
    """Who wins where, and how the best network fares there, in words."""
    runs: list[tuple[tuple[str, ...], list[float]]] = []
    for level, won in winners(found).items():
        if not runs or runs[-1][0] != won:
            runs.append((won, []))
        runs[-1][1].append(level)
    networks = [rival.label for rival in RIVALS if rival.points and rival.label in found]
    said = []
    for won, levels in runs:
        where = f"{levels[0]:g}" + (f" to {levels[-1]:g}" if len(levels) > 1 else "")
        if not won:
            said.append(f"at {where} no rival has a surface at least half of the time")
            continue
        words = f"at {where} {' and '.join(won)} {'wins' if len(won) == 1 else 'tie'}"
        if networks and not set(won) & set(networks):
            behind = [
                min(found[label][level].median for label in networks if level in found[label])
                / found[won[0]][level].median
                for level in levels
            ]
            words += f", the best network behind by a factor of {_span(behind)}"
        said.append(words)
    return f"{AXES[axis].label.capitalize()}: " + "; ".join(said) + "."


def _span(factors: Sequence[float]) -> str:
    low, high = (f"{value:.2f}" if np.isfinite(value) else "infinity" for value in (min(factors), max(factors)))
    return low if low == high else f"{low} to {high}"


def figure(rows: Sequence[Row], name: str, budget: int) -> Figure:
    """Distortion against bit errors and against packet loss, one line a rival, bands from quartile to quartile."""
    with mpl.rc_context(STYLE):
        drawn = Figure(figsize=(10.5, 5.2))
        axes = drawn.subplots(1, 2, sharey=True)
        for ax, axis in zip(axes, AXES, strict=True):
            _draw(ax, rows, name, axis)
        axes[0].set_ylabel("NRMSE (1: no surface)")
        axes[0].set_title(f"{name}, {budget:,} bytes on the air: bit errors")
        axes[1].set_title("lost packets")
        handles, labels = axes[0].get_legend_handles_labels()
        drawn.legend(handles, labels, loc="outside lower center", ncols=3)
    return drawn


def _draw(ax: Axes, rows: Sequence[Row], name: str, axis: str) -> None:
    found = summarise(rows, name, axis)
    labels = [rival.label for rival in RIVALS]
    for label, cells in found.items():
        look = labels.index(label) if label in labels else len(labels) - 1
        levels = np.array(list(cells))
        low, middle, high = (
            np.minimum([getattr(quartiles, part) for quartiles in cells.values()], NO_SURFACE)
            for part in ("low", "median", "high")
        )
        style = line_style(look)
        ax.fill_between(levels, low, high, color=style["color"], alpha=0.12, linewidth=0)
        ax.plot(levels, middle, label=label, linewidth=2.4 if label.endswith("network") else 1.4, **style)
    ax.set_yscale("log")
    if axis == "ber":
        ax.set_xscale("log")
    ax.set_xlabel(AXES[axis].label)


def _page(rows: Sequence[Row], contests: Sequence[Contest], seeds: int) -> str:
    parts = [
        "<h1>Features and raster codecs at equal bytes</h1>",
        f"<p>Every rival has the same bytes on the air, protection included, and meets the same channels with {seeds} "
        "seeds. The codecs start from a ready raster of 256 x 256 nodes and take their best setting; the network has "
        "the extrema of pieces of the same nodes, or a lattice of points. Lines are medians, bands reach from "
        "quartile to quartile; a decode that gives no surface counts as infinitely bad.</p>",
    ]
    for name, budget, datagram in contests:
        caption = f"{escape(name)}: {budget:,} bytes in datagrams of {datagram}."
        parts += [f"<h2>{escape(name)}</h2>", illustration(svg(figure(rows, name, budget)), caption)]
        for axis in AXES:
            found = summarise(rows, name, axis)
            best_at = winners(found)
            parts.append(f"<p>{escape(verdict(found, axis))}</p>")
            head = ["rival", *(f"{level:g}" for level in best_at)]
            body: list[list[TableCell | str]] = [
                [rival, *(_cell(cells.get(level), winner=rival in best_at[level]) for level in best_at)]
                for rival, cells in found.items()
            ]
            parts.append(table(head, body, caption=f"Median NRMSE by {AXES[axis].label}; the best in bold."))
    return page("Features and raster codecs at equal bytes", "\n".join(parts))


def _cell(quartiles: Quartiles | None, *, winner: bool) -> TableCell:
    if quartiles is None:
        return TableCell("")
    words = f"{quartiles.median:.4f}" if np.isfinite(quartiles.median) else "no surface"
    return TableCell(f"<b>{words}</b>" if winner else words)


def rivals_command(
    out: Annotated[Path, typer.Option(help="Folder for the table, the page and the pictures.")] = Path(
        "surfacelink-rivals"
    ),
    seeds: Annotated[int, typer.Option(min=1, help="Seeds of each channel; fewer are quicker.")] = 20,
    workers: Annotated[int, typer.Option(min=1, help="Worker processes.")] = 2,
) -> None:
    """Send two fields as features and by raster codecs, at equal bytes, through bit errors and packet loss."""
    console = Console(stderr=True)
    with progress_bar(console, "rivals") as progress:
        rows = run_rivals(out, seeds=seeds, workers=workers, progress=progress)
    for name, budget, _ in CONTESTS:
        for axis in AXES:
            said = verdict(summarise(rows, name, axis), axis)
            console.print(f"{name}, {budget} bytes. {said}", highlight=False)
    console.print(f"{out / 'rivals.html'}", highlight=False, soft_wrap=True)
