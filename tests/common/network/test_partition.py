from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator

from common.errors import TrainingError
from common.network import NetworkWarning, RBFNetwork, local
from common.network.cover import Cover, frame_for
from common.network.kernel import Kernel
from common.network.local import Levels
from common.network.partition import Partition
from common.surface import FloatArray
from tests.common.network.surfaces import bowl, rough, scattered, sine


def rmse(partition: Partition, f: Callable[[FloatArray], FloatArray], X: FloatArray) -> float:
    return float(np.sqrt(np.mean((partition.predict(X)[:, 0] - f(X)) ** 2)))


@pytest.fixture(scope="module")
def surface() -> Partition:
    X = scattered(4000)
    return Partition.fit(X, rough(X)[:, None])


@pytest.mark.parametrize(("f", "accepted"), [(sine, 1e-5), (bowl, 1e-5), (rough, 5e-3)])
def test_smooth_surfaces_are_reproduced(f: Callable[[FloatArray], FloatArray], accepted: float) -> None:
    X = scattered(5000)
    y = f(X)
    inner = 0.97 * scattered(2000, 1)
    assert rmse(Partition.fit(X, y[:, None]), f, inner) < accepted * np.ptp(y)


def test_patches_agree_with_one_dense_network() -> None:
    X = scattered(1500)
    y = rough(X)
    spread, smoothing = 0.15, 1e-6
    gram = Kernel.single(spread).gram(X)
    c = np.linalg.solve(gram + smoothing * np.eye(len(X)), y - y.mean())
    Q = 0.95 * scattered(500, 3)
    dense = Kernel.single(spread).gram(Q, X) @ c + y.mean()
    blended = Partition.fit(X, y[:, None], spread=spread, smoothing=smoothing).predict(Q)[:, 0]
    assert np.sqrt(np.mean((blended - dense) ** 2)) < 3e-3 * np.ptp(y)


def test_a_grid_holds_what_scattered_evaluation_gives(surface: Partition) -> None:
    x, y = np.linspace(-2.3, 2.3, 90), np.linspace(-2, 2.1, 70)
    grid = surface.predict_grid(x, y)
    nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(grid.reshape(-1, 1), surface.predict(nodes), atol=1e-8)
    shuffled = np.random.default_rng(0).permutation(90)
    np.testing.assert_allclose(surface.predict_grid(x[shuffled], y[::-1]), grid[::-1, shuffled], atol=1e-8)


@pytest.mark.parametrize(("f", "noise"), [(sine, 0.0), (bowl, 0.0), (rough, 0.0), (sine, 0.05), (bowl, 0.05)])
def test_the_band_covers_the_truth(f: Callable[[FloatArray], FloatArray], noise: float) -> None:
    shares = []
    for seed in range(2):
        X, Q = scattered(5000, seed), scattered(2000, 10 + seed)
        y = f(X) + noise * np.ptp(f(X)) * np.random.default_rng(seed).normal(size=len(X))
        fitted = Partition.fit(X, y[:, None])
        shares.append(np.mean(np.abs(fitted.predict(Q)[:, 0] - f(Q)) <= 1.96 * fitted.predict_std(Q)[:, 0]))
    assert 0.9 <= np.mean(shares) <= 0.98


def test_the_seam_is_invisible(surface: Partition) -> None:
    """Steps of height, slope and curvature along a line are no greater where patches begin and end than elsewhere."""
    cover, frame = surface.cover, surface.cover.frame
    step = 2e-4
    t = np.arange(-1.8, 1.8, step)
    at_seam, elsewhere = [], []
    for offset in (-1.1, 0.03, 0.77):
        z = surface.predict(np.stack([t, np.full_like(t, offset)], axis=1))[:, 0]
        curvature = np.abs(np.diff(z, 2)) / step**2
        u = frame.scaled(np.array([[0.0, offset]]))[0, 1]
        near = np.abs(cover.centres[:, 1] - u) <= 0.8 * cover.sides
        edges = np.concatenate([(cover.centres[near, 0] + part * cover.sides[near]) for part in (-0.8, -0.2, 0.2, 0.8)])
        edges = (edges - frame.start[0]) * frame.side + frame.low[0]
        distance = np.abs(t[1:-1, None] - edges).min(axis=1)
        at_seam.append(curvature[distance < 2 * step])
        elsewhere.append(curvature[distance > 10 * step])
    seam, rest = np.concatenate(at_seam), np.concatenate(elsewhere)
    assert len(seam) > 100
    assert np.percentile(seam, 95) < 1.1 * np.percentile(rest, 95)
    assert seam.max() < 1.1 * rest.max()


