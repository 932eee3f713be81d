"""How accurate the network is: tables beside the methods that a Python user would pick, run in the same process.

`benchmarks.network` has the speed, and random samples of every size.

    python -m benchmarks.accuracy [--table NAME ...] [--seeds N]

Each table prints medians over the seeds. Errors are RMSE against the truth, relative ones over the range of the truth.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Callable
from typing import Literal, TypeAlias

import numpy as np
from scipy.interpolate import RBFInterpolator, griddata
from scipy.spatial import KDTree

from benchmarks import terrain
from benchmarks.network import fractal, timed
from common.metrics import nrmse, rmse
from common.network import NetworkWarning, RBFNetwork
from common.network.kernel import ladder_spreads, mean_spacing, span
from common.network.partition import Partition
from common.network.selection import SMOOTHINGS, TRUST, Samples, Spectra, families, rounding_floor, score
from common.surface import BoolArray, FloatArray
from sender.features import extract_features
from sender.surfaces import SURFACES

PAPER = ("surface-1", "surface-2", "surface-3")
NOISES = ("clean", "z", "xyz")
TARGETS = ((0.20, 0.62, 0.62), (1.00, 0.96, 0.92), (0.42, 0.88, 0.86))


def ours(X: FloatArray, y: FloatArray, Q: FloatArray) -> FloatArray:
    """Heights at Q by the network with its defaults."""
    return RBFNetwork().fit(X, y).predict(Q)


def linear(X: FloatArray, y: FloatArray, Q: FloatArray) -> FloatArray:
    """Delaunay, linear; the nearest point outside of the hull."""
    return _griddata(X, y, Q, "linear")


def cubic(X: FloatArray, y: FloatArray, Q: FloatArray) -> FloatArray:
    """Clough-Tocher; the nearest point outside of the hull."""
    return _griddata(X, y, Q, "cubic")


def _griddata(X: FloatArray, y: FloatArray, Q: FloatArray, method: Literal["linear", "cubic"]) -> FloatArray:
    values = griddata(X, y, Q, method=method)
    return np.asarray(np.where(np.isnan(values), griddata(X, y, Q, method="nearest"), values))


def plate(X: FloatArray, y: FloatArray, Q: FloatArray, smoothing: float = 0.0) -> FloatArray:
    """SciPy's RBFInterpolator with a thin-plate spline."""
    return np.asarray(RBFInterpolator(X, y, smoothing=smoothing)(Q))


def linear_rbf(X: FloatArray, y: FloatArray, Q: FloatArray, smoothing: float = 0.0) -> FloatArray:
    """SciPy's RBFInterpolator with the kernel -r."""
    return np.asarray(RBFInterpolator(X, y, kernel="linear", smoothing=smoothing)(Q))


def received(name: str, noise: str, seed: int) -> tuple[FloatArray, FloatArray]:
    """Positions and heights of the feature points of one cloud, with normal noise of the paper's amplitude."""
    surface, rng = SURFACES[name], np.random.default_rng(seed)
    points = np.array(extract_features(surface.sample(rng), gap=surface.gap, region=surface.region).points)
    if noise != "clean":
        axes = slice(2, 3) if noise == "z" else slice(0, 3)
        points[:, axes] += rng.normal(0, surface.noise, points[:, axes].shape)
    return points[:, :2], points[:, 2]


def criterion(seeds: int) -> None:
    """What each criterion makes of the same candidates: ratio to the best traditional fit, as in `features`."""
    print("Feature points only: what each criterion makes of the same candidates (clean, z, xyz of surface 1, 2, 3)")
    found: dict[str, list[float]] = {}
    for name in PAPER:
        truth = SURFACES[name].grid((41, 41))
        Q, z = truth.points()[:, :2], truth.z.ravel()
        for noise in NOISES:
            ratios: dict[str, list[float]] = {}
            for seed in range(seeds):
                X, y = received(name, noise, seed)
                rival = min(nrmse(z, method(X, y, Q)) for method in (linear, cubic, plate))
                for rule, heights in _by_criterion(X, y, Q, z):
                    ratios.setdefault(rule, []).append(nrmse(z, heights) / rival)
            for rule, values in ratios.items():
                found.setdefault(rule, []).append(float(np.median(values)))
    for rule, medians in found.items():
        print(f"  {rule:44s} " + " | ".join(" ".join(f"{v:4.2f}" for v in medians[i : i + 3]) for i in (0, 3, 6)))


