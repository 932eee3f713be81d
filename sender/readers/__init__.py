"""Files in, points out: one way in, a module for each kind of format.

A reader takes the bytes of a file, its name for errors, the columns that are asked for (None where none are) and the
most points there may be, and gives `Rows`; it raises FileFormatError or LimitError. What holds for all of them, points
without a height and numbers that are not finite, is seen to here.
"""

from __future__ import annotations

import gzip
import io
import lzma
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from types import MappingProxyType
from typing import Literal, TypeAlias

import numpy as np

from common.errors import FileFormatError, PointsError, guess
from common.surface import FloatArray, as_points
from sender.readers.arrays import read_npy, read_npz
from sender.readers.geotiff import read_geotiff
from sender.readers.parts import MAX_FILE_BYTES, MAX_POINTS, Rows, stands_for_none
from sender.readers.srtm import read_hgt
from sender.readers.text import read_text

NoData: TypeAlias = Literal["nan"] | float
"""A height that stands for none; "nan" where only missing and NaN ones do."""

NO_HEIGHTS = frozenset({-9999.0, -99999.0, -32768.0, -32767.0, 9999.0, 99999.0})
"""Heights that geographic software writes where there is none, beside the largest of float32."""

Reader: TypeAlias = Callable[[bytes, str, Sequence[str] | None, int], Rows]

FORMATS: Mapping[str, Reader] = MappingProxyType(
    {
        **dict.fromkeys((".csv", ".txt", ".xyz", ".asc"), read_text),
        ".npy": read_npy,
        ".npz": read_npz,
        **dict.fromkeys((".tif", ".tiff"), read_geotiff),
        ".hgt": read_hgt,
    }
)
"""Ending of a file that is understood -> what reads it; each also compressed, as .gz or .xz."""

WAYS: Mapping[str, str] = {
    **dict.fromkeys((".nc", ".grd"), "gdal_translate makes .tif of it"),
    **dict.fromkeys((".las", ".laz"), "pdal translate makes .csv of it"),
    ".zip": "unpack it",
}
"""Ending of a file that is not read -> what makes one of it that is."""

UNPACKERS: Mapping[str, Callable[[io.BytesIO], io.BufferedIOBase]] = MappingProxyType(
    {".gz": lambda data: gzip.GzipFile(fileobj=data), ".xz": lzma.LZMAFile}
)
"""Ending of a compressed file -> what opens it."""


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
    LimitError, MissingExtraError, PointsError
        As `parse_points` says.
    """
    return parse_points(file_bytes(path), path.name, columns, no_data)


def file_bytes(path: Path) -> bytes:
    """What is in a file; raises FileFormatError where it cannot be read, with the one that was probably meant."""
    try:
        return path.read_bytes()
    except OSError as error:
        near = guess(path.name, _beside(path)) if isinstance(error, FileNotFoundError) else ""
        raise FileFormatError(f"cannot read {path}: {error.strerror or error}{near}") from error


def _beside(path: Path) -> list[str]:
    """Names in the folder of a file that is not there; of a folder of thousands only some."""
    try:
        return [entry.name for entry in islice(path.parent.iterdir(), 1000)]
    except OSError:
        return []


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
        Tells the format by its ending, each of which may have .gz or .xz behind it:

        .csv, .txt, .xyz, .asc
            A point a line, columns separated by commas, semicolons or white space, with or without a line of names,
            which may be a comment; "#" starts one, as do "%" and "//" at the start of a line. Or an ESRI ASCII grid,
            whose points are the centres of its cells.
        .npy
            An array of shape (n, 3).
        .npz
            Heights z (rows, columns) with x (columns,) and y (rows,); with their spacing dx and dy; or alone. x, y and
            z of one shape. Or a single array of shape (n, 3). x, y and z may be called as columns are. Nothing is
            unpickled.
        .tif, .tiff
            A GeoTIFF of one band, which is not rotated. Its points are the centres of its cells.
        .hgt
            A square of SRTM, x and y in degrees by its name, such as N44W072.hgt.

        Of a grid that does not say where it lies x and y are columns and rows, counted from the lower left; a note says
        so. The first row of one without y is the northernmost.
    columns : three names, optional
        Which columns are x, y and z: numbers counted from 0, in a text file also names, in any case, with or without
        the unit. By default the columns called x, y, z or another of `NAMES`; of three columns the one left; the only
        three, where no name contradicts that. A note says so where a name was not known. A grid has none.
    no_data : number or "nan", optional
        Leaves out the points whose height is this number (to the seven digits of a float32), missing, NaN or what
        the file says stands for none (NODATA_value, GDAL_NODATA, -32768 of SRTM); "nan" is no number beside those.
    most : int, optional
        Most points accepted, never more than `MAX_POINTS`; more are refused before they are read.

    Raises
    ------
    FileFormatError
        If the format is not known, the bytes are not of the format, or the columns are not there.
    LimitError
        If there are more than `most` points.
    MissingExtraError
        If a package that the format needs is not installed.
    PointsError
        If there is no point, a number is not finite, or a height is missing and `no_data` is not given.
    """
    data, name = _unpacked(data, name)
    suffix = Path(name).suffix.lower()
    if suffix not in FORMATS:
        way = f"{suffix} is not read; {WAYS[suffix]}" if suffix in WAYS else f"cannot tell the format of {name!r}"
        packed = " or ".join(UNPACKERS)
        raise FileFormatError(f"{way}; accepted endings are {', '.join(FORMATS)}, each also with {packed} behind it")
    rows = FORMATS[suffix](data, name, columns, MAX_POINTS if most is None else min(most, MAX_POINTS))
    return _cloud(rows, name, no_data)


def _cloud(rows: Rows, name: str, no_data: NoData | None) -> Cloud:
    """The points among the rows of a file."""
    points, place = np.asarray(rows.values, dtype=np.float64), rows.place
    z = points[:, 2]
    missing = np.isnan(z)
    if no_data is not None:
        missing |= stands_for_none(z, float(no_data))
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
    return Cloud(points, (*rows.notes, *notes))


def bare_name(name: str) -> str:
    """The name of a file without its folder and the endings that are understood.

    >>> bare_name("data/hills.CSV.xz"), bare_name("hills.2024.npy"), bare_name("hills")
    ('hills', 'hills.2024', 'hills')
    """
    bare = Path(name)
    for endings in (UNPACKERS.keys(), FORMATS.keys()):
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
