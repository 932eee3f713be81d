"""What the network is compared with: every other way to grow a surface from the points that arrived.

``reconstruct(name, points, x, y, rng)`` is the one call; ``BASELINES`` lists the names with title, source and what
must be installed. "Traditional fitting", as the paper calls it, is ``cubic``.

Every method is given the same: distinct positions in a fixed order (so the order of arrival does not matter; heights
at one position are averaged), shifted and scaled by one factor for x and y, heights scaled to 0..1. What cannot be
done is said here once:

* outside of the convex hull of the points the interpolants ``linear``, ``cubic`` and ``natural_neighbour`` are not
  defined; there the height of the nearest point stands;
* points on one line, or fewer than three, span no triangle and no plane: every method but the networks of this
  project then gives the height of the nearest point.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from common.errors import NotFoundError, PointsError, TrainingError, hint
from common.extras import is_installed, require
from common.network import NetworkWarning, RBFNetwork
from common.surface import FloatArray, as_points, finite_array
from simulator.baselines import interpolation, local, networks, statistical

__all__ = ["BASELINES", "Baseline", "reconstruct"]

Method: TypeAlias = Callable[[FloatArray, FloatArray, FloatArray, np.random.Generator], FloatArray]
"""(points (n, 3), x (columns,), y (rows,), rng) -> heights (rows, columns)."""

RESOLUTION = 1e-9
"""Positions closer than this share of the cloud's extent are one position: triangulations and dense systems cannot
tell them apart."""


@dataclass(frozen=True, slots=True)
class Baseline:
    """A way to grow a surface from points.

    Parameters
    ----------
    name, title, source : str
        Key of the registry; what it is, for a legend; where it is published.
    method : Method
    package : str
        Module beyond the project's own dependencies that it needs, installed by the extra ``baselines``; "" for none.
    plane : bool
        Whether it reproduces a plane exactly (within the hull of the points).
    raw : bool
        Whether it takes the points as they are, repeated positions and all, and in their own units.
    """

    name: str
    title: str
    source: str
    method: Method
    package: str = ""
    plane: bool = False
    raw: bool = False

    @property
    def available(self) -> bool:
        """Whether what it needs is installed."""
        return is_installed(self.package)

    def reconstruct(
        self, points: npt.ArrayLike, x: npt.ArrayLike, y: npt.ArrayLike, rng: np.random.Generator
    ) -> FloatArray:
        """Heights at the nodes of a grid; see `simulator.baselines.reconstruct`."""
        require(f"baseline {self.name}", self.package, "baselines")
        cloud, axis_x, axis_y = as_points(points), finite_array(x, "x"), finite_array(y, "y")
        if axis_x.ndim != 1 or axis_y.ndim != 1 or not axis_x.size or not axis_y.size:
            raise PointsError(f"x and y must be one-dimensional and not empty, got {axis_x.shape} and {axis_y.shape}")
        ordered = cloud[np.lexsort(cloud.T[::-1])]
        grid = self.method(ordered, axis_x, axis_y, rng) if self.raw else self._framed(ordered, axis_x, axis_y, rng)
        bad = grid.size - int(np.count_nonzero(np.isfinite(grid)))
        if bad:
            raise TrainingError(f"baseline {self.name} left {bad} of {grid.size} heights without a finite value")
        return np.ascontiguousarray(grid, dtype=np.float64)

    def _framed(self, cloud: FloatArray, x: FloatArray, y: FloatArray, rng: np.random.Generator) -> FloatArray:
        low, high = cloud.min(axis=0), cloud.max(axis=0)
        middle = (low[:2] + high[:2]) / 2
        extent = float((high - low)[:2].max()) or 1.0
        depth = float(high[2] - low[2]) or 1.0
        xy, heights = _distinct((cloud[:, :2] - middle) / extent, (cloud[:, 2] - low[2]) / depth)
        method = self.method if _spans_plane(xy) else interpolation.nearest
        grid = method(np.column_stack([xy, heights]), (x - middle[0]) / extent, (y - middle[1]) / extent, rng)
        return np.asarray(grid * depth + low[2])


def _distinct(xy: FloatArray, z: FloatArray) -> tuple[FloatArray, FloatArray]:
    """One position of each group of equal ones, as it is (moved, it might open the hull), and the mean height."""
    _, first, group, counts = np.unique(
        np.round(xy / RESOLUTION), axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    return xy[first], np.bincount(group.ravel(), z) / counts


def _spans_plane(xy: FloatArray) -> bool:
    """Whether positions (n, 2) in units of their extent are neither one point nor on one line."""
    return len(xy) >= 3 and bool(np.linalg.svd(xy - xy.mean(axis=0), compute_uv=False)[1] > 1e-6)


def _network(
    points: FloatArray,
    x: FloatArray,
    y: FloatArray,
    _: np.random.Generator,
    mapping: Literal["height", "autoassociative"] = "height",
) -> FloatArray:
    """Our network, spread and smoothing from the data."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NetworkWarning)  # its notes, which nobody could read here
        fitted = RBFNetwork(mapping=mapping).fit(points[:, :2], points[:, 2])
    return fitted.predict_grid(x, y)


