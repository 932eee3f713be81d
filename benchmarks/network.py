"""How fast the network is, and how accurate at that speed, beside the peers a Python user would pick.

    python -m benchmarks.network [--table NAME ...] [--seeds N] [--most N]

Everything runs in one process on this machine; figures come with their ratios. Peers that are not installed are left
out and named: ``pip install surfacelink[bench]``. Fits and predictions of one row see the same points.
"""

from __future__ import annotations

import argparse
import importlib.util
import resource
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import matplotlib.cbook
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.interpolate import RBFInterpolator
from scipy.spatial.distance import cdist

from common.metrics import rmse
from common.network import NetworkWarning, RBFNetwork, greedy
from common.network.threads import cores
from common.surface import FloatArray

console = Console(width=130)


@dataclass(frozen=True)
class Field:
    """A surface to sample: `draw(n, rng)` gives positions, heights, and held-out positions and heights."""

    name: str
    draw: Callable[[int, np.random.Generator], tuple[FloatArray, FloatArray, FloatArray, FloatArray]]


def _analytic(name: str, f: Callable[[FloatArray, FloatArray], FloatArray]) -> Field:
    def draw(n: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        X, Q = rng.uniform(-2, 2, (n, 2)), rng.uniform(-2, 2, (5000, 2))
        return X, f(X[:, 0], X[:, 1]), Q, f(Q[:, 0], Q[:, 1])

    return Field(name, draw)


def _cells(name: str, load: Callable[[], FloatArray]) -> Field:
    def draw(n: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        z = load()
        order = rng.permutation(z.size)[: n + 10_000]
        xy = np.stack([order % z.shape[1], order // z.shape[1]], axis=1).astype(np.float64)
        heights = z.ravel()[order]
        return xy[:n], heights[:n], xy[n:], heights[n:]

    return Field(name, draw)


def elevation() -> FloatArray:
    """The elevation grid that ships with matplotlib, in metres."""
    with np.load(matplotlib.cbook.get_sample_data("jacksboro_fault_dem.npz", asfileobj=False)) as data:
        return np.asarray(data["elevation"], dtype=np.float64)


def fractal(side: int = 2048, roughness: float = 0.8) -> FloatArray:
    """Terrain with the variogram r^(2H), by its spectrum; unit deviation, the same every time."""
    rng = np.random.default_rng(20)
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side))
    frequency[0, 0] = np.inf
    phases = np.exp(2j * np.pi * rng.random(frequency.shape))
    z = np.fft.irfft2(phases * rng.rayleigh(size=frequency.shape) * frequency ** -(roughness + 1), s=(side, side))
    return np.asarray(z / z.std())


SINE = _analytic("sin 2x + sin 2y", lambda x, y: np.sin(2 * x) + np.sin(2 * y))
BOWL = _analytic("surface 2", lambda x, y: -5 / (1 + x**2 + y**2))
ELEVATION = _cells("elevation", elevation)
FRACTAL = _cells("fractal terrain", fractal)

Predict = Callable[[FloatArray], FloatArray]


def network(X: FloatArray, y: FloatArray) -> Predict:
    """The network with its defaults."""
    return RBFNetwork().fit(X, y).predict


def scipy_rbf(kernel: str, neighbors: int | None = None, spread: float | None = None) -> Callable[..., Predict]:
    """SciPy's RBFInterpolator; a spread in mean spacings."""

    def fit(X: FloatArray, y: FloatArray) -> Predict:
        extra: dict[str, Any] = {}
        if spread is not None:
            spacing = float(np.sqrt(np.prod(np.ptp(X, axis=0)) / len(X)))
            extra = {"epsilon": 1 / (np.sqrt(2) * spread * spacing), "degree": -1}
        fitted: Any = RBFInterpolator
        return fitted(X, y, kernel=kernel, neighbors=neighbors, **extra)  # type: ignore[no-any-return]

    return fit


def process(X: FloatArray, y: FloatArray) -> Predict:
    """scikit-learn's GaussianProcessRegressor with its optimiser: constant times RBF plus white noise."""
    from sklearn.gaussian_process import GaussianProcessRegressor
    from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

    kernel = ConstantKernel(1.0, (1e-3, 1e5)) * RBF(1.0, (1e-3, 1e4)) + WhiteKernel(1e-3, (1e-12, 1e1))
    return GaussianProcessRegressor(kernel, normalize_y=True).fit(X, y).predict  # type: ignore[no-any-return]


def ferreus(kernel: str) -> Callable[..., Predict]:
    """The fast-multipole package ferreus_rbf with its defaults."""

    def fit(X: FloatArray, y: FloatArray) -> Predict:
        import ferreus_rbf
        from ferreus_rbf import interpolant_config as config

        chosen = config.InterpolantSettings(getattr(config.RBFKernelType, kernel))
        fitted = ferreus_rbf.RBFInterpolator(X, y[:, None], chosen)
        return lambda Q: np.asarray(fitted.evaluate(Q)).ravel()

    return fit


def installed(package: str) -> bool:
    """Whether a peer is there; says so where it is not."""
    found = importlib.util.find_spec(package) is not None
    if not found:
        console.print(f"[yellow]{package} is not installed; its columns are left out")
    return found


def timed(work: Callable[..., Any], *args: Any, repeat: int = 1, **kwargs: Any) -> tuple[float, Any]:
    """Least seconds of so many runs, and the last result."""
    seconds, result = np.inf, None
    for _ in range(repeat):
        start = time.perf_counter()
        result = work(*args, **kwargs)
        seconds = min(seconds, time.perf_counter() - start)
    return seconds, result


def show(title: str, header: list[str], rows: list[list[str]]) -> None:
    """Print a table."""
    table = Table(title=title, title_justify="left", header_style="bold")
    for i, name in enumerate(header):
        table.add_column(name, justify="left" if i == 0 else "right")
    for row in rows:
        table.add_row(*row)
    console.print(table)


def fit_table(seeds: int, most: int) -> None:
    """Fit and RMSE beside GaussianProcessRegressor."""
    if not installed("sklearn"):
        return
    rows = []
    for noise in (0.0, 0.05):
        for n in (50, 500, 2000):
            if n > most:
                continue
            figures = []
            for seed in range(seeds if n < 2000 else min(seeds, 2)):
                X, y, Q, truth = SINE.draw(n, np.random.default_rng(seed))
                y = y + noise * np.random.default_rng(seed + 1000).normal(size=n)
                seconds, predict = timed(network, X, y)
                theirs, regressor = timed(process, X, y)
                figures.append([seconds, rmse(truth, predict(Q)), theirs, rmse(truth, regressor(Q))])
            ours, error, theirs, other = np.median(figures, axis=0)
            rows.append([f"n = {n}, noise {noise:.0%}", f"{ours:.3f}", f"{theirs:.3f}", f"{ours / theirs:.3f}"])
            rows[-1] += [f"{error:.2e}", f"{other:.2e}", f"{error / other:.2f}"]
    header = ["sin 2x + sin 2y", "fit / s", "GaussianProcess / s", "ratio", "RMSE", "GaussianProcess", "ratio"]
    show("Spread and smoothing from the data", header, rows)


def accuracy_table(seeds: int, most: int) -> None:
    """RMSE of random samples beside every peer that takes as many points."""
    with_process, with_ferreus = installed("sklearn"), installed("ferreus_rbf")
    rows = []
    for field in (SINE, BOWL, ELEVATION):
        for n in (50, 500, 2000, 5000, 20_000):
            if n > most:
                continue
            dense = n <= 5000
            peers: dict[str, Callable[..., Predict]] = {
                "thin plate": scipy_rbf("thin_plate_spline", None if dense else 100),
                "linear": scipy_rbf("linear", None if dense else 100),
            }
            if dense:
                peers |= {f"Gaussian, spread {s:g} h": scipy_rbf("gaussian", spread=s) for s in (2, 4)}
            if with_process and n <= 500:
                peers["GaussianProcess"] = process
            if with_ferreus and n >= 2000:
                peers |= {f"ferreus {kernel}": ferreus(kernel) for kernel in ("Linear", "ThinPlateSpline")}
            errors: dict[str, list[float]] = {name: [] for name in ("network", *peers)}
            for seed in range(seeds if n <= 500 else 1):
                X, y, Q, truth = field.draw(n, np.random.default_rng(seed))
                for name, fit in {"network": network, **peers}.items():
                    errors[name].append(_error(fit, X, y, Q, truth))
            medians = {name: float(np.median(found)) for name, found in errors.items()}
            ours = medians.pop("network")
            best = min(medians, key=lambda name: medians[name])
            rows.append([f"{field.name}, n = {n}", f"{ours:.3g}", f"{medians[best]:.3g}", best])
            rows[-1].append(f"{ours / medians[best]:.3f}")
    show("RMSE of random samples without noise", ["", "network", "best peer", "which", "ratio"], rows)


def _error(fit: Callable[..., Predict], X: FloatArray, y: FloatArray, Q: FloatArray, truth: FloatArray) -> float:
    try:
        return rmse(truth, fit(X, y)(Q))
    except np.linalg.LinAlgError:
        return float("inf")


def grid_table(seeds: int, most: int) -> None:
    """A grid of 1000 x 1000 from 2,000 centres."""
    del seeds, most
    X, y, _, _ = SINE.draw(2000, np.random.default_rng(0))
    left, right = (np.random.default_rng(i).random((1000, 2000)) for i in range(2))
    product, _ = timed(np.matmul, left, right.T, repeat=5)
    axis = np.linspace(-2, 2, 1000)
    nodes = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    rows = []
    for name, spread in (("single spread 0.3", 0.3), ("single spread 0.03", 0.03), ("from the data", "auto")):
        fitted = RBFNetwork().set_params(spread=spread, smoothing="auto" if spread == "auto" else 1e-9).fit(X, y)
        seconds, _ = timed(fitted.predict_grid, axis, axis, repeat=5)
        rows.append([name, f"{seconds:.3f}", f"{seconds / product:.2f}", f"{product / seconds:.0%}"])
    peer = RBFInterpolator(X, y)
    share = 20
    theirs, _ = timed(peer, nodes[::share])
    theirs *= share
    for row in rows:
        row += [f"{theirs:.1f}", f"{theirs / float(row[1]):.0f}"]
    rate = 4 / product
    console.print(f"product of 1000 x 2000 and 2000 x 1000: {product:.3f} s, {rate:.1f} GFlop/s, {cores()} cores")
    header = [
        "2,000 centres to 1000 x 1000",
        "grid / s",
        "of a product",
        "product's rate",
        "RBFInterpolator / s",
        "times",
    ]
    show(f"Grid (RBFInterpolator: every {share}th node, scaled)", header, rows)


def greedy_table(seeds: int, most: int) -> None:
    """Centres needed for an error, and the time of many."""
    rows = []
    for field, spread in ((SINE, 1.2), (BOWL, 0.6)):
        for relative, goal in (
            (1e-2, {"surface 2": 60}.get(field.name, 36)),
            (1e-3, {"surface 2": 125}.get(field.name, 63)),
        ):
            figures = []
            for seed in range(seeds):
                X, y, _, _ = field.draw(2000, np.random.default_rng(seed))
                tolerance, values = relative * float(np.ptp(y)), (y - y.mean())[:, None]
                seconds, chosen = timed(greedy.select, X, values, _gaussian(spread), tolerance=tolerance)
                figures.append([len(chosen.indices), seconds])
            centres, seconds = np.median(figures, axis=0)
            rows.append([f"{field.name}, error {relative:g} of the range, spread {spread:g}"])
            rows[-1] += [f"{centres:.0f}", f"{goal}", f"{seconds:.3f}"]
    n = min(most, 20_000)
    X, y, _, _ = BOWL.draw(n, np.random.default_rng(0))
    seconds, chosen = timed(greedy.select, X, (y - y.mean())[:, None], _gaussian(0.1), max_centers=500)
    rows.append([f"{n} candidates, spread 0.1", f"{len(chosen.indices)}", "500", f"{seconds:.3f}"])
    show("Greedy choice among 2,000 points", ["", "centres", "goal", "seconds"], rows)


def _gaussian(spread: float) -> greedy.Gram:
    return lambda A, B: np.asarray(np.exp(cdist(A, B, "sqeuclidean") * (-0.5 / spread**2)))


def large_table(seeds: int, most: int) -> None:
    """Many points to a grid of 1000 x 1000, with SciPy's neighbourhoods and ferreus_rbf."""
    del seeds
    sizes = [n for n in (5000, 10_000, 20_000, 100_000, 1_000_000) if n <= most]
    with_ferreus = installed("ferreus_rbf")
    axis = np.linspace(0, 2047, 1000)
    nodes = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    rows, totals = [], {}
    for n in sizes:
        X, y, Q, truth = FRACTAL.draw(n, np.random.default_rng(0))
        fit, model = timed(RBFNetwork().fit, X, y)
        grid, _ = timed(model.predict_grid, axis, axis)
        ours, totals[n] = rmse(truth, model.predict(Q)), fit + grid
        rows.append([f"{n:,}", "network", f"{fit:.2f}", f"{grid:.2f}", f"{totals[n]:.2f}", "", f"{ours:.4g}", ""])
        rows[-1].append(f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f}")
        rows += list(_neighbours(n, X, y, Q, truth, nodes, grid, ours))
        for kernel in ("Linear", "ThinPlateSpline") if with_ferreus else ():
            fit, predict = timed(ferreus(kernel), X, y)
            grid, _ = timed(predict, nodes)
            theirs = rmse(truth, predict(Q))
            rows.append([f"{n:,}", f"ferreus {kernel}", f"{fit:.2f}", f"{grid:.2f}", f"{fit + grid:.2f}"])
            rows[-1] += [f"{(fit + grid) / totals[n]:.1f}", f"{theirs:.4g}", f"{ours / theirs:.3f}"]
            rows[-1].append(f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f}")
    header = ["points", "", "fit / s", "grid / s", "both / s", "times", "RMSE", "ours / theirs", "peak / MiB so far"]
    show("Fractal terrain to 1000 x 1000 ('times': theirs over ours; SciPy's counts the grid alone)", header, rows)
    last = sizes[-1]
    if last > 10_000 and 10_000 in totals:
        power = np.log(totals[last] / totals[10_000]) / np.log(last / 10_000)
        console.print(f"time grows as n^{power:.2f} from 10,000 to {last:,} points")


def _neighbours(
    n: int, X: FloatArray, y: FloatArray, Q: FloatArray, truth: FloatArray, nodes: FloatArray, ours: float, error: float
) -> Iterator[list[str]]:
    """RBFInterpolator(neighbors=50) on as many rows of the grid as take seconds, not minutes."""
    fitted = RBFInterpolator(X, y, neighbors=50)
    part = nodes[len(nodes) // 2 :][:20_000]
    seconds, _ = timed(fitted, part)
    seconds *= len(nodes) / len(part)
    theirs = rmse(truth, fitted(Q))
    row = [f"{n:,}", "RBFInterpolator, 50", "", f"{seconds:.1f} *", "", f"{seconds / ours:.1f}"]
    yield [*row, f"{theirs:.4g}", f"{error / theirs:.3f}", ""]


TABLES: dict[str, Callable[[int, int], None]] = {
    "fit": fit_table,
    "accuracy": accuracy_table,
    "grid": grid_table,
    "greedy": greedy_table,
    "large": large_table,
}


def main() -> None:
    """Run the tables that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", action="append", choices=sorted(TABLES), help="all where it is left out")
    parser.add_argument("--seeds", type=int, default=10, help="random samples of the small sizes")
    parser.add_argument("--most", type=int, default=1_000_000, help="largest number of points")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore", NetworkWarning)
    warnings.filterwarnings("ignore", module="sklearn")
    for name in chosen.table or TABLES:
        TABLES[name](chosen.seeds, chosen.most)


if __name__ == "__main__":
    main()
