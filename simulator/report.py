"""The report of a campaign: one self-contained page of plots, each explained in a sentence.

Lines are medians over the samples, bands reach from the lower to the upper quartile. A failed reconstruction counts
as infinitely bad.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from types import MappingProxyType
from typing import TypeAlias

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from common.channel import Channel
from simulator.methods import NETWORK, ON_CLOUD
from simulator.page import STYLE, TableCell, illustration, line_style, page, svg, table
from simulator.runner import Row
from simulator.statistics import Quartiles, group, number, text

WIDTH = 6.4
"""Least width of a figure, in inches; so are the two that follow, of a legend's line and of a letter."""

HANDLE, LETTER = 0.75, 0.08

SIZES = 1.5
"""Factor between the sizes of a line from which it is worth drawing over them."""

MAX_LINES = 8
"""Lines in one plot that colour, dash and marker still tell apart."""


@dataclass(frozen=True)
class AxisLook:
    """How an axis of channel levels is drawn."""

    label: str
    sentence: str
    logarithmic: bool = False
    percent: bool = False


AXES: Mapping[str, AxisLook] = MappingProxyType(
    {
        "noise": AxisLook(
            "noise in z, deviation over the range of z",
            "Distortion against Gaussian noise in the heights of the features that arrive.",
            percent=True,
        ),
        "noise in x, y and z": AxisLook(
            "noise in x, y and z, over the range of each",
            "Distortion against Gaussian noise in all three coordinates of the features that arrive, as in the paper.",
            percent=True,
        ),
        "loss": AxisLook("packets lost", "Distortion against the share of packets that never arrive.", percent=True),
        "ber": AxisLook(
            "bit-error rate",
            "Distortion against the share of bits that arrive wrong; what a checksum finds damaged is thrown away.",
            logarithmic=True,
        ),
        "ebn0_db": AxisLook(
            "Eb/N0 (dB)",
            "Distortion against the energy of a bit over the noise density; a poorer link is further to the left.",
        ),
    }
)


def look_of(axis: str) -> AxisLook:
    """How to draw an axis; one that is not known is drawn plainly."""
    return AXES.get(axis, AxisLook(axis, f"Distortion against {axis}."))


class Lines:
    """Names the line a row belongs to: its method, and what is sent where one method is given several things."""

    def __init__(self, rows: Sequence[Row]) -> None:
        self._sends: dict[str, set[str]] = {}
        self._wires: dict[str, set[str]] = {}
        for row in rows:
            self._sends.setdefault(text(row, "method"), set()).add(text(row, "sends"))
            self._wires.setdefault(text(row, "method"), set()).add(text(row, "wire"))

    def __call__(self, row: Row) -> str:
        method, sends, wire = text(row, "method"), text(row, "sends"), text(row, "wire")
        parts = [method]
        if len(self._sends[method]) > 1:
            parts.append(sends)
        if len(self._wires[method]) > 1:
            parts += _apart(wire, self._wires[method])
        return ", ".join(parts)


def _apart(wire: str, wires: set[str]) -> list[str]:
    """The settings of a wire, as JSON, that not all of `wires` have."""
    options = [set(json.loads(other or "{}").items()) for other in wires]
    common = set.intersection(*options)
    return [
        f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"
        for name, value in json.loads(wire or "{}").items()
        if (name, value) not in common
    ]


Curves: TypeAlias = Mapping[str, Mapping[str, Sequence[tuple[float, Quartiles]]]]
"""Surface -> line -> (level or other abscissa, distortion) in ascending order."""


def curves(rows: Sequence[Row], abscissa: str) -> Curves:
    """NRMSE against a column, per surface and line, over the samples."""
    line_of = Lines(rows)
    cells = group(
        [row for row in rows if row[abscissa] is not None],
        lambda row: (text(row, "surface"), line_of(row), number(row, abscissa)),
    )
    return _nested((key, Quartiles.of([row["nrmse"] for row in of])) for key, of in cells.items())


