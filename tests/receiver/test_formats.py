from __future__ import annotations

import io
import json
import sys
from dataclasses import replace
from typing import Any

import msgpack
import numpy as np
import pytest
import tifffile
from matplotlib.figure import Figure
from PIL import Image

from common.errors import NotAcceptableError
from common.surface import HeightGrid, Units
from receiver.formats import GRID_FORMATS, PART, TABLE_FORMATS, GridAnswer, Table, choose
from receiver.picture import Style, relief


def grid(rows: int = 4, columns: int = 3) -> GridAnswer:
    x, y = np.linspace(-1, 1, columns), np.linspace(10, 13, rows)
    z = np.random.default_rng(3).normal(size=(rows, columns)) * 10.0 ** (np.arange(columns) % 30)
    return GridAnswer("hills", HeightGrid(x, y, z, Units("km", "m")), np.abs(z))


def rendered(name: str, answer: GridAnswer) -> bytes:
    return b"".join(next(form for form in GRID_FORMATS if form.name == name).render(answer))


@pytest.mark.parametrize(
    ("accept", "name"),
    [
        (None, "json"),
        ("", "json"),
        ("*/*", "json"),
        ("application/*", "json"),
        ("text/csv", "csv"),
        ("text/*", "csv"),
        ("image/*", "png"),
        ("IMAGE/PNG", "png"),
        ("image/tiff, image/png;q=0.9", "tif"),
        ("image/tiff;q=0.2, image/png;q=0.9", "png"),
        ("application/x-msgpack", "msgpack"),
        ("application/octet-stream", "npy"),
        ("application/json;q=0, */*;q=0.1", "csv"),
        ("text/csv;q=0.5, */*;q=0.4", "csv"),
        ("text/html,application/xhtml+xml,image/avif,image/webp,*/*;q=0.8", "json"),
        ("text/csv; charset=utf-8; q=0.7, image/png; q=0.6", "csv"),
        ("application/json;q=high, text/csv;q=0.1", "csv"),
        (",,text/csv,", "csv"),
    ],
)
def test_accept(accept: str | None, name: str) -> None:
    assert choose(GRID_FORMATS, None, accept).name == name


@pytest.mark.parametrize("accept", ["text/html", "image/gif, video/*", "text/csv;q=0", "garbage"])
def test_what_is_not_offered_is_not_acceptable(accept: str) -> None:
    with pytest.raises(NotAcceptableError, match="text/csv"):
        choose(GRID_FORMATS, None, accept)


def test_f_goes_before_accept() -> None:
    assert choose(GRID_FORMATS, "npy", "text/csv").name == "npy"
    with pytest.raises(NotAcceptableError, match=r"json, csv, npy, npz, msgpack$"):
        choose(TABLE_FORMATS, "png", None)


def test_an_extra_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tifffile", None)
    with pytest.raises(NotAcceptableError, match=r"pip install 'surfacelink\[tif\]'"):
        choose(GRID_FORMATS, "tif", None)
    # Who takes any picture is not bothered with it.
    assert choose(GRID_FORMATS, None, "image/*").name == "png"


def test_names_and_media_types_are_unambiguous() -> None:
    for registry in (GRID_FORMATS, TABLE_FORMATS):
        assert len({form.name for form in registry}) == len(registry)
        types = [media for form in registry for media in (form.media_type, *form.also)]
        assert len(set(types)) == len(types)


@pytest.mark.parametrize("shape", [(4, 3), (2, 2), (3, PART + 1), (PART + 1, 2)])
def test_json_and_csv_say_exactly_what_the_numbers_are(shape: tuple[int, int]) -> None:
    answer = grid(*shape)
    told = json.loads(rendered("json", answer))
    np.testing.assert_array_equal(told["z"], answer.grid.z)
    np.testing.assert_array_equal(told["std"], answer.std)
    np.testing.assert_array_equal(told["x"], answer.grid.x)
    np.testing.assert_array_equal(told["y"], answer.grid.y)
    assert told["units"] == {"xy": "km", "z": "m"}
    header, *lines = rendered("csv", answer).decode().splitlines()
    assert header == "x,y,z,std"
    table = np.array([line.split(",") for line in lines], dtype=float)
    np.testing.assert_array_equal(table[:, :3], answer.grid.points())


