"""Noisy points of a smooth surface: merged, and fitted by one network; others: left to their patches."""

from __future__ import annotations

from collections.abc import Callable
from typing import NoReturn

import numpy as np
import pytest

from common.network import RBFNetwork
from common.network.coarsening import Bins, coarsened
from common.network.estimator import merge_repeated
from common.network.fitting import Wanted, train
from common.network.partition import Partition
from common.network.selection import Samples
from common.surface import FloatArray
from tests.common.network import surfaces
from tests.common.network.surfaces import bowl, scattered, sine

N = 8000


def rough(X: FloatArray) -> FloatArray:
    return surfaces.rough(X, finest=0.1, count=60)


def noisy(values: FloatArray, share: float) -> FloatArray:
    return np.asarray(values + share * values.std() * np.random.default_rng(9).normal(size=values.shape))


def rmse(a: FloatArray, b: FloatArray) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))


X, Q = scattered(N), 0.98 * scattered(2000, 1)


@pytest.fixture(scope="module")
def network() -> RBFNetwork:
    return RBFNetwork().fit(X, noisy(sine(X), 0.05))


@pytest.mark.parametrize(("f", "noise", "won"), [(sine, 0.01, 2.0), (sine, 0.2, 2.0), (bowl, 0.05, 1.5)])
def test_one_network_of_means_is_more_accurate_than_patches(
    f: Callable[[FloatArray], FloatArray], noise: float, won: float
) -> None:
    y = noisy(f(X), noise)
    patches = Partition.fit(X, y[:, None])
    merged = RBFNetwork().fit(X, y)
    assert merged.patches_ == 1
    assert won * rmse(merged.predict(Q), f(Q)) < rmse(patches.predict(Q)[:, 0], f(Q))


@pytest.mark.parametrize(("f", "noise"), [(sine, 0.0), (bowl, 0.0), (rough, 0.0), (rough, 0.1)])
def test_clean_points_and_rough_surfaces_keep_their_patches(
    f: Callable[[FloatArray], FloatArray], noise: float
) -> None:
    y = noisy(f(X), noise)
    samples = Samples(X, y[:, None], np.ones(N))
    kept = train(samples, Wanted(), lambda _stage, _share: None).network
    assert isinstance(kept, Partition)
    np.testing.assert_array_equal(kept.predict(Q), Partition.fit(X, y[:, None]).predict(Q))


@pytest.mark.parametrize("f", [sine, bowl])
@pytest.mark.parametrize("n", [4100, 5000, N])
def test_clean_points_cost_no_fit(f: Callable[[FloatArray], FloatArray], n: int) -> None:
    samples = Samples(X[:n], f(X[:n])[:, None], np.ones(n))
    patches = Partition.fit(samples.X, samples.y)

    def refused(*_: object) -> NoReturn:
        raise AssertionError

    assert coarsened(patches, samples, refused, refused, refused) is patches


def test_a_detail_in_a_small_part_keeps_the_patches() -> None:
    many = scattered(20_000, 2)
    y = noisy(sine(many), 0.05)
    assert RBFNetwork().fit(many, y).patches_ == 1
    detail = 0.7 * np.exp(-np.square(many - [1.1, -0.7]).sum(axis=1) / 0.08**2)
    assert RBFNetwork().fit(many, y + detail).patches_ > 1


def test_the_band_covers_the_truth() -> None:
    # The error of one smooth network is of a piece: a single cloud says little of how often the band holds.
    shares = []
    for seed in range(6):
        points, rng = scattered(6000, seed), np.random.default_rng(100 + seed)
        mean, deviation = (
            RBFNetwork().fit(points, sine(points) + 0.05 * rng.normal(size=6000)).predict(Q, return_std=True)
        )
        shares.append(np.mean(np.abs(mean - sine(Q)) <= 1.96 * deviation))
    assert 0.9 <= np.mean(shares) <= 0.98


def test_the_same_points_give_the_same_surface(network: RBFNetwork) -> None:
    again = RBFNetwork().fit(X, noisy(sine(X), 0.05))
    np.testing.assert_array_equal(again.predict(Q), network.predict(Q))


def test_learnt_attributes(network: RBFNetwork) -> None:
    assert network.stop_reason_ == "every mean of merged points is a centre"
    assert 300 < len(network.centers_) <= 600
    np.testing.assert_array_equal(network.members_, np.arange(len(network.centers_)))
    assert network.coefficients_.shape[-1] == len(network.centers_)
    copy = RBFNetwork.from_state(network.to_state())
    for before, after in zip(network.predict(Q, return_std=True), copy.predict(Q, return_std=True), strict=True):
        np.testing.assert_array_equal(before, after)


def test_wrong_points_are_named_by_their_rows() -> None:
    y = noisy(sine(X), 0.05)
    y[[17, 4711]] += 9
    spoilt = RBFNetwork().fit(X, y)
    np.testing.assert_array_equal(spoilt.outliers_, [17, 4711])
    assert spoilt.patches_ == 1
    assert rmse(spoilt.predict(Q), sine(Q)) < 0.01


