"""Feature extraction: the paper's counts, the definition by brute force, invariance, and clouds that are no surface."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from common.errors import ParameterError, PointsError
from common.surface import FloatArray, Region
from sender.features import extract_features, merge_repeated, piece_of
from sender.surfaces import SURFACES

LATTICE = np.array([[i, j, (7 * i + 3 * j) % 5] for i in range(6) for j in range(6)], dtype=float)


@pytest.mark.parametrize(
    ("name", "points", "features"),
    [("surface-1", 200, 50), ("surface-2", 200, 32), ("surface-3", 600, 32)],
)
@pytest.mark.parametrize("seed", range(5))
def test_the_counts_are_the_papers(name: str, points: int, features: int, seed: int) -> None:
    surface = SURFACES[name]
    cloud = surface.sample(np.random.default_rng(seed))
    assert len(cloud) == points
    assert len(extract_features(cloud, gap=surface.gap, region=surface.region)) == features


@given(
    hnp.arrays(np.float64, st.tuples(st.integers(3, 40), st.just(3)), elements=st.integers(0, 12)),
    st.sampled_from([1.0, 2.5, 4.0, 12.0]),
)
def test_every_piece_gives_its_least_and_its_greatest(cloud: FloatArray, gap: float) -> None:
    region = Region(0.0, 12.0, 0.0, 12.0)
    try:
        features = extract_features(cloud, gap=gap, region=region, repeated="mean")
    except PointsError as error:
        assert "one line" in str(error) or "one place" in str(error)  # noqa: PT017 - most clouds are surfaces
        return
    merged = merge_repeated(cloud, "mean")
    piece, kept = piece_of(merged, region, gap), piece_of(features.points, region, gap)
    assert set(kept) == set(piece)
    for index in set(piece):
        z, chosen = merged[piece == index, 2], features.points[kept == index, 2]
        assert chosen.min() == z.min()
        assert chosen.max() == z.max()
        assert len(chosen) == min(2, len(z))
    assert {tuple(row) for row in features.points} <= {tuple(row) for row in merged}


def test_the_order_of_the_points_does_not_matter() -> None:
    rng = np.random.default_rng(3)
    cloud = SURFACES["surface-3"].sample(rng)
    cloud[:, 2] = np.round(cloud[:, 2])  # many ties
    expected = extract_features(cloud, gap=0.5).points
    for _ in range(5):
        np.testing.assert_array_equal(extract_features(rng.permutation(cloud), gap=0.5).points, expected)


def test_a_cloud_keeps_every_point() -> None:
    features = extract_features(LATTICE, gap=None, kind="cloud")
    np.testing.assert_array_equal(features.points, np.unique(LATTICE, axis=0))
    assert features.gap is None


def test_a_lattice_lies_in_the_middle_of_the_pieces_and_on_a_plane_where_the_points_do() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(0, 6, (400, 2))
    region = Region(0.0, 6.0, 0.0, 4.0)
    xy[:, 1] *= 4 / 6
    features = extract_features(np.column_stack([xy, 2 + xy @ (3.0, -1.0)]), gap=0.5, kind="lattice", region=region)
    assert features.kind == "lattice"
    assert len(features) == 8 * 12
    np.testing.assert_allclose(features.points[:13, 0], [*np.arange(0.25, 6, 0.5), 0.25])
    np.testing.assert_allclose(features.points[:13, 1], [0.25] * 12 + [0.75])
    inner = (abs(features.xy - (3, 2)) < (2.3, 1.3)).all(axis=1)
    np.testing.assert_allclose(features.z[inner], 2 + features.xy[inner] @ (3.0, -1.0), atol=1e-9)


@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        (np.empty((0, 3)), "empty"),
        ([[1.0, 2.0, 3.0]], "at least 3"),
        ([[1.0, 2.0, 3.0]] * 10, "one place"),
        ([[i, 2.0 * i, 5.0 - i] for i in range(10)], "one line"),
        ([[1e6 + i, 2e6 + 2.0 * i, 5.0 - i] for i in range(10)], "one line"),
        (np.where(np.arange(108).reshape(36, 3) == 50, np.nan, LATTICE), "1 of 108 values are NaN"),
        (np.where(np.arange(108).reshape(36, 3) == 50, np.inf, LATTICE), "infinite"),
        (np.vstack([LATTICE, [[2.0, 2.0, 99.0]]]), "1 positions carry more than one height.* x = 2, y = 2.*mean"),
        (LATTICE[:, :2], r"\(n, 3\)"),
    ],
)
def test_a_cloud_that_is_no_surface_is_refused(cloud: FloatArray, message: str) -> None:
    with pytest.raises(PointsError, match=message):
        extract_features(cloud, gap=2.0)


@pytest.mark.parametrize(
    ("gap", "message"),
    [
        (100.0, "larger than the region"),
        (0.001, "at most"),
        (0.05, r"nearly all of them empty; choose about 1\.2, or at least 0\.083"),
    ],
)
def test_a_gap_that_does_not_fit_is_refused(gap: float | None, message: str) -> None:
    with pytest.raises(ParameterError, match=message):
        extract_features(LATTICE, gap=gap)


@pytest.mark.parametrize(("n", "longer"), [(3, 1.0), (10, 1.0), (11, 1.0), (200, 1e6), (3, 1e8)])
def test_without_a_gap_every_cloud_has_one_that_fits(n: int, longer: float) -> None:
    cloud = np.random.default_rng(n).random((n, 3)) * (longer, 1.0, 1.0)
    features = extract_features(np.vstack([cloud, cloud]), gap=None)
    assert len(features) > n / 2


def test_without_a_gap_a_region_has_as_many_pieces_as_usual() -> None:
    cloud = np.random.default_rng(0).random((11, 3)) * (3e3, 1e3, 1.0)
    width, height = np.ptp(cloud[:, :2], axis=0)
    features = extract_features(cloud, gap=None)
    assert features.gap is not None
    assert features.region.pieces(features.gap) == features.region.pieces(np.sqrt(width * height / 1024))


def test_without_a_gap_it_is_short_on_the_line() -> None:
    # sqrt(area / 1024) is 13.860048730350805, which takes 9 bytes of every packet.
    rows, columns = np.mgrid[:77, :105] * 4.988744589
    features = extract_features(np.column_stack([columns.ravel(), rows.ravel(), rows.ravel() % 7]), gap=None)
    assert features.gap == 14.0


def test_points_outside_of_the_region_are_refused() -> None:
    with pytest.raises(PointsError, match="outside of the region"):
        extract_features(LATTICE, gap=1.0, region=Region(0.0, 4.0, 0.0, 9.0))


@pytest.mark.parametrize(("how", "height"), [("mean", 3.0), ("min", 1.0), ("max", 6.0)])
def test_repeated_positions_are_merged_as_asked(how: str, height: float) -> None:
    cloud = [[0, 0, 1], [0, 0, 2], [0, 0, 6], [1, 0, 4], [0, 1, 5], [0, 1, 5]]
    merged = merge_repeated(cloud, how)  # type: ignore[arg-type]
    np.testing.assert_array_equal(merged, [[0, 0, height], [0, 1, 5], [1, 0, 4]])
