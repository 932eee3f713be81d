"""Grids in .npz and .hgt to points, and the real files of the four formats of grids."""

from __future__ import annotations

import contextlib
import gzip
import io
import tracemalloc
import zipfile
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.terrain import FOLDER
from common.errors import FileFormatError, LimitError, PointsError, SurfacelinkError
from common.surface import HeightGrid
from receiver.formats import GRID_FORMATS, GridAnswer
from sender.readers import parse_points, read_points

Z = np.array([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]])
POINTS = np.array([[0.0, 1.0, 2.5], [3.0, 4.0, -5.0]])
COUNTED = [[x, 1 - row, Z[row, x]] for row in range(2) for x in range(4)]
UNPLACED = "a.npz does not say where it lies; x and y are its columns and rows, counted from the lower left"


def npz(**arrays: Any) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


@pytest.mark.parametrize(
    "arrays",
    [
        {"x": [0, 1, 2, 3], "y": [1, 0], "z": Z},
        {"longitude": [0, 1, 2, 3], "Latitude (deg)": [1, 0], "topo": Z, "std": [1]},
        {"x": [0, 1, 2, 3], "y": [1, 0], "z": Z.astype(">i2"), "std": Z},
        {"z": Z, "dx": 1.0, "dy": 1, "units": "m"},
        {"heights": np.asfortranarray(Z.astype(np.float32)), "dx": 1.0, "dy": 1},
        {
            "x": np.arange(4.0) + np.zeros((2, 1)),
            "y": np.array([[1.0], [0.0]]) + np.zeros(4),
            "z": Z,
        },
    ],
)
def test_a_grid_that_says_where_its_heights_lie(arrays: dict[str, Any]) -> None:
    for data, name in ((npz(**arrays), "a.npz"), (gzip.compress(npz(**arrays)), "a.NPZ.gz")):
        cloud = parse_points(data, name)
        np.testing.assert_array_equal(cloud.points, COUNTED)
        assert cloud.notes == ()


@pytest.mark.parametrize("arrays", [{"z": Z}, {"arr_0": Z}, {"elevation": Z, "xmin": 3.0, "words": ["a", "b"]}])
def test_a_grid_that_lies_nowhere_has_columns_and_rows(arrays: dict[str, Any]) -> None:
    cloud = parse_points(npz(**arrays), "a.npz")
    np.testing.assert_array_equal(cloud.points, COUNTED)
    assert cloud.notes == (UNPLACED,)


def test_the_first_row_is_the_northernmost_and_spacing_is_kept() -> None:
    points = parse_points(npz(z=Z, dx=0.5, dy=2.0), "a.npz").points
    np.testing.assert_array_equal(points[[0, 3, 4]], [[0, 2, 1], [1.5, 2, 4], [0, 0, 5]])


@pytest.mark.parametrize(
    ("arrays", "columns"),
    [
        ({"arr_0": POINTS}, None),
        ({"survey": POINTS, "station": 3}, None),
        ({"x": POINTS[:, 0], "y": POINTS[:, 1], "z": POINTS[:, 2]}, None),
        ({"lon": POINTS[:, 0], "lat": POINTS[:, 1], "depth": POINTS[:, 2], "z_std": POINTS[:, 2]}, None),
        ({"arr_0": np.column_stack([POINTS[:, 2], [9, 9], POINTS[:, :2]])}, ("2", "3", "0")),
    ],
)
def test_points(arrays: dict[str, Any], columns: tuple[str, ...] | None) -> None:
    cloud = parse_points(npz(**arrays), "a.npz", columns)
    np.testing.assert_array_equal(cloud.points, POINTS)
    assert cloud.notes == ()


def test_heights_in_three_columns_are_heights_where_they_are_called_so() -> None:
    assert len(parse_points(npz(z=Z[:, :3]), "a.npz").points) == 6
    assert len(parse_points(npz(a=Z[:, :3]), "a.npz").points) == 2


def test_what_the_receiver_answers_is_read() -> None:
    grid = HeightGrid(np.linspace(-1, 1, 5), np.linspace(0, 0.3, 4), np.random.default_rng(0).normal(size=(4, 5)))
    render = next(form for form in GRID_FORMATS if form.name == "npz").render
    for std in (None, np.abs(grid.z)):
        data = b"".join(render(GridAnswer("hills", grid, std)))
        np.testing.assert_array_equal(parse_points(data, "hills.npz").points, grid.points())