def _by_criterion(X: FloatArray, y: FloatArray, Q: FloatArray, z: FloatArray) -> list[tuple[str, FloatArray]]:
    origin, unit, level, height = X.mean(axis=0), float(np.sqrt(X.var(axis=0).sum())), y.mean(), y.std()
    samples = Samples((X - origin) / unit, ((y - level) / height)[:, None], np.ones(len(X)))
    extent = span(samples.X)
    spreads = ladder_spreads(mean_spacing(samples.X), 2 * extent)
    kernels = [kind.kernel(spreads) for kind in families(spreads, extent)]
    smoothings = SMOOTHINGS[rounding_floor(len(X)) <= SMOOTHINGS]
    spectra = Spectra(np.array([kernel.gram(samples.X) for kernel in kernels]), samples)
    restricted, density, _, _ = spectra.criteria(smoothings)
    places = (Q - origin) / unit
    crosses = [kernel.gram(places, samples.X) for kernel in kernels]

    def heights(shares: FloatArray) -> FloatArray:
        total = np.zeros(len(Q))
        for i in np.flatnonzero(shares.sum(axis=1)).tolist():
            solution = spectra.solve(i, smoothings, shares[i])
            total += (crosses[i] @ solution.coefficients + solution.bias)[:, 0]
        return np.asarray(level + height * total)

    def soft(value: FloatArray) -> FloatArray:
        shares = np.exp(value.min() - value)
        shares[shares < 1e-3] = 0
        return np.asarray(shares / shares.sum())

    def hard(value: FloatArray) -> FloatArray:
        return np.asarray((value == value.min()) / np.count_nonzero(value == value.min()))

    squares, errors = np.empty_like(restricted), np.empty_like(restricted)
    for i, cross in enumerate(crosses):
        for j in range(len(smoothings)):
            solution = spectra.solve(i, smoothings[j : j + 1], np.ones(1))
            squares[i, j] = np.mean(solution.residuals**2)
            errors[i, j] = np.mean((level + height * (cross @ solution.coefficients + solution.bias)[:, 0] - z) ** 2)
    mixed = restricted / 2 + len(X) / 4 * np.log(squares)
    return [
        ("restricted likelihood, best", heights(hard(restricted))),
        ("leave-one-out square, best", heights(hard(squares))),
        ("leave-one-out density, best", heights(hard(density))),
        ("average by likelihood", heights(soft(restricted))),
        ("average by likelihood^1/2, square^-n/4", heights(soft(mixed))),
        ("average by leave-one-out density", heights(soft(density))),
        (f"average by density^{TRUST}", heights(soft(TRUST * density))),
        ("the same, some noise believed in (used)", heights(soft(score(len(X), density, smoothings)))),
        ("the best candidate in hindsight", heights(hard(errors))),
    ]


def features(seeds: int) -> None:
    """Only the feature points of the paper's surfaces, clean and noisy: ratio to the best traditional fit."""
    print("Feature points only: NRMSE of the network over that of the best of linear, cubic, thin plate")
    print(
        f"{'':10s} {'noise':6s} {'ratio':>7s} {'target':>7s} {'network':>9s} {'linear':>9s} {'cubic':>9s} {'plate':>9s}"
    )
    for name, targets in zip(PAPER, TARGETS, strict=True):
        surface = SURFACES[name]
        truth = surface.grid((61, 61))
        Q, z = truth.points()[:, :2], truth.z.ravel()
        for noise, target in zip(NOISES, targets, strict=True):
            rows = []
            for seed in range(seeds):
                X, y = received(name, noise, seed)
                rows.append([nrmse(z, method(X, y, Q)) for method in (ours, linear, cubic, plate)])
            table = np.array(rows)
            ratio = float(np.median(table[:, 0] / table[:, 1:].min(axis=1)))
            figures = " ".join(f"{value:9.4f}" for value in np.median(table, axis=0))
            print(f"{name:10s} {noise:6s} {ratio:7.2f} {target:7.2f} {figures}{'' if ratio <= target else '  missed'}")


