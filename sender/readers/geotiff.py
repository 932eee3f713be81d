"""GeoTIFF elevation rasters to points, by the package tifffile."""

from __future__ import annotations

import logging
import math
import re
import zlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from common.errors import FileFormatError
from common.extras import require
from common.surface import FloatArray
from sender.readers.parts import (
    MAX_POINTS,
    Metered,
    Rows,
    check_count,
    counted_axes,
    grid_rows,
    read_as,
    refuse_columns,
    stands_for_none,
    uncharted,
)

if TYPE_CHECKING:
    import tifffile

# It logs each tag that it cannot make sense of, and would do so on stderr; what matters of them is raised here.
logging.getLogger("tifffile").addHandler(logging.NullHandler())

DEFLATE = frozenset({8, 32_946})

COMPRESSIONS: Mapping[int, str] = {1: "none", 5: "LZW", **dict.fromkeys(DEFLATE, "deflate"), 50_000: "Zstandard"}
"""Compressions that are read: those that keep every height, and that do not unpack more than they are told to."""

BY_IMAGECODECS = frozenset({5, 50_000})
"""Those that tifffile does not read alone."""

FLOATING_POINT = 3
"""The predictor of floating-point numbers, which tifffile does not undo alone either."""

TAG_BYTES = 4 << 20
"""Of all tags of a file: those of the largest raster of one row a strip take a tenth of it; as Python's numbers they
take ten times as much memory."""

TILE_CELLS = 1 << 22
"""Cells of one tile, at most: usual ones have 256 x 256 to 1024 x 1024."""

PIXEL_SCALE, TIE_POINT, TRANSFORMATION, GEO_KEYS, METADATA, NO_DATA = 33_550, 33_922, 34_264, 34_735, 42_112, 42_113
RASTER_TYPE, PIXEL_IS_POINT = 1025, 2

SCALING = re.compile(r'<Item name="(SCALE|OFFSET)" sample="0" role="(?:scale|offset)">([^<]*)</Item>')
"""What GDAL says of heights that are stored as other numbers."""


def read_geotiff(data: bytes, name: str, columns: Sequence[str] | None, most: int) -> Rows:
    """The centres of the cells of a raster of one band; see `sender.readers.parse_points`.

    Raises MissingExtraError, too: without tifffile; without imagecodecs for what tifffile does not unpack alone.
    """
    refuse_columns(columns, name)
    require("reading a GeoTIFF", "tifffile", "tif")
    import tifffile  # an extra

    with read_as("a GeoTIFF that can be read", name), tifffile.TiffFile(Metered(data, TAG_BYTES)) as file:
        page = file.pages.first
        shape = _checked(file, page, name, most)
        x, y, notes = _axes(page, shape, name)
        return grid_rows(x, y, _heights(page, data, shape, name), notes)


def _checked(file: tifffile.TiffFile, page: tifffile.TiffPage, name: str, most: int) -> tuple[int, int]:
    """Rows and columns of the raster, if it is one of heights that can be read, and of no more than `most`."""
    rows, columns = page.imagelength, page.imagewidth
    check_count(rows * columns, name, most)
    if page.samplesperpixel != 1 or page.photometric not in (0, 1):
        what = f"{page.samplesperpixel} bands" if page.samplesperpixel != 1 else "colours"
        raise FileFormatError(
            f"{name} holds {what}; accepted is one band of heights, and gdal_translate -b 1 makes a file of the first"
        )
    if page.dtype is None or page.dtype.kind not in "fiu" or page.bitspersample not in (8, 16, 32, 64):
        raise FileFormatError(
            f"{name} holds numbers of {page.bitspersample} bits, kind {page.sampleformat:d} of TIFF; accepted are "
            "integers and floating-point numbers of 8, 16, 32 or 64 bits"
        )
    if page.compression not in COMPRESSIONS:
        raise FileFormatError(
            f"{name} is compressed by {getattr(page.compression, 'name', page.compression)}; accepted are "
            f"{', '.join(dict.fromkeys(COMPRESSIONS.values()))}; gdal_translate -co COMPRESS=DEFLATE makes one"
        )
    if page.compression in BY_IMAGECODECS:
        require(f"reading a GeoTIFF compressed by {COMPRESSIONS[page.compression]}", "imagecodecs", "codecs")
    if page.predictor == FLOATING_POINT:
        require("reading a GeoTIFF with the floating-point predictor", "imagecodecs", "codecs")
    for other in [each.aspage() for each in file.pages[1:]]:
        if other.subfiletype & 4:
            raise FileFormatError(f"{name} has a mask; accepted is a no-data value, which gdalwarp -dstnodata makes")
        if not other.is_reduced:
            raise FileFormatError(f"{name} holds several rasters; accepted is one, beside smaller copies of it")
    if page.imagedepth != 1 or min(rows, columns) < 1:
        raise FileFormatError(f"{name} has {page.imagedepth} x {rows} x {columns} cells; accepted is one layer of some")
    return rows, columns