def test_a_long_answer_comes_in_parts() -> None:
    answer = grid(300, 200)
    for name in ("json", "csv"):
        parts = list(next(form for form in GRID_FORMATS if form.name == name).render(answer))
        assert max(map(len, parts)) < 30 * 4 * PART


def test_binary_forms() -> None:
    answer = grid()
    np.testing.assert_array_equal(np.load(io.BytesIO(rendered("npy", answer))), [answer.grid.z, answer.std])
    bare = GridAnswer("hills", answer.grid)
    np.testing.assert_array_equal(np.load(io.BytesIO(rendered("npy", bare))), answer.grid.z)
    with np.load(io.BytesIO(rendered("npz", answer))) as archive:
        assert set(archive.files) == {"x", "y", "z", "std"}
    packed = msgpack.unpackb(rendered("msgpack", answer))
    np.testing.assert_array_equal(np.frombuffer(packed["std"], "<f8").reshape(packed["shape"]), answer.std)
    assert "std" not in msgpack.unpackb(rendered("msgpack", bare))


def test_the_same_grid_is_the_same_bytes() -> None:
    for form in GRID_FORMATS:
        assert b"".join(form.render(grid())) == b"".join(form.render(grid())), form.name


def test_geotiff_is_north_up_and_says_where_it_lies() -> None:
    answer = grid()
    with tifffile.TiffFile(io.BytesIO(rendered("tif", answer))) as tif:
        heights, deviations = tif.asarray()
        tags = tif.pages[0].tags  # type: ignore[union-attr]
        np.testing.assert_array_equal(heights, answer.grid.z[::-1])
        np.testing.assert_array_equal(deviations, np.abs(answer.grid.z[::-1]))
        assert tags["ModelTiepointTag"].value == (0, 0, 0, -1, 13, 0)
        np.testing.assert_allclose(tags["ModelPixelScaleTag"].value, (1, 1, 0))


def test_tables() -> None:
    columns = {"x": np.array([1.0, 2.0]), "y": np.array([0.1, 1e-300])}
    table = Table(columns, {"id": "hills", "gap": None})
    texts = {form.name: b"".join(form.render(table)) for form in TABLE_FORMATS}
    assert json.loads(texts["json"]) == {"id": "hills", "gap": None, "x": [1.0, 2.0], "y": [0.1, 1e-300]}
    assert texts["csv"] == b"x,y\n1.0,0.1\n2.0,1e-300\n"
    np.testing.assert_array_equal(np.load(io.BytesIO(texts["npy"])), np.column_stack(list(columns.values())))
    assert msgpack.unpackb(texts["msgpack"])["gap"] is None


def test_a_picture_of_deviations_shows_these(monkeypatch: pytest.MonkeyPatch) -> None:
    labels: list[str] = []
    save = Figure.savefig

    def keep(figure: Figure, *arguments: Any, **options: Any) -> None:
        labels.append(figure.axes[1].get_ylabel())
        save(figure, *arguments, **options)

    monkeypatch.setattr(Figure, "savefig", keep)
    answer = grid(20, 30)
    rendered("png", replace(answer, std=None))
    rendered("png", answer)
    assert labels == ["height (m)", "standard deviation (m)"]
    bare = np.asarray(Image.open(io.BytesIO(rendered("png", replace(answer, style=Style(colorbar=False))))))
    assert answer.std is not None
    deviations = HeightGrid(answer.grid.x, answer.grid.y, answer.std)
    np.testing.assert_array_equal(bare, relief(deviations, Style(shading=False)))
