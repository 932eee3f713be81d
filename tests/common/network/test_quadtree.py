from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.network import quadtree
from common.surface import IntArray

DEPTH = 12
SHAPE = (3 << 10, 2 << 10)


def codes_of(seed: int, clustered: bool) -> IntArray:
    rng = np.random.default_rng(seed)
    places = rng.integers(0, np.array(SHAPE), (400, 2))
    if clustered:
        places = np.concatenate([places, rng.integers(700, 712, (300, 2))])
    return np.sort(quadtree.interleaved(places))


@given(st.lists(st.tuples(st.integers(0, 2**30 - 1), st.integers(0, 2**30 - 1)), min_size=1))
def test_codes_are_undone(places: list[tuple[int, int]]) -> None:
    array = np.array(places, dtype=np.int64)
    np.testing.assert_array_equal(quadtree.deinterleaved(quadtree.interleaved(array)), array)


@pytest.mark.parametrize("clustered", [False, True])
@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000))
def test_cells_tile_the_region_hold_few_points_and_are_balanced(clustered: bool, seed: int) -> None:
    codes = codes_of(seed, clustered)
    tree = quadtree.build(codes, DEPTH, SHAPE, 10)
    corners, sides = tree.corners, tree.sides
    covered = np.clip(np.array(SHAPE) - corners, 0, sides[:, None]).prod(axis=1).sum()
    assert covered == SHAPE[0] * SHAPE[1]
    counts = np.diff(np.append(np.searchsorted(codes, tree.codes), len(codes)))
    assert counts.sum() == len(codes)
    assert np.all(counts[tree.levels < DEPTH] <= 10)
    neighbours = tree.neighbours()
    steps = np.where(neighbours >= 0, tree.levels[neighbours] - tree.levels[:, None], 0)
    assert np.abs(steps).max() <= 1


def test_neighbours_are_the_cells_that_touch() -> None:
    tree = quadtree.build(codes_of(0, True), DEPTH, SHAPE, 10)
    low, high = tree.corners, tree.corners + tree.sides[:, None]
    for cell, row in enumerate(tree.neighbours()):
        touching = np.flatnonzero(np.all((low <= high[cell]) & (high >= low[cell]), axis=1))
        found = row[row >= 0]
        assert row[0] == cell
        assert sorted(found) == sorted(touching)


def test_a_place_is_found_in_its_cell() -> None:
    tree = quadtree.build(codes_of(1, True), DEPTH, SHAPE, 10)
    places = np.random.default_rng(0).integers(0, np.array(SHAPE), (500, 2))
    cells = tree.find(places)
    inside = places - tree.corners[cells]
    assert np.all((inside >= 0) & (inside < tree.sides[cells, None]))