def noise(seeds: int) -> None:
    """The sine surface with 5 % noise, with gross outliers, with wild values: RMSE."""
    print("sin 2x + sin 2y, 2,000 samples: RMSE, found of the wrong points, wrongly set aside (median of seeds)")
    rows = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        cloud = SURFACES["surface-3"].sample(rng, 4000)
        X, y, Q, z = cloud[:2000, :2], cloud[:2000, 2], cloud[2000:, :2], cloud[2000:, 2]
        extent = 4.0
        noisy = rmse(z, ours(X, y + 0.05 * rng.normal(size=2000), Q))
        wrong = np.zeros(2000, dtype=bool)
        wrong[rng.permutation(2000)[:40]] = True
        spoilt = y + 0.01 * rng.normal(size=2000)
        spoilt[wrong] += rng.uniform(-extent / 2, extent / 2, 40)
        found, error = _set_aside(X, spoilt, Q, z, wrong)
        rows.append([noisy, error, *found])
        base = rmse(z, ours(X, y, Q))
        wrong[rng.permutation(2000)[:100]] = True
        wild = np.where(wrong, rng.uniform(-5, 5, 2000) * extent, y)
        found, error = _set_aside(X, wild, Q, z, wrong)
        rows[-1] += [base, error, *found]
    a = np.median(rows, axis=0)
    print(f"  5 % noise                     {a[0]:.4f}  target 0.026")
    print(f"  1 % noise, 2 % gross outliers {a[1]:.4f}  target 0.012   found {a[2]:.2f}, wrongly {a[3]:.3f}")
    print(f"  5 % wild values               {a[5]:.2e}  without them {a[4]:.2e}   found {a[6]:.2f}, wrongly {a[7]:.3f}")


def _set_aside(
    X: FloatArray, y: FloatArray, Q: FloatArray, z: FloatArray, wrong: BoolArray
) -> tuple[tuple[float, float], float]:
    network = RBFNetwork().fit(X, y)
    aside = np.zeros(len(X), dtype=bool)
    aside[network.outliers_] = True
    return (float(aside[wrong].mean()), float(aside[~wrong].mean())), rmse(z, network.predict(Q))


def wild(seeds: int) -> None:
    """5 % of the points replaced by wild values, on every kind of surface: NRMSE over that without them."""
    print("5 % of the points wild (up to five ranges off): NRMSE over that of the true values, over that of the other")
    print("points alone, found, wrongly set aside when there are none; medians, and the greatest of the second ratio")
    for level in (0.0, 0.01):
        for name in (*PAPER, "franke", "elevation"):
            for n in (100, 400, 2000):
                rows = []
                for seed in range(min(seeds, 5)):
                    X, y, spoilt, wrong, Q, z = _spoilt(name, n, level, 0.05, "wild", seed)
                    clean = RBFNetwork().fit(X, y)
                    found, error = _set_aside(X, spoilt, Q, z, wrong)
                    others = rmse(z, ours(X[~wrong], y[~wrong], Q))
                    rows.append([error / rmse(z, clean.predict(Q)), error / others, found[0], len(clean.outliers_) / n])
                a = np.median(rows, axis=0)
                print(
                    f"  noise {level:.2f} {name:10s} {n:5d}  {a[0]:5.2f} {a[1]:5.2f} ({np.max(rows, axis=0)[1]:.2f})"
                    f"  found {a[2]:.2f}  wrongly {a[3]:.4f}",
                    flush=True,
                )


def real(seeds: int) -> None:
    """Real terrain, 800 and 2,000 samples, clean and with 10 % noise: RMSE over the better of two splines."""
    print("Real terrain: RMSE over the better of thin plate and linear RBF (noisy: at their best smoothing by oracle)")
    ratios: dict[tuple[int, bool], list[float]] = {}
    for name in terrain.available():
        cloud = terrain.nodes(name)
        figures = []
        for n in (800, 2000):
            for noisy in (False, True):
                values = []
                for seed in range(min(seeds, 3)):
                    rng = np.random.default_rng(seed)
                    rows = rng.permutation(len(cloud))[: n + 3000]
                    X, Q, z = cloud[rows[:n], :2], cloud[rows[n:], :2], cloud[rows[n:], 2]
                    y = cloud[rows[:n], 2] + (0.1 * z.std() * rng.normal(size=n) if noisy else 0.0)
                    unit = np.ptp(X, axis=0).max()
                    smoothings = (0.0, 1e-5, 1e-4, 1e-3, 1e-2) if noisy else (0.0,)
                    rivals = [rmse(z, plate(X / unit, y, Q / unit, s)) for s in smoothings]
                    rivals += [rmse(z, linear_rbf(X / unit, y, Q / unit, s * 30)) for s in smoothings]
                    values.append(rmse(z, ours(X, y, Q)) / min(rivals))
                figures.append(float(np.median(values)))
                ratios.setdefault((n, noisy), []).append(figures[-1])
        print(f"  {name:16s} " + " ".join(f"{value:6.3f}" for value in figures), flush=True)
    print(f"  {'median':16s} " + " ".join(f"{np.median(v):6.3f}" for v in ratios.values()))
    print(
        f"  {'greatest':16s} "
        + " ".join(f"{max(v):6.3f}" for v in ratios.values())
        + "   800, 800 noisy, 2000, 2000 noisy"
    )


