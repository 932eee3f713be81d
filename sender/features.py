"""Points in, feature points out."""

from __future__ import annotations

import math
from collections.abc import Callable
from decimal import ROUND_CEILING, Context
from typing import Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from common.errors import ParameterError, PointsError
from common.surface import FeatureSet, FloatArray, IntArray, Region, Units, as_points

Repeated: TypeAlias = Literal["error", "mean", "min", "max"]
"""What to do with positions that carry more than one height."""

Extracted: TypeAlias = Literal["extrema", "lattice", "cloud"]
"""The kinds of feature set that `extract_features` makes."""

Heights: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]
"""(x, y) -> z, all of one shape."""

EMPTY_PIECES = 100
"""Pieces a point on average at most: beyond that nearly every piece is empty, every point a feature, and the gap a
mistake."""

USUAL_PIECES = 1024
"""Pieces that a region is cut into where nothing says how large they are: about 2,000 feature points."""

FARTHEST = 1e100
"""Coordinates beyond this have squares that leave the range of doubles; no unit of length makes such of a survey."""

COLLINEAR = 1e-10
"""Points whose extent across their main direction is below this share of that along it lie on one line: the square
root of the rounding of coordinates that carry an offset 10^6 times their extent."""


def merge_repeated(points: npt.ArrayLike, repeated: Repeated = "error") -> FloatArray:
    """One height for each position (x, y).

    Parameters
    ----------
    points : array_like, shape (n, 3)
    repeated : {"error", "mean", "min", "max"}
        The height kept where one position carries several. Rows that are equal to the last bit are merged always.

    Returns
    -------
    ndarray, shape (m, 3), m <= n, in order of x, then y.

    Raises
    ------
    PointsError
        If a position carries several heights and `repeated` is "error".
    ParameterError
        If a position carries several heights and `repeated` is none of these words.
    """
    points = np.unique(as_points(points), axis=0)  # sorted by x, y, z
    first = np.ones(len(points), dtype=bool)
    first[1:] = np.any(points[1:, :2] != points[:-1, :2], axis=1)
    if first.all():
        return points
    if repeated == "error":
        x, y, _ = points[int(np.flatnonzero(~first)[0])]
        raise PointsError(
            f"{int(np.count_nonzero(first[:-1] & ~first[1:]))} positions carry more than one height, the "
            f"first at x = {x:g}, y = {y:g}; choose which to keep: --repeated mean, min or max (as JSON: repeated)"
        )
    start = np.flatnonzero(first)
    z = points[:, 2]
    if repeated == "mean":
        merged = np.add.reduceat(z, start) / np.diff(np.append(start, len(z)))
    elif repeated in ("min", "max"):
        merged = (np.minimum if repeated == "min" else np.maximum).reduceat(z, start)
    else:
        raise ParameterError(f"repeated = {repeated!r} is unknown; accepted are error, mean, min, max")
    return np.column_stack([points[start, :2], merged])


def check_surface(points: npt.ArrayLike) -> FloatArray:
    """`points` as a read-only (n, 3) array, if they can be a surface.

    Raises
    ------
    PointsError
        If there are fewer than three points, all lie in one place or on one line of the xy plane, or a coordinate
        is beyond `FARTHEST`.
    """
    points = as_points(points)
    if len(points) < 3:
        raise PointsError(f"{len(points)} point(s) given; a surface needs at least 3 that are not on one line")
    farthest = float(np.abs(points).max())
    if farthest > FARTHEST:
        raise PointsError(f"a coordinate has the size {farthest:g}; accepted are coordinates up to {FARTHEST:g}")
    across = np.linalg.svd(points[:, :2] - points[:, :2].mean(axis=0), compute_uv=False)
    if across[0] == 0:
        raise PointsError(f"all {len(points)} points lie in one place; a surface needs at least 3 positions")
    if across[1] <= COLLINEAR * across[0]:
        raise PointsError(f"all {len(points)} points lie on one line of the xy plane; a surface needs an area")
    return points


def piece_of(points: FloatArray, region: Region, gap: float) -> IntArray:
    """Index of the piece, row by row from (x_min, y_min), that each of the (n, 3) points lies in, shape (n,).

    Raises ParameterError where the gap does not fit the region (see `Region.pieces`).
    """
    rows, columns = region.pieces(gap)
    column = np.clip(np.floor((points[:, 0] - region.x_min) / gap), 0, columns - 1)
    row = np.clip(np.floor((points[:, 1] - region.y_min) / gap), 0, rows - 1)
    return np.asarray(row * columns + column, dtype=np.int64)


def suitable_gap(points: FloatArray, region: Region) -> float:
    """The segment gap for points, shape (n, 3), of which nothing says how large their pieces should be.

    It cuts the region into `USUAL_PIECES`; where that would leave nearly all of them empty, into fewer. Of the gaps
    that make as many pieces it is one of few digits, since it stands in every packet.
    """
    area, longer = region.width * region.height, max(region.width, region.height)
    gap = math.sqrt(area / USUAL_PIECES)
    most = EMPTY_PIECES * len(points)
    if math.prod(region.pieces(gap)) > most:
        # Whole rows and columns are at most (width / gap + 1) (height / gap + 1) pieces: below `most` with these two.
        gap = max(2 * math.sqrt(area / most), 4 * longer / most)
    pieces = region.pieces(gap)
    rounded = (float(Context(digits, ROUND_CEILING).create_decimal_from_float(gap)) for digits in range(1, 17))
    return next((short for short in rounded if short <= longer and region.pieces(short) == pieces), gap)


