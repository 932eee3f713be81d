"""Files in, points out."""

from __future__ import annotations

import gzip
import io
import lzma
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, TypeAlias

import numpy as np

from common.errors import FileFormatError, LimitError, PointsError
from common.surface import BoolArray, FloatArray, as_points
from sender.tables import Table, is_number, shown

NoData: TypeAlias = Literal["nan"] | float
"""A height that stands for none; "nan" where only missing and NaN ones do."""

NO_HEIGHTS = frozenset({-9999.0, -99999.0, -32768.0, -32767.0, 9999.0, 99999.0})
"""Heights that geographic software writes where there is none, beside the largest of float32."""

FORMATS = (".csv", ".txt", ".xyz", ".asc", ".npy")
"""Endings that are understood; the text formats also compressed, as .gz or .xz."""

WAYS: Mapping[str, str] = {
    ".npz": "numpy.save of numpy.column_stack([x, y, z]) makes .npy of its arrays",
    **dict.fromkeys((".tif", ".tiff", ".hgt", ".nc", ".grd"), "gdal_translate -of AAIGrid makes .asc of it"),
    **dict.fromkeys((".las", ".laz"), "pdal translate makes .csv of it"),
}
"""Ending of a file that is not read -> what makes one of it that is."""

GRID = re.compile(
    r"\s*(ncols|nrows|xllcorner|xllcenter|yllcorner|yllcenter|cellsize|dx|dy|nodata_value)\s+(\S+)", re.IGNORECASE
)
"""What an ESRI ASCII grid begins with, several times; dx and dy are GDAL's where cells are not square."""

UNPACKERS: Mapping[str, Callable[[io.BytesIO], io.BufferedIOBase]] = MappingProxyType(
    {".gz": lambda data: gzip.GzipFile(fileobj=data), ".xz": lzma.LZMAFile}
)
"""Ending of a compressed file -> what opens it."""

