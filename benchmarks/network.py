"""How fast the network is, and how accurate at that speed, beside the peers a Python user would pick.

    python -m benchmarks.network [--table NAME ...] [--seeds N] [--most N]

Everything runs in one process on this machine; figures come with their ratios, rows as they are known, and the bars at
the end. Peers that are not installed are left out and named: ``pip install surfacelink[bench]``. Fits and
predictions of one row see the same points.
"""

from __future__ import annotations

import argparse
import importlib.util
import resource
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

import matplotlib.cbook
import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.spatial.distance import cdist

from common.metrics import rmse
from common.network import NetworkWarning, RBFNetwork, greedy
from common.network.threads import cores
from common.surface import FloatArray


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


@cache
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

SHORT = 20_000
"""Points up to which everything is timed three times, and the least counts."""

SHARE = 50
"""One row of the grid in so many is what RBFInterpolator is timed on; its time is that of its nodes, one by one."""

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
        say(f"{package} is not installed; it is left out")
    return found


def timed(work: Callable[..., Any], *args: Any, repeat: int = 1, **kwargs: Any) -> tuple[float, Any]:
    """Least seconds of so many runs, and the last result."""
    seconds, result = np.inf, None
    # Threads of a matrix product spin on for a moment, on cores that are another's turn now.
    time.sleep(0.2)
    for _ in range(repeat):
        start = time.perf_counter()
        result = work(*args, **kwargs)
        seconds = min(seconds, time.perf_counter() - start)
    return seconds, result


class Table:
    """Rows that are printed as soon as they are known."""

    def __init__(self, title: str, first: int, *columns: str) -> None:
        self.first, self.widths = first, [max(9, len(column) + 2) for column in columns]
        say(f"\n{title}")
        self.row("", *columns)

    def row(self, name: str, *cells: str | float) -> None:
        """A row; numbers are shown to three digits."""
        texts = [cell if isinstance(cell, str) else f"{cell:.3g}" for cell in cells]
        say(name.ljust(self.first) + "".join(t.rjust(w) for t, w in zip(texts, self.widths, strict=False)))


def say(text: str) -> None:
    """Print a line at once."""
    print(text, flush=True)


@dataclass(frozen=True)
class Bar:
    """A figure and what it is to be: at most, or at least, the goal."""

    what: str
    figure: float
    goal: float
    least: bool = False

    @property
    def met(self) -> bool:
        """Whether the figure is what it is to be."""
        return self.figure >= self.goal if self.least else self.figure <= self.goal


Bars = Iterator[Bar]


def fit_table(seeds: int, most: int) -> Bars:
    """Fit and RMSE beside GaussianProcessRegressor."""
    if not installed("sklearn"):
        return
    table = Table(
        "Spread and smoothing from the data, beside GaussianProcessRegressor",
        38,
        *("fit / s", "theirs / s", "ratio", "RMSE", "theirs", "ratio", "seeds"),
    )
    # Few points are a matter of luck. Without noise their optimiser takes minutes for 2,000 points.
    cases = [(50, 0.0, 0.5, 4 * seeds), (50, 0.05, 0.5, 4 * seeds), (500, 0.0, 0.2, min(seeds, 3))]
    cases += [(500, 0.05, 0.2, min(seeds, 3)), (2000, 0.05, 0.05, 1)]
    for n, noise, goal, repeats in cases:
        for field in (SINE, BOWL) if n < 2000 else (SINE,):
            if n > most:
                continue
            figures = []
            for seed in range(repeats):
                X, y, Q, truth = field.draw(n, np.random.default_rng(seed))
                y = y + noise * np.random.default_rng(seed + 1000).normal(size=n)
                seconds, predict = timed(network, X, y)
                theirs, regressor = timed(process, X, y)
                figures.append([seconds, theirs, rmse(truth, predict(Q)), rmse(truth, regressor(Q))])
            ours, theirs, error, other = np.median(figures, axis=0).tolist()
            name = f"{field.name}, n = {n:,}, noise {noise:.0%}"
            table.row(name, ours, theirs, ours / theirs, error, other, error / other, f"{repeats}")
            yield Bar(f"fit, {name}: seconds over theirs", ours / theirs, goal)
            yield Bar(f"fit, {name}: RMSE over theirs", error / other, 1.0)