def _nested(cells: Iterable[tuple[tuple[str, str, float], Quartiles]]) -> Curves:
    nested: dict[str, dict[str, list[tuple[float, Quartiles]]]] = {}
    for (surface, line, x), quartiles in cells:
        nested.setdefault(surface, {}).setdefault(line, []).append((x, quartiles))
    return {s: {line: sorted(points, key=lambda p: p[0]) for line, points in of.items()} for s, of in nested.items()}


Place: TypeAlias = tuple[str, str, float | None, str]
"""Surface, axis, level, and the channel where it has no level."""


def _place(row: Row) -> Place:
    level = None if row["level"] is None else number(row, "level")
    return text(row, "surface"), text(row, "axis"), level, text(row, "channel") if level is None else ""


def choose_lines(rows: Sequence[Row], most: int = MAX_LINES) -> list[str]:
    """The lines worth drawing, the same in every plot: networks first, then the others by their mean rank."""
    line_of = Lines(rows)
    ranks: dict[str, list[float]] = {}
    for of in group(rows, _place).values():
        medians = {line: Quartiles.of([row["nrmse"] for row in its]).median for line, its in group(of, line_of).items()}
        for line, median in medians.items():
            ranks.setdefault(line, []).append(sum(other < median for other in medians.values()))
    order = sorted(ranks, key=lambda name: (not name.startswith(NETWORK), float(np.mean(ranks[name])), name))
    return order[:most]


def _nice_name(surface: str) -> str:
    # A file is called as it is.
    return surface if "." in surface else surface.replace("-", " ").capitalize()


def draw_curves(all_curves: Curves, look: AxisLook, lines: Sequence[str]) -> Figure:
    """Small multiples, one a surface: distortion against the level, a line a method."""
    surfaces = list(all_curves)
    columns = min(3, len(surfaces))
    rows = math.ceil(len(surfaces) / columns)
    with mpl.rc_context(STYLE):
        width = max(WIDTH, 3.35 * columns + 0.5)
        figure = Figure(figsize=(width, 2.75 * rows + 0.75))
        grid = figure.subplots(rows, columns, squeeze=False, sharex=True)
        for k, axes in enumerate(grid.flat):
            if k >= len(surfaces):
                axes.set_visible(False)
                continue
            _draw_lines(axes, all_curves[surfaces[k]], look, lines)
            axes.set_title(_nice_name(surfaces[k]))
            if k % columns == 0:
                axes.set_ylabel("NRMSE")
            if k + columns >= len(surfaces):
                axes.set_xlabel(look.label)
                axes.tick_params(labelbottom=True)
        shown: dict[str, Artist] = {}
        for axes in grid.flat:
            shown |= dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
        labels = [line for line in lines if line in shown]
        handles = [shown[line] for line in labels]
        entry = HANDLE + LETTER * max(map(len, labels), default=0)
        ncols = max(1, min(4, len(labels), int(width / entry)))
        figure.legend(handles, labels, loc="outside upper center", ncols=ncols, handlelength=3.2)
    return figure