def test_what_is_given_is_kept() -> None:
    y = noisy(sine(X), 0.05)
    assert RBFNetwork(smoothing=0.01).fit(X, y).smoothing_ == 0.01
    assert RBFNetwork(spread=0.3).fit(X, y).patches_ > 1


def test_every_output_must_gain() -> None:
    smooth, detailed = noisy(sine(X), 0.1), rough(X)
    assert RBFNetwork().fit(X, np.stack([smooth, detailed], axis=1)).patches_ > 1
    both = RBFNetwork().fit(X, np.stack([smooth, noisy(bowl(X), 0.1)], axis=1))
    assert both.patches_ == 1
    assert rmse(both.predict(Q)[:, 0], sine(Q)) < 0.02


def test_merging_weighs_points_by_the_samples_behind_them() -> None:
    y = sine(X)[:, None]
    weights = np.random.default_rng(3).integers(1, 4, N)
    merged = Bins.of(Samples(X, y, weights.astype(np.float64)), 100)
    repeated = np.repeat(np.arange(N), weights)
    plain = Bins.of(Samples(X[repeated], y[repeated], np.ones(len(repeated))), 100)
    for name in ("X", "y", "weights"):
        np.testing.assert_allclose(getattr(merged.samples, name), getattr(plain.samples, name), rtol=1e-12)
    np.testing.assert_allclose(merged.offsets, plain.offsets, atol=1e-12)
    np.testing.assert_allclose(merged.scatter, plain.scatter, rtol=1e-9)
    assert merged.samples.weights.sum() == weights.sum()


def test_two_pairs_of_places_have_the_mean_and_covariance_of_what_was_merged() -> None:
    merged = Bins.of(Samples(X[:50], sine(X[:50])[:, None], np.ones(50)), 1)
    places = np.concatenate([merged.samples.X + side * merged.offsets[:, 0] for side in (-1, 1)])
    np.testing.assert_allclose(places.mean(axis=0), X[:50].mean(axis=0))
    np.testing.assert_allclose(np.cov(places.T, bias=True), np.cov(X[:50].T, bias=True))


def test_squares_are_counted_where_there_are_points() -> None:
    line = np.stack([np.linspace(0, 1, 500), np.zeros(500)], axis=1)
    assert len(Bins.of(Samples(line, line[:, :1], np.ones(500)), 50).samples) == 50
    diagonal = np.stack([np.linspace(0, 1, 500)] * 2, axis=1)
    assert 50 <= len(Bins.of(Samples(diagonal, diagonal[:, :1], np.ones(500)), 100).samples) <= 100
    far = np.concatenate([X, [[1e4, -1e5]]])
    assert 300 <= len(Bins.of(Samples(far, far[:, :1], np.ones(len(far))), 600).samples) <= 600


def test_a_point_far_away_and_a_constant_output_do_not_matter(network: RBFNetwork) -> None:
    y = noisy(sine(X), 0.05)
    one = RBFNetwork().fit(np.concatenate([X, [[60.0, 60.0]]]), np.append(y, 0.0))
    two = RBFNetwork().fit(X, np.column_stack([y, np.full(N, 0.1)]))
    assert one.patches_ == two.patches_ == network.patches_ == 1
    error = rmse(network.predict(Q), sine(Q))
    assert rmse(one.predict(Q), sine(Q)) < 1.5 * error
    np.testing.assert_allclose(two.predict(Q)[:, 1], 0.1)
    assert rmse(two.predict(Q)[:, 0], sine(Q)) < 1.2 * error


def test_the_calmer_of_two_outputs_has_a_narrower_band() -> None:
    rng = np.random.default_rng(3)
    y = np.column_stack([sine(X) + 0.1 * rng.normal(size=N), bowl(X) / 2 + 0.03 * rng.normal(size=N)])
    mean, deviation = RBFNetwork().fit(X, y).predict(Q, return_std=True)
    truth = np.column_stack([sine(Q), bowl(Q) / 2])
    errors = np.sqrt(np.mean((mean - truth) ** 2, axis=0))
    assert np.all(np.median(deviation, axis=0) < 2.2 * errors)
    assert np.all(np.mean(np.abs(mean - truth) <= 1.96 * deviation, axis=0) > 0.88)


def test_progress_never_goes_back_and_ends_whole() -> None:
    told: list[tuple[str, float]] = []
    RBFNetwork(callback=lambda stage, share: told.append((stage, share))).fit(X, noisy(sine(X), 0.05))
    merging = [share for stage, share in told if stage == "merging"]
    assert merging == sorted(merging)
    assert told[-1] == ("merging", 1.0)


def test_repeated_positions_weigh_as_much_as_they_are() -> None:
    y = noisy(sine(X), 0.1)
    twice = np.concatenate([X, X]), np.concatenate([y + 0.05, y - 0.05])
    distinct, means, weights, _ = merge_repeated(twice[0], twice[1][:, None])
    np.testing.assert_allclose(means[:, 0], y)
    assert np.all(weights == 2)
    assert rmse(RBFNetwork().fit(*twice).predict(Q), RBFNetwork().fit(distinct, y).predict(Q)) < 0.01
