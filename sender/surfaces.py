"""The surfaces that can be sent by name: the paper's, two test functions of the field, one real elevation grid.

References
----------
Khanna, Rajpal, Dureja, Arora, "Surface Reconstruction using Feature based Approach with Radial Basis Function Neural
Network" (the paper): surfaces 1 to 3.
R. Franke, "Scattered data interpolation: tests of some methods", Math. Comp. 38 (1982) 181-200.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Protocol

import numpy as np
from matplotlib.cbook import get_sample_data

from common.errors import NotFoundError, ParameterError, hint
from common.surface import FloatArray, HeightGrid, Region, Units

METRES_PER_DEGREE = 111_200.0
"""Length of a degree of latitude, as matplotlib's own examples take it for this elevation grid."""


class Surface(Protocol):
    """A surface z = f(x, y) over a region, with the settings it is usually sent with."""

    @property
    def name(self) -> str:
        """Name used on the command line and over HTTP."""

    @property
    def title(self) -> str:
        """One line for a person: what it is, or its formula."""

    @property
    def region(self) -> Region:
        """Where it is defined."""

    @property
    def units(self) -> Units:
        """Units of the coordinates."""

    @property
    def points(self) -> int:
        """Points of the cloud, unless another number is asked for."""

    @property
    def gap(self) -> float:
        """Side of the square pieces (segment gap), in the units of x and y."""

    @property
    def noise(self) -> float:
        """Amplitude of the noise it is tried with, in the unit of z."""

    @property
    def spread(self) -> float | None:
        """The spread printed in the paper; None for a surface that is not in it."""

    def sample(self, rng: np.random.Generator, n: int | None = None) -> FloatArray:
        """An unorganised cloud of `n` (default `points`) points of the surface, shape (n, 3)."""

    def grid(self, shape: tuple[int, int] | None = None) -> HeightGrid:
        """The true heights on a grid of `shape` (rows, columns)."""


MOST_POINTS = 10_000_000
"""Points of a cloud that is drawn from a formula."""


def _checked_count(n: int, limit: int) -> int:
    if not 1 <= n <= limit:
        raise ParameterError(f"the number of points must be 1 to {limit}, got {n}")
    return n


@dataclass(frozen=True)
class AnalyticSurface:
    """A surface given by a formula; clouds are drawn uniformly over the region."""

    name: str
    title: str
    height: Callable[[FloatArray, FloatArray], FloatArray]
    region: Region
    points: int
    gap: float
    noise: float
    spread: float | None = None
    units: Units = Units()

    def sample(self, rng: np.random.Generator, n: int | None = None) -> FloatArray:
        """`n` points, uniform over the region; raises ParameterError unless 1 <= n <= `MOST_POINTS`."""
        n = _checked_count(self.points if n is None else n, MOST_POINTS)
        x = rng.uniform(self.region.x_min, self.region.x_max, n)
        y = rng.uniform(self.region.y_min, self.region.y_max, n)
        return np.column_stack([x, y, self.height(x, y)])

    def grid(self, shape: tuple[int, int] | None = None) -> HeightGrid:
        """Heights on `shape` (rows, columns), by default 101 x 101, edges of the region included."""
        x, y = self.region.axes(shape or (101, 101))
        return HeightGrid(x, y, self.height(x[None, :], y[:, None]), self.units)


@dataclass(frozen=True)
class GriddedSurface:
    """A measured surface: heights at the nodes of a grid, loaded when first needed."""

    name: str
    title: str
    load: Callable[[], HeightGrid]
    pieces: int
    relative_noise: float = 0.05
    spread: float | None = None

    @cached_property
    def nodes(self) -> HeightGrid:
        """The grid as measured."""
        return self.load()

    @property
    def region(self) -> Region:
        """The rectangle between the outermost nodes."""
        return self.nodes.region

    @property
    def units(self) -> Units:
        """Units of the coordinates."""
        return self.nodes.units

    @property
    def points(self) -> int:
        """Every node is a point of the cloud."""
        return self.nodes.z.size

    @property
    def gap(self) -> float:
        """Side of the pieces, so that about `pieces` of them cover the region."""
        return float(np.sqrt(self.region.width * self.region.height / self.pieces))

    @property
    def noise(self) -> float:
        """`relative_noise` times the range of z."""
        return self.relative_noise * float(np.ptp(self.nodes.z))

    def sample(self, rng: np.random.Generator, n: int | None = None) -> FloatArray:
        """`n` nodes drawn without replacement; all of them by default, in random order."""
        cloud = self.nodes.points()
        n = _checked_count(len(cloud) if n is None else n, len(cloud))
        return cloud[rng.permutation(len(cloud))[:n]]

    def grid(self, shape: tuple[int, int] | None = None) -> HeightGrid:
        """The grid as measured, or the nearest nodes of it thinned to `shape` (rows, columns)."""
        if shape is None:
            return self.nodes
        rows, columns = shape
        if not (1 <= rows <= self.nodes.shape[0] and 1 <= columns <= self.nodes.shape[1]):
            raise ParameterError(
                f"{self.name} has {self.nodes.shape[0]} x {self.nodes.shape[1]} nodes; "
                f"a grid of {rows} x {columns} would have to invent heights"
            )
        i = np.linspace(0, self.nodes.shape[0] - 1, rows).round().astype(int)
        j = np.linspace(0, self.nodes.shape[1] - 1, columns).round().astype(int)
        return HeightGrid(self.nodes.x[j], self.nodes.y[i], self.nodes.z[np.ix_(i, j)], self.nodes.units)