def _draw_lines(
    axes: Axes, of: Mapping[str, Sequence[tuple[float, Quartiles]]], look: AxisLook, lines: Sequence[str]
) -> None:
    finite = [s.median for line in lines for _, s in of.get(line, ()) if math.isfinite(s.median)]
    top = 1.6 * max(finite, default=1.0)
    for k, line in enumerate(lines):
        points = of.get(line)
        if not points:
            continue
        x = np.array([level for level, _ in points])
        median, low, high = (np.array([getattr(s, name) for _, s in points]) for name in ("median", "low", "high"))
        style = line_style(k)
        own = line.startswith(NETWORK)
        axes.plot(
            x, np.where(np.isfinite(median), median, np.nan), label=line, zorder=5 if own else 3,
            linewidth=2.3 if own else 1.3, markeredgecolor="white", markeredgewidth=0.5, **style,
        )  # fmt: skip
        axes.fill_between(x, np.minimum(low, top), np.minimum(high, top), color=style["color"], alpha=0.13, linewidth=0)
        failed = ~np.isfinite(median)
        if failed.any():
            axes.plot(x[failed], np.full(int(failed.sum()), top), color=style["color"], marker="x", linestyle="none")
    axes.set_yscale("log")
    axes.set_ylim(top=top * 1.1)
    bottom, top = axes.get_ylim()
    several = (1.0, 2.0, 5.0) if top > 10 * bottom else (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0,) if top > 300 * bottom else several))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    if look.logarithmic:
        axes.set_xscale("log")
        left, right = axes.get_xlim()
        if left > 1 and right < 100 * left:
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.0f}"))
            axes.xaxis.set_minor_formatter(NullFormatter())
    elif look.percent:
        axes.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{100 * value:g} %"))


def draw_time(rows: Sequence[Row], seconds: Sequence[float | None]) -> Figure | None:
    """Seconds of a reconstruction against the points it was given, a line a method; None where none was measured."""
    cells: dict[str, dict[float, list[float]]] = {}
    for row, taken in zip(rows, seconds, strict=True):
        if taken is None or row["failure"] is not None or row["features_received"] is None:
            continue
        method = text(row, "method")
        given = number(row, "points" if method.endswith(ON_CLOUD) else "features_received")
        # Losses scatter the number of points: binned to a third of an octave, a line stays a line.
        size = 2 ** (round(3 * math.log2(given)) / 3)
        cells.setdefault(method, {}).setdefault(size, []).append(taken)
    if not cells:
        return None
    slow_first = sorted(cells, key=lambda name: -float(np.median([t for times in cells[name].values() for t in times])))
    methods = sorted(slow_first, key=lambda name: not name.startswith(NETWORK))[:MAX_LINES]
    sizes_drawn = sorted({size for method in methods for size in cells[method]})
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(6.4, 3.9))
        axes = figure.subplots()
        for k, method in enumerate(methods):
            sizes = sorted(cells[method])
            axes.plot(sizes, [float(np.median(cells[method][size])) for size in sizes], label=method, **line_style(k))
        axes.set(xscale="log", yscale="log", xlabel="points given to the method", ylabel="seconds, fit and grid")
        if len(sizes_drawn) <= 8:
            axes.xaxis.set_major_locator(FixedLocator(sizes_drawn))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0f}"))
        axes.xaxis.set_minor_formatter(NullFormatter())
        figure.legend(loc="outside right upper", handlelength=3.2)
    return figure


def cells_csv(rows: Sequence[Row]) -> str:
    """Every (surface, channel, line) of a campaign as CSV: median and quartiles of the NRMSE over its samples."""
    line_of = Lines(rows)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["surface", "axis", "level", "line", "bytes", "samples", "failed", "median", "low", "high"])
    for (surface, axis, level, channel), of in group(rows, _place).items():
        for line, its in group(of, line_of).items():
            quartiles = Quartiles.of([row["nrmse"] for row in its])
            errors = [f"{value:.4g}" for value in (quartiles.median, quartiles.low, quartiles.high)]
            size = f"{_median(its, 'bytes'):.0f}"
            writer.writerow([surface, channel or axis, level, line, size, quartiles.count, quartiles.failed, *errors])
    return out.getvalue()


# Who wins where