def test_missing_heights_are_told_by_row_and_column() -> None:
    z = Z.copy()
    z[1, 2] = np.nan
    with pytest.raises(PointsError, match=r"1 of 8 points have no height .* row 1, column 2, counted from 0; .*nan"):
        parse_points(npz(z=z), "a.npz")
    assert len(parse_points(npz(z=z), "a.npz", no_data="nan").points) == 7


class Touched:
    """Ends the process when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, ("raise SystemExit('unpickled')",)


def zipped(**members: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return buffer.getvalue()


def header(shape: tuple[int, ...], dtype: str = "<f8") -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array_header_1_0(buffer, {"descr": dtype, "fortran_order": False, "shape": shape})
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (npz(a=Z, b=Z), r"holds a \(2, 4\) float64, b \(2, 4\) float64; accepted are heights z \(rows, columns\)"),
        (npz(), "holds no array; accepted"),
        (npz(z=np.array([Touched()])), r"holds z \(1,\) object; accepted are"),
        (npz(z=Z.astype(complex)), r"holds z \(2, 4\) complex128"),
        (npz(z=Z[0]), r"holds z \(4,\) float64; accepted"),
        (npz(z=np.zeros((2, 3, 4))), r"holds z \(2, 3, 4\) float64; accepted"),
        (npz(z=Z, x=[1, 2, 3]), r"holds z \(2, 4\) float64, x \(3,\) int64"),
        (npz(z=Z, x=[1, 2], y=[1, 2, 3, 4]), r"x \(columns,\) and y \(rows,\)"),
        (npz(z=Z, dx=1.0), r"dx \(\) float64; accepted"),
        (npz(z=Z, dx=[1.0], dy=[1.0]), r"dx \(1,\) float64"),
        (npz(z=Z, dx=0.0, dy=1.0), "dx and dy, the spacing of its heights, must be positive, got 0 and 1"),
        (npz(z=Z, dx=np.nan, dy=1.0), "must be positive, got nan and 1"),
        (npz(**{f"a{k}": Z for k in range(20)}), r"a7 \(2, 4\) float64, \.\.\.; accepted"),
        (npz(a=Z)[:-30], "a.npz is not an NPZ file of arrays, or a damaged one: File is not a zip file"),
        (zipped(z=b"no array"), "is not an NPZ file of arrays"),
        (zipped(z=header((2, 4))), "is not an NPZ file of arrays"),
        (b"", "is not an NPZ file of arrays"),
    ],
)
def test_an_archive_that_is_no_surface_says_what_it_holds(data: bytes, message: str) -> None:
    with pytest.raises(FileFormatError, match=message):
        parse_points(data, "a.npz")


def test_a_grid_has_no_columns_to_choose_from() -> None:
    for data, name in ((npz(z=Z), "a.npz"), (npz(z=Z, dx=1.0, dy=1.0), "a.npz"), (hgt(), "N44W072.hgt")):
        with pytest.raises(FileFormatError, match="no columns to choose from"):
            parse_points(data, name, ("0", "1", "2"))


def test_no_more_points_than_asked_for_are_read() -> None:
    for data, name, count in ((npz(z=Z), "a.npz", 8), (npz(a=POINTS), "a.npz", 2), (hgt(), "N44W072.hgt", 1201**2)):
        assert len(parse_points(data, name, most=count).points) == count
        with pytest.raises(LimitError, match=f"holds {count} points; at most {count - 1}"):
            parse_points(data, name, most=count - 1)


def contents_bomb() -> bytes:
    """An archive of nothing but a long table of contents."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for k in range(15_000):
            archive.writestr(f"{k:050}.npy", b"")
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("data", "error", "message"),
    [
        (zipped(z=header((10**6, 10**6)) + bytes(50_000_000)), LimitError, "holds 1000000000000 points"),
        (zipped(a=header((10, 10**9)) + bytes(50_000_000)), LimitError, "holds 10000000000 points"),
        (zipped(a=header((100, 3), "<U9999999") + bytes(50_000_000)), FileFormatError, "holds a"),
        (zipped(z=b"\x93NUMPY\x02\x00" + b"\xff\xff\xff\x7f" + bytes(50_000_000)), FileFormatError, "not an NPZ file"),
        (contents_bomb(), FileFormatError, "table of contents is larger"),
    ],
    ids=["rows", "columns", "words", "header", "contents"],
)
def test_sizes_are_refused_before_they_take_memory(data: bytes, error: type[Exception], message: str) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(error, match=message):
            parse_points(data, "a.npz")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 20_000_000


