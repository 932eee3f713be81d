"""The six fields on which raster codecs are measured: 256 x 256 nodes each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from common.errors import NotFoundError, hint
from common.surface import HeightGrid
from sender.surfaces import find_surface

SHAPE = (256, 256)
"""Rows and columns: sides of a power of two, which favours the transform codecs."""


def _analytic(name: str) -> Callable[[], HeightGrid]:
    return lambda: find_surface(name).grid(SHAPE)


def _elevation_crop() -> HeightGrid:
    """The middle of the elevation grid: rows 44 to 299 and columns 73 to 328, of 344 x 403."""
    whole = find_surface("elevation").grid()
    rows, columns = slice(44, 300), slice(73, 329)
    return HeightGrid(whole.x[columns], whole.y[rows], np.ascontiguousarray(whole.z[rows, columns]), whole.units)


FIELDS: Mapping[str, Callable[[], HeightGrid]] = MappingProxyType(
    {name: _analytic(name) for name in ("surface-1", "surface-2", "surface-3", "franke", "peaks")}
    | {"elevation": _elevation_crop}
)
"""The fields by name; call one to have it."""


def field(name: str) -> HeightGrid:
    """The field of that name; raises NotFoundError."""
    if name not in FIELDS:
        raise NotFoundError(f"no field is called {name!r}{hint(name, FIELDS)}")
    return FIELDS[name]()