def test_gradient_is_the_derivative_of_what_is_predicted(surface: Partition) -> None:
    X, step = 1.1 * scattered(200, 5), 1e-5
    X = X[np.all(np.abs(np.abs(X) - 2) > 0.01, axis=1)]
    slopes = surface.predict_gradient(X)
    assert slopes.shape == (len(X), 1, 2)
    for axis in range(2):
        shift = step * np.eye(2)[axis]
        difference = (surface.predict(X + shift) - surface.predict(X - shift)) / (2 * step)
        np.testing.assert_allclose(slopes[:, :, axis], difference, atol=1e-4 * np.abs(slopes).max())


def test_deviation_covers_the_truth() -> None:
    X, noise = scattered(6000), np.random.default_rng(9).normal(0, 0.05, 6000)
    fitted = Partition.fit(X, (rough(X) + noise)[:, None])
    Q = 0.97 * scattered(4000, 2)
    error, deviation = fitted.predict(Q)[:, 0] - rough(Q), fitted.predict_std(Q)[:, 0]
    assert 0.88 < np.mean(np.abs(error) < 1.96 * deviation) < 0.99
    far = fitted.predict_std(np.array([[3.0, 3.0]]))[0, 0]
    assert far > 3 * np.median(deviation)


def test_noise_is_smoothed() -> None:
    X = scattered(5000)
    noisy = sine(X) + np.random.default_rng(1).normal(0, 0.2, len(X))
    assert rmse(Partition.fit(X, noisy[:, None]), sine, 0.97 * scattered(1000, 1)) < 0.06


def test_a_cliff_in_a_smooth_surface_does_not_explode() -> None:
    def harbour(X: FloatArray) -> FloatArray:
        return np.asarray(100.0 * (X[:, 0] > 500) + 5 * np.sin(X[:, 0] / 60) * np.cos(X[:, 1] / 50))

    rng = np.random.default_rng(1)
    X, Q = rng.uniform(0, 1000, (4500, 2)), rng.uniform(0, 1000, (5000, 2))
    network = RBFNetwork().fit(X, harbour(X))
    assert not len(network.outliers_)
    axis = np.linspace(0, 1000, 300)
    grid = network.predict_grid(axis, axis)
    assert -55 < grid.min() < -5
    assert 105 < grid.max() < 155
    theirs = np.mean((harbour(Q) - RBFInterpolator(X, harbour(X), neighbors=50)(Q)) ** 2)
    assert np.mean((harbour(Q) - network.predict(Q)) ** 2) < 1.2 * theirs


def ridge(X: FloatArray) -> FloatArray:
    return np.asarray(np.abs(X[:, 0] - 0.3 * X[:, 1]))


def cliff(X: FloatArray) -> FloatArray:
    return np.asarray(np.tanh(20 * (X[:, 0] - 0.3 * np.sin(2 * X[:, 1]))))


@pytest.mark.parametrize(
    ("f", "rows", "accepted"),
    [
        (ridge, lambda _X: slice(None), 1.1),
        (ridge, lambda X: np.hypot(*X.T) > 0.8, 1.5),
        (cliff, lambda X: np.hypot(*X.T) > 0.8, 2.0),
        (cliff, lambda X: X[:, 0] % 0.6 < 0.3, 2.0),
    ],
    ids=["ridge", "ridge, hole", "cliff, hole", "cliff, stripes"],
)
def test_an_edge_in_what_is_smooth_elsewhere_costs_no_more_than_a_thin_plate(
    f: Callable[[FloatArray], FloatArray], rows: Callable[[FloatArray], Any], accepted: float
) -> None:
    X, Q = scattered(12_000), scattered(1000, 1)
    X = X[rows(X)][:5000]
    fitted = Partition.fit(X, f(X)[:, None])
    theirs = np.sqrt(np.mean((RBFInterpolator(X, f(X), neighbors=50)(Q) - f(Q)) ** 2))
    assert rmse(fitted, f, Q) < accepted * theirs
    assert np.abs(fitted.predict(Q)).max() < 1.5 * np.abs(f(X)).max()


