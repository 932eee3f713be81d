"""What the readers of all formats share: how they answer, how many points there may be, whose fault an error is."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from common.errors import FileFormatError, LimitError, SurfacelinkError
from common.surface import BoolArray, FloatArray

MAX_FILE_BYTES = 1 << 30
"""A file, unpacked: 1 GiB holds about 20 million points as text, more than a laptop's memory holds with working
arrays, and keeps a small compressed file from filling the memory."""

MAX_POINTS = MAX_FILE_BYTES // 24
"""Points of a file, at most: as many as the largest file of three float64 a point holds, however few bytes they take
in another."""


@dataclass(frozen=True)
class Rows:
    """What stands in a file.

    Attributes
    ----------
    values : ndarray, shape (n, 3)
        x, y, z; real numbers of any type, NaN where one is missing or stands for none.
    place : callable
        Tells where in the file a row of `values` stands, in words.
    notes : tuple of str
        What is worth a word of how it was read.
    """

    values: npt.NDArray[Any]
    place: Callable[[int], str]
    notes: tuple[str, ...] = ()


def grid_rows(x: FloatArray, y: FloatArray, z: npt.NDArray[Any], notes: tuple[str, ...] = ()) -> Rows:
    """The nodes of a grid, row by row: x of the columns, y of the rows, z of shape (len(y), len(x))."""
    columns = len(x)
    xs, ys = np.meshgrid(x, y)
    return Rows(
        np.column_stack([xs.ravel(), ys.ravel(), np.asarray(z, dtype=np.float64).ravel()]),
        lambda row: f"row {row // columns}, column {row % columns}, counted from 0",
        notes,
    )


def counted_axes(shape: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """(x, y) of a grid that lies nowhere: its columns and rows, the last row at 0, so that the first is the north."""
    rows, columns = shape
    return np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64)[::-1]


def uncharted(name: str) -> str:
    """The note on a grid with `counted_axes`."""
    return f"{name} does not say where it lies; x and y are its columns and rows, counted from the lower left"


def stands_for_none(z: FloatArray, no_data: float) -> BoolArray:
    """Which heights are this number, to the seven digits of a float32, which many were."""
    return np.isclose(z, no_data, rtol=1e-7, atol=0.0)


def check_count(count: int, name: str, most: int) -> None:
    """Raise LimitError where a file holds more than `most` points."""
    if count > most:
        raise LimitError(f"{name} holds {count} points; at most {most} are accepted")


def refuse_columns(columns: Sequence[str] | None, name: str) -> None:
    """Raise FileFormatError where columns are asked for of a grid."""
    if columns is not None:
        raise FileFormatError(f"{name} is a grid of heights, which has no columns to choose from")


@contextmanager
def read_as(what: str, name: str) -> Iterator[None]:
    """Whatever a library raises on a file that is not `what`, or a damaged one, becomes a FileFormatError."""
    try:
        yield
    except SurfacelinkError:
        raise
    except Exception as error:  # on damaged bytes the libraries raise whatever their parsers stumble over
        # Of these nobody learns more than that.
        stumbled = isinstance(error, TypeError | LookupError | ArithmeticError | AttributeError)
        why = "" if stumbled else f": {str(error)[:200]}"
        raise FileFormatError(f"{name} is not {what}, or a damaged one{why}") from error


class Metered(io.BytesIO):
    """A file of which no more than `left` bytes are read: repeated or huge tables of contents multiply in memory."""

    def __init__(self, data: bytes, left: int) -> None:
        super().__init__(data)
        self.left = left

    def read(self, size: int | None = -1, /) -> bytes:
        """As of any file; raises ValueError where it is too much."""
        data = super().read(size)
        self.left -= len(data)
        if self.left < 0:
            raise ValueError("its table of contents is larger than that of any usual file")
        return data