@dataclass(frozen=True)
class Contest:
    """One cell of a campaign: a surface under a channel in so many bytes, every line's distortion.

    One line stands for the network, `own`, the same in every cell: the best of several, chosen by the samples it is
    compared on, would win more than any of them.
    """

    surface: str
    axis: str
    level: float | None
    channel: str
    budget: str
    harmful: bool
    distortion: Mapping[str, Quartiles]
    own: str

    @property
    def winner(self) -> str:
        """The line of lowest median among the network's own and its rivals, "" where none of them has a surface; of
        several that are equal the network's own, or else the first."""
        lowest = self._lowest(self.own)
        return self.own if self.own in lowest else next(iter(lowest), "")

    def won_by(self, line: str) -> bool:
        """Whether no line has a lower median; another line of the network enters in the place of `own`."""
        return line in self._lowest(line if line.startswith(NETWORK) else self.own)

    def tied(self, line: str) -> bool:
        """Whether `line` won, and another line, of the network or not, has the same median."""
        same = [each for each in self.distortion.values() if each.median == self.distortion[line].median]
        return self.won_by(line) and len(same) > 1

    def _lowest(self, entrant: str) -> list[str]:
        entered = [line for line in self.distortion if line == entrant or not line.startswith(NETWORK)]
        least = min(self.distortion[line].median for line in entered)
        return [line for line in entered if self.distortion[line].median == least] if math.isfinite(least) else []

    @property
    def best(self) -> str:
        """The winner, or the network's own line where there is none."""
        return self.winner or self.own

    @property
    def lost_by_all(self) -> bool:
        """Whether the median sample fails whatever the method: nothing arrived."""
        return all(math.isinf(quartiles.median) for quartiles in self.distortion.values())


def contests(rows: Sequence[Row]) -> list[Contest]:
    """Every (surface, channel, bytes allowed) in which the network's own line takes part and has a rival.

    That line is the first of a network with the receiver's settings, or the first network there is. Methods on the
    unharmed cloud are left out.
    """
    fair = [_of_a_budget(row) for row in rows if not text(row, "method").endswith(ON_CLOUD)]
    budgets = {row["budget"] for row in fair}
    line_of = Lines(fair)
    networks = [row for row in fair if text(row, "method").startswith(NETWORK)]
    if len(networks) in (0, len(fair)):
        return []
    own = line_of(next((row for row in networks if row["method"] == NETWORK), networks[0]))
    found = []
    for ((surface, axis, level, channel), budget), of in group(
        fair, lambda row: (_place(row), text(row, "budget") if len(budgets) > 1 else "")
    ).items():
        distortion = {line: Quartiles.of([row["nrmse"] for row in its]) for line, its in group(of, line_of).items()}
        harmful = any(_harms(text(row, "channel")) for row in of)
        if own in distortion and not all(line.startswith(NETWORK) for line in distortion):
            found.append(Contest(surface, axis, level, channel, budget, harmful, distortion, own))
    return found


@cache
def _harms(channel: str) -> bool:
    """Whether a channel, in short form, does anything at all."""
    return any(impairment.acts for impairment in Channel.parse(channel).impairments)


def _of_a_budget(row: Row) -> Row:
    """The row with its bytes allowed apart from what it sends."""
    budget = re.search(r" ?budget=(\d+)", text(row, "sends"))
    sends = text(row, "sends").replace(budget[0], "") if budget else row["sends"]
    return {**row, "sends": sends, "budget": budget[1] if budget else ""}


def _level(contest: Contest) -> str:
    size = f", {int(contest.budget):,} bytes" if contest.budget else ""
    return _channel(contest.axis, contest.level, contest.channel) + size


def _channel(axis: str, level: float | None, channel: str) -> str:
    if level is None:
        return channel or "clean"
    value = f"{100 * level:g} %" if look_of(axis).percent else f"{level:g}"
    return f"{axis.replace('_', ' ')} {value}"


def medians(rows: Sequence[Row]) -> Mapping[tuple[str, str], Mapping[str, str]]:
    """(surface, channel) -> line -> median NRMSE over the samples, as people read them."""
    line_of = Lines(rows)
    return {
        (surface, _channel(axis, level, channel)): {
            line: _distortion(Quartiles.of([row["nrmse"] for row in its]).median)
            for line, its in group(of, line_of).items()
        }
        for (surface, axis, level, channel), of in group(rows, _place).items()
    }


