"""Files to points: the formats, and one clear line for whatever is wrong with a file."""

from __future__ import annotations

import contextlib
import gzip
import io
import lzma
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from common.errors import FileFormatError, LimitError, PointsError, SurfacelinkError
from sender.readers import parse_points, read_points
from sender.tables import BLOCK, Table
from sender.transmission import transmission_id

POINTS = np.array([[0.0, 1.0, 2.5], [3.0, 4.0, -5.0]])
TEXT = b"x,y,z\n0,1,2.5\n3,4,-5\n"


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("data", "name", "columns"),
    [
        (TEXT, "a.csv", None),
        (b"0,1,2.5\n3,4,-5\n", "a.CSV", None),
        (b"# made by hand\n0 1 2.5\n3   4 -5  # last\n\n", "a.xyz", None),
        (b"z;x;y\n2.5;0;1\n-5;3;4\n", "a.txt", None),
        (b"\xef\xbb\xbfx\ty\tz\tnote\n0\t1\t2.5\t1\n3\t4\t-5\t1\n", "a.txt", None),
        (b"lon,lat,depth,date\n0,1,2.5,9\n3,4,-5,9\n", "a.csv", ("LON", "lat", "depth")),
        (b"9,0,1,2.5\n9,3,4,-5\n", "a.csv", ("1", "2", "3")),
        (b"depth,x,y\n2.5,0,1\n-5,3,4\n", "a.csv", None),
        (b"lat,lon,elev\n1,0,2.5\n4,3,-5\n", "a.csv", None),
        (b"Northing (m),gravity,Easting (m)\n1,2.5,0\n4,-5,3\n", "a.csv", None),
        (b"lat,lon,x,y,date,Depth [m]\n9,9,0,1,9,2.5\n9,9,3,4,9,-5\n", "a.csv", None),
        (b"a,b,c\n0,1,2.5\n3,4,-5\n", "a.csv", None),
        (b"a,b,z\n0,1,2.5\n3,4,-5\n", "a.csv", None),
        (gzip.compress(TEXT, mtime=0), "a.csv.gz", None),
        (lzma.compress(TEXT), "a.csv.xz", None),
        (lzma.compress(TEXT[:14]) + lzma.compress(TEXT[14:]), "a.csv.xz", None),  # as parallel packers write it
        (npy(POINTS), "a.npy", None),
        (npy(POINTS.astype(np.float32)), "a.npy", None),
    ],
)
def test_each_format_gives_the_same_points(data: bytes, name: str, columns: tuple[str, ...] | None) -> None:
    np.testing.assert_array_equal(parse_points(data, name, columns).points, POINTS)


@pytest.mark.parametrize(
    ("data", "name"),
    [
        (TEXT, "a.csv"),
        (b"0 1 2.5\n3 4 -5\n", "a.xyz"),
        (gzip.compress(TEXT, mtime=0), "a.csv.gz"),
        (npy(POINTS), "a.npy"),
    ],
)
def test_no_more_points_than_asked_for_are_read(data: bytes, name: str) -> None:
    np.testing.assert_array_equal(parse_points(data, name, most=2).points, POINTS)
    with pytest.raises(LimitError, match="holds 2 points; at most 1"):
        parse_points(data, name, most=1)


def test_a_header_that_promises_too_many_points_is_enough_to_refuse_a_file() -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**12, 3)})
    with pytest.raises(LimitError, match="holds 1000000000000 points"):
        parse_points(header.getvalue(), "a.npy", most=1000)