def many(seeds: int) -> None:
    """Many wrong points: RMSE over that of the other points alone."""
    shares = (0.05, 0.1, 0.2, 0.3, 0.4)
    print(
        "Many wrong points, gross (off by up to half the range) and wild (anywhere within five): RMSE over that of the"
    )
    print(
        f"other points alone, median; columns: {', '.join(f'{share:.0%}' for share in shares)} of the points are wrong"
    )
    for name in ("surface-3", "peaks"):
        for n in (100, 400, 2000):
            for level in (0.0, 0.01):
                figures = {
                    kind: [_beside_others(name, n, level, share, kind, seeds) for share in shares] for kind in WRONG
                }
                print(
                    f"  {name:10s} {n:5d} noise {level:4.0%} "
                    + "   ".join(f"{kind} " + " ".join(f"{v:7.3g}" for v in row) for kind, row in figures.items()),
                    flush=True,
                )


WRONG: dict[str, Callable[[FloatArray, float, np.random.Generator], FloatArray]] = {
    "gross": lambda y, span, rng: y + rng.uniform(-span / 2, span / 2, len(y)),
    "wild": lambda y, span, rng: rng.uniform(-5 * span, 5 * span, len(y)),
}
"""What wrong points are instead of the values, of which the span is given."""


def _spoilt(
    name: str, n: int, level: float, share: float, kind: str, seed: int
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, FloatArray, FloatArray]:
    """Positions, values, the same with a share of wrong ones, which are wrong; places to ask and what is true there."""
    rng = np.random.default_rng(seed)
    cloud = SURFACES[name].sample(rng, n + 2000)
    z = cloud[n:, 2]
    extent = float(np.ptp(z))
    y = cloud[:n, 2] + level * extent * rng.normal(size=n)
    wrong = np.zeros(n, dtype=bool)
    wrong[rng.permutation(n)[: round(share * n)]] = True
    return cloud[:n, :2], y, np.where(wrong, WRONG[kind](y, extent, rng), y), wrong, cloud[n:, :2], z


def _beside_others(name: str, n: int, level: float, share: float, kind: str, seeds: int) -> float:
    """RMSE from spoilt values over that from the right ones alone, median over the seeds."""
    ratios = []
    for seed in range(min(seeds, 5)):
        X, y, spoilt, wrong, Q, z = _spoilt(name, n, level, share, kind, seed)
        ratios.append(rmse(z, ours(X, spoilt, Q)) / rmse(z, ours(X[~wrong], y[~wrong], Q)))
    return float(np.median(ratios))


def coverage(seeds: int) -> None:
    """Share of the truth within the 95 % band."""
    print("Coverage of the 95 % band, per cent (target 90 to 98): clean, 5 % noise")
    names: list[str] = [*PAPER, "franke", "peaks", *terrain.available()]
    sizes = (100, 400, 1500, 6000, 20000)
    for name in names:
        cloud = None if name in SURFACES else terrain.nodes(name)
        figures = []
        for n in sizes:
            if cloud is not None and len(cloud) < n + 2000:
                continue
            for noisy in (False, True):
                values = []
                # One cloud of few points says little of the next.
                share = 8 if n < 200 else 2 if n < 1000 else 1 if n < 5000 else 0.4
                for seed in range(max(1, round(share * seeds))):
                    rng = np.random.default_rng(seed)
                    part = (
                        SURFACES[name].sample(rng, n + 2000)
                        if cloud is None
                        else cloud[rng.permutation(len(cloud))[: n + 2000]]
                    )
                    z = part[n:, 2]
                    y = part[:n, 2] + (0.05 * np.ptp(z) * rng.normal(size=n) if noisy else 0.0)
                    mean, deviation = RBFNetwork().fit(part[:n, :2], y).predict(part[n:, :2], return_std=True)
                    values.append(float(np.mean(np.abs(mean - z) <= 1.96 * deviation)))
                figures.append(100 * float(np.mean(values)))
        print(f"  {name:16s} " + " ".join(f"{value:5.1f}" for value in figures), flush=True)
    print("  columns, clean and noisy each: " + ", ".join(map(str, sizes)) + " points")


