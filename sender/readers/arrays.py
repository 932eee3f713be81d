"""NumPy's files to points: .npy holds a table of points, .npz a table, a grid, or both with their axes."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import prod
from types import MappingProxyType
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from common.errors import FileFormatError
from sender.readers.columns import GRIDS, NAMES, bare_label, choose_columns, listed
from sender.readers.parts import (
    MAX_FILE_BYTES,
    Metered,
    Rows,
    check_count,
    counted_axes,
    grid_rows,
    read_as,
    refuse_columns,
    uncharted,
)

Array = npt.NDArray[Any]

HEADERS = MappingProxyType({(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0})
"""Version of an NPY file -> what reads its header; the third is for names of columns beyond Latin-1 alone."""

HEADER_BYTES = 16_384
"""Of an array in an archive that are looked at before it is read: NumPy takes headers of up to 10,000."""

DIRECTORY_BYTES = 1 << 20
"""Of the table of contents of an archive: room for thousands of arrays; as objects a whole upload of it would be
gigabytes."""

GRID_KEYS = (
    "accepted are heights z (rows, columns), alone, with their spacing dx and dy, or with x (columns,) and y (rows,); "
    "x, y and z of one shape; or a single array (n, 3), columns x, y, z"
)
"""What is said of an archive of which it is not clear what in it is the surface."""


def read_npy(data: bytes, name: str, columns: Sequence[str] | None, most: int) -> Rows:
    """The points in an array of shape (n, 3); see `sender.readers.parse_points`."""
    with read_as("an NPY file of numbers", name):
        shape, _ = _header(io.BytesIO(data))
        check_count(shape[0] if shape else 1, name, most)
        array = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    return _table(array, name, columns)


def _header(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    shape, _, dtype = HEADERS[np.lib.format.read_magic(file)](file)
    return shape, dtype


def _table(array: Array, name: str, columns: Sequence[str] | None) -> Rows:
    """The rows of an array (n, 3), or of three columns of one (n, k)."""
    if columns is not None and array.ndim == 2 and array.shape[1]:
        array = array[:, choose_columns([""] * array.shape[1], columns, name)]
    if array.ndim != 2 or array.shape[1] != 3:
        grids = f"; {GRIDS}" if array.ndim == 2 else ""
        raise FileFormatError(
            f"{name} holds an array of shape {array.shape}; accepted is (n, 3), columns x, y, z{grids}"
        )
    if array.dtype.kind not in "fiu":
        raise FileFormatError(f"{name} holds {array.dtype}; accepted are real numbers")
    return Rows(array, _row)


def _row(row: int) -> str:
    return f"row {row}, counted from 0"


@dataclass(frozen=True)
class Member:
    """An array of real numbers in an archive, of which only the header has been read."""

    info: zipfile.ZipInfo
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    start: int

    def load(self, archive: zipfile.ZipFile, name: str) -> Array:
        """The array; raises FileFormatError where it is larger than a file may be."""
        size = self.start + prod(self.shape) * self.dtype.itemsize
        if size > MAX_FILE_BYTES:
            raise FileFormatError(f"{name} holds more than {MAX_FILE_BYTES >> 20} MiB")
        with archive.open(self.info) as packed:
            data = packed.read(size)
        array: Array = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
        return array


def read_npz(data: bytes, name: str, columns: Sequence[str] | None, most: int) -> Rows:
    """The points in an archive of arrays; see `sender.readers.parse_points`.

    Nothing is unpacked before its header says that it is not too large, and nothing that is no array of real numbers.
    """
    with read_as("an NPZ file of arrays", name):
        file = Metered(data, DIRECTORY_BYTES)
        with zipfile.ZipFile(file) as archive:
            file.left = MAX_FILE_BYTES
            members, told = {}, []
            for info in archive.infolist():
                label = info.filename.removesuffix(".npy")
                with archive.open(info) as packed:
                    head = io.BytesIO(packed.read(HEADER_BYTES))
                shape, dtype = _header(head)
                if dtype.kind in "fiu":
                    members[label] = Member(info, shape, dtype, head.tell())
                told.append(f"{label} {shape} {dtype}")
            surface = _surface(members, columns)
            if surface is None:
                raise FileFormatError(f"{name} holds {listed(told) or 'no array'}; {GRID_KEYS}")
            return _rows(archive, surface, name, columns, most)


@dataclass(frozen=True)
class Surface:
    """The members of an archive that are a surface.

    `x` and `y` are both there or both not, as are `steps` (dx, dy); without a `grid` the rows of z are points.
    """

    z: Member
    x: Member | None = None
    y: Member | None = None
    steps: tuple[Member, Member] | None = None
    grid: bool = True


def _surface(members: Mapping[str, Member], columns: Sequence[str] | None) -> Surface | None:
    """The surface among arrays; None where it is not clear."""
    x, y, z = (_called(axis, members) for axis in NAMES)
    dx, dy = (members.get(f"d{axis}") for axis in "xy")
    named = z is not None
    if z is None:
        flat = [member for member in members.values() if len(member.shape) == 2]
        z = flat[0] if len(flat) == 1 else None
    if z is None:
        return None
    if x is not None and y is not None:
        if x.shape == y.shape == z.shape and len(z.shape) in (1, 2):
            return Surface(z, x, y, grid=False)
        return Surface(z, x, y) if len(z.shape) == 2 and (*y.shape, *x.shape) == z.shape else None
    if x is not None or y is not None or len(z.shape) != 2:
        return None
    if dx is not None and dy is not None:
        return Surface(z, steps=(dx, dy)) if dx.shape == dy.shape == () else None
    if dx is not None or dy is not None:
        return None
    return Surface(z, grid=named or (columns is None and z.shape[1] != 3))


def _called(axis: str, members: Mapping[str, Member]) -> Member | None:
    """The array that is called as an axis is, the plain name before the told."""
    found = [member for label, member in members.items() if bare_label(label) in NAMES[axis]]
    return members.get(axis) or (found[0] if len(found) == 1 else None)


def _rows(archive: zipfile.ZipFile, surface: Surface, name: str, columns: Sequence[str] | None, most: int) -> Rows:
    z, x, y = surface.z, surface.x, surface.y
    is_table = not surface.grid and x is None
    check_count(z.shape[0] if is_table else prod(z.shape), name, most)
    if is_table:
        return _table(z.load(archive, name), name, columns)
    refuse_columns(columns, name)
    heights = z.load(archive, name)
    if x is not None and y is not None:
        xs, ys = (np.asarray(each.load(archive, name), dtype=np.float64) for each in (x, y))
        if surface.grid:
            return grid_rows(xs, ys, heights)
        return Rows(np.column_stack([xs.ravel(), ys.ravel(), heights.ravel()]), _row)
    xs, ys = counted_axes(heights.shape)
    if surface.steps is None:
        return grid_rows(xs, ys, heights, (uncharted(name),))
    dx, dy = (float(step.load(archive, name)) for step in surface.steps)
    if not (0 < dx < np.inf and 0 < dy < np.inf):
        raise FileFormatError(f"{name}: dx and dy, the spacing of its heights, must be positive, got {dx:g} and {dy:g}")
    return grid_rows(xs * dx, ys * dy, heights)