def _heights(page: tifffile.TiffPage, data: bytes, shape: tuple[int, int], name: str) -> FloatArray:
    """Heights, shape (rows, columns), NaN where there is none."""
    no_data = _no_data(page, name)
    z: npt.NDArray[Any] = np.full(shape, 0 if no_data is None else no_data, dtype=np.float64)
    rows, columns = shape
    side = (page.tilelength, page.tilewidth) if page.is_tiled else (page.rowsperstrip, columns)
    segments = math.ceil(rows / side[0]) * math.ceil(columns / side[1])
    if page.is_tiled and (math.prod(side) > TILE_CELLS or segments * math.prod(side) > MAX_POINTS):
        raise FileFormatError(
            f"{name} has {segments} tiles of {side[0]} x {side[1]} cells; accepted are up to {TILE_CELLS} cells a tile "
            f"and {MAX_POINTS} in all"
        )
    if not len(page.dataoffsets) == len(page.databytecounts) == segments:
        raise FileFormatError(
            f"{name} is damaged: of {segments} strips or tiles it says where {len(page.dataoffsets)} are, and how long "
            f"{len(page.databytecounts)} are"
        )
    most = math.prod(side) * page.bitspersample // 8
    for index, (start, length) in enumerate(zip(page.dataoffsets, page.databytecounts, strict=True)):
        if not length:  # GDAL leaves out tiles that hold nothing
            continue
        packed = data[start : start + length]
        if len(packed) != length:
            raise FileFormatError(f"{name} is cut off: it ends before the {length} bytes of heights at byte {start}")
        if page.compression in DEFLATE and len(zlib.decompressobj().decompress(packed, most + 1)) > most:
            # Without imagecodecs tifffile would unpack all there is.
            raise FileFormatError(f"{name} is damaged: a strip or tile unpacks to more than its {most} bytes")
        segment, (_, _, top, left, _), _ = page.decode(packed, index)
        if segment is None:
            raise FileFormatError(f"{name} is damaged: a strip or tile holds nothing")
        part = segment[0, : rows - top, : columns - left, 0]
        z[top : top + part.shape[0], left : left + part.shape[1]] = part
    if no_data is not None:
        z[stands_for_none(z, no_data)] = np.nan
    scaling = {key: float(value) for key, value in SCALING.findall(str(page.tags.valueof(METADATA) or ""))}
    return np.asarray(z * scaling.get("SCALE", 1.0) + scaling.get("OFFSET", 0.0), dtype=np.float64)


def _no_data(page: tifffile.TiffPage, name: str) -> float | None:
    text = page.tags.valueof(NO_DATA)
    if text is None:
        return None
    try:
        return float(text)
    except ValueError as error:
        raise FileFormatError(f"{name}: its GDAL_NODATA, {str(text)[:60]!r}, is no number") from error


def _axes(page: tifffile.TiffPage, shape: tuple[int, int], name: str) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
    """x of the columns' centres, y of the rows', and what is worth a word of them."""
    scale, tie, matrix = (page.tags.valueof(code) for code in (PIXEL_SCALE, TIE_POINT, TRANSFORMATION))
    if scale is None and tie is None and matrix is None:
        return *counted_axes(shape), (uncharted(name),)
    if matrix is not None:
        across, turned_x, _, x, turned_y, down, _, y = matrix[:8]
    elif scale is not None and tie is not None and len(tie) == 6:
        across, down = scale[0], -abs(scale[1])  # as GDAL takes it, whatever its sign
        turned_x = turned_y = 0.0
        x, y = tie[3] - tie[0] * across, tie[4] - tie[1] * down
    else:
        raise FileFormatError(
            f"{name} lies where other tags say than those accepted, a scale with one tie point or a transformation; "
            "gdalwarp makes such a file"
        )
    if turned_x or turned_y:
        raise FileFormatError(f"{name} is rotated; accepted are rows along x and columns along y, as gdalwarp makes it")
    if not (across and down and np.isfinite([across, down, x, y]).all()):
        raise FileFormatError(f"{name}: its cells have the sides {across:g} and {down:g}; accepted are finite ones")
    middle = 0.0 if _pixel_is_point(page) else 0.5
    rows, columns = shape
    return _spread(x + middle * across, across, columns), _spread(y + middle * down, down, rows), ()


def _spread(first: float, step: float, count: int) -> FloatArray:
    """Numbers `step` apart; what the receiver wrote comes back to the bit, where its region has usual bounds."""
    # A step that was divided out of an extent has its rounding, which the fifteen digits take away that doubles hold.
    last = first + (count - 1) * step
    last = round(last, 14 - math.floor(math.log10(max(abs(first), abs(last), abs(step)))))
    ascending = np.linspace(min(first, last), max(first, last), count)
    return ascending if step > 0 else ascending[::-1]


def _pixel_is_point(page: tifffile.TiffPage) -> bool:
    """Whether the georeference is that of the middle of a cell, not of its corner."""
    keys = page.tags.valueof(GEO_KEYS) or ()
    return any(tuple(keys[k : k + 4]) == (RASTER_TYPE, 0, 1, PIXEL_IS_POINT) for k in range(4, len(keys), 4))
