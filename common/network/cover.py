"""Overlapping square patches over points in the plane: which points and which positions belong to which patch.

The cells of a balanced quadtree hold about `CELL_POINTS` points each. A patch is a cell and a margin around it, at most
half its side, so only cells that touch it have anything in it. Lengths are in *cells*: sides of the square that would
hold `CELL_POINTS` points if their density were even.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from common.network import quadtree
from common.network.quadtree import Quadtree
from common.surface import FloatArray, IntArray

CELL_POINTS = 36
"""Points a cell holds in the mean."""

SPLIT = 65
"""Points of a cell that is not split yet: nearly five deviations above the mean, so even density splits none."""

GROUP = 2048
"""Patches whose points are looked up together."""

NINE: FloatArray = np.array([(i, j) for i in (0.0, 0.5, 1.0) for j in (0.0, 0.5, 1.0)])
"""Places of a square, in its sides."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Where the cells lie.

    Attributes
    ----------
    low : ndarray, shape (2,)
        Lower left corner of the data's box, in the units of the positions.
    side : float
        Side of a cell, in the units of the positions.
    extent : ndarray, shape (2,)
        Width and height of the data's box, in cells.
    """

    low: FloatArray
    side: float
    extent: FloatArray

    @property
    def cells(self) -> IntArray:
        """Columns and rows of cells over the box."""
        return np.maximum(np.ceil(self.extent - 1e-9), 1).astype(np.int64)

    @property
    def start(self) -> FloatArray:
        """Where the data's box begins: what the cells are too wide is shared by both ends."""
        return np.asarray(np.maximum(self.cells - self.extent, 0.0) / 2)

    @property
    def bits(self) -> int:
        """Levels of the tree below a cell of even density."""
        return quadtree.DEEPEST - int(self.cells.max() - 1).bit_length()

    @property
    def shape(self) -> tuple[int, int]:
        """Columns and rows at the finest level."""
        return int(self.cells[0]) << self.bits, int(self.cells[1]) << self.bits

    def scaled(self, X: FloatArray) -> FloatArray:
        """Positions (m, 2) in cells."""
        return np.asarray((X - self.low) / self.side + self.start)

    def clipped(self, u: FloatArray) -> FloatArray:
        """The nearest place inside the data's box."""
        return np.clip(u, self.start, self.start + self.extent)

    def places(self, u: FloatArray) -> IntArray:
        """Finest columns and rows of places inside the data's box."""
        return np.clip((u * 2.0**self.bits).astype(np.int64), 0, np.array(self.shape) - 1)

    def codes(self, X: FloatArray) -> IntArray:
        """Finest Morton codes of positions."""
        return quadtree.interleaved(self.places(self.clipped(self.scaled(X))))


def frame_for(X: FloatArray) -> Frame:
    """Cells of such a side that the typical one that is not empty holds `CELL_POINTS` of the positions (n, 2)."""
    low, box = X.min(axis=0), np.ptp(X, axis=0)
    share = CELL_POINTS / len(X)
    side = max(float(np.sqrt(box[0] * box[1] * share)), float(box.max()) * share)
    frame = Frame(low, side, box / side)
    rows = np.floor(frame.scaled(X)).astype(np.int64)
    cell = rows[:, 0] * (frame.cells[1] + 1) + rows[:, 1]
    typical = float(np.median(np.bincount(cell)[cell]))
    side *= float(np.clip(np.sqrt(CELL_POINTS / typical), 0.25, 1.0))
    return Frame(low, side, box / side)


