"""GeoTIFF to points: where the cells lie, what they hold, and one clear line for each file that is not read."""

from __future__ import annotations

import contextlib
import gzip
import io
import logging
import struct
import subprocess
import sys
import tracemalloc
import zlib
from typing import Any

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from common.errors import FileFormatError, LimitError, MissingExtraError, PointsError, SurfacelinkError
from common.surface import FloatArray, HeightGrid, Region
from receiver.formats import GRID_FORMATS, GridAnswer
from sender.readers import Cloud, parse_points

Z = np.array([[1, 2, 3], [4, 5, 6]])
SCALE = (33_550, "d", 3, (2.0, 3.0, 0.0), True)
TIE = (33_922, "d", 6, (0.0, 0.0, 0.0, 10.0, 50.0, 0.0), True)
POINT = (34_735, "H", 8, (1, 1, 0, 1, 1025, 0, 1, 2), True)
AREA = (34_735, "H", 8, (1, 1, 0, 1, 1025, 0, 1, 1), True)


def matrix(*values: float) -> tuple[Any, ...]:
    return (34_264, "d", 16, (*values, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), True)


def no_data(text: str) -> tuple[Any, ...]:
    return (42_113, "s", len(text) + 1, text, True)


def tif(z: Any = Z, *tags: tuple[Any, ...], **options: Any) -> bytes:
    buffer = io.BytesIO()
    options = {"photometric": "minisblack", "metadata": None} | options
    tifffile.imwrite(buffer, np.asarray(z), extratags=tags, **options)
    return buffer.getvalue()


def read(data: bytes, name: str = "a.tif", **options: Any) -> Cloud:
    return parse_points(data, name, **options)


CENTRES = [[11, 48.5, 1], [13, 48.5, 2], [15, 48.5, 3], [11, 45.5, 4], [13, 45.5, 5], [15, 45.5, 6]]


@pytest.mark.parametrize(
    "tags",
    [
        (SCALE, TIE),
        (SCALE, TIE, AREA),
        (SCALE, (33_922, "d", 6, (1.0, 2.0, 0.0, 12.0, 44.0, 0.0), True)),
        (SCALE, (33_922, "d", 6, (0.0, 0.0, 0.0, 11.0, 48.5, 0.0), True), POINT),
        ((33_550, "d", 3, (2.0, -3.0, 0.0), True), TIE),
        (matrix(2, 0, 0, 10, 0, -3, 0, 50),),
        (matrix(2, 0, 0, 11, 0, -3, 0, 48.5), POINT),
    ],
)
def test_heights_stand_at_the_centres_of_cells(tags: tuple[Any, ...]) -> None:
    for z in (Z.astype(np.float32), Z.astype(">i2"), Z.astype(np.uint8)):
        cloud = read(tif(z, *tags))
        np.testing.assert_array_equal(cloud.points, CENTRES)
        assert cloud.notes == ()


def test_rows_may_run_to_the_north() -> None:
    points = read(tif(Z, matrix(2, 0, 0, 10, 0, 3, 0, 50))).points
    np.testing.assert_array_equal(points[:, 1], [51.5] * 3 + [54.5] * 3)


def written(grid: HeightGrid) -> bytes:
    return b"".join(next(form for form in GRID_FORMATS if form.name == "tif").render(GridAnswer("hills", grid)))


def from_the_north(grid: HeightGrid) -> FloatArray:
    return grid.points().reshape(*grid.shape, 3)[::-1].reshape(-1, 3)


@given(
    st.integers(0, 6),
    st.tuples(st.integers(-(10**9), 10**9), st.integers(-(10**9), 10**9)),
    st.tuples(st.integers(1, 10**9), st.integers(1, 10**9)),
    st.tuples(st.integers(2, 12), st.integers(2, 12)),
)
def test_what_the_receiver_answers_is_read_to_the_bit(
    digits: int, low: tuple[int, int], extent: tuple[int, int], shape: tuple[int, int]
) -> None:
    # Bounds as people give them, of few digits after the point.
    x, y = ((start / 10**digits, (start + side) / 10**digits) for start, side in zip(low, extent, strict=True))
    axes = Region(*x, *y).axes(shape)
    grid = HeightGrid(*axes, np.random.default_rng(0).normal(size=shape))
    np.testing.assert_array_equal(read(written(grid)).points, from_the_north(grid))