Likely: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray | BoolArray]

UNEVEN: dict[str, Likely] = {
    "everywhere": lambda x, _y: np.ones_like(x),
    "tracks": lambda x, _y: np.abs((12 * x + 0.5) % 1 - 0.5) < 0.02,
    "crossing": lambda x, y: (np.abs((8 * x + np.sin(3 * y)) % 1 - 0.5) < 0.01) | (np.abs(3 * y % 1 - 0.5) < 0.006),
    "stripes": lambda x, _y: 6 * x % 1 < 0.5,
    "hole": lambda x, y: np.hypot(x - 0.5, y - 0.5) > 0.2,
    "thinning": lambda x, _y: np.exp(-6 * x),
}
"""How likely a place of the unit square is to be measured."""

SHAPES: dict[str, Callable[[FloatArray, FloatArray], FloatArray]] = {
    "sines": lambda x, y: np.sin(8 * x) + np.sin(8 * y),
    "ridge": lambda x, y: np.abs(x - 0.5 - 0.3 * (y - 0.5)),
    "cliff": lambda x, y: np.tanh(80 * (x - 0.5 - 0.08 * np.sin(8 * y))),
    "terrain": lambda x, y: fractal()[tuple(np.rint(2047 * axis).astype(int) for axis in (y, x))],
}


def drawn(n: int, likely: Likely, rng: np.random.Generator) -> FloatArray:
    """Places (n, 2) of the unit square, each as likely as that."""
    X = np.empty((0, 2))
    while len(X) < n:
        tried = rng.random((4 * n, 2))
        X = np.vstack([X, tried[rng.random(4 * n) < likely(*tried.T)]])[:n]
    return X


def uneven(seeds: int) -> None:
    """Points along tracks, in stripes, around a hole, ever thinner: ratio to the best of two splines."""
    print("Uneven points: RMSE over the better of thin plate (50 neighbours) and linear; median (greatest)")
    for name, shape in SHAPES.items():
        for n in (400, 1500, 6000):
            figures = []
            for likely in UNEVEN.values():
                ratios = []
                for seed in range(min(seeds, 5)):
                    rng = np.random.default_rng(seed)
                    X = drawn(n, likely, rng)
                    Q, y = rng.random((2000, 2)), shape(*X.T)
                    z = shape(*Q.T)
                    rivals = (RBFInterpolator(X, y, neighbors=50)(Q), linear(X, y, Q))
                    ratios.append(rmse(z, ours(X, y, Q)) / min(rmse(z, heights) for heights in rivals))
                figures.append(f"{np.median(ratios):6.2f} ({max(ratios):5.2f})")
            print(f"  {name:8s} {n:5d} " + " ".join(figures), flush=True)
    print("  columns: " + ", ".join(UNEVEN))


GAPS: dict[str, Likely] = {
    "half": lambda x, _y: x > 0.5,
    "corner": lambda x, y: (x > 0.5) | (y > 0.5),
    "strip": lambda x, _y: np.abs(x - 0.5) > 0.17,
    "hole": UNEVEN["hole"],
    "tracks": lambda x, _y: np.abs((4 * x + 0.5) % 1 - 0.5) < 0.02,
    "clusters": lambda x, y: np.hypot(3 * x % 1 - 0.5, 3 * y % 1 - 0.5) < 0.25,
}
"""Where points are; the rest is to be told from afar."""

HILLS: dict[str, Callable[[FloatArray, FloatArray], FloatArray]] = {
    **SHAPES,
    "dip": lambda x, y: -1 / (1 + (4 * x - 2) ** 2 + (4 * y - 2) ** 2),
    "surface 3": lambda x, y: (4 * x - 2) * np.exp(-((4 * x - 2) ** 2) - (4 * y - 2) ** 2),
}