def test_a_kernel_goes_that_explodes_between_tracks_across_a_cliff() -> None:
    rng = np.random.default_rng(1)
    X = rng.random((200_000, 2))
    X = X[np.abs((12 * X[:, 0] + 0.5) % 1 - 0.5) < 0.02][:6000]
    steep = np.tanh(80 * (X[:, 0] - 0.5 - 0.08 * np.sin(8 * X[:, 1])))
    fitted = Partition.fit(X, steep[:, None])
    assert np.abs(fitted.predict(rng.random((4000, 2)))).max() < 2


@pytest.mark.parametrize("away", [3.0, 100.0])
def test_a_lone_point_far_away_costs_the_others_nothing(away: float) -> None:
    X, Q = scattered(5000), scattered(1000, 1)
    alone = rmse(Partition.fit(X, bowl(X)[:, None]), bowl, Q)
    further = np.vstack([X, [away, away / 2]])
    fitted = Partition.fit(further, np.append(bowl(X), 0.3)[:, None])
    assert rmse(fitted, bowl, Q) < 3 * alone
    np.testing.assert_allclose(fitted.predict(further[-1:]), 0.3, atol=1e-3)


def test_a_smooth_surface_keeps_its_kernel_where_a_hole_makes_it_doubtful() -> None:
    X = scattered(9000)
    X = X[np.hypot(X[:, 0] - 0.3, X[:, 1]) > 0.7][:6000]
    fitted = Partition.fit(X, bowl(X)[:, None])
    Q = 0.97 * scattered(2000, 1)
    assert rmse(fitted, bowl, Q[np.hypot(Q[:, 0] - 0.3, Q[:, 1]) > 0.75]) < 1e-4


def test_a_lake_is_known_to_be_flat_and_says_nothing_of_the_hills() -> None:
    def hills(X: FloatArray) -> FloatArray:
        return np.asarray(np.maximum(372.4, 376 + 8 * np.sin(X[:, 0] / 300) * np.cos(X[:, 1] / 260)))

    rng = np.random.default_rng(0)
    X, Q = rng.uniform(0, 1000, (12_000, 2)), rng.uniform(0, 1000, (3000, 2))
    assert 0.2 < np.mean(hills(X) == 372.4) < 0.5
    mean, deviation = RBFNetwork().fit(X, hills(X)).predict(Q, return_std=True)
    assert deviation.max() < 1
    assert np.quantile(deviation, 0.05) < 1e-6
    shore = deviation > 1e-6
    assert np.mean(np.abs(mean - hills(Q))[shore] <= 1.96 * deviation[shore] + 1e-9) >= 0.9


def test_every_place_of_a_hole_is_covered() -> None:
    X = scattered(6000)
    X = X[np.hypot(X[:, 0] - 0.3, X[:, 1]) > 0.8]
    fitted = Partition.fit(X, sine(X)[:, None])
    grid = fitted.predict_grid(np.linspace(-2, 2, 120), np.linspace(-2, 2, 110))
    assert np.all(np.isfinite(grid))
    nodes = np.stack(np.meshgrid(np.linspace(-2, 2, 120), np.linspace(-2, 2, 110)), axis=-1).reshape(-1, 2)
    error = np.abs(grid.ravel() - sine(nodes))
    hole = np.hypot(nodes[:, 0] - 0.3, nodes[:, 1]) < 0.75
    assert error[hole].max() < 0.6
    assert np.sqrt(np.mean(error[~hole] ** 2)) < 1e-3
    deviation = fitted.predict_std(nodes)[:, 0]
    assert np.median(deviation[hole]) > 10 * np.median(deviation[~hole])


def test_density_may_vary_a_thousandfold() -> None:
    rng = np.random.default_rng(0)
    X = np.concatenate([scattered(2000), 0.5 + 0.02 * rng.normal(size=(4000, 2)), [[0.5, 0.5 + 1e-9]]])
    fitted = Partition.fit(X, rough(X)[:, None])
    assert np.diff(fitted.starts).max() < 700
    assert rmse(fitted, rough, 0.95 * scattered(1000, 1)) < 0.05 * np.ptp(rough(X))
    assert rmse(fitted, rough, 0.5 + 0.02 * rng.normal(size=(500, 2))) < 1e-3 * np.ptp(rough(X))