def extract_features(
    points: npt.ArrayLike,
    *,
    gap: float | None,
    kind: Extracted = "extrema",
    region: Region | None = None,
    repeated: Repeated = "error",
    units: Units = Units(),
) -> FeatureSet:
    """The feature points of a cloud (the paper, section "Feature extraction").

    The region is cut into square pieces of side `gap`. In each piece the point of least and the point of greatest z
    are kept; where the two are one point it is kept once, and an empty piece gives none.

    Parameters
    ----------
    points : array_like, shape (n, 3)
        x, y, z of the cloud, in any order: the result does not depend on it.
    gap : float or None
        Side of a piece (segment gap), in the units of x and y; None for `suitable_gap`. Not used for the kind "cloud".
    kind : {"extrema", "lattice", "cloud"}
        "lattice" takes one point a piece, in the middle of it, so that positions need not be sent; its height is
        interpolated linearly between the points (beyond their convex hull: that of the nearest). Where `gap` does not
        divide the region, the pieces of a lattice are a little smaller. "cloud" keeps every point.
    region : Region, optional
        Where the surface is defined; by default the bounding rectangle of the points. Points outside are refused.
    repeated : {"error", "mean", "min", "max"}
        What to do with positions that carry more than one height, see `merge_repeated`.
    units : Units
        Units of the coordinates.

    Returns
    -------
    FeatureSet
        Extrema are ordered by piece, the point of least z first; a lattice row by row; a cloud by x,
        then y.

    Raises
    ------
    PointsError
        If the points are not a surface (see `check_surface`, `merge_repeated`) or lie outside of `region`.
    ParameterError
        If `gap` does not fit the region (see `Region.pieces`), would leave nearly all pieces empty, or `kind` is
        unknown.
    """
    points = merge_repeated(check_surface(points), repeated)
    if region is None:
        region = Region.of(points)
    outside = (
        (points[:, 0] < region.x_min)
        | (points[:, 0] > region.x_max)
        | (points[:, 1] < region.y_min)
        | (points[:, 1] > region.y_max)
    )
    if outside.any():
        raise PointsError(
            f"{int(outside.sum())} of {len(points)} points lie outside of the region "
            f"x {region.x_min:g} to {region.x_max:g}, y {region.y_min:g} to {region.y_max:g}"
        )
    if kind == "cloud":
        return FeatureSet(points, region, None, kind, units)
    if kind not in get_args(Extracted):
        raise ParameterError(f"kind {kind!r} cannot be extracted; accepted are {', '.join(get_args(Extracted))}")
    if gap is None:
        gap = suitable_gap(points, region)
    rows, columns = region.pieces(gap)
    if rows * columns > EMPTY_PIECES * len(points):
        usual = math.sqrt(2 * region.width * region.height / len(points))
        raise ParameterError(
            f"segment gap {gap:g} cuts the region into {rows * columns:,} pieces for {len(points):,} points, nearly "
            f"all of them empty; choose about {usual:.2g}, or at least {usual / math.sqrt(2 * EMPTY_PIECES):.2g}"
        )
    if kind == "lattice":
        return lattice(linear_heights(points, region), gap, region, units)
    piece = piece_of(points, region, gap)
    order = np.lexsort((points[:, 1], points[:, 0], points[:, 2], piece))
    first = np.flatnonzero(np.diff(piece[order], prepend=-1))
    last = np.append(first[1:], len(order)) - 1
    return FeatureSet(points[order[np.unique([first, last])]], region, gap, kind, units)


def linear_heights(points: FloatArray, region: Region) -> Heights:
    """Heights between points, shape (n, 3), linear on triangles; beyond their convex hull that of the nearest.

    Raises PointsError where the points are no surface (see `check_surface`).
    """
    points = check_surface(points)
    low, extent = np.array([region.x_min, region.y_min]), np.array([region.width, region.height])
    # A region far from square would have its triangles judged by slivers.
    scaled = (points[:, :2] - low) / extent
    inside, beyond = LinearNDInterpolator(scaled, points[:, 2]), NearestNDInterpolator(scaled, points[:, 2])

    def heights(x: FloatArray, y: FloatArray) -> FloatArray:
        at = (x - low[0]) / extent[0], (y - low[1]) / extent[1]
        z = np.asarray(inside(*at))
        return np.where(np.isnan(z), beyond(*at), z)

    return heights


def lattice(heights: Heights, gap: float, region: Region, units: Units = Units()) -> FeatureSet:
    """One point in the middle of each of the pieces that a region is evenly cut into, about `gap` wide; row by row.

    It is what `extract_features` makes, for heights that are known already: whoever tries several gaps triangulates
    once. It does not know the points, and so does not say whether the gap suits them. Raises ParameterError where that
    does not fit the region (see `Region.pieces`).
    """
    x, y = np.meshgrid(*region.axes(region.pieces(gap), centred=True))
    return FeatureSet(np.column_stack([x.ravel(), y.ravel(), heights(x, y).ravel()]), region, gap, "lattice", units)
