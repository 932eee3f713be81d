"""Text in, columns of numbers out; what is wrong is told by line and cell, as an editor shows them."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import chain

import numpy as np

from common.errors import FileFormatError
from common.surface import FloatArray

NUMBER = re.compile(r"[+-]?([0-9]+([.,][0-9]*)?|[.,][0-9]+)([eEdD][+-]?[0-9]+)?|[+-]?(?i:nan|inf|infinity)")
"""A number as programs write it: with a decimal point or comma, with an exponent of Fortran's, or a word for it."""

THOUSANDS = re.compile(r"[+-]?[0-9]{1,3},[0-9]{3}")
"""What may be a number of thousands as well as one with a decimal comma."""

MISSING = frozenset({"", "na", "n/a", "null"})
"""Cells that stand for no number, beside nan, in any case."""

MARKS = (";", "\t", ",")
"""What may separate cells, beside white space; the comma is last, since it may be the decimal one."""

BLOCK = 256
"""Lines that are read at once: so many are read cell by cell where NumPy does not read one of them."""

PLAIN = str.maketrans({"\N{MINUS SIGN}": "-", "d": "e", "D": "e"})
"""What makes numbers of Fortran and of typesetters those of everybody else."""


def is_number(cell: str) -> bool:
    """Whether a cell holds a number; nan and inf are."""
    return NUMBER.fullmatch(cell.replace("\N{MINUS SIGN}", "-")) is not None


