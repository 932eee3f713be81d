"""The pieces of a region as the compact forms see them: a grid of cells, dealt out to the packets.

Packet i of P takes the cells (row r, column c) with (c + s r) mod P = i, where s is coprime to P and near to P over the
golden ratio: whatever packets arrive, their cells lie evenly over the region. A packet's cells are known from its
number, so where its points lie need not be said.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from common.surface import IntArray


@dataclass(frozen=True, slots=True)
class Cells:
    """A grid of cells from the low corner of what is quantised.

    Parameters
    ----------
    rows, columns : int
        Cells along y, and along x.
    side : float or None
        Side of the cells where they are the pieces of a segment gap; None where they divide the region evenly.
    """

    rows: int
    columns: int
    side: float | None = None

    def __len__(self) -> int:
        return self.rows * self.columns

    def most_per_packet(self, total: int) -> int:
        """A bound of the cells that one of `total` packets takes."""
        return self.rows * -(-self.columns // total)

    def of_packets(self, sequences: Sequence[int], total: int) -> tuple[IntArray, IntArray]:
        """The cells, ``row * columns + column``, of packets, ascending and end to end; and how many each packet has."""
        rows = np.arange(self.rows)
        first = (np.asarray(sequences)[:, None] - skew(total) * rows) % total
        columns = first[:, :, None] + np.arange(0, self.columns, total)
        inside = columns < self.columns
        return (rows[:, None] * self.columns + columns)[inside], np.count_nonzero(inside, axis=(1, 2))

    def most(self, total: int) -> int:
        """The cells of the packet that has most of them."""
        rows, columns = np.divmod(np.arange(len(self)), self.columns)
        return int(np.bincount(self.owner(rows, columns, total)).max())

    def owner(self, rows: IntArray, columns: IntArray, total: int) -> IntArray:
        """The packet that each cell belongs to."""
        owner: IntArray = (columns + skew(total) * rows) % total
        return owner


@lru_cache(maxsize=64)
def skew(total: int) -> int:
    """The least s >= P / golden ratio, rounded, that is coprime to P = `total`."""
    s = max(1, round(total * 0.6180339887498949))
    while math.gcd(s, total) != 1:
        s += 1
    return s
