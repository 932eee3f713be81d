"""A balanced quadtree over points in the plane: square cells of a few points each, neighbours at most twice as large.

Cells carry Morton codes, so the points of a cell are a run of the sorted points, and the cell of a position is a binary
search. A level of the tree is one array operation; nothing here is a loop over cells or points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from common.surface import BoolArray, IntArray

DEEPEST = 30
"""Levels below the root: two codes of as many bits fit one 64-bit integer."""

RING = 13
"""A cell and the twelve places of half its size around it."""


@dataclass(frozen=True, slots=True, eq=False)
class Quadtree:
    """Cells in Morton order.

    Lengths are in units of the root cell's 2^-depth part; positions in the root are [0, 2^depth).

    Attributes
    ----------
    depth : int
        Level of the finest codes; the root is level 0.
    codes : ndarray of int64, shape (cells,)
        First finest code of each cell, ascending.
    levels : ndarray of int64, shape (cells,)
    shape : tuple of int
        Columns and rows of finest cells that belong to the region; the rest of the root has no cells.
    """

    depth: int
    codes: IntArray
    levels: IntArray
    shape: tuple[int, int]

    def __len__(self) -> int:
        return len(self.codes)

    @property
    def sides(self) -> IntArray:
        """Side of each cell, shape (cells,)."""
        return np.left_shift(np.int64(1), self.depth - self.levels)

    @property
    def corners(self) -> IntArray:
        """Least column and row of each cell, shape (cells, 2)."""
        return deinterleaved(self.codes)

    def find(self, places: IntArray) -> IntArray:
        """Cell that holds each place (column, row), shape (..., 2); the places are inside the region."""
        return np.searchsorted(self.codes, interleaved(places), side="right") - 1

    def neighbours(self) -> IntArray:
        """Every cell that touches a cell, and itself first, shape (cells, RING); -1 where there are fewer."""
        ring = np.array([(i, j) for i in range(-1, 3) for j in range(-1, 3) if not (0 <= i < 2 and 0 <= j < 2)])
        places = self.corners[:, None, :] + ring * self.sides[:, None, None] // 2
        inside = np.all((places >= 0) & (places < np.array(self.shape)), axis=2)
        found = np.full((len(self), RING), -1, dtype=np.int64)
        found[:, 1:] = np.where(inside, self.find(np.where(inside[..., None], places, 0)), -1)
        found[:, 1:].sort(axis=1)
        found[:, 2:][found[:, 2:] == found[:, 1:-1]] = -1
        found[:, 0] = np.arange(len(self))
        return found


def build(codes: IntArray, depth: int, shape: tuple[int, int], most: int) -> Quadtree:
    """Split until no cell holds more than `most` points, then until neighbours differ by one level.

    Parameters
    ----------
    codes : ndarray of int64, shape (n,)
        Finest Morton codes of the points, ascending.
    depth : int
        Levels of the codes, at most `DEEPEST`.
    shape : tuple of int
        Columns and rows of finest cells inside the region.
    most : int
        Points of a cell that is not split; a cell at the finest level is never split.
    """
    inner: list[IntArray] = []
    nodes = np.zeros(1, dtype=np.int64)
    for level in range(depth):
        shift = 2 * (depth - level)
        first = np.searchsorted(codes, nodes << shift)
        last = np.searchsorted(codes, (nodes + 1) << shift)
        full = nodes[last - first > most]
        if not len(full):
            break
        inner.append(full)
        nodes = _children(full)
    for level in range(len(inner) - 1, 0, -1):
        places = deinterleaved(inner[level])
        steps = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)])
        around = (places[:, None, :] + steps).reshape(-1, 2)
        around = around[_inside(around, level, depth, shape)]
        inner[level - 1] = np.union1d(inner[level - 1], interleaved(around) >> 2)
    leaves: list[IntArray] = []
    levels: list[IntArray] = []
    nodes = np.zeros(1, dtype=np.int64)
    for level in range(len(inner) + 1):
        split = np.isin(nodes, inner[level]) if level < len(inner) else np.zeros(len(nodes), dtype=bool)
        leaf = nodes[~split]
        leaf = leaf[_inside(deinterleaved(leaf), level, depth, shape)]
        leaves.append(leaf << 2 * (depth - level))
        levels.append(np.full(len(leaf), level, dtype=np.int64))
        nodes = _children(nodes[split])
    starts = np.concatenate(leaves)
    order = np.argsort(starts)
    return Quadtree(depth, starts[order], np.concatenate(levels)[order], shape)


def _children(nodes: IntArray) -> IntArray:
    return np.asarray(((nodes << 2)[:, None] + np.arange(4)).ravel())


def _inside(places: IntArray, level: int, depth: int, shape: tuple[int, int]) -> BoolArray:
    """Whether cells at these columns and rows of a level touch the region."""
    return np.asarray(np.all((places >= 0) & (places << (depth - level) < np.array(shape)), axis=1))


def interleaved(places: IntArray) -> IntArray:
    """Morton codes of columns and rows, shape (..., 2) -> (...): the column's bits at the even places."""
    return np.asarray(_spread(places[..., 0]) | (_spread(places[..., 1]) << 1))


def deinterleaved(codes: IntArray) -> IntArray:
    """Columns and rows of Morton codes, shape (...) -> (..., 2)."""
    return np.stack([_packed(codes), _packed(codes >> 1)], axis=-1)


_MASKS = (0x00000000FFFFFFFF, 0x0000FFFF0000FFFF, 0x00FF00FF00FF00FF, 0x0F0F0F0F0F0F0F0F, 0x3333333333333333)
_EVEN = 0x5555555555555555


def _spread(values: IntArray) -> IntArray:
    """Each bit of 31 moved to twice its place."""
    spread = values.astype(np.int64)
    for mask, shift in zip((*_MASKS[1:], _EVEN), (16, 8, 4, 2, 1), strict=True):
        spread = (spread | (spread << shift)) & mask
    return spread


def _packed(codes: IntArray) -> IntArray:
    """The inverse of `_spread`."""
    packed = codes & _EVEN
    for mask, shift in zip(reversed(_MASKS), (1, 2, 4, 8, 16), strict=True):
        packed = (packed | (packed >> shift)) & mask
    return np.asarray(packed)