@pytest.mark.parametrize(
    ("data", "name", "message"),
    [
        (TEXT, "a.dat", "accepted endings are .csv"),
        (
            b"",
            "a.NC",
            r"\.nc is not read; gdal_translate makes .tif of it; accepted endings are .*, each also with .gz",
        ),
        (b"", "N44W072.hgt.zip", r"\.zip is not read; unpack it; accepted endings are"),
        (b"", "a.csv", "empty"),
        (b"# nothing\n", "a.csv", "empty"),
        (b"1,2,3\n1,2\n", "a.csv", "line 2 has 2 cells"),
        (b"1,2,3\n1,2,three\n", "a.csv", "line 2: z is 'three', which is no number"),
        (b"# a\r\n\r\nx,y,z\r\n1,2,3\r\n# b\r\n1,-,3\r\n", "a.csv", "line 6: y is '-'"),
        (b"x,y,z\n1,2,3\n1,2,3,4\n", "a.csv", "line 3 has 4 cells where 3 are expected: '1,2,3,4'"),
        (b"x y z quality\n1 2 3 9\n1 2 9\n", "a.xyz", "line 3 has 3 cells where 4 are expected"),  # no z
        (b"date x y z\n2020-01-01 10:00 1 2 3\n", "a.xyz", "line 2 has 5 cells where 4"),
        (b"1,2,3\n\x00\x00,1,2\n", "a.csv", "not text in UTF-8: a zero byte on line 2"),
        (b"PK\x03\x04\x14\x00", "a.csv", "a zero byte on line 1"),
        (b"# cloud\n3\n1 2 3\n4 5 6\n", "a.xyz", "line 2: '3' is no point x, y, z; accepted are cells separated by"),
        (b"x|y|z\n1|2|3\n", "a.txt", r"line 2: '1\|2\|3' is no point"),
        (b"x y z\n1 2 \xb5\n", "a.xyz", "byte 10, line 2"),
        (b"1,2,3,4\n", "a.csv", "4 columns"),
        (b"\xff\xfe\x00", "a.csv", "not text in UTF-8"),
        (b"PK\x03\x04", "a.npy", "not an NPY file"),
        (b"\x93NUMPY\x03\x00", "a.npy", "not an NPY file"),
        (npy(np.zeros((3, 4))), "a.npy", r"shape \(3, 4\)"),
        (npy(np.array([{}], dtype=object)), "a.npy", "not an NPY file"),
        (b"not gzip", "a.csv.gz", "not a .gz file"),
        (b"not xz", "a.csv.xz", "not a .xz file"),
        (gzip.compress(TEXT, mtime=0)[:-9], "a.csv.gz", "not a .gz file"),
        (lzma.compress(TEXT)[:-9], "a.csv.xz", "not a .xz file"),
    ],
)
def test_a_file_that_holds_no_points_says_why(data: bytes, name: str, message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        parse_points(data, name)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("x;y;z\n0,5;1;2\n345,123;4,0;-5,25\n", "a.csv"),
        ("0,5;1;2\n345,123;4,0;-5,25\n", "a.csv"),
        ("sep=;\nx;y;z\n0,5;1;2\n345,123;4;-5,25\n", "a.csv"),
        ("x\ty\tz\n0,5\t1\t2\n345,123\t4,0\t-5,25\n", "a.txt"),
        ("0,5 1,0 2,0\n345,123 4,0 -5,25\n", "a.xyz"),
        ('x,y,z\n"0,5","1","2"\n"345,123","4","-5,25"\n', "a.csv"),
        ("x;y;z;note\n0,5;1;2;no. 1\n345,123;4;-5,25;no. 2\n", "a.csv"),
    ],
)
def test_decimal_commas_are_read_where_they_can_be_nothing_else(text: str, name: str) -> None:
    np.testing.assert_array_equal(parse_points(text.encode(), name).points, [[0.5, 1, 2], [345.123, 4, -5.25]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x;y;z\n1.5;2,5;3\n", "line 2: y is '2,5'.*decimal commas are accepted where no number has a point"),
        ("x;y;z\n1;2;1.234,5\n", "line 2: z is '1.234,5'"),
        ("x;y;z\n1;2;1,234,567\n", "line 2: z is '1,234,567'"),
        ("x\ty\tz\n1\t2\t3\n1,234\t2,345\t3\n", "line 3: x is '1,234'.*must not look like thousands"),
        ('x,y,z\n1,2,"1,234"\n', "line 2: z is '1,234'"),
        ("x,y,z\n1,5,2,5,3,5\n", "line 2 has 6 cells where 3 are expected"),
    ],
)
def test_commas_that_may_be_something_else_are_refused(text: str, message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        parse_points(text.encode(), "a.csv")


@pytest.mark.parametrize(
    "text",
    [
        "1,2,3,\n4,5,6,\n",
        "x,y,z\n1,2,3,\n4,5,6,\n",
        '"x","y","z"\r\n"1", "2", "3"\r\n"4","5","6"\r\n',
        '"x" "y" "z"\n1 2 3\n4 5 6\n',
        'x,y,z,note\n1,2,3,"a, 9, 9, 9"\n4,5,6,"not closed\n',
        'note,x,y,z\n"a, 9, 9, 9",1,2,3\nb,4,5,6\n',
        "x\ty\tz\n1.\t+2\t3D+00\n4\t.5d1\t60E-1\n",
        "\t1\t2\t3\n\t4\t5\t6\n",
        "x\ty\tz\t\n1\t2\t3\t\n4\t5\t6\t\n",
        "1,2,3\r\n4,5,6\r\n\x1a",
        "  1   2   3 \n 40e-1 5.0 6.00\n",
        "x,y,z\r1,2,3\r4,5,6\r",
        "x,y,z,station\n1,2,3,A #1\n4,5,6,A #2\n",
    ],
)
def test_what_programs_write(text: str) -> None:
    np.testing.assert_array_equal(parse_points(text.encode(), "a.csv").points, [[1, 2, 3], [4, 5, 6]])


def test_a_row_with_a_word_in_it_is_not_taken_for_names() -> None:
    text = b"1,2,3,rock\n4,5,6,sand\n"
    np.testing.assert_array_equal(parse_points(text, "a.csv", ("0", "1", "2")).points, [[1, 2, 3], [4, 5, 6]])
    text = b",0,1,2\n0,1.0,2.0,3.0\n1,4.0,5.0,6.0\n"  # pandas
    np.testing.assert_array_equal(parse_points(text, "a.csv", ("1", "2", "3")).points, [[1, 2, 3], [4, 5, 6]])


def test_numbers_are_read_to_the_last_bit_in_either_way() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (300, 3)) * [6.4e6, 1.7e12, 1e-3]
    text = "\n".join(",".join(map(repr, point)) for point in points.tolist())
    np.testing.assert_array_equal(parse_points(text.encode(), "a.csv").points, points)
    np.testing.assert_array_equal(parse_points(f'x,y,z,"note"\n{text}'.encode(), "a.csv").points, points)


