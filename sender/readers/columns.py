"""Which columns of a table are x, y and z."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from common.errors import FileFormatError

NAMES: Mapping[str, frozenset[str]] = {
    "x": frozenset({"x", "lon", "long", "longitude", "east", "easting"}),
    "y": frozenset({"y", "lat", "latitude", "north", "northing"}),
    "z": frozenset({"z", "height", "elevation", "elev", "altitude", "alt", "depth"}),
}
"""What the columns of a text file, and the arrays of an .npz, may be called, in any case, a unit in brackets after it.
Depths keep their sign."""

GRIDS = (
    "heights of a grid, a row a line, separated by blanks, are read where the lines of an ESRI ASCII grid stand before "
    "them: ncols, nrows, xllcorner, yllcorner and cellsize, each with its value; an array of them is read from .npz"
)
"""What is said of a table that may be a grid, of which --columns would take three columns of heights."""

UNDERSTOOD = "; ".join(f"{axis} may be called {', '.join(sorted(names))}" for axis, names in NAMES.items())


def bare_label(label: str) -> str:
    """A column's name in lower case, without its unit."""
    return re.sub(r"[(\[].*", "", label).strip().lower()


def choose_columns(names: list[str], wanted: Sequence[str] | None, name: str) -> tuple[int, int, int]:
    """Places of the columns x, y and z among those of these names, "" where one has none; `name` is the file's.

    Raises FileFormatError where the `wanted` ones are not there or, without them, it is not clear which they are.
    """
    if wanted is None:
        return _named(names, name)
    found = [_places(label.strip().lower(), names) for label in wanted]
    has = f"numbers 0 to {len(names) - 1}" + (f", names {listed(names)}" if any(names) else "")
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
    return whole or [k for k, other in enumerate(names) if bare_label(other) == label != ""]


def listed(labels: list[str]) -> str:
    """Names for an error, not too many of them."""
    return ", ".join(labels[:8]) + (", ..." if len(labels) > 8 else "")


def _named(labels: list[str], name: str) -> tuple[int, int, int]:
    bare = [bare_label(label) for label in labels]
    axes = [next((axis for axis, accepted in NAMES.items() if label in accepted), "") for label in bare]
    if len(axes) == 3 and all(axis in ("", place) for axis, place in zip(axes, NAMES, strict=True)):
        return 0, 1, 2
    if len(axes) == 3 and axes.count("") == 1 and len(set(axes)) == 3:
        axes = [axis or next(iter(NAMES.keys() - axes)) for axis in axes]
    # The plain name goes before the others: x, y, z beside lon and lat.
    found = [(bare if axis in bare else axes, axis) for axis in NAMES]
    if any(names.count(axis) != 1 for names, axis in found):
        names = f" ({listed(labels)})" if any(labels) else ""
        grids = "" if any(axes) else f"; {GRIDS}"
        raise FileFormatError(
            f"{name} has {len(labels)} columns{names}, and which of them are x, y and z is not clear; "
            f"{UNDERSTOOD}; or say which they are, for example --columns 0,1,2 (as JSON and TOML: columns){grids}"
        )
    x, y, z = (names.index(axis) for names, axis in found)
    return x, y, z
