"""The short search where there are more points than are averaged over every candidate."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator
from threadpoolctl import threadpool_limits

from common.network import RBFNetwork, search, threads
from common.network.kernel import ladder_spreads, mean_spacing
from common.network.selection import SMOOTHINGS, Candidate, Kind, Samples, Scored, average, families, rounding_floor
from common.surface import FloatArray


def samples(n: int, noise: float) -> Samples:
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (n, 2))
    y = np.sin(4 * X[:, :1]) + np.sin(4 * X[:, 1:]) + noise * rng.normal(size=(n, 1))
    return Samples(X, y, np.ones(n))


@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_a_handful_of_candidates_finds_the_family_and_the_noise(noise: float) -> None:
    given = samples(400, noise)
    spreads = ladder_spreads(mean_spacing(given.X), 4.0)
    smoothings = SMOOTHINGS[rounding_floor(400) <= SMOOTHINGS]
    found = search.fit(given, families(spreads, 2.0), spreads, smoothings, lambda _share: None)
    assert len(found.scored.candidates) == len(set(found.scored.candidates)) <= search.TRIALS
    assert all(candidate.smoothing >= 0.999 * rounding_floor(400) for candidate in found.scored.candidates)
    assert found.scored.best.kind.family == "single"
    if noise:
        assert noise**2 / 2 < found.smoothing * found.variance < 2 * noise**2


def test_of_clean_points_hardly_any_candidate_is_smoothed() -> None:
    given, floor = samples(400, 0.0), rounding_floor(400)
    spreads = ladder_spreads(mean_spacing(given.X), 4.0)
    found = search.fit(given, families(spreads, 2.0), spreads, SMOOTHINGS, lambda _share: None)
    tried = [
        candidate for candidate in found.scored.candidates if candidate.kind.family == found.scored.best.kind.family
    ]
    assert len(tried) > 3
    assert sum(candidate.smoothing > 1.001 * floor for candidate in tried) == 1


def test_a_rough_kernel_has_its_chance_where_many_more_points_are_to_come() -> None:
    """What few points take for smooth and noisy is rough and clean to many."""
    rng = np.random.default_rng(3)
    waves = rng.normal(size=(80, 2))
    waves *= (2 * np.pi / np.geomspace(4, 0.15, 80) / np.linalg.norm(waves, axis=1))[:, None]
    X = rng.uniform(-1, 1, (1600, 2))
    heights = np.sin(X @ waves.T + rng.uniform(0, 6, 80)) / np.linalg.norm(waves, axis=1) ** 1.5
    given = Samples(X, heights.sum(axis=1)[:, None] / heights.sum(axis=1).std(), np.ones(1600))
    spreads = ladder_spreads(mean_spacing(X), 4.0)
    told: list[float] = []
    found = search.fit(given, families(spreads, 2.0), spreads, SMOOTHINGS[2:], told.append)
    assert "ladder" in {candidate.kind.family for candidate in found.scored.candidates}
    assert len(found.scored.candidates) == search.FINALISTS
    assert told == sorted(told)


def test_finalists_come_from_two_families_unless_one_is_far_behind() -> None:
    smooth, rough = Kind("single", 0.5), Kind("ladder", 1.0)
    candidates = [Candidate(smooth, 1e-3), Candidate(smooth, 1e-2), Candidate(rough, 1e-9), Candidate(rough, 1e-4)]
    for behind, second in ((5.0, 2), (2 * search.FAR_BEHIND, 1)):
        scored = Scored(candidates, np.array([0.0, 1.0, behind, behind + 1.0]), np.ones(4), np.ones(4))
        kinds = [candidate.kind for candidate in search._finalists(scored)]
        assert kinds == [smooth, candidates[second].kind]


def test_what_is_given_stays() -> None:
    given = samples(400, 0.1)
    found = search.fit(given, [Kind("single", 0.5)], np.array([0.5]), SMOOTHINGS[:20], lambda _share: None)
    assert {round(candidate.kind.parameter, 6) for candidate in found.scored.candidates} == {0.5}
    found = search.fit(given, [Kind("single", 0.5)], np.array([0.5]), np.array([1e-3]), lambda _share: None)
    assert [candidate.smoothing for candidate in found.scored.candidates] == pytest.approx([1e-3])


@pytest.mark.parametrize("noise", [0.02, 0.1, 0.4])
def test_a_handful_of_candidates_comes_near_the_best_of_all(noise: float) -> None:
    given = samples(400, noise)
    spreads = ladder_spreads(mean_spacing(given.X), 4.0)
    found = search.fit(given, families(spreads, 2.0), spreads, SMOOTHINGS[2:], lambda _share: None)
    lattice = [Kind("single", spread) for spread in np.geomspace(0.2, 1.4, 12).tolist()]
    best = average(given, lattice, spreads, SMOOTHINGS[2:], lambda _share: None).scored.scores.min()
    assert found.scored.scores.min() < best + 4.0


@pytest.mark.parametrize("n", [60, 300])
def test_the_same_bits_whatever_the_threads(n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    given = samples(n, 0.05)
    grids = []
    for count in (1, 2, 3):
        monkeypatch.setattr(threads, "cores", lambda count=count: count)
        with threadpool_limits(count):
            grids.append(RBFNetwork().fit(given.X, given.y[:, 0]).coefficients_)
    np.testing.assert_array_equal(grids[0], grids[1])
    np.testing.assert_array_equal(grids[0], grids[2])


@pytest.mark.parametrize(("n", "seed", "accepted"), [(240, 1, 3.0), (1500, 0, 1.5)])
def test_a_ridge_that_few_points_see_is_not_forgiven(n: int, seed: int, accepted: float) -> None:
    """Four points of five lie on a plane, which a wide Gaussian foretells to the last digit."""
    rng = np.random.default_rng(seed)
    X = rng.random((20 * n, 2))
    X = X[rng.random(len(X)) < np.exp(-6 * X[:, 0])][:n]
    Q = rng.random((1000, 2))

    def ridge(places: FloatArray) -> FloatArray:
        return np.abs(places[:, 0] - 0.5 - 0.3 * (places[:, 1] - 0.5))

    ours = np.sqrt(np.mean((RBFNetwork().fit(X, ridge(X)).predict(Q) - ridge(Q)) ** 2))
    theirs = np.sqrt(np.mean((RBFInterpolator(X, ridge(X))(Q) - ridge(Q)) ** 2))
    assert ours < accepted * theirs


@pytest.mark.parametrize("seed", [1, 3])
def test_what_most_points_know_to_the_last_digit_is_no_excuse_where_few_are(seed: int) -> None:
    """Ever fewer points across a ridge: what most of them believe in is 2 and 5 times as far off."""
    rng, X = np.random.default_rng(seed), np.empty((0, 2))
    while len(X) < 400:
        tried = rng.random((1600, 2))
        X = np.vstack([X, tried[rng.random(1600) < np.exp(-6 * tried[:, 0])]])[:400]
    Q = rng.random((2000, 2))
    y, z = (np.abs(places[:, 0] - 0.5 - 0.3 * (places[:, 1] - 0.5)) for places in (X, Q))
    ours, theirs = (model(Q) - z for model in (RBFNetwork().fit(X, y).predict, RBFInterpolator(X, y)))
    assert np.mean(ours**2) < np.mean(theirs**2)
