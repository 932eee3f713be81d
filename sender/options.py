"""Options of how a file is read, of every command that reads one."""

from __future__ import annotations

from typing import Annotated, TypeAlias

import typer

Columns: TypeAlias = Annotated[
    str | None,
    typer.Option(metavar="X,Y,Z", help="Columns of a file, by name or number from 0, for example lon,lat,depth."),
]
NoDataHeight: TypeAlias = Annotated[
    str | None,
    typer.Option(
        metavar="HEIGHT",
        help="Leave out a file's points of this height, and those without any; nan for only the latter.",
    ),
]


def labels_of(columns: str | None) -> list[str] | None:
    """The columns that are named in the option, as `sender.readers.parse_points` takes them."""
    return None if columns is None else [label.strip() for label in columns.split(",")]