def _franke(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.asarray(
        0.75 * np.exp(-((9 * x - 2) ** 2 + (9 * y - 2) ** 2) / 4)
        + 0.75 * np.exp(-((9 * x + 1) ** 2) / 49 - (9 * y + 1) / 10)
        + 0.5 * np.exp(-((9 * x - 7) ** 2 + (9 * y - 3) ** 2) / 4)
        - 0.2 * np.exp(-((9 * x - 4) ** 2) - (9 * y - 7) ** 2)
    )


def _peaks(x: FloatArray, y: FloatArray) -> FloatArray:
    return np.asarray(
        3 * (1 - x) ** 2 * np.exp(-(x**2) - (y + 1) ** 2)
        - 10 * (x / 5 - x**3 - y**5) * np.exp(-(x**2) - y**2)
        - np.exp(-((x + 1) ** 2) - y**2) / 3
    )


def _jacksboro() -> HeightGrid:
    """Elevation around the Jacksboro fault, Tennessee, as it ships with matplotlib; x east, y north, metres."""
    with np.load(get_sample_data("jacksboro_fault_dem.npz", asfileobj=False)) as dem:
        z = np.asarray(dem["elevation"], dtype=np.float64)[::-1]  # stored from north to south
        dy = METRES_PER_DEGREE * float(dem["dy"])
        dx = METRES_PER_DEGREE * float(dem["dx"]) * math.cos(math.radians(float(dem["ymin"])))
    # To the centimetre: what lies beyond is no measurement, and would cost bytes in every packet.
    x, y = (
        np.round(round(step, 2) * np.arange(n, dtype=np.float64), 2) for step, n in ((dx, z.shape[1]), (dy, z.shape[0]))
    )
    return HeightGrid(x, y, z, Units(xy="m", z="m"))


_PAPER_1 = Region(-1.0, 1.0, -1.0, 1.0)
_PAPER_2 = Region(-2.0, 2.0, -2.0, 2.0)

_ALL: tuple[Surface, ...] = (
    AnalyticSurface(
        "surface-1",
        "z = 3 / (1 + x² + y²)",
        lambda x, y: 3 / (1 + x**2 + y**2),
        _PAPER_1,
        points=200,
        gap=0.4,
        noise=0.1,
        spread=0.3,
    ),
    AnalyticSurface(
        "surface-1-printed",
        "z = 3 / (x² + y²), as printed; singular at the origin",
        lambda x, y: 3 / (x**2 + y**2),
        _PAPER_1,
        points=200,
        gap=0.4,
        noise=0.1,
        spread=0.3,
    ),
    AnalyticSurface(
        "surface-2",
        "z = -5 / (1 + x² + y²)",
        lambda x, y: -5 / (1 + x**2 + y**2),
        _PAPER_2,
        points=200,
        gap=1.0,
        noise=0.1,
        spread=0.3,
    ),
    AnalyticSurface(
        "surface-3",
        "z = sin 2x + sin 2y",
        lambda x, y: np.asarray(np.sin(2 * x) + np.sin(2 * y)),
        _PAPER_2,
        points=600,
        gap=1.0,
        noise=0.2,
        spread=0.3,
    ),
    AnalyticSurface(
        "surface-3-squared",
        "z = sin² x + sin² y, the paper's other reading",
        lambda x, y: np.asarray(np.sin(x) ** 2 + np.sin(y) ** 2),
        _PAPER_2,
        points=600,
        gap=1.0,
        noise=0.2,
        spread=0.3,
    ),
    AnalyticSurface(
        "franke",
        "Franke's function on the unit square",
        _franke,
        Region(0, 1, 0, 1),
        points=600,
        gap=0.2,
        noise=0.05,
    ),
    AnalyticSurface("peaks", "peaks, on [-3, 3]²", _peaks, Region(-3, 3, -3, 3), points=1000, gap=0.75, noise=0.7),
    GriddedSurface("elevation", "elevation around the Jacksboro fault, 344 x 403 nodes", _jacksboro, pieces=2000),
)

SURFACES: Mapping[str, Surface] = MappingProxyType({surface.name: surface for surface in _ALL})
"""The surfaces by name."""


def find_surface(name: str) -> Surface:
    """The surface of that name; raises NotFoundError that lists the names."""
    if name not in SURFACES:
        raise NotFoundError(f"no surface is called {name!r}{hint(name, SURFACES)}")
    return SURFACES[name]


def names_file(name: str) -> bool:
    """Whether a name is meant as that of a file: there is one, or the name has a folder or an ending."""
    path = Path(name)
    return name not in SURFACES and (path.exists() or len(path.parts) > 1 or bool(path.suffix))