def test_tracks_and_lines() -> None:
    rng = np.random.default_rng(0)
    t = rng.uniform(-2, 2, 3000)
    tracks = np.stack([t, np.round(rng.uniform(-2, 2, 3000))], axis=1)
    Q = 0.95 * scattered(300, 1)
    assert rmse(Partition.fit(tracks, sine(tracks)[:, None]), sine, Q) < 0.7
    assert rmse(Partition.fit(tracks, sine(tracks)[:, None]), sine, tracks[:200]) < 1e-3
    line = np.stack([t, 0.5 * t], axis=1)
    assert rmse(Partition.fit(line, sine(line)[:, None]), sine, 0.9 * line[:300]) < 1e-3
    flat = np.stack([t, np.zeros_like(t)], axis=1)
    assert rmse(Partition.fit(flat, sine(flat)[:, None]), sine, 0.9 * flat[:300]) < 1e-3


def test_repeated_positions_are_one_centre_of_more_weight() -> None:
    X = scattered(1500)
    y = sine(X) + np.random.default_rng(0).normal(0, 0.1, 1500)
    doubled = Partition.fit(np.concatenate([X, X]), np.concatenate([y, y + 0.2])[:, None], smoothing=0.01)
    weighted = Partition.fit(X, (y + 0.1)[:, None], smoothing=0.01, weights=np.full(1500, 2.0))
    Q = scattered(200, 4)
    np.testing.assert_allclose(np.sort(doubled.weights), np.full(1500, 2.0))
    np.testing.assert_allclose(doubled.predict(Q), weighted.predict(Q), atol=0.1)


@pytest.mark.parametrize(("scale", "shift"), [(1e9, 0.0), (1e-9, 0.0), (1.0, 1e6)])
def test_units_and_origin_do_not_matter(scale: float, shift: float) -> None:
    X, Q = scattered(2000), scattered(300, 2)
    plain = Partition.fit(X, rough(X)[:, None], smoothing=1e-4).predict(Q)
    moved = Partition.fit(X * scale + shift, 7 * rough(X)[:, None] * scale + shift, smoothing=1e-4)
    found = (moved.predict(Q * scale + shift) - shift) / scale / 7
    np.testing.assert_allclose(found, plain, atol=1e-4)


def test_outputs_are_fitted_side_by_side() -> None:
    X, Q = scattered(1500), scattered(100, 2)
    both = Partition.fit(X, np.stack([sine(X), rough(X)], axis=1), smoothing=1e-6, spread=0.3)
    one = Partition.fit(X, rough(X)[:, None], smoothing=1e-6, spread=0.3)
    np.testing.assert_allclose(both.predict(Q)[:, 1:], one.predict(Q), atol=1e-6)
    x = np.linspace(-1, 1, 20)
    np.testing.assert_allclose(both.predict_grid(x, x)[:, :, 1:], one.predict_grid(x, x), atol=1e-6)
    np.testing.assert_allclose(both.predict_gradient(Q)[:, 1:], one.predict_gradient(Q), atol=1e-4)
    assert both.predict_std(Q).shape == (100, 2)


def test_settings_change_the_outcome(surface: Partition) -> None:
    X = scattered(4000)
    Q = scattered(50, 2)
    plain = surface.predict(Q)
    for fitted in (
        Partition.fit(X, rough(X)[:, None], spread=0.05),
        Partition.fit(X, rough(X)[:, None], smoothing=0.5),
        Partition.fit(X, rough(X)[:, None], weights=np.linspace(0.001, 1, 4000), smoothing=0.1),
    ):
        assert np.abs(fitted.predict(Q) - plain).max() > 1e-4
    assert Partition.fit(X, rough(X)[:, None], spread=0.05).spreads == pytest.approx(0.05)


def test_the_same_points_give_the_same_surface(surface: Partition) -> None:
    X = scattered(4000)
    again = Partition.fit(X, rough(X)[:, None])
    np.testing.assert_array_equal(again.coefficients, surface.coefficients)


def test_state_is_kept(surface: Partition) -> None:
    copy = Partition.from_state({name: np.array(value) for name, value in surface.to_state().items()})
    Q = scattered(100, 8)
    np.testing.assert_array_equal(copy.predict(Q), surface.predict(Q))
    np.testing.assert_array_equal(copy.predict_std(Q), surface.predict_std(Q))
    assert all(value.dtype != object for value in surface.to_state().values())


def test_centres_are_the_points(surface: Partition) -> None:
    X = scattered(4000)
    found = surface.centers
    np.testing.assert_allclose(found[np.lexsort(found.T)], X[np.lexsort(X.T)], atol=1e-12)
    assert surface.spreads.shape == (len(surface), len(surface.kernel.spreads))