def contests_html(cells: Sequence[Contest], notes: Mapping[str, str]) -> str:
    """The share of cells that the network wins, the cells that it does not, and why."""
    nothing = [cell for cell in cells if cell.lost_by_all]
    cells = [cell for cell in cells if not cell.lost_by_all]
    harmful = [cell for cell in cells if cell.harmful]
    lost = [cell for cell in cells if cell.winner != cell.own]
    won = sum(cell.winner == cell.own for cell in harmful)
    clean = [cell for cell in cells if not cell.harmful]
    clean_won = sum(cell.winner == cell.own for cell in clean)
    shares = [f"<b>{won} of {len(harmful)} cells with harm ({100 * won / len(harmful):.0f} %)</b>"] if harmful else []
    shares += [f"{clean_won} of {len(clean)} {'without' if harmful else 'cells without harm'}"] if clean else []
    words = (
        f"{_subject(cells)} the lowest median NRMSE in {', and in '.join(shares)}."
        if shares
        else "No line has a surface."
    )
    intro = f"<p class='lead'>{words}</p>"
    by_axis = group(harmful, lambda cell: cell.axis)
    if len(by_axis) > 1:
        shares = [
            f"{escape(look_of(axis).label)}: {sum(cell.winner == cell.own for cell in of)} of {len(of)}"
            for axis, of in by_axis.items()
        ]
        intro += f"<p>{'; '.join(shares)}.</p>"
    if nothing:
        where = ", ".join(f"{_nice_name(cell.surface)} {_level(cell)}" for cell in nothing)
        intro += f"<p>Not counted, since the median sample loses everything sent: {escape(where)}.</p>"
    if not lost:
        return intro
    rows: list[list[TableCell | str]] = [
        [
            _nice_name(cell.surface),
            _level(cell),
            cell.winner or "none",
            _distortion(cell.distortion[cell.best].median),
            _distortion(cell.distortion[cell.own].median),
            _ratio(cell.distortion[cell.own].median / cell.distortion[cell.best].median),
            TableCell(escape(_why(cell, notes)), "wrap"),
        ]
        for cell in lost
    ]
    head = ["surface", "channel", "lowest", "its NRMSE", "network", "ratio", "why"]
    return intro + table(head, rows, names=3, caption="The cells in which the network does not win.")


def _subject(cells: Sequence[Contest]) -> str:
    """Who is said to win: the network, and which of its lines where there are several."""
    own = cells[0].own
    if all(line == own or not line.startswith(NETWORK) for cell in cells for line in cell.distortion):
        return "The network has"
    return (
        f"Of the network's lines, the one called \u201c{escape(own)}\u201d alone is counted. Against its rivals it has"
    )


def _why(cell: Contest, notes: Mapping[str, str]) -> str:
    best, own = cell.distortion[cell.best], cell.distortion[cell.own]
    note = notes.get(f"{cell.surface} {cell.axis} {cell.level}", notes.get(cell.surface, ""))
    close = own.low <= best.high and own.median < 1.1 * best.median
    scatter = "Within the scatter between samples: the quartiles overlap." if close else ""
    return " ".join(filter(None, [scatter, note])) or "No explanation is known."