@dataclass(frozen=True, slots=True, eq=False)
class Cover:
    """Patches over a frame.

    Attributes
    ----------
    frame : Frame
    tree : Quadtree
    centres : ndarray, shape (patches, 2)
        In cells.
    sides : ndarray, shape (patches,)
        Sides of the patches' own cells, in cells.
    touching : ndarray, shape (patches, RING)
        Patches whose cells touch, itself first, -1 where there are fewer.
    """

    frame: Frame
    tree: Quadtree
    centres: FloatArray = field(init=False)
    sides: FloatArray = field(init=False)
    touching: IntArray = field(init=False)

    def __post_init__(self) -> None:
        scale = 2.0**-self.frame.bits
        sides = self.tree.sides * scale
        object.__setattr__(self, "sides", sides)
        object.__setattr__(self, "centres", self.tree.corners * scale + sides[:, None] / 2)
        object.__setattr__(self, "touching", self.tree.neighbours())

    @classmethod
    def over(cls, frame: Frame, codes: IntArray) -> Cover:
        """The cover of the points with these ascending codes."""
        return cls(frame, quadtree.build(codes, quadtree.DEEPEST, frame.shape, SPLIT))

    def __len__(self) -> int:
        return len(self.tree)

    def runs(self, codes: IntArray) -> IntArray:
        """Where the run of each cell begins among ascending codes, and the end of the last, shape (patches + 1,)."""
        return np.append(np.searchsorted(codes, self.tree.codes), len(codes))

    def squares(self, patches: IntArray, margin: float, most: float | None = None) -> tuple[FloatArray, FloatArray]:
        """Lower left and upper right corners, shape (p, 2), of the patches' cells and a margin, in sides of the cell.

        They end with the data's box. With `most`, at most 0.5, the margin is as wide as that opposite of where the box
        cuts off the other.
        """
        start, end = self.frame.start, self.frame.start + self.frame.extent
        centres, sides = self.centres[patches], self.sides[patches, None]
        low, high = centres - (0.5 + margin) * sides, centres + (0.5 + margin) * sides
        if most is not None:
            left, right = low < start, high > end
            low = np.where(right, centres - (0.5 + most) * sides, low)
            high = np.where(left, centres + (0.5 + most) * sides, high)
        # Balancing makes cells that lie outside of the box, too.
        low = np.maximum(low, start)
        return low, np.maximum(low, np.minimum(high, end))

    def members(
        self, patches: IntArray, u: FloatArray, runs: IntArray, low: FloatArray, high: FloatArray
    ) -> tuple[IntArray, IntArray]:
        """Which places lie in which patch.

        Parameters
        ----------
        patches : ndarray of int, shape (p,)
        u : ndarray, shape (m, 2)
            Places in cells, inside the data's box, sorted by code.
        runs : ndarray of int
            What `runs` gave for those codes.
        low, high : ndarray, shape (p, 2)
            Corners of the patches, within the cells that touch (see `squares`).

        Returns
        -------
        position, row : ndarrays of int, shape (pairs,)
            Position in `patches`, ascending, and row of `u`.
        """
        touching = self.touching[patches]
        first = runs[touching]
        counts = np.where(touching >= 0, runs[touching + 1] - first, 0)
        position = np.repeat(np.arange(len(patches)), counts.sum(axis=1))
        row = ragged(first.ravel(), counts.ravel())
        inside = np.ones(len(row), dtype=bool)
        for axis in range(2):
            at = u[row, axis]
            inside &= (at >= low[position, axis]) & (at <= high[position, axis])
        return position[inside], row[inside]

    def groups(self) -> Iterator[IntArray]:
        """All patches, `GROUP` at a time."""
        for start in range(0, len(self), GROUP):
            yield np.arange(start, min(len(self), start + GROUP))


def ragged(first: IntArray, counts: IntArray) -> IntArray:
    """The runs first[i], first[i] + 1, ... of counts[i] numbers each, end to end."""
    total = int(counts.sum())
    ends = np.cumsum(counts)
    return np.asarray(np.arange(total) + np.repeat(first - (ends - counts), counts))


def step(t: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The quintic step from 0 at t <= 0 to 1 at t >= 1, with two continuous derivatives, and its slope."""
    t = np.clip(t, 0.0, 1.0)
    return t**3 * (10 - 15 * t + 6 * t * t), 30 * np.square(t * (1 - t))