def test_what_cannot_be_fitted_is_refused() -> None:
    X = scattered(3000)
    with pytest.raises(TrainingError, match="MiB"):
        Partition.fit(X, rough(X)[:, None], memory=1 << 20)
    with pytest.raises(TrainingError, match="one place"):
        Partition.fit(np.ones((100, 2)), np.ones((100, 1)))


def test_progress_is_told_and_may_cancel() -> None:
    X = scattered(2000)
    stages: list[str] = []
    Partition.fit(X, rough(X)[:, None], tick=lambda stage, _: stages.append(stage))
    assert list(dict.fromkeys(stages)) == ["cells", "selection", "solve"]

    def stop(stage: str, _: float) -> None:
        if stage == "solve":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Partition.fit(X, rough(X)[:, None], tick=stop)


@pytest.mark.parametrize("n", [2, 3, 10, 60])
def test_few_points_are_enough(n: int) -> None:
    X = scattered(n)
    fitted = Partition.fit(X, sine(X)[:, None], smoothing=1e-9)
    assert len(fitted) == 1
    # What lambda leaves at the points is lambda c, and lambda |c|^2 is at most the quadratic form of the values.
    left = np.linalg.norm(fitted.predict(X)[:, 0] - sine(X))
    assert left <= 1.01 * np.sqrt(1e-9 * (n - 1)) * fitted.amplitude[0, 0]


@pytest.mark.parametrize("scale", [1.0, 0.7, 1e-3, 3e5])
def test_lattices_of_any_side_have_cells(scale: float) -> None:
    for side in range(66, 175, 6):
        axis = scale * np.arange(side)
        frame = frame_for(np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2))
        assert np.all(frame.start >= 0)
        assert np.all(frame.cells >= 1)


def test_points_of_a_patch_are_those_in_its_square() -> None:
    rng = np.random.default_rng(4)
    # So dense at one side that balancing makes cells outside of the box.
    X = np.concatenate([rng.uniform(0, 1, (1500, 2)), np.column_stack([1e-3 * rng.random(1000), rng.random(1000)])])
    X *= (1.0, 0.7)
    frame = frame_for(X)
    order = np.argsort(frame.codes(X))
    u, codes = frame.scaled(X[order]), frame.codes(X[order])
    cover = Cover.over(frame, codes)
    patches = np.arange(len(cover))
    for margins in ((0.3, 0.5), (0.15, None)):
        low, high = cover.squares(patches, *margins)
        assert np.all(low <= high)
        position, row = cover.members(patches, u, cover.runs(codes), low, high)
        inside = np.all((u >= low[:, None]) & (u <= high[:, None]), axis=2)
        assert len(np.unique(position * len(u) + row)) == len(row)
        broad = (high > low).all(axis=1)
        np.testing.assert_array_equal(np.bincount(position, minlength=len(patches))[broad], inside.sum(axis=1)[broad])
    assert Partition.fit(X, X[:, :1]).predict(X) == pytest.approx(X[:, :1], abs=1e-5)


def test_a_patch_that_needs_more_smoothing_has_it_alone() -> None:
    X = np.random.default_rng(0).uniform(0, 1, (5000, 2)) ** 6 * 2 - 1
    fitted = Partition.fit(X, sine(X)[:, None])
    raised = np.mean(fitted.smoothing > fitted.smoothing.min())
    assert 0 < raised < 0.1
    assert rmse(fitted, sine, X) < 1e-5


def test_the_band_of_points_on_tracks_is_narrow() -> None:
    rng = np.random.default_rng(5)
    X = np.column_stack([rng.uniform(-1, 1, 6000), rng.integers(0, 6, 6000) / 3 - 1])
    fitted = Partition.fit(X, sine(X)[:, None])
    assert fitted.calibration.factor < 10
    assert np.median(fitted.predict_std(X[::10] + np.array([1e-4, 0.0]))) < 1e-6


def test_many_outputs_are_as_one_by_one() -> None:
    X = scattered(600)
    y = np.column_stack([sine(X + shift / 50) for shift in range(40)])
    together = Partition.fit(X, y, spread=0.5, smoothing=1e-6).predict(X)
    alone = Partition.fit(X, y[:, 7:8], spread=0.5, smoothing=1e-6).predict(X)
    np.testing.assert_allclose(together[:, 7], alone[:, 0], atol=1e-9)