def ranking_html(cells: Sequence[Contest]) -> str:
    """Every line of the campaign: cells won, and its NRMSE over the network's, by surface."""
    own = cells[0].own
    cells = [cell for cell in cells if not cell.lost_by_all]
    surfaces = list(dict.fromkeys(cell.surface for cell in cells))
    names = list(dict.fromkeys(name for cell in cells for name in cell.distortion))

    def ratio(name: str, of: Sequence[Contest]) -> float:
        here = [cell for cell in of if name in cell.distortion]
        pairs = [(cell.distortion[name].median, cell.distortion[own].median) for cell in here]
        values = [its / ours for its, ours in pairs if math.isfinite(its) and math.isfinite(ours)]
        return float(np.exp(np.mean(np.log(values)))) if values else math.nan

    harm = any(cell.harmful for cell in cells)
    harmful = [cell for cell in cells if cell.harmful] if harm else cells
    order = sorted(names, key=lambda name: (ratio(name, harmful), name))
    won = {name: [cell for cell in harmful if name in cell.distortion and cell.won_by(name)] for name in names}
    tied = {name: sum(cell.tied(name) for cell in won[name]) for name in names}
    rows = [
        [
            name,
            f"{len(won[name])}{f', {tied[name]} of them tied' if tied[name] else ''}",
            _ratio(ratio(name, harmful)),
            *(_ratio(ratio(name, [cell for cell in harmful if cell.surface == s])) for s in surfaces),
        ]
        for name in order
    ]
    named = f"\u201c{escape(own)}\u201d"
    return table(
        ["line", "cells won", "all", *(_nice_name(s) for s in surfaces)],
        rows,
        caption=f"Cells {'with harm ' if harm else ''}that each line wins, a line of the network against those that "
        f"are none, and its median NRMSE over that of {named} (geometric mean over the cells in which both give a "
        f"surface; above 1 {named} is better)."
        + (
            " In a cell that is tied another line has the same median, and each is counted."
            if any(tied.values())
            else ""
        ),
    )


def lines_html(rows: Sequence[Row]) -> str:
    """Every line under every channel, the best first: what no plot and no contest shows."""
    line_of = Lines(rows)
    body = []
    for (surface, axis, level, channel), of in group(rows, _place).items():
        medians = {line: Quartiles.of([row["nrmse"] for row in its]) for line, its in group(of, line_of).items()}
        sizes = {line: _median(its, "bytes") for line, its in group(of, line_of).items()}
        body += [
            [
                _nice_name(surface),
                _channel(axis, level, channel),
                line,
                _distortion(its.median),
                f"{_distortion(its.low)} to {_distortion(its.high)}",
                str(its.failed or ""),
                f"{sizes[line]:,.0f}",
            ]
            for line, its in sorted(medians.items(), key=lambda item: (item[1].median, item[0]))
        ]
    caption = "Medians over the samples, the best first; a sample that fails counts as infinitely bad."
    head = ["surface", "channel", "line", "NRMSE", "quartiles", "failed", "bytes"]
    return table(head, body, names=3, caption=caption)


def _distortion(value: float) -> str:
    return "fails" if math.isinf(value) else f"{value:.4f}" if value >= 0.001 else f"{value:.2g}"


def _ratio(value: float) -> str:
    return "∞" if math.isinf(value) else "" if math.isnan(value) else f"{value:.2f}"


# The page


@dataclass(frozen=True)
class Words:
    """What a person adds to the numbers: the title, what was tried, the command, and why a cell is lost."""

    title: str
    lead: str
    command: str
    notes: Mapping[str, str]


def render(rows: Sequence[Row], words: Words, seconds: Sequence[float | None] | None = None) -> str:
    """The page, as HTML.

    Parameters
    ----------
    rows : rows of a campaign's table.
    words : title, lead, command and notes.
    seconds : time of each row, in the order of `rows`, None where it was not measured; the plot of times is left out
        where none was.
    """
    sent = [row for row in rows if not text(row, "method").endswith(ON_CLOUD)]
    parts = [f"<h1>{escape(words.title)}</h1>", f'<p class="lead">{escape(words.lead)}</p>', _tried(rows)]
    parts.append(f"<pre>{escape(words.command)}</pre>")
    cells = contests(rows)
    lines = choose_lines(sent)
    by_axis = {axis: curves(of, "level") for axis, of in group(sent, lambda row: row["axis"]).items()}
    if cells:
        parts += ["<h2>Who wins where</h2>", contests_html(cells, words.notes), ranking_html(cells)]
    elif not all(map(_has_levels, by_axis.values())) or len(set(map(Lines(sent), sent))) > len(lines):
        parts += ["<h2>Distortion of every line</h2>", lines_html(rows)]
    for axis, of_axis in by_axis.items():
        if not _has_levels(of_axis):
            continue
        look = look_of(str(axis))
        parts += [f"<h2>Distortion against {escape(look.label)}</h2>", _curves_html(of_axis, look, lines)]
    parts += _bytes_html(sent)
    times = None if seconds is None else draw_time(rows, seconds)
    if times is not None:
        parts += [
            "<h2>Time against points</h2>",
            illustration(
                svg(times),
                "Median time of one reconstruction, fit and evaluation on the grid, with one BLAS thread and as many "
                "processes side by side as the campaign had workers; the figures belong to the machine. The slowest "
                "methods are drawn.",
            ),
        ]
    return page(words.title, "\n".join(parts))