def long_text(row: str, at: int, template: str = "{k};{k};7") -> bytes:
    """Lines of a table of several blocks, of which one is `row`."""
    lines = [template.format(k=k) for k in range(3 * BLOCK)]
    return "\n".join([*lines[:at], row, *lines[at:]]).encode()


def test_one_cell_that_numpy_does_not_read_costs_its_block(monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[int] = []
    cells = Table.cells

    def counted(table: Table, row: int) -> list[str]:
        read.append(row)
        return cells(table, row)

    monkeypatch.setattr(Table, "cells", counted)
    for row, z in (("0;0;", np.nan), ('0;0;"5"', 5.0), ("0;0;5,0", 5.0)):
        read.clear()
        values = Table.of(long_text(row, 2 * BLOCK).decode(), "a.csv").columns((0, 1, 2), "xyz")
        expected = np.array([[k, k, 7.0] for k in range(3 * BLOCK)])
        np.testing.assert_array_equal(values, np.insert(expected, 2 * BLOCK, [0.0, 0.0, z], axis=0))
        if "," not in row:
            assert read == list(range(2 * BLOCK, 3 * BLOCK))


@pytest.mark.parametrize("at", [1, BLOCK, 3 * BLOCK - 1])
def test_what_is_wrong_far_down_is_told_by_its_line(at: int) -> None:
    with pytest.raises(FileFormatError, match=f"line {at + 1}: y is 'two'"):
        parse_points(long_text("1;two;3", at), "a.csv", ("0", "1", "2"))
    with pytest.raises(FileFormatError, match=f"line {at + 1} has 2 cells, and z is to be the one after 2"):
        parse_points(long_text("1;2", at), "a.csv", ("0", "1", "2"))


@pytest.mark.parametrize("at", [1, BLOCK, 3 * BLOCK - 1])
def test_a_decimal_comma_anywhere_goes_with_no_point_anywhere(at: int) -> None:
    with pytest.raises(FileFormatError, match=f"line {at + 1}: z is '1,5'"):
        parse_points(long_text("1;2;1,5", at, "{k};{k};7.0"), "a.csv")
    cloud = parse_points(long_text("1;2;1,5;no. 0", at, "{k};{k};7;no. {k}"), "a.csv", ("0", "1", "2"))
    np.testing.assert_array_equal(cloud.points[at], [1, 2, 1.5])


@pytest.mark.parametrize("header", ["z,a,b", "x,x,y", "x,lat,long", "lon,lat,height,depth", "y,x,z,z", "y,a,b"])
def test_names_that_leave_the_axes_open_are_refused(header: str) -> None:
    row = ",".join("123456"[: header.count(",") + 1])
    with pytest.raises(FileFormatError, match=r"not clear; x may be called .*longitude.*--columns 0,1,2 "):
        parse_points(f"{header}\n{row}\n".encode(), "a.csv")


@pytest.mark.parametrize(
    "text",
    [
        "# lat lon depth\n1 0 2.5\n4 3 -5\n",
        "# lat, lon, depth\n1 0 2.5\n4 3 -5\n",
        "# lat lon depth\n1,0,2.5\n4,3,-5\n",
        "# survey of 2020\n# Latitude [deg] Longitude [deg] Depth [m]\n#\n# by hand\n1 0 2.5\n4 3 -5\n",
        "//Y X Z\n1 0 2.5\n4 3 -5\n",
        "% northing;easting;value\n1;0;2.5\n4;3;-5\n",
        "#,Y,X,Z\n1,1,0,2.5\n2,4,3,-5\n",
        "# lat lon value\n1 0 2.5\n4 3 -5\n",
        "Y [m] X [m] Z [m]\n1 0 2.5\n4 3 -5\n",
        "y,x,z\n1 0 2.5\n4 3 -5\n",
    ],
)
def test_names_in_a_comment_count_as_those_of_a_first_line(text: str) -> None:
    np.testing.assert_array_equal(parse_points(text.encode(), "a.xyz").points, POINTS)


def test_names_that_numpy_writes_are_read(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "a.txt", POINTS[:, [1, 0, 2]], header="lat lon depth")
    cloud = read_points(tmp_path / "a.txt")
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.notes == ()
    np.savetxt(tmp_path / "b.txt", POINTS[:, [2, 0, 1]], header="a b c")
    np.testing.assert_array_equal(read_points(tmp_path / "b.txt", ("B", "c", "a")).points, POINTS)


@pytest.mark.parametrize("comment", ["made by hand", "depth in metres", "1 2 3", "lat lon"])
def test_a_comment_that_holds_no_names_is_a_comment(comment: str) -> None:
    np.testing.assert_array_equal(parse_points(f"# {comment}\n0 1 2.5\n3 4 -5\n".encode(), "a.xyz").points, POINTS)


@pytest.mark.parametrize(
    ("header", "note"),
    [
        ("x,y,z", ""),
        ("lon,lat,Depth [m]", ""),
        ("a,b,c", "a.csv: x, y, z are taken from the columns a, b, c; --columns takes others"),
        (
            "lon,lat,bathymetry_m",
            "a.csv: x, y, z are taken from the columns lon, lat, bathymetry_m; --columns takes others",
        ),
    ],
)
def test_a_note_tells_which_columns_of_unknown_names_were_taken(header: str, note: str) -> None:
    text = f"{header}\n0,1,2.5\n3,4,-5\n".encode()
    assert parse_points(text, "a.csv").notes == ((note,) if note else ())
    assert parse_points(text, "a.csv", ("0", "1", "2")).notes == ()


@pytest.mark.parametrize(
    ("header", "columns", "message"),
    [
        ("lon,lat,depth", ("lon", "lat"), r"three columns .* not 2 \(lon, lat\); .* 0 to 2, names lon, lat, depth"),
        ("lon,lat,depth", ("lon", "lat", "3"), "'3' is none of the file's columns: numbers 0 to 2, names lon, lat"),
        ("x,y,y", ("x", "y", "2"), "'y' is more than one of"),
        ("", ("x", "y", "z"), "'x' is none of the file's columns: numbers 0 to 2$"),
    ],
)
def test_columns_that_are_not_three_of_the_file_are_told(header: str, columns: tuple[str, ...], message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        parse_points(f"{header}\n1,2,3\n4,5,6\n".encode(), "a.csv", columns)


def test_columns_are_found_without_their_unit_and_by_number_beside_too_few_names() -> None:
    text = b"Depth [m],lon (deg),lat (deg),lon\n2.5,9,1,0\n-5,9,4,3\n"
    np.testing.assert_array_equal(parse_points(text, "a.csv", ("lon", "lat", "depth")).points, POINTS)
    text = b'"u" "v" "w"\n"1" 0 1 2.5\n"2" 3 4 -5\n'  # as R writes it, names of rows without one of their own
    np.testing.assert_array_equal(parse_points(text, "a.txt", ("1", "2", "3")).points, POINTS)


def test_the_columns_of_an_array_are_taken_by_number() -> None:
    array = npy(np.column_stack([POINTS[:, 2], np.ones(2), POINTS[:, :2]]))
    np.testing.assert_array_equal(parse_points(array, "a.npy", ("2", "3", "0")).points, POINTS)
    with pytest.raises(FileFormatError, match=r"'x' is none of the file's columns: numbers 0 to 3$"):
        parse_points(array, "a.npy", ("x", "3", "0"))


@pytest.mark.parametrize(
    "text",
    [
        b"# x" + b" " * 1_000_000 + b"y\n1,2,3\n",
        b"1,2,3\n4,5," + b"9" * 1_000_000 + b"x\n",
        b"ncols 1\n" * 125_000,
    ],
    ids=["blanks", "digits", "headers"],
)
def test_long_runs_are_read_once(text: bytes) -> None:
    # With a pattern that goes back over them a megabyte takes hours, which no test is given.
    with contextlib.suppress(SurfacelinkError):
        parse_points(text, "a.csv")


def test_a_column_of_thousands_of_digits_is_none() -> None:
    with pytest.raises(FileFormatError, match="is none of the file's columns"):
        parse_points(TEXT, "a.csv", ("9" * 5000, "0", "1"))


def test_columns_that_are_not_there_are_named() -> None:
    with pytest.raises(FileFormatError, match=r"'depth' is none of .*x, y, z"):
        parse_points(TEXT, "a.csv", ("x", "y", "depth"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,z\n1,2,3\ninf,4,5\n", "line 3: x is missing, NaN or infinite"),
        ("x,y,z\n1,2,3\n\n1,,5\n", "line 4: y is missing"),
        ("1,2,-inf\n", "line 1: z is"),
    ],
)
def test_numbers_that_are_not_finite_are_refused(text: str, message: str) -> None:
    for no_data in (None, "nan", 3.0):
        with pytest.raises(PointsError, match=message):
            parse_points(text.encode(), "a.csv", no_data=no_data)


HOLES = b"x,y,z\n0,1,2.5\n# no fix\n7,8,\n7,8,NaN\n3,4,-5\n7,8,n/a\n"


@pytest.mark.parametrize(
    ("data", "name", "place"),
    [
        (HOLES, "a.csv", "line 4"),
        (b"0 1 2.5\n3 4 -5\n7 8 nan\n7 8 nan\n7 8 NaN", "a.xyz", "line 3"),
        (b"0;1;2,5\n3;4;-5,0\n7;8;\n7,5;8;\n7;8;", "a.csv", "line 3"),
        (npy(np.vstack([POINTS, np.full((3, 3), np.nan)])), "a.npy", "row 2, counted from 0"),
    ],
)
def test_points_without_a_height_are_left_out_where_that_is_asked_for(data: bytes, name: str, place: str) -> None:
    with pytest.raises(PointsError, match=f"{name}: 3 of 5 points have no height .* {place}; .*--no-data nan"):
        parse_points(data, name)
    for no_data in ("nan", -9999.0):
        cloud = parse_points(data, name, no_data=no_data)
        np.testing.assert_array_equal(cloud.points, POINTS)
        assert cloud.notes == (f"{name}: 3 of 5 points have no height and are left out",)


@pytest.mark.parametrize(
    ("written", "said"),
    [("-9999", -9999.0), ("-9999.00", -9999.0), ("-32768", -32768.0), ("-3.402823466385289e+38", -3.4028235e38)],
)
def test_heights_that_stand_for_none_are_left_out_by_their_value(written: str, said: float) -> None:
    text = b"0,1,2.5\n7,8,%s\n3,4,-5\n7,8,\n" % written.encode()
    cloud = parse_points(text, "a.csv", no_data=said)
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.notes == ("a.csv: 2 of 4 points have no height and are left out",)


def test_heights_that_look_like_none_are_kept_and_told() -> None:
    cloud = parse_points(b"0,1,2.5\n7,8,-9999\n3,4,-5\n7,8,-9999\n", "a.csv")
    assert len(cloud.points) == 4
    assert cloud.notes == ("a.csv: 2 heights are -9999, which often stands for none; --no-data -9999 leaves them out",)


GRID = """ncols 3
nrows 2
xllcorner 10
yllcorner -1
cellsize 2
NODATA_value -9999
1 2 3
4 -9999 6
"""


@pytest.mark.parametrize(
    "text",
    [
        GRID,
        GRID.replace("\n", "\r\n") + "\x1a",
        GRID.replace("\n", "\r"),
        GRID.upper().replace("XLLCORNER 10", "XLLCENTER 11").replace("YLLCORNER -1", "YLLCENTER 0"),
        GRID.replace("cellsize 2", "dx 2\ndy 2.0"),
        "\n" + GRID.replace(" ", "  \t ").replace("10", "10,0"),
        GRID.replace("2 3\n4", "2\n3 4"),  # a row may end anywhere
        GRID.replace("nrows 2\n", "").replace("ncols 3", "nrows 2\nncols 3"),
        GRID.replace("4 -9999", "4 nan").replace("NODATA_value -9999\n", ""),
    ],
)
def test_a_grid_gives_the_centres_of_its_cells(text: str) -> None:
    points = [[11, 2, 1], [13, 2, 2], [15, 2, 3], [11, 0, 4], [15, 0, 6]]
    for name in ("a.asc", "a.txt"):
        cloud = parse_points(text.encode(), name, no_data="nan")
        np.testing.assert_array_equal(cloud.points, points)
        assert cloud.notes == (f"{name}: 1 of 6 points have no height and are left out",)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("", "", "1 of 6 points have no height .* the first on line 8; --no-data nan"),
        ("2 3", "2 three", "line 7: a value is 'three', which is no number"),
        ("cellsize 2", "cellsize two", "line 5: a value is 'two'"),
        ("ncols 3", "ncols 4", "holds 6 heights where nrows 2 x ncols 4 are expected"),
        ("ncols 3\nnrows 2", "ncols -3\nnrows -2", "nrows -2 x ncols -3"),
        ("ncols 3\nnrows 2", "ncols 2.5\nnrows 2.4", "nrows 2.4 x ncols 2.5"),
        ("nrows 2\n", "", "has no nrows before"),
        ("yllcorner -1\n", "", "has no yllcorner or yllcenter before"),
        ("cellsize 2\n", "dx 2\n", "has no dy or cellsize before"),
        ("cellsize 2", "cellsize 0", "a positive number, got 0"),
        ("cellsize 2", "cellsize nan", "a positive number, got nan"),
        ("NODATA_value -9999", "xllcorner inf", "line 7: x is missing, NaN or infinite"),
        (GRID, "ncols 3", "holds 0 heights|has no nrows"),
    ],
)
def test_a_grid_that_is_none_is_told(old: str, new: str, message: str) -> None:
    with pytest.raises((FileFormatError, PointsError), match=message):
        parse_points(GRID.replace(old, new).encode(), "a.asc")


