"""`simulate sweep`: a campaign from a file or from options, run in worker processes, stopped and resumed at will."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

import common
import receiver
import sender
import simulator
from common.errors import ParameterError
from common.extras import is_installed
from sender.options import Columns, NoDataHeight, labels_of
from sender.surfaces import names_file
from simulator import report
from simulator.campaign import Campaign
from simulator.folder import make_folder, write_whole
from simulator.methods import NAMES
from simulator.progress import progress_bar
from simulator.runner import Journal, Progress, Result, Row, Run, silent
from simulator.table import to_csv, to_parquet
from simulator.transports import Way, opened
from simulator.trial import notes_of, run_trial

PRESENTATION = frozenset(
    f"{name}.py"
    for name in (
        "__main__",
        "demo",
        "folder",
        "page",
        "paper",
        "pictures",
        "progress",
        "report",
        "statistics",
        "sweep",
        "table",
    )
)
"""Modules of the simulator that no row depends on."""


LIBRARIES = (
    "numpy",
    "scipy",
    "matplotlib",
    "msgpack",
    "tifffile",
    "scikit-learn",
    "startinpy",
    "imagecodecs",
    "pydelatin",
    "reedsolo",
)
"""Distributions that rows depend on."""


def library_versions() -> dict[str, str]:
    """The versions of those of `LIBRARIES` that are installed."""
    versions = {}
    for library in LIBRARIES:
        with suppress(PackageNotFoundError):
            versions[library] = version(library)
    return versions


@cache
def code_digest() -> str:
    """Stands for the code that rows depend on: cells that other code has finished are run again."""
    digest = hashlib.sha256()
    for package in (common, sender, receiver, simulator):
        root = Path(package.__path__[0])
        for path in sorted(root.rglob("*.py")):
            if package is not simulator or path.name not in PRESENTATION:
                digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    digest.update(json.dumps(library_versions()).encode())
    return digest.hexdigest()[:8]


def run_campaign(
    campaign: Campaign,
    out: Path,
    *,
    workers: int,
    progress: Progress = silent,
    command: str = "simulate sweep",
    times: bool = True,
    work: Callable[..., Result] = run_trial,
    way: Way = Way.DIRECT,
) -> list[Row]:
    """Run what the journal in `out` does not hold, then write the table, the times and the report.

    ``journal.jsonl`` finished trials; ``table.csv`` (and ``table.parquet`` where pyarrow is installed) the rows;
    ``cells.csv`` medians and quartiles; ``seconds.csv`` what each row took, empty where that was not measured;
    ``report.html``; ``environment.json`` what it ran on. `way` is that of `work`: what went another way is run again.
    """
    trials = campaign.trials()
    with Journal(out / "journal.jsonl") as journal:
        results = Run(trials, work, workers, stamp=f"{code_digest()}-{way}-").collect(journal, progress=progress)
    rows = [row for result in results for row in result.rows]
    seconds = [value for result in results for value in result.seconds]
    write_whole(out / "table.csv", to_csv(rows))
    write_whole(out / "cells.csv", report.cells_csv(rows))
    if is_installed("pyarrow"):
        write_whole(out / "table.parquet", to_parquet(rows))
    write_whole(
        out / "seconds.csv",
        "".join(["seconds\n", *("\n" if value is None else f"{value:.6f}\n" for value in seconds)]),
    )
    write_whole(out / "environment.json", json.dumps(environment(workers), indent=1) + "\n")
    words = report.Words(campaign.title or campaign.name, campaign.lead, command, campaign.notes)
    write_whole(out / "report.html", report.render(rows, words, seconds if times else None))
    return rows


def environment(workers: int) -> Mapping[str, str | int | None]:
    """What a campaign ran on."""
    return {
        "python": platform.python_version(),
        **library_versions(),
        "code": code_digest(),
        "machine": platform.machine(),
        "system": platform.system(),
        "cores": os.cpu_count(),
        "workers": workers,
    }


def plan_of_options(
    *,
    surface: list[str] | None,
    columns: str | None,
    no_data: str | None,
    channel: list[str] | None,
    method: list[str] | None,
    points: int | None,
    gap: float | None,
    pieces: int | None,
    budget: int | None,
    seeds: int | None,
    seed: int | None,
    grid: str | None,
    rounds: int | None,
) -> dict[str, Any]:
    """The keys of a campaign that options give; files are relative to where the command runs.

    Raises ParameterError where an option is out of place.
    """
    plan: dict[str, Any] = {}
    settings = {"columns": labels_of(columns), "no_data": no_data}
    reading = {key: value for key, value in settings.items() if value is not None}
    if reading and not any(map(names_file, surface or ())):
        raise ParameterError("--columns and --no-data go with a file of points that --surface names")
    if surface:
        plan["surfaces"] = [{"file": Path(name).absolute()} | reading if names_file(name) else name for name in surface]
    features = {"points": points, "gap": gap, "pieces": pieces, "budget": budget}
    given = {key: value for key, value in features.items() if value is not None}
    if given:
        plan["features"] = [given]
    if grid is not None:
        plan["grid"] = _sides(grid)
    scalars = {"channels": channel or None, "methods": method or None, "seeds": seeds, "seed": seed, "rounds": rounds}
    return plan | {key: value for key, value in scalars.items() if value is not None}


def _sides(text: str) -> tuple[int, int]:
    """Rows and columns of "64x48", "64,48", or "64" for both; raises ParameterError where it is none of them."""
    found = re.fullmatch(r"(\d{1,9})(?:[x,](\d{1,9}))?", text)
    if found is None:
        raise ParameterError(f"--grid is rows x columns, for example 64x48, or one number for both; got {text!r}")
    return int(found[1]), int(found[2] or found[1])


DEFAULT_PLAN: Mapping[str, list[str]] = {
    "surfaces": ["surface-1", "surface-2", "surface-3"],
    "channels": ["clean", "gaussian:std=0.1,axes=z"],
    "methods": ["network", "linear", "cubic"],
}
"""What `simulate sweep` without a file tries, where no option says otherwise."""

HELP = (
    "Run a campaign: surfaces x features x channels x methods x seeds; run again to go on where it stopped.\n\n"
    "Without a file the options are the campaign, with 10 samples of each surface; where they are silent it is "
    + "; ".join(f"{key} {', '.join(values)}" for key, values in DEFAULT_PLAN.items())
    + ". The keys of a file, and campaigns to begin from, are in docs/campaigns of the repository."
)


MOST_ROWS, MOST_COLUMNS = 20, 6
"""A larger table of medians is not for a terminal; cells.csv has it."""


def medians_table(rows: Sequence[Row]) -> Table | None:
    """Median NRMSE by surface and channel, a column a line of the report; None where it would be long."""
    cells = report.medians(rows)
    if len(cells) > MOST_ROWS:
        return None
    lines = report.choose_lines(rows, MOST_COLUMNS)
    all_lines = {line for of in cells.values() for line in of}
    more = f"; {len(all_lines) - len(lines)} lines more are in cells.csv" if len(all_lines) > len(lines) else ""
    table = Table(
        box=SIMPLE_HEAD, pad_edge=False, caption=f"Median NRMSE over the samples{more}.", caption_justify="left"
    )
    table.add_column("surface", no_wrap=True)
    table.add_column("channel")
    for line in lines:
        table.add_column(escape(line), justify="right")
    for (surface, channel), of in cells.items():
        table.add_row(escape(surface), escape(channel), *(of.get(line, "") for line in lines))
    return table


def sweep_command(
    campaign: Annotated[
        Path | None, typer.Argument(metavar="FILE", help="Campaign in TOML; what options say goes before it.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of journal, table and report; by default the campaign's name.")
    ] = None,
    workers: Annotated[int | None, typer.Option(min=1, help="Worker processes; by default one a core.")] = None,
    surface: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME|FILE",
            help="A surface (`sender surfaces` lists them), or a file of points or of a grid; may be repeated.",
        ),
    ] = None,
    columns: Columns = None,
    no_data: NoDataHeight = None,
    channel: Annotated[
        list[str] | None,
        typer.Option(metavar="SPEC", help='A channel, for example "gaussian:std=0.1;erasure:p=0.05"; may be repeated.'),
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help=f"One of {', '.join(NAMES)}; may be repeated."),
    ] = None,
    points: Annotated[int | None, typer.Option(help="Points of the cloud that features are chosen from.")] = None,
    gap: Annotated[float | None, typer.Option(help="Segment gap, in the units of x and y.")] = None,
    pieces: Annotated[int | None, typer.Option(help="Instead of --gap: pieces along the longer side.")] = None,
    budget: Annotated[
        int | None, typer.Option(help="Instead of --gap: bytes to send; the finest pieces that fit are taken.")
    ] = None,
    seeds: Annotated[int | None, typer.Option(help="Samples of each surface.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed that every random draw follows from.")] = None,
    grid: Annotated[
        str | None,
        typer.Option(metavar="ROWSxCOLUMNS", help="Grid that is compared on, for example 64x48; 64 means 64x64."),
    ] = None,
    rounds: Annotated[
        int | None, typer.Option(help="How often to send, the first time included; later only what is missing.")
    ] = None,
    transport: Annotated[
        Way,
        typer.Option(
            help="direct: in process; asgi: through the receiver's HTTP interface in process; http: over sockets."
        ),
    ] = Way.DIRECT,
    times: Annotated[bool, typer.Option(help="Plot the times of the reconstructions, too.")] = True,
    fresh: Annotated[bool, typer.Option("--fresh", help="Start anew, and forget what had finished.")] = False,
) -> None:
    # The help is HELP, which names the plan that is the default.
    overrides = plan_of_options(
        surface=surface,
        columns=columns,
        no_data=no_data,
        channel=channel,
        method=method,
        points=points,
        gap=gap,
        pieces=pieces,
        budget=budget,
        seeds=seeds,
        seed=seed,
        grid=grid,
        rounds=rounds,
    )
    if campaign is None:
        plan = Campaign.build({**DEFAULT_PLAN, **overrides}, source="options")
    else:
        plan = Campaign.load(campaign, overrides)
    console = Console(stderr=True)
    for note in dict.fromkeys(note for choice in plan.surfaces for note in notes_of(choice)):
        console.print(f"note: {note}", highlight=False, markup=False, soft_wrap=True)
    folder = out or Path(plan.name)
    make_folder(folder)
    if fresh:
        (folder / "journal.jsonl").unlink(missing_ok=True)
    try:
        with progress_bar(console, plan.name) as progress, opened(transport) as carrier:
            rows = run_campaign(
                plan,
                folder,
                workers=workers or os.cpu_count() or 1,
                progress=progress,
                work=partial(run_trial, transport=carrier),
                way=transport,
                times=times,
                command=shlex.join(["simulate", *sys.argv[1:]]),
            )
    except KeyboardInterrupt:
        console.print(f"stopped; finished cells are kept in {folder}, the same command goes on", highlight=False)
        raise typer.Exit(130) from None
    failed = sum(row["failure"] is not None for row in rows)
    table = medians_table(rows)
    if table is not None:
        console.print(table, highlight=False)
    console.print(f"{len(rows)} rows, {failed} failed reconstructions", highlight=False)
    for name in ("table.csv", "report.html"):
        console.print(str(folder / name), highlight=False, soft_wrap=True)