def test_a_constant_stays_constant() -> None:
    X = scattered(1000)
    np.testing.assert_allclose(Partition.fit(X, np.full((1000, 1), 3.5)).predict(1.2 * X), 3.5)


@pytest.mark.parametrize("kernel", [Kernel.single(1.3), Kernel.mixture(np.array([8.0, 4.0, 2.0, 0.7]), np.ones(4))])
def test_batched_matrices_and_solutions(kernel: Kernel) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-4, 4, (3, 50, 2))
    points[1, 40:] = local.FAR * (1 + np.arange(10))[:, None]
    diagonal = rng.uniform(0.1, 0.2, (3, 50))
    real = np.ones((3, 50), dtype=bool)
    real[1, 40:] = False
    y = rng.normal(size=(3, 2, 50)) * real[:, None]
    solved = local.solve(points, diagonal, real, y, Levels(kernel))
    assert solved is not None
    for p in range(3):
        k = 40 if p == 1 else 50
        saddle = np.block([[kernel.gram(points[p, :k]) + np.diag(diagonal[p, :k]), np.ones((k, 1))], [np.ones(k), 0]])
        expected = np.linalg.solve(saddle, np.append(y[p, :, :k], np.zeros((2, 1)), axis=1).T).T
        np.testing.assert_allclose(solved.coefficients[p, :, :k], expected[:, :-1], atol=1e-9)
        np.testing.assert_allclose(solved.bias[p], expected[:, -1], atol=1e-9)
        np.testing.assert_allclose(solved.quadratic[p], np.sum(expected[:, :-1] * y[p, :, :k], axis=1), atol=1e-8)
        assert not solved.coefficients[p, :, k:].any()
    assert local.solve(points, -2 * np.ones((3, 50)), real, y, Levels(kernel)) is None


def test_rectangles_are_the_kernel_at_their_nodes() -> None:
    rng = np.random.default_rng(1)
    kernel = Kernel.mixture(np.array([8.0, 4.0, 2.0, 0.7]), np.array([1.0, 0.5, 0.3, 0.1]))
    points, across, up = rng.uniform(-4, 4, (3, 20, 2)), rng.uniform(-4, 4, (3, 5)), rng.uniform(-4, 4, (3, 7))
    coefficients = rng.normal(size=(3, 20, 2))
    values = local.rectangles(points, across, up, coefficients, Levels(kernel))
    for p in range(3):
        nodes = np.stack(np.meshgrid(across[p], up[p]), axis=-1).reshape(-1, 2)
        expected = kernel.gram(nodes, points[p]) @ coefficients[p]
        np.testing.assert_allclose(values[:, p].reshape(2, -1).T, expected, atol=1e-12)


def waves(X: FloatArray) -> FloatArray:
    return np.asarray(np.sin(6 * X[:, 0]) + np.cos(5 * X[:, 1]))


def test_noisy_points_that_no_smoothing_can_interpolate_are_smoothed_and_a_note_says_so() -> None:
    rng = np.random.default_rng(0)
    X, Q = rng.random((4500, 2)), rng.random((1000, 2))
    with pytest.warns(NetworkWarning, match="rounding keeps it off the points"):
        network = RBFNetwork(smoothing=0).fit(X, waves(X) + 0.05 * rng.normal(size=4500))
    assert len(network.notes_) == 1
    assert np.sqrt(np.mean((network.predict(Q) - waves(Q)) ** 2)) < 0.03


def test_clean_points_are_interpolated_without_smoothing() -> None:
    X = np.random.default_rng(0).random((4500, 2))
    network = RBFNetwork(smoothing=0).fit(X, waves(X))
    assert not network.notes_
    np.testing.assert_allclose(network.predict(X), waves(X), atol=1e-5)


@pytest.mark.parametrize("extent", [0.3, 1.0])
def test_gaps_between_clusters_stay_near_the_values(extent: float) -> None:
    rng = np.random.default_rng(1)
    middles = 100 * rng.random((5, 2))
    X = (middles[:, None] + extent * rng.normal(size=(5, 1000, 2))).reshape(-1, 2)
    z = sine(X)
    surface = Partition.fit(X, z[:, None])
    assert np.max(np.abs(surface.predict(100 * rng.random((2000, 2))))) < 4 * np.max(np.abs(z))
    np.testing.assert_allclose(surface.predict(X)[:, 0], z, atol=1e-5)
