"""The points of every patch: those of its square and, where it has too few, the nearest ones wherever they are."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from scipy.spatial import KDTree

from common.network.cover import NINE, Cover
from common.network.threads import parallel
from common.surface import FloatArray, IntArray

Tick: TypeAlias = Callable[[str, float], None]

FIT_MARGIN = 0.3
"""How far the points of a patch reach beyond its cell, in sides of the cell; at most as far as the touching cells."""

RIM_MARGIN = 0.5
"""How far they reach away from the rim of the data, where there is nothing on the other side."""

FEWEST = 3
"""Points in a quarter of a patch below which it borrows."""

BORROWED = 12
"""Points borrowed at each of nine places of a patch."""


def points_of(cover: Cover, u: FloatArray, runs: IntArray, tick: Tick) -> tuple[IntArray, IntArray, FloatArray]:
    """Of every patch: where its points begin (patches + 1,), their rows, and the mean spacing of each patch."""

    def gather(patches: IntArray) -> tuple[IntArray, IntArray, IntArray, FloatArray]:
        low, high = cover.squares(patches, FIT_MARGIN, RIM_MARGIN)
        position, row = cover.members(patches, u, runs, low, high)
        middle = (low + high) / 2
        quarter = (u[row, 0] > middle[position, 0]) + 2 * (u[row, 1] > middle[position, 1])
        counts = np.bincount(4 * position + quarter, minlength=4 * len(patches)).reshape(-1, 4)
        total = counts.sum(axis=1)
        spacing = np.sqrt(np.prod(high - low, axis=1) / np.maximum(total, 1))
        poor = np.flatnonzero(counts.min(axis=1) < FEWEST)
        return total, row.astype(np.int32), patches[poor], spacing

    groups = list(cover.groups())
    found = parallel(gather, groups, tick=lambda fraction: tick("cells", fraction))
    counts = np.concatenate([part[0] for part in found])
    members = np.concatenate([part[1] for part in found])
    poor = np.concatenate([part[2] for part in found])
    spacings = np.concatenate([part[3] for part in found])
    starts = np.append(0, np.cumsum(counts))
    if len(poor):
        starts, members = _with_borrowed(cover, u, starts, members, poor, spacings)
    return starts, members, spacings


def _with_borrowed(
    cover: Cover, u: FloatArray, starts: IntArray, members: IntArray, poor: IntArray, spacings: FloatArray
) -> tuple[IntArray, IntArray]:
    """Add to each of the `poor` patches the points nearest to nine places of its square; mends their spacings."""
    nearest = KDTree(u, balanced_tree=False, compact_nodes=False)
    low, high = cover.squares(poor, FIT_MARGIN, RIM_MARGIN)
    places = low[:, None] + NINE * (high - low)[:, None]
    _, rows = nearest.query(places.reshape(-1, 2), k=range(1, min(BORROWED, len(u)) + 1))
    borrowed = rows.reshape(len(poor), -1).astype(np.int32)
    runs: list[IntArray] = []
    done = 0
    counts = np.diff(starts)
    for patch, extra in zip(poor, borrowed, strict=True):
        runs.append(members[done : starts[patch]])
        mine = np.union1d(members[starts[patch] : starts[patch + 1]], extra)
        runs.append(mine)
        done = starts[patch + 1]
        counts[patch] = len(mine)
        box = np.ptp(u[mine], axis=0)
        spacings[patch] = max(float(np.sqrt(box[0] * box[1] / len(mine))), float(box.max()) / len(mine))
    runs.append(members[done:])
    return np.append(0, np.cumsum(counts)), np.concatenate(runs)