def _has_levels(of_axis: Curves) -> bool:
    return any(len(points) > 1 for lines in of_axis.values() for points in lines.values())


def _curves_html(of_axis: Curves, look: AxisLook, lines: Sequence[str]) -> str:
    left_out = len({line for of in of_axis.values() for line in of} - set(lines))
    more = f" The {left_out} lines of highest mean rank are left out; the table above has them all." if left_out else ""
    caption = (
        f"{look.sentence} Medians over the samples, bands from quartile to quartile, a cross at the top edge where the "
        f"median sample fails.{more}"
    )
    return illustration(svg(draw_curves(of_axis, look, lines)), escape(caption))


def _bytes_html(rows: Sequence[Row]) -> list[str]:
    clean = [row for row in rows if not _harms(text(row, "channel"))]
    cells = group(clean, lambda row: (text(row, "surface"), row["wire"], row["sends"], text(row, "method")))
    sized = _nested(
        (
            (surface, _sized_line(of[0]), _median(of, "bytes")),
            Quartiles.of([row["nrmse"] for row in of]),
        )
        for (surface, *_), of in cells.items()
    )
    if not any(points[-1][0] > SIZES * points[0][0] for of in sized.values() for points in of.values()):
        return []
    sentence = "Distortion against the bytes sent, all overhead counted, on a clean channel."
    look = AxisLook("bytes on the air", sentence, logarithmic=True)
    lines = list(dict.fromkeys(line for of in sized.values() for line in of))
    best = {line: min(quartiles.median for of in sized.values() for _, quartiles in of.get(line, [])) for line in lines}
    chosen = sorted(lines, key=lambda line: (not line.startswith(NETWORK), best[line]))[:MAX_LINES]
    return ["<h2>Distortion against bytes</h2>", _curves_html(sized, look, chosen)]


def _sized_line(row: Row) -> str:
    """A line of the plot over bytes: the method, and the kind of points where it is not the paper's."""
    kind = re.search(r"kind=(\w+)", text(row, "sends"))
    return f"{text(row, 'method')}, {kind[1]}" if kind else text(row, "method")


def _median(rows: Sequence[Row], column: str) -> float:
    return float(np.median([number(row, column) for row in rows]))


def _tried(rows: Sequence[Row]) -> str:
    def distinct(name: str) -> list[str]:
        return list(dict.fromkeys(text(row, name) for row in rows))

    def count(things: Collection[object], word: str) -> str:
        return f"{len(things)} {word}{'' if len(things) == 1 else 's'}"

    grids = " and ".join(f"{r} x {c}" for r, c in dict.fromkeys((row["rows"], row["columns"]) for row in rows))
    channels = {_place(row)[1:] for row in rows}
    failures = sum(row["failure"] is not None for row in rows)
    return (
        f"<p>{count(rows, 'reconstruction')}: {', '.join(map(escape, distinct('surface')))}; "
        f"{count(distinct('sample'), 'sample')} of each; {count(channels, 'channel')}; "
        f"{count(distinct('method'), 'method')}; on a grid of {grids}. {failures or 'None'} of them failed.</p>"
    )