_ALL = (
    Baseline("nearest", "nearest point", "Thiessen 1911", interpolation.nearest),
    Baseline(
        "linear",
        "linear on Delaunay triangles",
        "Delaunay 1934; scipy.interpolate.LinearNDInterpolator",
        interpolation.linear,
        plane=True,
    ),
    Baseline(
        "cubic",
        "cubic on Delaunay triangles (traditional fitting)",
        "Clough and Tocher 1965, gradients after Nielson 1983; scipy.interpolate.CloughTocher2DInterpolator",
        interpolation.cubic,
        plane=True,
    ),
    Baseline(
        "natural_neighbour",
        "natural neighbour",
        "Sibson 1981; startinpy (Ledoux)",
        interpolation.natural_neighbour,
        package="startinpy",
        plane=True,
    ),
    Baseline(
        "thin_plate",
        "thin plate through the points",
        "Duchon 1976; scipy.interpolate.RBFInterpolator",
        interpolation.thin_plate,
        plane=True,
    ),
    Baseline(
        "thin_plate_gcv",
        "thin plate, smoothed by generalised cross-validation",
        "Wahba 1990, Spline Models for Observational Data; Craven and Wahba 1979",
        interpolation.thin_plate_gcv,
        plane=True,
    ),
    Baseline(
        "smoothing_spline",
        "bicubic smoothing spline, cross-validated",
        "Eilers and Marx 1996; Craven and Wahba 1979; scipy.interpolate.BSpline",
        statistical.smoothing_spline,
        plane=True,
    ),
    Baseline(
        "kriging",
        "regression kriging (plane, Matérn 3/2, nugget)",
        "Matheron 1963; Rasmussen and Williams 2006; sklearn.gaussian_process",
        statistical.kriging,
        package="sklearn",
        plane=True,
    ),
    Baseline(
        "kmeans_network",
        "RBF network, k-means centres",
        "Moody and Darken 1989; Liu, as compared in the paper",
        networks.kmeans_centers,
    ),
    Baseline(
        "random_network",
        "RBF network, random centres",
        "Broomhead and Lowe 1988",
        networks.random_centers,
    ),
    Baseline(
        "exact_network",
        "RBF network, every point a centre, spread by the paper's rule",
        "Powell 1987; spread: twice the distance between centres (the paper)",
        networks.every_center,
    ),
    Baseline("grnn", "generalised regression network", "Specht 1991; Yang, as compared in the paper", networks.grnn),
    Baseline(
        "back_propagation",
        "back-propagation network",
        "Rumelhart, Hinton and Williams 1986; Yang, as compared in the paper; sklearn.neural_network.MLPRegressor",
        networks.back_propagation,
        package="sklearn",
    ),
    Baseline(
        "moving_least_squares",
        "moving least squares",
        "Lancaster and Salkauskas 1981; Levin 1998",
        local.moving_least_squares,
        plane=True,
    ),
    Baseline(
        "principal_component",
        "principal-component planes, blended",
        "Hoppe, DeRose, Duchamp, McDonald and Stuetzle 1992",
        local.principal_component,
        plane=True,
    ),
    Baseline(
        "autoassociative",
        "our network as the paper draws it: a point onto the surface",
        "Khanna, Rajpal, Dureja and Arora (the paper): three inputs, three outputs",
        partial(_network, mapping="autoassociative"),
        raw=True,
    ),
    Baseline("network", "our network, spread and smoothing from the data", "this project", _network, raw=True),
)

BASELINES: Mapping[str, Baseline] = MappingProxyType({baseline.name: baseline for baseline in _ALL})
"""Every method by name; those whose `available` is false raise MissingExtraError when used."""


def reconstruct(
    name: str, points: npt.ArrayLike, x: npt.ArrayLike, y: npt.ArrayLike, rng: np.random.Generator
) -> FloatArray:
    """Grow a surface from points.

    Parameters
    ----------
    name : str
        Key of `BASELINES`.
    points : array_like, shape (n, 3)
        x, y, z; n >= 1 (the networks of this project need more); positions may repeat.
    x : array_like, shape (columns,)
    y : array_like, shape (rows,)
        Nodes of the grid, in the units of the points.
    rng : numpy.random.Generator
        For the methods that draw (initial centres and weights, folds); the same state gives the same heights.

    Returns
    -------
    ndarray, shape (rows, columns)
        Heights, finite, in the unit of z; ``[i, j]`` is at (x[j], y[i]). The same whatever the order of the points.

    Raises
    ------
    NotFoundError
        No such method.
    MissingExtraError
        The extra ``baselines`` is not installed.
    PointsError
        Points or axes that are not finite, empty or of the wrong shape.
    TrainingError
        The method found no finite surface for these points.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> corners = [(0, 0, 0), (1, 0, 1), (0, 1, 2), (1, 1, 3)]
    >>> reconstruct("linear", corners, [0.0, 0.5, 1.0], [0.5], rng).round(12).tolist()
    [[1.0, 1.5, 2.0]]
    """
    if name not in BASELINES:
        raise NotFoundError(f"no baseline {name!r}{hint(name, BASELINES)}")
    return BASELINES[name].reconstruct(points, x, y, rng)