def test_bounds_of_all_digits_come_back_to_their_rounding() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        low = rng.uniform(-1000, 1000, 2)
        high = low + rng.uniform(1e-3, 1000, 2)
        x, y = Region(low[0], high[0], low[1], high[1]).axes((17, 23))
        grid = HeightGrid(x, y, rng.normal(size=(17, 23)))
        points = read(written(grid)).points
        np.testing.assert_array_equal(points[:, 2], from_the_north(grid)[:, 2])
        # Half of the fifteenth digit of up to 2,000.
        np.testing.assert_allclose(points, from_the_north(grid), rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    "options",
    [
        {"tile": (16, 16)},
        {"tile": (16, 32), "compression": "zlib"},
        {"rowsperstrip": 7},
        {"rowsperstrip": 7, "compression": "zlib", "predictor": 2},
        {"compression": "zlib", "predictor": 3},
        {"compression": "lzw", "rowsperstrip": 5},
        {"compression": "lzw", "predictor": 2, "tile": (16, 16)},
        {"compression": "zstd"},
        {"byteorder": ">"},
        {"byteorder": ">", "compression": "zlib", "predictor": 2, "tile": (16, 16)},
        {"bigtiff": True},
        {"bigtiff": True, "byteorder": ">"},
    ],
)
@pytest.mark.parametrize("kind", ["f4", "f8", "i2", "u2", "i4"])
def test_every_layout_gives_the_same_heights(options: dict[str, Any], kind: str) -> None:
    if options.get("predictor") == 3 and kind[0] != "f":
        return  # of floating-point numbers alone
    if options.get("predictor") == 2 and kind[0] == "f":
        kind = "u1"
    z = np.random.default_rng(0).integers(0, 200, (37, 45)).astype(kind)
    data = tif(z, SCALE, TIE, **options)
    np.testing.assert_array_equal(read(data).points[:, 2], z.ravel())
    np.testing.assert_array_equal(read(gzip.compress(data), "a.TIFF.gz").points, read(data).points)


def test_what_the_file_says_stands_for_none_is_no_height() -> None:
    z = Z.astype(np.float32)
    z[0, 1] = -9999
    data = tif(z, SCALE, TIE, no_data("-9999"))
    with pytest.raises(PointsError, match=r"1 of 6 points .* first on row 0, column 1, counted from 0; --no-data nan"):
        read(data)
    cloud = read(data, no_data="nan")
    np.testing.assert_array_equal(cloud.points, [CENTRES[0], *CENTRES[2:]])
    assert cloud.notes == ("a.tif: 1 of 6 points have no height and are left out",)
    z[0, 1] = np.nan
    np.testing.assert_array_equal(read(tif(z, SCALE, TIE), no_data="nan").points, cloud.points)
    z[0, 1] = -3.4028235e38
    text = no_data("-3.4028229999999999e+038")  # as ArcGIS writes it, which no float32 is
    assert "often stands for none" in read(tif(z, SCALE, TIE, text)).notes[0]
    with pytest.raises(FileFormatError, match="its GDAL_NODATA, 'none', is no number"):
        read(tif(z, SCALE, TIE, no_data("none")))


def test_tiles_that_are_left_out_hold_no_height() -> None:
    z = np.ones((20, 40), np.int16)
    data = bytearray(tif(z, SCALE, TIE, no_data("-1"), tile=(16, 16)))
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        tags = file.pages.first.tags
        for code in (324, 325):
            tag = tags[code]
            data[tag.valueoffset : tag.valueoffset + tag.valuebytecount // tag.count] = bytes(
                tag.valuebytecount // tag.count
            )
    assert len(read(bytes(data), no_data="nan").points) == 20 * 40 - 16 * 16


def test_stored_numbers_are_scaled_as_the_file_says() -> None:
    text = (
        '<GDALMetadata>\n  <Item name="OFFSET" sample="0" role="offset">100</Item>\n'
        '  <Item name="SCALE" sample="0" role="scale">0.5</Item>\n</GDALMetadata>'
    )
    cloud = read(tif(Z, SCALE, TIE, no_data("6"), (42_112, "s", len(text) + 1, text, True)), no_data="nan")
    np.testing.assert_array_equal(cloud.points[:, 2], [100.5, 101, 101.5, 102, 102.5])


