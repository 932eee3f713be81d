"""SRTM height files (.hgt) to points: squares of a degree, of which the name alone says where they lie."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from common.errors import FileFormatError
from sender.readers.parts import Rows, check_count, counted_axes, grid_rows, refuse_columns, uncharted

SIDES = (1201, 3601)
"""Rows and columns of a square: 3 or 1 arc-seconds apart, those on the edges shared with the neighbours."""

CORNER = re.compile(r"([NS])(\d\d)_?([EW])(\d{3})(?!\d)", re.IGNORECASE)
"""What a name begins with: latitude and longitude of the lower left node, in degrees."""

VOID = -32768


def read_hgt(data: bytes, name: str, columns: Sequence[str] | None, most: int) -> Rows:
    """The nodes of an SRTM square, x and y in degrees; see `sender.readers.parse_points`."""
    refuse_columns(columns, name)
    side = math.isqrt(len(data) // 2)
    if side not in SIDES or len(data) != 2 * side * side:
        sizes = " or ".join(f"{side} x {side} ({2 * side * side} bytes)" for side in SIDES)
        raise FileFormatError(f"{name} is not an SRTM file: it holds {len(data)} bytes; accepted are heights, {sizes}")
    check_count(side * side, name, most)
    heights = np.frombuffer(data, dtype=">i2").reshape(side, side)
    z = np.where(heights == VOID, np.nan, heights)
    x, y = counted_axes((side, side))
    corner = CORNER.match(name)
    if corner is None:
        return grid_rows(x, y, z, (f"{uncharted(name)}; a name such as N44W072.hgt places it in degrees",))
    south, latitude, west, longitude = corner.groups()
    first_x = int(longitude) * (-1 if west in "Ww" else 1)
    first_y = int(latitude) * (-1 if south in "Ss" else 1)
    return grid_rows(first_x + x / (side - 1), first_y + y / (side - 1), z)
