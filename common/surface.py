"""What travels and what comes back: a region, a set of feature points, a grid of heights.

Arrays are C-ordered float64 and read-only. A grid is ``z[row, column]`` with rows along ascending y and columns
along ascending x.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from common.errors import ParameterError, PointsError

FloatArray: TypeAlias = npt.NDArray[np.float64]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]

FeatureKind: TypeAlias = Literal["extrema", "cloud", "lattice", "greedy"]
"""How the points were chosen: least and greatest z of each piece; all points; one point at each node of a regular
lattice; greedily, against the reconstruction."""

Unit: TypeAlias = Literal["", "m", "km", "cm", "mm", "um", "nm", "ft", "deg"]
"""Units of length the wire can name; "" is a surface without a unit."""

UNITS: tuple[Unit, ...] = get_args(Unit)
FEATURE_KINDS: tuple[FeatureKind, ...] = get_args(FeatureKind)

MAX_PIECES = 16_000_000
"""Pieces a region may be cut into: the memory of one bookkeeping array stays below 128 MB."""


def finite_array(values: npt.ArrayLike, name: str) -> FloatArray:
    """A read-only C-ordered float64 copy of `values`; raises PointsError unless numeric and finite."""
    try:
        array = np.array(values, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise PointsError(f"{name} must be an array of numbers: {error}") from error
    bad = array.size - int(np.count_nonzero(np.isfinite(array)))
    if bad:
        raise PointsError(f"{name} must be finite; {bad} of {array.size} values are NaN or infinite")
    array.setflags(write=False)
    return array


def as_points(values: npt.ArrayLike) -> FloatArray:
    """A read-only (n, 3) copy of `values`, n >= 1, columns x, y, z; raises PointsError otherwise."""
    points = finite_array(values, "points")
    if points.ndim != 2 or points.shape[1] != 3:
        raise PointsError(f"points must have the shape (n, 3), columns x, y, z; got {points.shape}")
    if not len(points):
        raise PointsError("the cloud is empty; at least one point (x, y, z) is needed")
    return points


@dataclass(frozen=True, slots=True)
class Units:
    """Units of the coordinates: `xy` of x and y, `z` of the heights."""

    xy: Unit = ""
    z: Unit = ""

    def __post_init__(self) -> None:
        for name, unit in (("xy", self.xy), ("z", self.z)):
            if unit not in UNITS:
                raise ParameterError(f"unit {name} is {unit!r}; accepted are {', '.join(map(repr, UNITS))}")


@dataclass(frozen=True, slots=True)
class Region:
    """A rectangle of the xy plane, x_min < x_max and y_min < y_max, in the units of x and y."""

    x_min: float
    x_max: float
    y_min: float
    y_max: float

    def __post_init__(self) -> None:
        if not all(np.isfinite(self.bounds)):
            raise ParameterError(f"region bounds must be finite, got {self.bounds}")
        if not (self.x_min < self.x_max and self.y_min < self.y_max):
            raise ParameterError(
                f"region must have x_min < x_max and y_min < y_max, got x {self.x_min:g} to {self.x_max:g}, "
                f"y {self.y_min:g} to {self.y_max:g}"
            )
        if not (np.isfinite(self.width) and np.isfinite(self.height)):
            raise ParameterError("region is wider than a double can hold")

    @classmethod
    def of(cls, points: npt.ArrayLike) -> Self:
        """The bounding rectangle of (n, 3) points; raises PointsError where they span no area."""
        xy = as_points(points)[:, :2]
        (x_min, y_min), (x_max, y_max) = xy.min(axis=0).tolist(), xy.max(axis=0).tolist()
        if not (x_min < x_max and y_min < y_max):
            raise PointsError(
                f"the points span no area: x from {x_min:g} to {x_max:g}, y from {y_min:g} to {y_max:g}; "
                "a surface needs at least three points that are not on one line"
            )
        return cls(x_min, x_max, y_min, y_max)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """(x_min, x_max, y_min, y_max)."""
        return (self.x_min, self.x_max, self.y_min, self.y_max)

    @property
    def width(self) -> float:
        """Extent along x."""
        return self.x_max - self.x_min

    @property
    def height(self) -> float:
        """Extent along y."""
        return self.y_max - self.y_min

    def axes(self, shape: tuple[int, int], *, centred: bool = False) -> tuple[FloatArray, FloatArray]:
        """Ascending (x, y) of a grid of `shape` (rows, columns).

        Its nodes divide the region from edge to edge or, `centred`, are the middles of so many equal cells. Raises
        ParameterError where there is no row or no column.
        """
        rows, columns = shape
        if rows < 1 or columns < 1:
            raise ParameterError(f"grid shape must be at least 1 x 1, got {rows} x {columns}")
        if centred:
            x = self.x_min + (np.arange(columns) + 0.5) * (self.width / columns)
            y = self.y_min + (np.arange(rows) + 0.5) * (self.height / rows)
            return np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        return np.linspace(self.x_min, self.x_max, columns), np.linspace(self.y_min, self.y_max, rows)

    def pieces(self, gap: float) -> tuple[int, int]:
        """(rows, columns) of the square pieces of side `gap` that cover the region.

        The last row and column may reach beyond the region. Raises ParameterError where `gap` is not positive, is
        larger than the region, or would cut it into more than `MAX_PIECES`.
        """
        if not (np.isfinite(gap) and gap > 0):
            raise ParameterError(f"segment gap must be a positive number, got {gap:g}")
        if gap > max(self.width, self.height) * (1 + 1e-9):
            raise ParameterError(
                f"segment gap {gap:g} is larger than the region, {self.width:g} x {self.height:g}; "
                f"choose one below {max(self.width, self.height):g}"
            )
        # 2 / 0.4 is 5 in the paper, 5.000000000000001 in doubles.
        rows, columns = (max(1, float(np.ceil(side / gap * (1 - 1e-9)))) for side in (self.height, self.width))
        if rows * columns > MAX_PIECES:
            raise ParameterError(
                f"segment gap {gap:g} cuts the region into {rows * columns:.3g} pieces; at most {MAX_PIECES} are "
                f"accepted, a gap of {float(np.sqrt(self.width * self.height / MAX_PIECES)):.3g} or more"
            )
        return int(rows), int(columns)


@dataclass(frozen=True, slots=True, eq=False)
class FeatureSet:
    """The points of a surface that are worth sending.

    Parameters
    ----------
    points : array_like, shape (n, 3)
        x, y, z. n >= 1, finite. Points may lie outside of `region` (noise puts them there).
    region : Region
        The region the surface is defined on, and the one it is reconstructed on.
    gap : float or None
        Side of the square pieces (segment gap), in the units of x and y; None where there are no pieces.
    kind : FeatureKind
        How the points were chosen.
    units : Units
        Units of the coordinates.

    Raises
    ------
    PointsError
        If the points are empty, not finite or not of shape (n, 3).
    ParameterError
        If `gap` or `kind` is out of bounds.
    """

    points: FloatArray
    region: Region
    gap: float | None = None
    kind: FeatureKind = "cloud"
    units: Units = Units()

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", as_points(self.points))
        if self.gap is not None and not (np.isfinite(self.gap) and self.gap > 0):
            raise ParameterError(f"segment gap must be a positive number or None, got {self.gap}")
        if self.kind not in FEATURE_KINDS:
            raise ParameterError(f"kind {self.kind!r} is unknown; accepted are {', '.join(FEATURE_KINDS)}")

    def __len__(self) -> int:
        return len(self.points)

    @property
    def xy(self) -> FloatArray:
        """Positions, shape (n, 2)."""
        return self.points[:, :2]

    @property
    def z(self) -> FloatArray:
        """Heights, shape (n,)."""
        return self.points[:, 2]


@dataclass(frozen=True, slots=True, eq=False)
class HeightGrid:
    """Heights on a rectangular grid.

    Parameters
    ----------
    x : array_like, shape (columns,)
        Strictly ascending.
    y : array_like, shape (rows,)
        Strictly ascending.
    z : array_like, shape (rows, columns)
        ``z[i, j]`` is the height at (x[j], y[i]); finite.
    units : Units
        Units of the coordinates.

    Raises
    ------
    PointsError
        If an axis is not strictly ascending, a value is not finite or the shapes do not fit.
    """

    x: FloatArray
    y: FloatArray
    z: FloatArray
    units: Units = Units()

    def __post_init__(self) -> None:
        for name in ("x", "y", "z"):
            object.__setattr__(self, name, finite_array(getattr(self, name), name))
        for name, axis in (("x", self.x), ("y", self.y)):
            if axis.ndim != 1 or not axis.size or np.any(np.diff(axis) <= 0):
                raise PointsError(f"axis {name} must be one-dimensional and strictly ascending")
        if self.z.shape != (self.y.size, self.x.size):
            raise PointsError(
                f"z must have the shape (len(y), len(x)) = {(self.y.size, self.x.size)}, got {self.z.shape}"
            )

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns)."""
        return self.y.size, self.x.size

    @property
    def region(self) -> Region:
        """The rectangle between the outermost nodes; raises ParameterError for a grid of one row or column."""
        return Region(float(self.x[0]), float(self.x[-1]), float(self.y[0]), float(self.y[-1]))

    def points(self) -> FloatArray:
        """The nodes as a cloud, shape (rows * columns, 3), row by row."""
        x, y = np.meshgrid(self.x, self.y)
        return np.column_stack([x.ravel(), y.ravel(), self.z.ravel()])