@dataclass(frozen=True)
class Table:
    """The lines of a text that are neither blank nor comments, and what separates their cells.

    Parameters
    ----------
    name : str
        Name of the file, for errors.
    lines : list of str
    numbers : list of int
        Where the lines stand in the file, counted from 1.
    mark : str or None
        What separates cells; None is white space.
    comments : list of str
        What stands in the lines of comment before the first of `lines`.
    """

    name: str
    lines: list[str]
    numbers: list[int]
    mark: str | None
    comments: list[str]

    @classmethod
    def of(cls, text: str, name: str) -> Table:
        """The table in a text; raises FileFormatError where there is none."""
        text = text.rstrip("\x1a")  # the end of a file of DOS
        raws = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
        held = [raw.partition("#")[0].strip(" ") for raw in raws]
        numbers = [
            number
            for number, line in enumerate(held, 1)
            if line and not line.isspace() and not line.startswith(("//", "%"))
        ]
        lines = held if len(numbers) == len(held) else [held[number - 1] for number in numbers]
        comments = [raw.strip().lstrip("#/%").strip() for raw in raws[: numbers[0] - 1 if numbers else 0]]
        mark = None
        if lines and (excel := re.fullmatch(r'"?sep=([;,\t])"?', lines[0])):
            mark = excel[1]
            del lines[0], numbers[0]
        if not lines:
            raise FileFormatError(f"{name} is empty; accepted is one point a line, three columns x, y, z")
        mark = mark or _mark(lines[:2])
        if mark == "\t" and all(line.startswith(mark) for line in lines):
            lines = [line[1:] for line in lines]
        return cls(name, lines, numbers, mark, comments)

    def cells(self, row: int) -> list[str]:
        """The cells of a row, without quotes; raises FileFormatError."""
        try:
            return _split(self.lines[row], self.mark)
        except csv.Error as error:
            raise FileFormatError(f"{self.name}, line {self.numbers[row]}: {error}") from error

    def labels(self, text: str, width: int) -> list[str]:
        """The names in a text: as its cells are separated, or however else there are `width` of them."""
        try:
            cells = _split(text, self.mark)
        except csv.Error:
            return []
        # A unit belongs to the name before it.
        words = re.split(r"[,;\s]+", " ".join(text.split()).replace(" (", "(").replace(" [", "["))
        return words if len(words) == width and (self.mark is None or len(cells) != width) else cells

    def after_names(self) -> Table:
        """The table without its first row."""
        return Table(self.name, self.lines[1:], self.numbers[1:], self.mark, self.comments)

    def check_width(self, width: int) -> None:
        """Raise FileFormatError unless the rows have `width` cells; between marks the last ones may be missing."""
        if self.mark is None:
            counts = [len(line.split()) for line in self.lines]
        else:
            counts = [line.count(self.mark) + 1 for line in self.lines]
        if counts.count(width) == len(counts):
            return
        for row, count in enumerate(counts):
            if count == width or (self.mark is not None and count < width):
                continue
            cells = self.cells(row)
            if any(cells[width:]) or (self.mark is None and len(cells) < width):
                raise FileFormatError(
                    f"{self.name}, line {self.numbers[row]} has {len(cells)} cells where {width} are expected: "
                    f"{shown(self.lines[row])}"
                )

    def columns(self, use: Sequence[int], labels: Sequence[str]) -> FloatArray:
        """The columns `use` as numbers, shape (rows, len(use)); NaN where a cell is missing.

        `labels` say what the columns are, for errors; raises FileFormatError where a cell is no number.
        """
        values = np.empty((len(self.lines), len(use)))
        left: list[int] = []
        for start in range(0, len(self.lines), BLOCK):
            lines = self.lines[start : start + BLOCK]
            rows = range(start, start + len(lines))
            try:
                if '"' in "".join(lines):  # which NumPy takes for a part of the cell
                    left.extend(rows)
                else:
                    values[rows] = np.loadtxt(
                        lines, delimiter=self.mark, usecols=use, ndmin=2, dtype=np.float64, comments=None
                    )
            except ValueError:
                left.extend(rows)  # NumPy does not say which cell of which line of the file
        if left:
            values[left] = self._cell_by_cell(left, use, labels)
        return values

    def _cell_by_cell(self, rows: list[int], use: Sequence[int], labels: Sequence[str]) -> FloatArray:
        """What `columns` gives, of some rows; it takes the others for numbers without a decimal comma."""
        flat: list[str] = []
        for row in rows:
            cells = self.cells(row)
            if len(cells) <= max(use):
                raise FileFormatError(
                    f"{self.name}, line {self.numbers[row]} has {len(cells)} cells, and {labels[use.index(max(use))]} "
                    f"is to be the one after {max(use)}: {shown(self.lines[row])}"
                )
            flat += [cells[column] for column in use]
        seen = set(rows)
        beside = (self.cells(row)[column] for row in range(len(self.lines)) if row not in seen for column in use)
        comma = "." if self._has_decimal_comma(flat, beside) else ","
        plain = "\n".join("nan" if cell.lower() in MISSING else cell for cell in flat)
        plain = plain.translate(PLAIN).replace(",", comma)
        try:
            values = np.loadtxt(plain.split("\n"), delimiter="\x1f", ndmin=1, dtype=np.float64, comments=None)
            return np.reshape(values, (len(rows), len(use)))
        except ValueError as error:
            for k, cell in enumerate(flat):
                if cell.lower() not in MISSING and not (is_number(cell) and ("," not in cell or comma == ".")):
                    line = self.numbers[rows[k // len(use)]]
                    raise FileFormatError(
                        f"{self.name}, line {line}: {labels[k % len(use)]} is {shown(cell)}, which is no number"
                        f"{f'; {DECIMAL_COMMAS}' if ',' in cell else ''}"
                    ) from error
            raise FileFormatError(f"{self.name} is not a table of numbers: {error}") from error

    def _has_decimal_comma(self, cells: list[str], others: Iterable[str]) -> bool:
        """Whether commas in numbers can only be decimal ones; `others` are those without a comma."""
        commas = [cell for cell in cells if "," in cell]
        if not commas or any("." in cell for cell in chain(cells, others)):
            return False
        # Where ";" separates cells it does so because the comma is the decimal one.
        return self.mark == ";" or not all(THOUSANDS.fullmatch(cell) for cell in commas)


DECIMAL_COMMAS = (
    "decimal commas are accepted where no number has a point, and where the cells are not separated by ; some number "
    "must not look like thousands, as 1,234 does"
)


def shown(text: str) -> str:
    """A text for an error, not too much of it."""
    return repr(text if len(text) <= 60 else f"{text[:57]}...")


def _split(line: str, mark: str | None) -> list[str]:
    if mark is None:
        return [cell.strip('"') for cell in re.findall(r'"[^"]*"|\S+', line)] if '"' in line else line.split()
    cells = next(csv.reader([line], delimiter=mark, skipinitialspace=True)) if '"' in line else line.split(mark)
    return [cell.strip() for cell in cells]


def _mark(lines: list[str]) -> str | None:
    """What separates cells, by the first lines: names and a point, or two points."""
    for mark in MARKS:
        if all(mark in line for line in lines):
            # "1,5 2,5 3,5" has three cells, "1 2 3;" is no table of semicolons.
            try:
                cells = _split(lines[-1], mark)
            except csv.Error:
                return mark
            if not any(len(cell.split()) > 1 and all(map(is_number, cell.split())) for cell in cells):
                return mark
    return None