def test_a_grid_has_no_columns_and_no_more_points_than_asked_for() -> None:
    with pytest.raises(FileFormatError, match="no columns to choose from"):
        parse_points(GRID.encode(), "a.asc", ("0", "1", "2"))
    with pytest.raises(LimitError, match="holds 6 points; at most 5"):
        parse_points(GRID.encode(), "a.asc", most=5)


@pytest.mark.parametrize(
    ("data", "name"),
    [(b"V1,V2,V3,V4\n1,2,3,4\n5,6,7,8\n", "a.csv"), (npy(np.arange(8.0).reshape(2, 4)), "a.npy")],
)
def test_a_matrix_of_heights_is_told_how_a_grid_is_read(data: bytes, name: str) -> None:
    with pytest.raises(FileFormatError, match="heights of a grid, a row a line, separated by blanks"):
        parse_points(data, name)
    told = b"ncols 4\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2 3 4\n5 6 7 8\n"
    assert parse_points(told, "a.csv").points[:4].tolist() == [[k + 0.5, 1.5, k + 1] for k in range(4)]


def test_columns_of_which_some_are_known_are_no_grid() -> None:
    with pytest.raises(FileFormatError, match="not clear") as error:
        parse_points(b"lon,a,b,c\n1,2,3,4\n", "a.csv")
    assert "grid" not in str(error.value)