NPY_HEADERS = MappingProxyType(
    {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
)
"""Version of an NPY file -> what reads its header; the third is for names of columns beyond Latin-1 alone."""

MAX_FILE_BYTES = 1 << 30
"""A file, unpacked: 1 GiB holds about 20 million points as text, more than a laptop's memory holds with working
arrays, and keeps a small compressed file from filling the memory."""

NAMES: Mapping[str, frozenset[str]] = {
    "x": frozenset({"x", "lon", "long", "longitude", "east", "easting"}),
    "y": frozenset({"y", "lat", "latitude", "north", "northing"}),
    "z": frozenset({"z", "height", "elevation", "elev", "altitude", "alt", "depth"}),
}
"""What the columns of a text file may be called, in any case, a unit in brackets after it. Depths keep their sign."""

GRIDS = (
    "heights of a grid, a row a line, separated by blanks, are read where the lines of an ESRI ASCII grid stand before "
    "them: ncols, nrows, xllcorner, yllcorner and cellsize, each with its value"
)
"""What is said of a table that may be a grid, of which --columns would take three columns of heights."""

UNDERSTOOD = "; ".join(f"{axis} may be called {', '.join(sorted(names))}" for axis, names in NAMES.items())


@dataclass(frozen=True)
class Cloud:
    """Points of a file, shape (n, 3), and what is worth a word of how they were read."""

    points: FloatArray
    notes: tuple[str, ...] = ()


def read_points(path: Path, columns: Sequence[str] | None = None, no_data: NoData | None = None) -> Cloud:
    """The points of a file; see `parse_points` for the formats.

    Raises
    ------
    FileFormatError
        If the file cannot be read, and as `parse_points` says.
    PointsError
        As `parse_points` says.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}") from error
    return parse_points(data, path.name, columns, no_data)


def parse_points(
    data: bytes,
    name: str,
    columns: Sequence[str] | None = None,
    no_data: NoData | None = None,
    most: int | None = None,
) -> Cloud:
    """The points in the bytes of a file called `name`.

    Parameters
    ----------
    data : bytes
    name : str
        Tells the format by its ending: .npy holds an array of shape (n, 3); .csv, .txt and .xyz hold a point a line,
        columns separated by commas, semicolons or white space, with or without a line of names, which may be a
        comment; "#" starts one, as do "%" and "//" at the start of a line. Or, as .asc mostly does, an ESRI ASCII grid,
        whose points are the centres of its cells. The text formats may be compressed (.gz, .xz).
    columns : three names, optional
        Which columns are x, y and z: numbers counted from 0, in a text file also names, in any case, with or without
        the unit. By default the columns called x, y, z or another of `NAMES`; of three columns the one left; the only
        three, where no name contradicts that. A note says so where a name was not known.
    no_data : number or "nan", optional
        Leaves out the points whose height is this number (to the seven digits of a float32), missing, NaN or a grid's
        NODATA_value; "nan" is no number beside those.
    most : int, optional
        Most points accepted; more are refused before they are read.

    Raises
    ------
    FileFormatError
        If the format is not known, the bytes are not of the format, or the columns are not there.
    LimitError
        If there are more than `most` points.
    PointsError
        If there is no point, a number is not finite, or a height is missing and `no_data` is not given.
    """
    data, name = _unpacked(data, name)
    suffix = Path(name).suffix.lower()
    if suffix not in FORMATS:
        way = f"{suffix} is not read; {WAYS[suffix]}" if suffix in WAYS else f"cannot tell the format of {name!r}"
        packed = " or ".join(UNPACKERS)
        raise FileFormatError(
            f"{way}; accepted endings are {', '.join(FORMATS)}, those of text also with {packed} behind them"
        )
    if suffix == ".npy":
        return _cloud(_parse_npy(data, name, columns, most), lambda row: f"row {row}, counted from 0", name, no_data)
    points, numbers, notes = _parse_text(data, name, columns, most)
    cloud = _cloud(points, lambda row: f"line {numbers[row]}", name, no_data)
    return replace(cloud, notes=(*notes, *cloud.notes))


def _cloud(values: np.ndarray[Any, Any], place: Callable[[int], str], name: str, no_data: NoData | None) -> Cloud:
    """The points among the rows of an array (n, 3); `place` tells where in the file a row stands."""
    points = np.asarray(values, dtype=np.float64)
    z = points[:, 2]
    missing = np.isnan(z)
    if no_data is not None:
        missing |= _stands_for_none(z, float(no_data))
    elif missing.any():
        raise PointsError(
            f"{name}: {np.count_nonzero(missing)} of {len(z)} points have no height (an empty cell, NaN, NODATA), the "
            f"first on {place(int(missing.argmax()))}; --no-data nan (as JSON and TOML: no_data) leaves them out"
        )
    kept = np.flatnonzero(~missing)
    if len(z) and not len(kept):
        raise PointsError(f"{name}: none of its {len(z)} points has a height")
    points = points[kept]
    left_out = len(z) - len(kept)
    notes = [f"{name}: {left_out} of {len(z)} points have no height and are left out"] if left_out else []
    bad = ~np.isfinite(points)
    if bad.any():
        row, axis = np.argwhere(bad)[0].tolist()
        raise PointsError(
            f"{name}, {place(int(kept[row]))}: {'xyz'[axis]} is missing, NaN or infinite; accepted are finite numbers"
        )
    points = as_points(points)
    heights = points[:, 2]
    notes += [
        f"{name}: {np.count_nonzero(heights == end)} heights are {end:.9g}, which often stands for none; "
        f"--no-data {end:.9g} leaves them out"
        for end in sorted({heights.min(), heights.max()})
        if end in NO_HEIGHTS or 1e38 <= abs(end) < 4e38
    ]
    return Cloud(points, tuple(notes))


def _stands_for_none(z: FloatArray, no_data: float) -> BoolArray:
    return np.isclose(z, no_data, rtol=1e-7, atol=0.0)  # many heights were a float32


def _parse_npy(data: bytes, name: str, columns: Sequence[str] | None, most: int | None) -> np.ndarray[Any, Any]:
    file = io.BytesIO(data)
    try:
        shape, _, _ = NPY_HEADERS[np.lib.format.read_magic(file)](file)
        _check_count(shape[0] if shape else 1, name, most)
        array = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    except LimitError:
        raise
    except (KeyError, ValueError, EOFError, OSError, MemoryError) as error:
        raise FileFormatError(f"{name} is not an NPY file of numbers: {error}") from error
    if columns is not None and array.ndim == 2 and array.shape[1]:
        array = array[:, _columns([""] * array.shape[1], columns, name)]
    if array.ndim != 2 or array.shape[1] != 3:
        grids = f"; {GRIDS}" if array.ndim == 2 else ""
        raise FileFormatError(
            f"{name} holds an array of shape {array.shape}; accepted is (n, 3), columns x, y, z{grids}"
        )
    if array.dtype.kind not in "fiu":
        raise FileFormatError(f"{name} holds {array.dtype}; accepted are real numbers")
    return array


def _check_count(count: int, name: str, most: int | None) -> None:
    if most is not None and count > most:
        raise LimitError(f"{name} holds {count} points; at most {most} are accepted")


def bare_name(name: str) -> str:
    """The name of a file without its folder and the endings that are understood.

    >>> bare_name("data/hills.CSV.xz"), bare_name("hills.2024.npy"), bare_name("hills")
    ('hills', 'hills.2024', 'hills')
    """
    bare = Path(name)
    for endings in (UNPACKERS, FORMATS):
        bare = bare.with_suffix("") if bare.suffix.lower() in endings else bare
    return bare.name


def _unpacked(data: bytes, name: str) -> tuple[bytes, str]:
    suffix = Path(name).suffix.lower()
    if suffix in UNPACKERS:
        try:
            with UNPACKERS[suffix](io.BytesIO(data)) as file:
                data, name = file.read(MAX_FILE_BYTES + 1), name[: -len(suffix)]
        except (gzip.BadGzipFile, EOFError, lzma.LZMAError, zlib.error) as error:
            raise FileFormatError(f"{name} is not a {suffix} file: {error}") from error
    if len(data) > MAX_FILE_BYTES:
        raise FileFormatError(f"{name} holds more than {MAX_FILE_BYTES >> 20} MiB")
    return data, name


def _parse_text(
    data: bytes, name: str, columns: Sequence[str] | None, most: int | None
) -> tuple[FloatArray, list[int], list[str]]:
    """Columns x, y, z, NaN where a cell is missing; the lines they stand on; what is worth a word."""
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
        if columns is not None:
            raise FileFormatError(f"{name} is a grid of heights, which has no columns to choose from")
        return *_parse_grid(text, name, most), []
    table = Table.of(text, name)
    known = frozenset().union(*NAMES.values(), (_bare(label) for label in columns or ()))
    has_names = _are_names(table.cells(0), known)
    if has_names and len(table.lines) == 1:
        raise FileFormatError(f"{name} holds a line of names and no point")
    _check_count(len(table.lines) - has_names, name, most)
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
    use = _columns(names or [""] * width, columns, name)
    table.check_width(width)
    notes = []
    if names and columns is None and not all(_bare(names[k]) in known for k in use):
        found = ", ".join(names[k] for k in use)
        notes.append(f"{name}: x, y, z are taken from the columns {found}; --columns takes others")
    return table.columns(use, tuple(NAMES)), table.numbers, notes


def _parse_grid(text: str, name: str, most: int | None) -> tuple[FloatArray, list[int]]:
    """Centres of the cells of an ESRI ASCII grid, as `_parse_text` gives points, row by row from the north."""
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
    _check_count(len(values) - len(keys), name, most)
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
    x, y = np.meshgrid(axes[0], axes[1][::-1])
    z = np.where(_stands_for_none(z, header.get("nodata_value", np.nan)), np.nan, z)
    return np.column_stack([x.ravel(), y.ravel(), z]), numbers[len(keys) :]


def _are_numbers(columns: Sequence[str] | None) -> bool:
    return columns is not None and all(label.strip().isdecimal() for label in columns)


def _are_names(cells: list[str], known: frozenset[str]) -> bool:
    """Whether the cells of a first line are names of columns."""
    named = any(_bare(cell) in known and not is_number(cell) for cell in cells)
    return named or not any(map(is_number, cells)) or _numbered(cells)


def _commented(table: Table, width: int, known: frozenset[str]) -> list[str]:
    """The names in the last comment before the points that holds some, as numpy.savetxt writes them."""
    for text in reversed(table.comments):
        labels = table.labels(text, width)
        if len(labels) == width and not any(map(is_number, labels)):
            places = [k for k, label in enumerate(labels) if _bare(label) in known]
            # One of the names alone may be a word of prose, such as "depth in metres".
            if len(places) > 1 or any(_bare(labels[k]) in list(NAMES.values())[k] for k in places if k < len(NAMES)):
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


def _bare(label: str) -> str:
    """A column's name in lower case, without its unit."""
    return re.sub(r"[(\[].*", "", label).strip().lower()


def _columns(names: list[str], wanted: Sequence[str] | None, name: str) -> tuple[int, int, int]:
    if wanted is None:
        return _named(names, name)
    found = [_places(label.strip().lower(), names) for label in wanted]
    has = f"numbers 0 to {len(names) - 1}" + (f", names {_listed(names)}" if any(names) else "")
    if len(wanted) != 3:
        raise FileFormatError(
            f"{name}: three columns are needed, those of x, y and z, not {len(wanted)} ({', '.join(wanted)}); "
            f"the file's columns: {has}"
        )
    for label, places in zip(wanted, found, strict=True):
        if len(places) != 1:
            raise FileFormatError(
                f"{name}: {label!r} is {'more than one' if places else 'none'} of the file's columns: {has}"
            )
    x, y, z = (place for (place,) in found)
    if len({x, y, z}) < 3:
        raise FileFormatError(f"{name}: {', '.join(wanted)} name the same column twice; the file's columns: {has}")
    return x, y, z


def _places(label: str, names: list[str]) -> list[int]:
    """Where a column stands that is told by a number counted from 0, its name, or its name without the unit."""
    if label.isdecimal() and len(label) < 10 and int(label) < len(names):  # Python reads no number of any length
        return [int(label)]
    whole = [k for k, other in enumerate(names) if other.lower() == label]
    return whole or [k for k, other in enumerate(names) if _bare(other) == label != ""]


def _listed(labels: list[str]) -> str:
    return ", ".join(labels[:8]) + (", ..." if len(labels) > 8 else "")


def _named(labels: list[str], name: str) -> tuple[int, int, int]:
    bare = [_bare(label) for label in labels]
    axes = [next((axis for axis, accepted in NAMES.items() if label in accepted), "") for label in bare]
    if len(axes) == 3 and all(axis in ("", place) for axis, place in zip(axes, NAMES, strict=True)):
        return 0, 1, 2
    if len(axes) == 3 and axes.count("") == 1 and len(set(axes)) == 3:
        axes = [axis or next(iter(NAMES.keys() - axes)) for axis in axes]
    # The plain name goes before the others: x, y, z beside lon and lat.
    found = [(bare if axis in bare else axes, axis) for axis in NAMES]
    if any(names.count(axis) != 1 for names, axis in found):
        names = f" ({_listed(labels)})" if any(labels) else ""
        grids = "" if any(axes) else f"; {GRIDS}"
        raise FileFormatError(
            f"{name} has {len(labels)} columns{names}, and which of them are x, y and z is not clear; "
            f"{UNDERSTOOD}; or say which they are, for example --columns 0,1,2 (as JSON and TOML: columns){grids}"
        )
    x, y, z = (names.index(axis) for names, axis in found)
    return x, y, z
