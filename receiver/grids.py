"""What a request for a grid means: `shape`, `bbox` and what else stands in its query."""

from __future__ import annotations

from dataclasses import dataclass
from hashlib import sha256

import numpy as np

from common.errors import ParameterError
from common.network.model import SurfaceModel
from common.surface import Region
from receiver.formats import Format, GridAnswer
from receiver.picture import Style

DEFAULT_SHAPE = (200, 200)

PICTURE_SIDE = 600
"""Nodes along the longer side of a picture of no given shape, which keeps the proportions of the region."""

MAX_SIDE = 32_768
"""Rows or columns of a grid: one row is written at a time, and must not hold the interpreter for long."""

EDGE = 1e-9
"""Share of the region that a bounding box may reach beyond it: coordinates are written in decimals."""


@dataclass(frozen=True, slots=True)
class GridRequest:
    """A grid that can be computed."""

    region: Region
    shape: tuple[int, int]
    std: bool
    style: Style

    def tag(self, digest: str, form: Format[GridAnswer]) -> str:
        """A strong ETag: the same model, request and form give the same bytes."""
        return f'"{sha256(repr((digest, self, form.name)).encode()).hexdigest()[:32]}"'

    def answer(self, name: str, model: SurfaceModel) -> GridAnswer:
        """Compute it."""
        x, y = self.region.axes(self.shape)
        return GridAnswer(name, model.grid(x, y), model.std(x, y) if self.std else None, self.style)


def parse_shape(text: str, max_cells: int) -> tuple[int, int]:
    """(rows, columns) of "rows,columns"; raises ParameterError."""
    parts = text.split(",")
    if len(parts) != 2 or not all(part.strip().isdecimal() and len(part.strip()) <= 9 for part in parts):
        raise ParameterError("shape must be rows,columns, such as 200,200")
    rows, columns = (int(part) for part in parts)
    if not (2 <= rows <= MAX_SIDE and 2 <= columns <= MAX_SIDE):
        raise ParameterError(f"shape must have 2 to {MAX_SIDE} rows and columns")
    if rows * columns > max_cells:
        raise ParameterError(f"shape has {rows * columns} cells; at most {max_cells} are computed here")
    return rows, columns


def parse_bbox(text: str, region: Region) -> Region:
    """The part of `region` that "x_min,y_min,x_max,y_max" names; raises ParameterError."""
    try:
        x_min, y_min, x_max, y_max = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ParameterError("bbox must be x_min,y_min,x_max,y_max, four numbers") from error
    try:
        part = Region(x_min, x_max, y_min, y_max)
    except ParameterError as error:
        raise ParameterError(f"bbox is no region: {error}") from error
    slack_x, slack_y = region.width * EDGE, region.height * EDGE
    if (
        x_min < region.x_min - slack_x
        or x_max > region.x_max + slack_x
        or y_min < region.y_min - slack_y
        or y_max > region.y_max + slack_y
    ):
        raise ParameterError(
            f"bbox reaches beyond the region of the surface, "
            f"{region.x_min},{region.y_min},{region.x_max},{region.y_max}; nothing is known there"
        )
    return part


def default_shape(region: Region, picture: bool, max_cells: int) -> tuple[int, int]:
    """(rows, columns) where none is given; those of a picture are in the proportions of `region`."""
    if not picture:
        side = int(np.sqrt(max_cells))
        return min(DEFAULT_SHAPE[0], side), min(DEFAULT_SHAPE[1], side)
    longer = max(region.width, region.height)
    side = min(PICTURE_SIDE, int(np.sqrt(max_cells)))
    return (
        max(2, round(side * region.height / longer)),
        max(2, round(side * region.width / longer)),
    )