def test_points_in_a_file_of_grids_are_read() -> None:
    np.testing.assert_array_equal(parse_points(b"0 1 2.5\n3 4 -5\n", "a.asc").points, POINTS)


def test_a_file_without_any_height_says_so() -> None:
    with pytest.raises(PointsError, match="none of its 2 points has a height"):
        parse_points(b"x,y,z\n1,2,\n3,4,\n", "a.csv", no_data="nan")


def test_complex_numbers_are_no_coordinates() -> None:
    with pytest.raises(FileFormatError, match="complex128; accepted are real numbers"):
        parse_points(npy(np.ones((3, 3), complex)), "a.npy")


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"cannot read .*No such file"):
        read_points(tmp_path / "none.csv")
    with pytest.raises(FileFormatError, match="cannot read"):
        read_points(tmp_path)
    with pytest.raises(FileFormatError, match=r"No such file or directory$"):
        read_points(tmp_path / "nowhere" / "none.csv")
    (tmp_path / "prairie.tif").touch()
    with pytest.raises(FileFormatError, match=r"No such file or directory; did you mean 'prairie\.tif'"):
        read_points(tmp_path / "prairy.tif")


@given(
    st.binary(max_size=200),
    st.sampled_from(["a.csv", "a.xyz", "a.npy", "a.csv.gz", "a.npy.xz", "a.npz", "a.tif", "a.hgt"]),
)
@example(b'"' + b"a" * 200_000, "a.csv")
@example(b'1,2,3\n"' + b"a" * 200_000 + b",2,3", "a.csv")
@example(b"\x00\x01,\x02,\x03\n1,2,3\n", "a.csv")
def test_any_bytes_are_points_or_our_error(data: bytes, name: str) -> None:
    try:
        points = parse_points(data, name).points
    except SurfacelinkError:
        return
    assert points.shape[1] == 3


@pytest.mark.parametrize(
    ("name", "made"),
    [
        ("california_gps.csv.xz", "california_gps"),
        ("data/hills.CSV.gz", "hills"),
        ("hills.npy", "hills"),
        ("hills.2024.xyz", "hills.2024"),
        ("my field.csv", "my-field"),
        (".csv.xz", "csv"),
        ("dem.tiff", "dem"),
        ("N44W072.hgt.gz", "N44W072"),
        ("surface-1", "surface-1"),
    ],
)
def test_the_id_of_a_file_is_its_name_without_the_endings_that_are_understood(name: str, made: str) -> None:
    assert transmission_id(name) == made


@given(st.text(alphabet='0123456789.,;- \t\n\r"#xyzdeN', max_size=60))
def test_any_text_is_points_or_our_error(text: str) -> None:
    with contextlib.suppress(SurfacelinkError):
        assert parse_points(text.encode(), "a.csv").points.shape[1] == 3