def test_rows_of_many_columns_are_no_way_round_the_limit() -> None:
    with pytest.raises(FileFormatError, match="holds more than 1024 MiB"):
        parse_points(zipped(a=header((1000, 10**6))), "a.npz", ("0", "1", "2"))


@given(st.data())
def test_a_damaged_archive_is_points_or_our_error(data: st.DataObject) -> None:
    archive = npz(z=Z, dx=1.0, dy=1.0)
    damaged = bytearray(archive[: data.draw(st.integers(0, len(archive)) | st.just(len(archive)))])
    if damaged:
        for bit in data.draw(st.lists(st.integers(0, 8 * len(damaged) - 1), max_size=4)):
            damaged[bit // 8] ^= 1 << bit % 8
    with contextlib.suppress(SurfacelinkError):
        assert parse_points(bytes(damaged), "a.npz", most=100_000).points.shape[1] == 3


def hgt(void: bool = False) -> bytes:
    z = np.arange(1201 * 1201).reshape(1201, 1201) % 3000
    if void:
        z[1200, 3] = -32768
    return z.astype(">i2").tobytes()


@pytest.mark.parametrize(
    ("name", "x", "y"),
    [
        ("N44W072.hgt", -72, 44),
        ("s04e007.SRTMGL3.hgt", 7, -4),
        ("N00_E179_v3.HGT", 179, 0),
    ],
)
def test_a_square_of_srtm_lies_where_its_name_says(name: str, x: float, y: float) -> None:
    cloud = parse_points(hgt(), name)
    assert cloud.notes == ()
    np.testing.assert_allclose(
        cloud.points[[0, 1200, 1201, -1]],
        [[x, y + 1, 0], [x + 1, y + 1, 1200], [x, y + 1199 / 1200, 1201], [x + 1, y, (1201 * 1201 - 1) % 3000]],
        rtol=1e-15,
    )
    np.testing.assert_array_equal(parse_points(gzip.compress(hgt(), 1), f"{name}.gz").points, cloud.points)


def test_a_square_whose_name_does_not_place_it_has_columns_and_rows() -> None:
    for name in ("upload.hgt", "N44W72.hgt", "N44W0721.hgt"):
        cloud = parse_points(hgt(), name)
        np.testing.assert_array_equal(cloud.points[[0, -1], :2], [[0, 1200], [1200, 0]])
        assert cloud.notes == (
            f"{name} does not say where it lies; x and y are its columns and rows, counted from the lower left; "
            "a name such as N44W072.hgt places it in degrees",
        )


def test_voids_are_no_heights() -> None:
    with pytest.raises(PointsError, match=r"1 of 1442401 points have no height .* row 1200, column 3"):
        parse_points(hgt(void=True), "N44W072.hgt")
    assert len(parse_points(hgt(void=True), "N44W072.hgt", no_data="nan").points) == 1201 * 1201 - 1


@pytest.mark.parametrize("size", [0, 3, 1201 * 1201 * 2 - 1, 1201 * 1201 * 2 + 2, 100 * 100 * 2])
def test_a_file_of_another_size_is_no_square_of_srtm(size: int) -> None:
    message = f"it holds {size} bytes; accepted are heights, 1201 x 1201 .2884802 bytes. or 3601 x 3601"
    with pytest.raises(FileFormatError, match=message):
        parse_points(bytes(size), "N44W072.hgt")


@pytest.mark.parametrize(
    ("name", "count", "low", "high"),
    [
        (
            "prairie_lidar.tif",
            160_000,
            (429252.813370022, 5150485.924942633, 379.659),
            (429651.813370022, 5150884.924942633, 410.759),
        ),
        ("N44W072.hgt", 1_442_401, (-72, 44, 115), (-71, 45, 1908)),
        ("st_helens.npz", 148_885, (0, 30, 682), (9780, 13980, 2543)),
        ("afm_islands.npz", 65_536, (0, 0, -0.000863), (0.59765625, 0.59765625, 0.0128379)),
    ],
)
def test_real_files(name: str, count: int, low: tuple[float, ...], high: tuple[float, ...]) -> None:
    path = FOLDER / name
    if not path.exists():
        pytest.skip(f"{name} is not in the folder of real surfaces, {FOLDER}; SURFACELINK_SURFACES says where that is")
    points = read_points(path, no_data="nan").points
    assert len(points) == count
    np.testing.assert_allclose(points.min(axis=0), low, rtol=1e-4 if name.startswith("afm") else 1e-6)
    np.testing.assert_allclose(points.max(axis=0), high, rtol=1e-4 if name.startswith("afm") else 1e-6)