def gaps(seeds: int) -> None:
    """Share of the truth within the 95 % band, at places further from all points than their mean spacing."""
    print("Coverage of the 95 % band in gaps and beyond the edge, per cent: clean, 5 % noise")
    for name, shape in HILLS.items():
        for n in (100, 400, 1500, 6000):
            figures = []
            for likely in GAPS.values():
                for noise in (0.0, 0.05):
                    shares = []
                    for seed in range(seeds if n < 1000 else min(seeds, 3)):
                        rng = np.random.default_rng(seed)
                        X, Q = drawn(n, likely, rng), rng.random((4000, 2))
                        y, z = shape(*X.T), shape(*Q.T)
                        y = y + noise * np.std(y) * rng.normal(size=n)
                        mean, deviation = RBFNetwork().fit(X, y).predict(Q, return_std=True)
                        far = KDTree(X).query(Q)[0] > n**-0.5
                        shares.append(float(np.mean((np.abs(mean - z) <= 1.96 * deviation)[far])))
                    figures.append(100 * float(np.mean(shares)))
            print(f"  {name:10s} {n:5d} " + " ".join(f"{value:5.1f}" for value in figures), flush=True)
    print("  columns, clean and noisy each: " + ", ".join(GAPS))


def merging(seeds: int) -> None:
    """Many noisy points of smooth surfaces: the network beside its patches alone."""
    print("Many noisy points: RMSE over the noise's deviation, of the patches alone and of the network, and seconds")
    print("  noise in per cent of the heights' deviation; medians")
    for name in ("surface-3", "surface-2", "franke", "peaks"):
        for n in (5000, 20_000, 100_000):
            for level in (0.01, 0.05, 0.2):
                rows = []
                for seed in range(min(seeds, 3)):
                    rng = np.random.default_rng(seed)
                    cloud = SURFACES[name].sample(rng, n + 2000)
                    X, Q, z = cloud[:n, :2], cloud[n:, :2], cloud[n:, 2]
                    noise = level * float(z.std())
                    y = cloud[:n, 2] + noise * rng.normal(size=n)
                    cut, patches = timed(Partition.fit, X, y[:, None])
                    merged, network = timed(RBFNetwork().fit, X, y)
                    errors = [rmse(z, patches.predict(Q)[:, 0]) / noise, rmse(z, network.predict(Q)) / noise]
                    rows.append([*errors, cut, merged])
                a = np.median(rows, axis=0)
                print(
                    f"  {name:10s} {n:7d} {100 * level:3.0f} %  {a[0]:6.3f} {a[1]:6.3f}   {a[2]:6.2f} s {a[3]:6.2f} s",
                    flush=True,
                )


def exploded(_seeds: int) -> None:
    """The elevation grid, 2,000 samples, spread of 3 mean spacings, no smoothing: what plain solvers do silently."""
    rng = np.random.default_rng(0)
    cloud = SURFACES["elevation"].sample(rng, 6000)
    X, y, Q, z = cloud[:2000, :2], cloud[:2000, 2], cloud[2000:, :2], cloud[2000:, 2]
    spread = 3 * float(np.sqrt(np.prod(np.ptp(X, axis=0)) / 2000))
    K = np.exp(-((X[:, None] - X) ** 2).sum(axis=2) / (2 * spread**2))
    cross = np.exp(-((Q[:, None] - X) ** 2).sum(axis=2) / (2 * spread**2))
    print(f"Spread of 3 mean spacings, smoothing 0: plain solve {rmse(z, cross @ np.linalg.solve(K, y)):.0f} m")
    with warnings.catch_warnings(record=True):
        warnings.simplefilter("always", NetworkWarning)
        network = RBFNetwork(spread=spread, smoothing=0.0).fit(X, y)
    print(f"  network {rmse(z, network.predict(Q)):.1f} m; notes: {list(network.notes_)}")


TABLES: dict[str, Callable[[int], None]] = {
    "features": features,
    "criterion": criterion,
    "noise": noise,
    "wild": wild,
    "many": many,
    "terrain": real,
    "coverage": coverage,
    "uneven": uneven,
    "gaps": gaps,
    "merging": merging,
    "exploded": exploded,
}


def main() -> None:
    """Print the tables that were asked for, by default all."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy", description=__doc__.splitlines()[0])
    parser.add_argument("--table", nargs="*", choices=list(TABLES), default=list(TABLES), help="all by default")
    parser.add_argument("--seeds", type=int, default=12, help="random samples of each surface (%(default)s)")
    options = parser.parse_args()
    for name in options.table:
        TABLES[name](options.seeds)
        print(flush=True)


if __name__ == "__main__":
    main()
