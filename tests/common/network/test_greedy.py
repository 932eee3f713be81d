from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from common.errors import ParameterError
from common.network import greedy
from common.network.greedy import Gram, select
from common.surface import FloatArray
from tests.common.network.surfaces import bowl, scattered, sine


def gaussian(spread: float) -> Gram:
    return lambda A, B: np.asarray(np.exp(cdist(A, B, "sqeuclidean") * (-0.5 / spread**2)))


def sample(f: Callable[[FloatArray], FloatArray], n: int, seed: int = 0) -> tuple[FloatArray, FloatArray]:
    X = scattered(n, seed)
    y = f(X)
    return X, (y - y.mean())[:, None]


@pytest.mark.parametrize("block", [1, 7])
@pytest.mark.parametrize("smoothing", [0.0, 0.05])
@pytest.mark.parametrize("weighted", [False, True])
def test_with_every_point_a_centre_it_is_the_dense_solution(block: int, smoothing: float, weighted: bool) -> None:
    rng = np.random.default_rng(1)
    X, y = rng.uniform(-2, 2, (200, 2)), rng.normal(size=(200, 2))
    weights = np.arange(1.0, 201.0) if weighted else np.ones(200)
    gram = gaussian(0.1)
    chosen = select(X, y, gram, smoothing=smoothing, weights=weights, block=block)
    dense = np.linalg.solve(gram(X, X) + smoothing * np.diag(1 / weights), y)
    assert chosen.stop_reason == "every point is a centre"
    assert sorted(chosen.indices) == list(range(200))
    np.testing.assert_allclose(chosen.coefficients, dense[chosen.indices], atol=1e-8 * np.abs(dense).max())


@pytest.mark.parametrize("smoothing", [0.0, 1e-2])
def test_coefficients_are_the_regularised_fit_of_all_points(smoothing: float) -> None:
    X, y = sample(sine, 400)
    y = y + np.random.default_rng(2).normal(0, 0.1, y.shape)
    gram = gaussian(0.5)
    chosen = select(X, y, gram, smoothing=smoothing, max_centers=40)
    centers = X[chosen.indices]
    K, Kcc = gram(X, centers), gram(centers, centers)
    root = np.linalg.cholesky(Kcc + 1e-14 * np.eye(40)).T
    stacked = np.vstack([K, np.sqrt(smoothing) * root])
    expected = K @ np.linalg.lstsq(stacked, np.vstack([y, np.zeros((40, 1))]), rcond=None)[0]
    np.testing.assert_allclose(K @ chosen.coefficients, expected, atol=1e-6)
    assert chosen.stop_reason == "max_centers"


@pytest.mark.parametrize(
    ("f", "spread", "relative", "most"),
    [(sine, 1.2, 1e-2, 36), (sine, 1.2, 1e-3, 63), (bowl, 0.6, 1e-2, 60), (bowl, 0.6, 1e-3, 125)],
)
def test_few_centres_are_enough(
    f: Callable[[FloatArray], FloatArray], spread: float, relative: float, most: int
) -> None:
    counts = []
    for seed in range(5):
        X, y = sample(f, 2000, seed)
        tolerance = relative * float(np.ptp(y))
        chosen = select(X, y, gaussian(spread), tolerance=tolerance)
        error = np.abs(y - gaussian(spread)(X, X[chosen.indices]) @ chosen.coefficients).max()
        assert chosen.stop_reason == "tolerance"
        assert error <= tolerance * (1 + 1e-6)
        assert chosen.history[-1] == pytest.approx(error, rel=1e-3)
        counts.append(len(chosen.indices))
    assert np.median(counts) <= most


@pytest.mark.parametrize("block", [1, 8])
def test_stops_at_the_rounding_floor_and_picks_no_centre_twice(block: int) -> None:
    X, y = sample(bowl, 500)
    chosen = select(X, y, gaussian(3.0), block=block)
    assert chosen.stop_reason == "rounding"
    assert len(set(chosen.indices)) == len(chosen.indices) < 500
    assert np.all(np.isfinite(chosen.coefficients))
    assert chosen.history[-1] < 0.2 * chosen.history[0]


def test_starts_from_the_initial_rows() -> None:
    X, y = sample(sine, 100)
    first = np.array([5, 17, 3])
    chosen = select(X, y, gaussian(0.8), initial=first, max_centers=10)
    np.testing.assert_array_equal(chosen.indices[:3], first)
    assert len(chosen.history) == 1 + 1 + 7


def test_blocks_take_fewer_rounds() -> None:
    X, y = sample(sine, 500)
    single = select(X, y, gaussian(0.8), max_centers=40, block=1)
    blocks = select(X, y, gaussian(0.8), max_centers=40, block=10)
    assert (len(single.history), len(blocks.history)) == (41, 5)
    assert blocks.history[-1] < 0.05 * blocks.history[0]


def test_nothing_to_explain_needs_no_centre() -> None:
    X, _ = sample(sine, 20)
    chosen = select(X, np.zeros((20, 1)), gaussian(1.0))
    assert chosen.stop_reason == "tolerance"
    assert len(chosen.indices) == 0
    assert chosen.coefficients.shape == (0, 1)


def test_memory_is_checked_before_it_is_taken() -> None:
    X, y = sample(sine, 1000)
    with pytest.raises(ParameterError, match="MiB"):
        select(X, y, gaussian(0.1), max_centers=900, memory=1 << 20)
    assert select(X, y, gaussian(0.1), memory=1 << 20).stop_reason == "memory"


@pytest.mark.parametrize("initial", [[1, 1], [-1], [100]])
def test_impossible_initial_rows_are_refused(initial: list[int]) -> None:
    X, y = sample(sine, 100)
    with pytest.raises(ParameterError, match="initial"):
        select(X, y, gaussian(0.5), initial=np.array(initial))


def test_progress_is_told_after_every_round() -> None:
    X, y = sample(sine, 300)
    fractions: list[float] = []
    select(X, y, gaussian(0.8), max_centers=12, block=4, tick=fractions.append)
    assert fractions == [4 / 12, 8 / 12, 1.0]


def test_gain_needs_no_more_centres_than_the_largest_error_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = []
    for shortlist in (1, greedy.SHORTLIST):
        monkeypatch.setattr(greedy, "SHORTLIST", shortlist)
        total = 0
        for seed in range(3):
            X, y = sample(bowl, 1000, seed)
            total += len(select(X, y, gaussian(0.6), tolerance=1e-2 * float(np.ptp(y))).indices)
        counts.append(total)
    assert counts[1] < counts[0]
