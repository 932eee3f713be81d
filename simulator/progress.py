"""A bar with the time left."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import rich.progress as bars
from rich.console import Console

from simulator.runner import Progress


@contextmanager
def progress_bar(console: Console, title: str) -> Iterator[Progress]:
    """A bar with the time left, as a function of (finished, all)."""
    columns = (
        bars.TextColumn("{task.description}"),
        bars.BarColumn(bar_width=None),
        bars.MofNCompleteColumn(),
        bars.TimeElapsedColumn(),
        bars.TextColumn("left"),
        bars.TimeRemainingColumn(),
    )
    with bars.Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)
