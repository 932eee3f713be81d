"""The forms an answer can take: one registry, and the choice among them by `?f=` or the header Accept.

A renderer yields the answer in parts, so that a long one neither fills the memory nor holds the interpreter for long.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Generic, TypeVar

import msgpack
import numpy as np
import numpy.typing as npt

from common.errors import NotAcceptableError
from common.extras import is_installed
from common.surface import FloatArray, HeightGrid
from common.wire import MEDIA_TYPE, MEDIA_TYPES
from receiver.picture import Style, picture

PART = 8_192
"""Numbers that are written between two yields: a few milliseconds of work."""

Content = TypeVar("Content")


@dataclass(frozen=True, slots=True)
class GridAnswer:
    """A height grid on its way out.

    Attributes
    ----------
    name : str
        The surface.
    grid : HeightGrid
    std : ndarray, shape (rows, columns), or None
        Standard deviation of the heights, in the units of z, where it was asked for; a picture shows it in their place.
    style : Style
        How a picture of it looks.
    """

    name: str
    grid: HeightGrid
    std: FloatArray | None = None
    style: Style = field(default_factory=Style)


@dataclass(frozen=True, slots=True)
class Table:
    """Named columns of one length on their way out, and what else JSON and msgpack say about them."""

    columns: dict[str, FloatArray]
    about: dict[str, Any]


@dataclass(frozen=True, slots=True)
class Format(Generic[Content]):
    """A form of an answer.

    Attributes
    ----------
    name : str
        What `?f=` calls it, and the ending of a file of it.
    media_type : str
        What the answer's Content-Type says.
    render : callable
        Yields the bytes of some content.
    also : tuple of str
        Other media types that mean it in Accept.
    needs, extra : str
        The module that it needs beyond the project's own dependencies, and the extra of the distribution that brings
        it; "" for none.
    """

    name: str
    media_type: str
    render: Callable[[Content], Iterator[bytes]]
    also: tuple[str, ...] = ()
    needs: str = ""
    extra: str = ""

    @property
    def available(self) -> bool:
        """Whether what it needs is installed."""
        return is_installed(self.needs)


def _little_endian(values: npt.NDArray[Any]) -> bytes:
    """The bytes of C-ordered little-endian float64."""
    return np.ascontiguousarray(values, dtype="<f8").tobytes()


def _parts(values: FloatArray) -> Iterator[tuple[int, list[Any]]]:
    """Rows of `values` as lists, a part at a time, each with the number of its first row."""
    step = max(1, PART // (values[0].size if len(values) else 1))
    for start in range(0, len(values), step):
        yield start, values[start : start + step].tolist()


def _json_array(values: FloatArray) -> Iterator[bytes]:
    """A JSON array of the first axis, its rows in parts."""
    separator = b"["
    for _, rows in _parts(values):
        yield separator + json.dumps(rows, separators=(",", ":"))[1:-1].encode()
        separator = b","
    yield b"]" if len(values) else b"[]"


def _json_object(members: Iterable[tuple[str, Any]]) -> Iterator[bytes]:
    """A JSON object; arrays in parts."""
    separator = "{"
    for name, value in members:
        yield f"{separator}{json.dumps(name)}:".encode()
        if isinstance(value, np.ndarray):
            yield from _json_array(value)
        else:
            yield json.dumps(value, separators=(",", ":")).encode()
        separator = ","
    yield b"}\n"


def _csv(columns: dict[str, FloatArray]) -> Iterator[bytes]:
    yield (",".join(columns) + "\n").encode()
    table = np.column_stack(list(columns.values()))
    for _, rows in _parts(table):
        yield "".join([",".join(map(repr, row)) + "\n" for row in rows]).encode()


def _npy(values: npt.NDArray[Any]) -> Iterator[bytes]:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.ascontiguousarray(values, dtype="<f8"), allow_pickle=False)
    yield buffer.getvalue()


def _npz(arrays: Mapping[str, npt.NDArray[Any]]) -> Iterator[bytes]:
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    yield buffer.getvalue()


def _msgpack(value: dict[str, Any]) -> Iterator[bytes]:
    packed: bytes = msgpack.packb(value)
    yield packed


def _grid_json(answer: GridAnswer) -> Iterator[bytes]:
    grid = answer.grid
    members: list[tuple[str, Any]] = [
        ("id", answer.name),
        ("shape", list(grid.shape)),
        ("units", asdict(grid.units)),
        ("x", grid.x),
        ("y", grid.y),
        ("z", grid.z),
    ]
    return _json_object(members + ([("std", answer.std)] if answer.std is not None else []))


def _grid_csv(answer: GridAnswer) -> Iterator[bytes]:
    points = answer.grid.points()
    columns = {"x": points[:, 0], "y": points[:, 1], "z": points[:, 2]}
    return _csv(columns | ({"std": answer.std.ravel()} if answer.std is not None else {}))


def _grid_npy(answer: GridAnswer) -> Iterator[bytes]:
    return _npy(answer.grid.z if answer.std is None else np.stack([answer.grid.z, answer.std]))


def _grid_npz(answer: GridAnswer) -> Iterator[bytes]:
    grid = answer.grid
    return _npz({"x": grid.x, "y": grid.y, "z": grid.z} | ({"std": answer.std} if answer.std is not None else {}))


def _grid_msgpack(answer: GridAnswer) -> Iterator[bytes]:
    grid = answer.grid
    value: dict[str, Any] = {
        "id": answer.name,
        "shape": list(grid.shape),
        "dtype": "<f8",
        "units": asdict(grid.units),
        "x": _little_endian(grid.x),
        "y": _little_endian(grid.y),
        "z": _little_endian(grid.z),
    }
    return _msgpack(value | ({"std": _little_endian(answer.std)} if answer.std is not None else {}))


def _grid_png(answer: GridAnswer) -> Iterator[bytes]:
    if answer.std is None:
        yield picture(answer.grid, answer.name, answer.style)
        return
    # Light tells slopes of the ground; a deviation has none.
    deviations = HeightGrid(answer.grid.x, answer.grid.y, answer.std, answer.grid.units)
    yield picture(deviations, answer.name, replace(answer.style, shading=False), "standard deviation")


def _grid_tif(answer: GridAnswer) -> Iterator[bytes]:
    """GeoTIFF, float64, north up, pixels as points; a second band is the standard deviation."""
    import tifffile  # an extra

    grid = answer.grid
    bands = [grid.z] if answer.std is None else [grid.z, answer.std]
    image = np.stack([band[::-1] for band in bands]).astype("<f8")
    step_x = grid.region.width / (grid.shape[1] - 1)
    step_y = grid.region.height / (grid.shape[0] - 1)
    tie = (0.0, 0.0, 0.0, float(grid.x[0]), float(grid.y[-1]), 0.0)
    # GTModelTypeGeoKey user-defined: no datum is known; GTRasterTypeGeoKey: a pixel stands for its centre.
    keys = (1, 1, 0, 2, 1024, 0, 1, 32_767, 1025, 0, 1, 2)
    buffer = io.BytesIO()
    tifffile.imwrite(
        buffer,
        image if len(bands) > 1 else image[0],
        photometric="minisblack",
        planarconfig="separate" if len(bands) > 1 else None,
        metadata=None,
        description=f"{answer.name}: heights{f' in {grid.units.z}' if grid.units.z else ''}",
        software="surfacelink",
        extratags=[
            (33_550, "d", 3, (step_x, step_y, 0.0), True),
            (33_922, "d", 6, tie, True),
            (34_735, "H", len(keys), keys, True),
        ],
    )
    yield buffer.getvalue()


def _table_json(table: Table) -> Iterator[bytes]:
    return _json_object([*table.about.items(), *table.columns.items()])


def _table_csv(table: Table) -> Iterator[bytes]:
    return _csv(table.columns)


def _table_npy(table: Table) -> Iterator[bytes]:
    return _npy(np.column_stack(list(table.columns.values())))


def _table_npz(table: Table) -> Iterator[bytes]:
    return _npz(table.columns)


def _table_msgpack(table: Table) -> Iterator[bytes]:
    packed = {name: _little_endian(values) for name, values in table.columns.items()}
    return _msgpack(table.about | {"dtype": "<f8"} | packed)


_MSGPACK_ALSO = tuple(sorted(MEDIA_TYPES - {MEDIA_TYPE}))
_NPY_ALSO = ("application/npy", "application/octet-stream")

GRID_FORMATS: tuple[Format[GridAnswer], ...] = (
    Format("json", "application/json", _grid_json),
    Format("csv", "text/csv", _grid_csv),
    Format("npy", "application/x-npy", _grid_npy, _NPY_ALSO),
    Format("npz", "application/x-npz", _grid_npz, ("application/npz",)),
    Format("msgpack", MEDIA_TYPE, _grid_msgpack, _MSGPACK_ALSO),
    Format("png", "image/png", _grid_png),
    Format("tif", "image/tiff", _grid_tif, ("image/geotiff",), needs="tifffile", extra="tif"),
)

TABLE_FORMATS: tuple[Format[Table], ...] = (
    Format("json", "application/json", _table_json),
    Format("csv", "text/csv", _table_csv),
    Format("npy", "application/x-npy", _table_npy, _NPY_ALSO),
    Format("npz", "application/x-npz", _table_npz, ("application/npz",)),
    Format("msgpack", MEDIA_TYPE, _table_msgpack, _MSGPACK_ALSO),
)


def _accepted(accept: str) -> list[tuple[str, float]]:
    """(media range, q) of a header Accept; what cannot be read is left out (RFC 9110, section 12.5.1)."""
    ranges = []
    for part in accept.split(","):
        media, *parameters = (piece.strip().lower() for piece in part.split(";"))
        q = 1.0
        for parameter in parameters:
            name, _, value = parameter.partition("=")
            if name.strip() == "q":
                try:
                    q = min(1.0, max(0.0, float(value)))
                except ValueError:
                    q = 0.0
        if media:
            ranges.append((media, q))
    return ranges


def _quality(media_type: str, ranges: Sequence[tuple[str, float]]) -> float:
    """The q of the most specific range that `media_type` is in; 0 where it is in none."""
    kind = media_type.partition("/")[0]
    for wanted in (media_type, f"{kind}/*", "*/*"):
        found = [q for media, q in ranges if media == wanted]
        if found:
            return max(found)
    return 0.0


def choose(formats: Sequence[Format[Content]], name: str | None, accept: str | None) -> Format[Content]:
    """The format that `name` (of ``?f=``) or else the header Accept asks for; the first one where neither does.

    Raises
    ------
    NotAcceptableError
        If there is no such format, or what it needs is not installed.
    """
    offered = ", ".join(form.name for form in formats)
    if name is not None:
        chosen = next((form for form in formats if form.name == name), None)
        if chosen is None:
            raise NotAcceptableError(f"?f= is one of {offered}")
    elif not (ranges := _accepted(accept or "")):
        chosen = formats[0]
    else:
        qualities = [max(_quality(media, ranges) for media in (form.media_type, *form.also)) for form in formats]
        best = max(qualities)
        if best == 0:
            types = ", ".join(form.media_type for form in formats)
            raise NotAcceptableError(f"the header Accept names none of {types}; ?f= chooses among {offered}")
        chosen = formats[qualities.index(best)]
    if not chosen.available:
        raise NotAcceptableError(
            f"{chosen.name} needs the package {chosen.needs}, which is not installed here; "
            f"pip install 'surfacelink[{chosen.extra}]' brings it"
        )
    return chosen