def accuracy_table(seeds: int, most: int) -> Bars:
    """RMSE of random samples beside every peer that takes as many points."""
    with_process, with_ferreus = installed("sklearn"), installed("ferreus_rbf")
    table = Table("RMSE of random samples without noise", 28, "network", "best peer", "ratio", "which it is         ")
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
            # Few points are a matter of luck.
            for seed in range(4 * seeds if n < 500 else min(seeds, 3) if n == 500 else 1):
                X, y, Q, truth = field.draw(n, np.random.default_rng(seed))
                for name, fit in {"network": network, **peers}.items():
                    errors[name].append(_error(fit, X, y, Q, truth))
            medians = {name: float(np.median(found)) for name, found in errors.items()}
            ours = medians.pop("network")
            best = min(medians, key=lambda name: medians[name])
            table.row(f"{field.name}, n = {n:,}", ours, medians[best], ours / medians[best], best)
            yield Bar(f"accuracy, {field.name}, n = {n:,}: RMSE over the best peer's", ours / medians[best], 1.0)


def _error(fit: Callable[..., Predict], X: FloatArray, y: FloatArray, Q: FloatArray, truth: FloatArray) -> float:
    try:
        return rmse(truth, fit(X, y)(Q))
    except np.linalg.LinAlgError:
        return float("inf")


def grid_table(seeds: int, most: int) -> Bars:
    """A grid of 1000 x 1000 from 2,000 centres."""
    del seeds, most
    X, y, _, _ = SINE.draw(2000, np.random.default_rng(0))
    left, right = (np.random.default_rng(i).random((1000, 2000)) for i in range(2))
    product, _ = timed(np.matmul, left, right.T, repeat=5)
    axis = np.linspace(-2, 2, 1000)
    share = 20
    theirs, _ = timed(RBFInterpolator(X, y), _nodes(axis)[::share])
    theirs *= share
    say(f"\nproduct of 1000 x 2000 and 2000 x 1000: {product:.3f} s, {4 / product:.1f} GFlop/s, {cores()} cores")
    say(f"RBFInterpolator: {theirs:.1f} s (every {share}th node timed, times {share})")
    table = Table("2,000 centres to 1000 x 1000", 28, "grid / s", "product's rate", "RBFInterpolator over it")
    for name, spread in (("single spread 0.3", 0.3), ("single spread 0.03", 0.03), ("from the data", "auto")):
        fitted = RBFNetwork().set_params(spread=spread, smoothing="auto" if spread == "auto" else 1e-9).fit(X, y)
        seconds, _ = timed(fitted.predict_grid, axis, axis, repeat=5)
        table.row(name, seconds, f"{product / seconds:.0%}", theirs / seconds)
        if spread != "auto":
            yield Bar(f"grid, {name}: rate over that of a matrix product", product / seconds, 0.6, least=True)
            yield Bar(f"grid, {name}: times faster than RBFInterpolator", theirs / seconds, 100, least=True)


def _nodes(axis: FloatArray) -> FloatArray:
    return np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)


def greedy_table(seeds: int, most: int) -> Bars:
    """Centres needed for an error, and the time of many."""
    table = Table("Greedy choice", 56, "centres", "goal", "seconds")
    for field, spread, goals in ((SINE, 1.2, (36, 63)), (BOWL, 0.6, (60, 125))):
        for relative, goal in zip((1e-2, 1e-3), goals, strict=True):
            figures = []
            for seed in range(seeds):
                X, y, _, _ = field.draw(2000, np.random.default_rng(seed))
                tolerance, values = relative * float(np.ptp(y)), (y - y.mean())[:, None]
                seconds, chosen = timed(greedy.select, X, values, _gaussian(spread), tolerance=tolerance)
                figures.append([len(chosen.indices), seconds])
            centres, seconds = np.median(figures, axis=0).tolist()
            name = f"{field.name}, 2,000 points, error {relative:g} of the range"
            table.row(name, f"{centres:.0f}", f"{goal}", seconds)
            yield Bar(f"greedy, {name}: centres", centres, goal)
    n = min(most, 20_000)
    X, y, _, _ = BOWL.draw(n, np.random.default_rng(0))
    seconds, chosen = timed(greedy.select, X, (y - y.mean())[:, None], _gaussian(0.1), max_centers=500, repeat=3)
    table.row(f"{n:,} candidates, spread 0.1", f"{len(chosen.indices)}", "500", seconds)
    yield Bar(f"greedy, {len(chosen.indices)} centres of {n:,}: seconds", seconds, 2.0)


def _gaussian(spread: float) -> greedy.Gram:
    return lambda A, B: np.asarray(np.exp(cdist(A, B, "sqeuclidean") * (-0.5 / spread**2)))


