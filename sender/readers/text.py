"""Text to points: a point a line, or an ESRI ASCII grid."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from common.errors import FileFormatError
from sender.readers.columns import NAMES, bare_label, choose_columns
from sender.readers.parts import Rows, check_count, grid_rows, refuse_columns, stands_for_none
from sender.tables import Table, is_number, shown

GRID = re.compile(
    r"\s*(ncols|nrows|xllcorner|xllcenter|yllcorner|yllcenter|cellsize|dx|dy|nodata_value)\s+(\S+)", re.IGNORECASE
)
"""What an ESRI ASCII grid begins with, several times; dx and dy are GDAL's where cells are not square."""


def read_text(data: bytes, name: str, columns: Sequence[str] | None, most: int) -> Rows:
    """The points in a text; see `sender.readers.parse_points`."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise FileFormatError(
            f"{name} is not text in UTF-8: {error.reason} at byte {error.start}, line {line}"
        ) from error
    if "\0" in text:
        line = text.count("\n", 0, text.index("\0")) + 1
        raise FileFormatError(f"{name} is not text in UTF-8: a zero byte on line {line}")
    if GRID.match(text):
        refuse_columns(columns, name)
        return _read_grid(text, name, most)
    table = Table.of(text, name)
    known = frozenset().union(*NAMES.values(), (bare_label(label) for label in columns or ()))
    has_names = _are_names(table.cells(0), known)
    if has_names and len(table.lines) == 1:
        raise FileFormatError(f"{name} holds a line of names and no point")
    check_count(len(table.lines) - has_names, name, most)
    names_line, table = table.lines[0], table.after_names() if has_names else table
    width = _width(table)
    if width < len(NAMES):
        raise FileFormatError(
            f"{name}, line {table.numbers[0]}: {shown(table.lines[0])} is no point x, y, z; "
            "accepted are cells separated by commas, semicolons, tabs or white space"
        )
    names = table.labels(names_line, width) if has_names else _commented(table, width, known)
    if names and not _are_numbers(columns):
        width = len(names)
    elif len(names) != width:
        names = []
    use = choose_columns(names or [""] * width, columns, name)
    table.check_width(width)
    notes = []
    if names and columns is None and not all(bare_label(names[k]) in known for k in use):
        found = ", ".join(names[k] for k in use)
        notes.append(f"{name}: x, y, z are taken from the columns {found}; --columns takes others")
    return Rows(table.columns(use, tuple(NAMES)), _on_line(table.numbers), tuple(notes))


def _on_line(numbers: list[int]) -> Callable[[int], str]:
    return lambda row: f"line {numbers[row]}"


def _read_grid(text: str, name: str, most: int) -> Rows:
    """Centres of the cells of an ESRI ASCII grid, row by row from the north."""
    keys, values, numbers, end, line_number = [], [], [], 0, 1
    while found := GRID.match(text, end):
        line_number += text.count("\n", end, found.start(2))
        keys.append(found[1].lower())
        values.append(found[2])
        numbers.append(line_number)
        end = found.end()
    for number, line in enumerate(text[end:].rstrip("\x1a").split("\n"), line_number):
        cells = line.split()
        values += cells
        numbers += [number] * len(cells)
    check_count(len(values) - len(keys), name, most)
    read = Table(name, values, numbers, None, []).columns((0,), ("a value",))[:, 0]
    header, z = dict(zip(keys, read.tolist(), strict=False)), read[len(keys) :]

    def of(*accepted: str) -> tuple[str, float]:
        for key in accepted:
            if key in header:
                return key, header[key]
        raise FileFormatError(f"{name} has no {' or '.join(accepted)} before the heights of its grid")

    rows, columns = of("nrows")[1], of("ncols")[1]
    if min(rows, columns) < 1 or rows % 1 or columns % 1 or rows * columns != len(z):
        raise FileFormatError(
            f"{name} holds {len(z)} heights where nrows {rows:.9g} x ncols {columns:.9g} are expected"
        )
    axes = []
    for axis, count in (("x", columns), ("y", rows)):
        step = of(f"d{axis}", "cellsize")[1]
        if not step > 0:
            raise FileFormatError(f"{name}: the side of a cell must be a positive number, got {step:g}")
        key, first = of(f"{axis}llcorner", f"{axis}llcenter")
        axes.append(first + (np.arange(count) + (0.5 if key.endswith("corner") else 0.0)) * step)
    z = np.where(stands_for_none(z, header.get("nodata_value", np.nan)), np.nan, z)
    return replace(grid_rows(axes[0], axes[1][::-1], z), place=_on_line(numbers[len(keys) :]))


def _are_numbers(columns: Sequence[str] | None) -> bool:
    return columns is not None and all(label.strip().isdecimal() for label in columns)


def _are_names(cells: list[str], known: frozenset[str]) -> bool:
    """Whether the cells of a first line are names of columns."""
    named = any(bare_label(cell) in known and not is_number(cell) for cell in cells)
    return named or not any(map(is_number, cells)) or _numbered(cells)


def _commented(table: Table, width: int, known: frozenset[str]) -> list[str]:
    """The names in the last comment before the points that holds some, as numpy.savetxt writes them."""
    for text in reversed(table.comments):
        labels = table.labels(text, width)
        if len(labels) == width and not any(map(is_number, labels)):
            places = [k for k, label in enumerate(labels) if bare_label(label) in known]
            # One of the names alone may be a word of prose, such as "depth in metres".
            if len(places) > 1 or any(
                bare_label(labels[k]) in list(NAMES.values())[k] for k in places if k < len(NAMES)
            ):
                return labels
    return []


def _numbered(cells: list[str]) -> bool:
    """Whether these are the names that pandas gives columns without any: an empty one, 0, 1, 2."""
    return len(cells) > 1 and cells == ["", *map(str, range(len(cells) - 1))]


def _width(table: Table) -> int:
    """Columns of a table without names; a mark that ends every line separates nothing."""
    width = len(table.cells(0))
    mark = table.mark
    return width - (width > 3 and mark is not None and all(line.endswith(mark) for line in table.lines))
