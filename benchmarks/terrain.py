"""Real surfaces: matplotlib's two elevation grids, and the grids of a folder where there is one.

The folder is `SURFACELINK_SURFACES`, by default `shared/surfaces` beside the checkout.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.cbook import get_sample_data
from PIL import Image

from common.surface import FloatArray

FOLDER = Path(os.environ.get("SURFACELINK_SURFACES", Path(__file__).parents[2] / "shared" / "surfaces"))


def _jacksboro() -> tuple[FloatArray, float, float]:
    with np.load(get_sample_data("jacksboro_fault_dem.npz", asfileobj=False)) as dem:
        z = np.asarray(dem["elevation"], dtype=np.float64)
        return z, 111_320 * float(dem["dx"]) * float(np.cos(np.radians(dem["ymin"]))), 111_320 * float(dem["dy"])


def _topobathy() -> tuple[FloatArray, float, float]:
    with np.load(get_sample_data("topobathy.npz", asfileobj=False)) as dem:
        longitude, latitude = dem["longitude"].astype(np.float64), dem["latitude"].astype(np.float64)
        shrink = float(np.cos(np.radians(latitude.mean())))
        return (
            np.asarray(dem["topo"], dtype=np.float64),
            abs(float(np.diff(longitude).mean())) * shrink,
            abs(float(np.diff(latitude).mean())),
        )


def _asc(name: str, missing: float | None = None) -> Callable[[], tuple[FloatArray, float, float]]:
    def read() -> tuple[FloatArray, float, float]:
        lines = (FOLDER / name).read_text().splitlines()
        header: dict[str, float] = {}
        while lines and lines[0].split()[0][0].isalpha():
            key, value = lines.pop(0).split()[:2]
            header[key.lower()] = float(value)
        z = np.array(" ".join(lines).split(), dtype=np.float64).reshape(int(header["nrows"]), int(header["ncols"]))
        gap = header.get("nodata_value", missing)
        return np.where(z == gap, np.nan, z), header["cellsize"], header["cellsize"]

    return read


def _volcano() -> tuple[FloatArray, float, float]:
    return np.loadtxt(FOLDER / "maunga_whau.csv", delimiter=",", skiprows=1), 10.0, 10.0


def _npz(name: str) -> Callable[[], tuple[FloatArray, float, float]]:
    def read() -> tuple[FloatArray, float, float]:
        with np.load(FOLDER / name) as grid:
            return np.asarray(grid["z"], dtype=np.float64), float(grid["dx"]), float(grid["dy"])

    return read


def _tif() -> tuple[FloatArray, float, float]:
    with Image.open(FOLDER / "prairie_lidar.tif") as image:
        return np.asarray(image, dtype=np.float64), 1.0, 1.0


def _hgt() -> tuple[FloatArray, float, float]:
    z = np.frombuffer((FOLDER / "N44W072.hgt").read_bytes(), dtype=">i2").reshape(1201, 1201).astype(np.float64)
    return z, 92.6 * float(np.cos(np.radians(44.5))), 92.6


_READERS: dict[str, tuple[str | None, Callable[[], tuple[FloatArray, float, float]]]] = {
    "jacksboro": (None, _jacksboro),
    "topobathy": (None, _topobathy),
    "volcano": ("maunga_whau.csv", _volcano),
    "gully": ("bijou_gully.asc", _asc("bijou_gully.asc")),
    "marsh": ("tidal_marsh.asc", _asc("tidal_marsh.asc", 999)),
    "prairie": ("prairie_lidar.tif", _tif),
    "white-mountains": ("N44W072.hgt", _hgt),
    "st-helens": ("st_helens.npz", _npz("st_helens.npz")),
    "afm": ("afm_islands.npz", _npz("afm_islands.npz")),
}


def available() -> list[str]:
    """Names of the surfaces whose files are there."""
    return [name for name, (file, _) in _READERS.items() if file is None or (FOLDER / file).exists()]


def nodes(name: str) -> FloatArray:
    """All valid nodes of a surface, shape (n, 3), x, y and z in its own units."""
    z, dx, dy = _READERS[name][1]()
    rows, columns = np.nonzero(np.isfinite(z))
    return np.column_stack([columns * dx, rows * dy, z[rows, columns]])