def large_table(seeds: int, most: int) -> Bars:
    """Many points to a grid of 1000 x 1000, with SciPy's neighbourhoods and ferreus_rbf."""
    del seeds
    sizes = [n for n in (5000, 10_000, 20_000, 100_000, 1_000_000) if n <= most]
    axis = np.linspace(0, 2047, 1000)
    nodes = _nodes(axis)
    table = Table(
        "Fractal terrain to 1000 x 1000; 'times': theirs over ours, SciPy's for the grid alone over our fit and grid",
        34,
        *("fit / s", "grid / s", "both / s", "times", "RMSE", "ours over it", "peak / MiB"),
    )
    ours: dict[int, tuple[float, float]] = {}
    for n in sizes:
        X, y, Q, truth = FRACTAL.draw(n, np.random.default_rng(0))
        repeat = 3 if n <= SHORT else 1
        fit, model = timed(RBFNetwork().fit, X, y, repeat=repeat)
        grid, _ = timed(model.predict_grid, axis, axis, repeat=repeat)
        ours[n] = fit + grid, rmse(truth, model.predict(Q))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        table.row(f"{n:,} network", fit, grid, fit + grid, "", ours[n][1], "", f"{peak:.0f}")
        if n == 1_000_000:
            yield Bar(f"large, {n:,}: peak in MiB", peak, 2048)
    if sizes and sizes[-1] > 10_000:
        power = float(np.log(ours[sizes[-1]][0] / ours[10_000][0]) / np.log(sizes[-1] / 10_000))
        say(f"time grows as n^{power:.2f} from 10,000 to {sizes[-1]:,} points")
        yield Bar(f"large, growth from 10,000 to {sizes[-1]:,}: exponent", power, 1.1)
    for n in sizes:
        X, y, Q, truth = FRACTAL.draw(n, np.random.default_rng(0))
        fitted = RBFInterpolator(X, y, neighbors=50)
        seconds, _ = timed(fitted, nodes.reshape(1000, 1000, 2)[::SHARE].reshape(-1, 2))
        seconds, error = seconds * SHARE, rmse(truth, fitted(Q))
        times, ratio = seconds / ours[n][0], ours[n][1] / error
        table.row(f"{n:,} RBFInterpolator, 50 *", "", seconds, seconds, times, error, ratio)
        if n == 1_000_000:
            yield Bar(f"large, {n:,}: times faster than RBFInterpolator(neighbors=50)", times, 10, least=True)
            yield Bar(f"large, {n:,}: RMSE over RBFInterpolator's", ratio, 1.0)
    say(f"* every {SHARE}th row of the grid timed, times {SHARE}")
    if not installed("ferreus_rbf"):
        return
    for n in sizes:
        X, y, Q, truth = FRACTAL.draw(n, np.random.default_rng(0))
        # Its thin plate takes more than six minutes for a million points.
        for kernel in ("Linear", "ThinPlateSpline") if n <= 100_000 else ("Linear",):
            repeat = 3 if n <= SHORT else 1
            fit, predict = timed(ferreus(kernel), X, y, repeat=repeat)
            grid, _ = timed(predict, nodes, repeat=repeat)
            error = rmse(truth, predict(Q))
            times, ratio = (fit + grid) / ours[n][0], ours[n][1] / error
            table.row(f"{n:,} ferreus {kernel}", fit, grid, fit + grid, times, error, ratio)
            goal = 8 if n == 1_000_000 else 1
            yield Bar(f"large, {n:,}: times faster than ferreus {kernel}", times, goal, least=True)
            yield Bar(f"large, {n:,}: RMSE over ferreus {kernel}'s", ratio, 1.0)


TABLES: dict[str, Callable[[int, int], Bars]] = {
    "fit": fit_table,
    "accuracy": accuracy_table,
    "grid": grid_table,
    "greedy": greedy_table,
    "large": large_table,
}


def main() -> None:
    """Run the tables that were asked for."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.network", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--table", action="append", choices=sorted(TABLES), help="may be repeated; all by default")
    parser.add_argument("--seeds", type=int, default=10, help="random samples of the small sizes (%(default)s)")
    parser.add_argument("--most", type=int, default=1_000_000, help="largest number of points (%(default)s)")
    chosen = parser.parse_args()
    warnings.simplefilter("ignore", NetworkWarning)
    bars: list[Bar] = []
    warnings.filterwarnings("ignore", module="sklearn")
    for name in chosen.table or TABLES:
        bars += TABLES[name](chosen.seeds, chosen.most)
    say("\nWhat is to be shown")
    for bar in bars:
        goal = f"at {'least' if bar.least else 'most'} {bar.goal:g}"
        say(f"{'' if bar.met else 'MISSED':8}{bar.what:80}{bar.figure:10.3g}   {goal}")


if __name__ == "__main__":
    main()