def test_a_raster_that_lies_nowhere_has_columns_and_rows() -> None:
    cloud = read(tif(Z))
    np.testing.assert_array_equal(cloud.points, [[0, 1, 1], [1, 1, 2], [2, 1, 3], [0, 0, 4], [1, 0, 5], [2, 0, 6]])
    assert cloud.notes == (
        "a.tif does not say where it lies; x and y are its columns and rows, counted from the lower left",
    )


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (tif(np.zeros((2, 4, 5)), SCALE, TIE, planarconfig="separate"), "holds 2 bands; accepted is one.*-b 1"),
        (tif(np.zeros((4, 5, 3), np.uint8), photometric="rgb"), "holds 3 bands"),
        (
            tif(Z.astype(np.uint8), photometric="palette", colormap=np.zeros((3, 256), np.uint16)),
            "holds colours; accepted is one band of heights",
        ),
        (tif(Z.astype(complex)), "holds numbers of 128 bits, kind 6 of TIFF; accepted are integers and floating"),
        (tif(np.zeros((16, 16), bool)), "holds numbers of 1 bits"),
        (tif(np.zeros((2, 4, 5)), SCALE, TIE), "holds several rasters; accepted is one"),
        (
            tif(np.zeros((16, 16), np.uint8), compression="packbits"),
            "is compressed by PACKBITS; accepted are none, LZW",
        ),
        (tif(np.zeros((16, 16), np.float32), compression="lerc"), "is compressed by LERC.*-co COMPRESS=DEFLATE"),
        (tif(Z, matrix(2, 1, 0, 10, 1, -3, 0, 50)), "is rotated; accepted are rows along x"),
        (tif(Z, matrix(2, 0, 0, 10, 0, 0, 0, 50)), "cells have the sides 2 and 0; accepted are"),
        (tif(Z, matrix(2, 0, 0, np.nan, 0, -3, 0, 50)), "accepted are finite"),
        (tif(Z, SCALE), "lies where other tags say"),
        (tif(Z, (33_922, "d", 12, (0.0,) * 12, True)), "lies where other tags say.*gdalwarp makes such a file"),
        (b"", "a.tif is not a GeoTIFF that can be read, or a damaged one"),
        (b"II*\0" + bytes(20), "a.tif is not a GeoTIFF that can be read, or a damaged one$"),
        (b"PK\x03\x04", "not a TIFF file"),
        (tif(Z, SCALE, TIE)[:-1], "a.tif is cut off"),
        (tif(Z, SCALE, TIE)[:100], "a.tif is"),
    ],
)
def test_a_raster_that_is_not_read_says_why(data: bytes, message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        read(data)


def pages(*kinds: int) -> bytes:
    buffer = io.BytesIO()
    with tifffile.TiffWriter(buffer) as writer:
        for kind in kinds:
            z = Z > 3 if kind & 4 else Z
            writer.write(z, extratags=[SCALE, TIE], metadata=None, subfiletype=kind, photometric="minisblack")
    return buffer.getvalue()


def test_smaller_copies_are_passed_over_and_masks_are_not() -> None:
    np.testing.assert_array_equal(read(pages(0, 1, 1)).points, CENTRES)
    with pytest.raises(FileFormatError, match="has a mask; accepted is a no-data value"):
        read(pages(0, 1, 4))


def test_a_raster_has_no_columns_to_choose_from() -> None:
    with pytest.raises(FileFormatError, match="no columns to choose from"):
        read(tif(), columns=("0", "1", "2"))


def test_packages_that_are_missing_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    for options in ({"compression": "lzw"}, {"compression": "zlib", "predictor": 3}):
        with pytest.raises(MissingExtraError, match=r"needs the package imagecodecs; .*'surfacelink\[codecs\]'"):
            read(tif(Z.astype(np.float32), **options))
    monkeypatch.setitem(sys.modules, "tifffile", None)
    with pytest.raises(
        MissingExtraError, match=r"reading a GeoTIFF needs the package tifffile; .*'surfacelink\[tif\]'"
    ):
        read(b"II")


def test_deflate_is_read_without_imagecodecs() -> None:
    z = np.arange(600, dtype=np.int16).reshape(20, 30)
    data = tif(z, SCALE, TIE, compression="zlib", predictor=2, tile=(16, 16))
    program = (
        "import sys; sys.modules['imagecodecs'] = None\n"
        "from sender.readers import parse_points\n"
        "print(parse_points(sys.stdin.buffer.read(), 'a.tif').points[:, 2].tolist() == list(range(600)))"
    )
    ran = subprocess.run([sys.executable, "-c", program], input=data, capture_output=True, check=True)
    assert ran.stdout.split() == [b"True"]


def patched(data: bytes, code: int, value: int) -> bytes:
    """A file with another value in one of its tags of one number."""
    with tifffile.TiffFile(io.BytesIO(data)) as file:
        tag = file.pages.first.tags[code]
        size = tag.valuebytecount
        return data[: tag.valueoffset] + value.to_bytes(size, "little") + data[tag.valueoffset + size :]


BOMB = zlib.compress(bytes(50_000_000), 9)
SPREAD = tif(np.zeros((64, 64)), SCALE, TIE, compression="zlib")


def bomb() -> bytes:
    """A file whose only strip unpacks to 50 MB, of the 32 kB that it should."""
    return patched(patched(SPREAD, 273, len(SPREAD)), 279, len(BOMB)) + BOMB


def tag_bomb() -> bytes:
    """A file of 6 MB that has all of itself as the value of a tag, 500 times."""
    tags = b"".join(struct.pack("<HHII", 273, 4, 1_500_000, 8) for _ in range(500))
    return b"II*\0" + struct.pack("<I", 6_000_008) + bytes(6_000_000) + struct.pack("<H", 500) + tags + bytes(4)


@pytest.mark.parametrize(
    ("data", "error", "message"),
    [
        (patched(patched(tif(), 256, 60_000), 257, 60_000), LimitError, "3600000000 points; at most 44739242"),
        (bomb(), FileFormatError, "unpacks to more than its 32768 bytes"),
        (patched(tif(np.zeros((20, 20)), tile=(16, 16)), 322, 65_520), FileFormatError, "damaged|tiles of 16 x 65520"),
        (
            patched(patched(tif(np.zeros((20, 20)), tile=(16, 16)), 322, 65_520), 323, 65_520),
            FileFormatError,
            "has 1 tiles of 65520 x 65520 cells; accepted are up to 4194304 cells a tile",
        ),
        (tag_bomb(), FileFormatError, "table of contents is larger"),
    ],
    ids=["declared", "deflate", "wide tiles", "tiles", "tags"],
)
def test_sizes_are_refused_before_they_take_memory(data: bytes, error: type[Exception], message: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(error, match=message):
            read(data)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 3 * len(data) + 20_000_000


def test_no_more_points_than_asked_for_are_read() -> None:
    assert len(read(tif(), most=6).points) == 6
    with pytest.raises(LimitError, match="holds 6 points; at most 5"):
        read(tif(), most=5)


LAYOUTS = [
    tif(Z.astype(np.float32), SCALE, TIE, AREA, no_data("-9999"), byteorder=">"),
    tif(np.arange(600, dtype=np.int16).reshape(20, 30), SCALE, TIE, compression="zlib", predictor=2, tile=(16, 16)),
    tif(np.arange(600, dtype=np.float32).reshape(20, 30), SCALE, TIE, compression="lzw", predictor=3),
    pages(0, 1),
]


@given(st.sampled_from(LAYOUTS), st.data())
def test_a_damaged_file_is_points_or_our_error(layout: bytes, data: st.DataObject) -> None:
    damaged = bytearray(layout[: data.draw(st.integers(0, len(layout)) | st.just(len(layout)))])
    if damaged:
        for bit in data.draw(st.lists(st.integers(0, 8 * len(damaged) - 1), max_size=4)):
            damaged[bit // 8] ^= 1 << bit % 8
    with contextlib.suppress(SurfacelinkError):
        assert read(bytes(damaged), most=100_000).points.shape[1] == 3


def test_nothing_is_printed_of_what_a_file_says_wrongly(capsys: pytest.CaptureFixture[str]) -> None:
    read(tif(Z.astype(np.float32), SCALE, TIE, no_data("-3.402823e+38")))
    assert capsys.readouterr().err == ""
    assert any(isinstance(each, logging.NullHandler) for each in logging.getLogger("tifffile").handlers)
