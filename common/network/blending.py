"""What overlapping patches say, blended by smooth weights: on grids, at scattered positions, derivatives.

The weight of a patch is a product of quintic steps along the axes, over the sum of all that reach a place, so the blend
has two continuous derivatives and no seam. Beyond the data's box the nearest patches go on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from common.network.cover import Cover, ragged, step
from common.network.local import CACHED
from common.network.threads import in_order
from common.surface import BoolArray, FloatArray, IntArray

BLEND_MARGIN = 0.15
"""How far the weight of a patch reaches: less than its points, so that no patch is asked at its rim."""

GRID_CACHED = 1 << 16
"""Gaussians of one level along one axis of the rectangles of a grid that are evaluated at once."""

TILE = 128
"""Most rows and columns of a grid that a patch evaluates at once."""

QUERIES = 256
"""Most scattered positions that a patch evaluates at once."""


@dataclass(frozen=True, slots=True, eq=False)
class Blend:
    """The weights of the patches, and which of them are asked together.

    Attributes
    ----------
    cover : Cover
        The patches' squares.
    spacings : ndarray, shape (patches,)
        Mean spacing of each patch, in cells: places are told to it in these, about its middle.
    counts : ndarray of int, shape (patches,)
        Points of each patch: what a batch of them costs.
    """

    cover: Cover
    spacings: FloatArray
    counts: IntArray

    def grid(
        self,
        x: FloatArray,
        y: FloatArray,
        outputs: int,
        evaluate: Callable[[IntArray, FloatArray, FloatArray], FloatArray],
    ) -> FloatArray:
        """Values on a grid, shape (len(y), len(x), outputs).

        `evaluate` takes patches (p,) and the coordinates of columns (p, c) and rows (p, r) to values (outputs, p, r,
        c).
        """
        columns, rows = np.argsort(x, kind="stable"), np.argsort(y, kind="stable")
        axes = self._axis(x[columns], 0), self._axis(y[rows], 1)

        def work(piece: tuple[IntArray, IntArray]) -> tuple[IntArray, FloatArray, FloatArray]:
            return self._rectangles(*piece, axes, evaluate)

        total, weight = np.zeros((outputs, len(y) * len(x))), np.zeros(len(y) * len(x))
        for nodes, values, w in in_order(work, self._pieces(axes)):
            np.add.at(weight, nodes.ravel(), w.ravel())
            for output in range(outputs):
                np.add.at(total[output], nodes.ravel(), values[output].ravel())
        total /= weight
        grid = np.empty((len(y), len(x), outputs))
        grid[np.ix_(rows, columns)] = np.moveaxis(total.reshape(outputs, len(y), len(x)), 0, 2)
        return grid

    def scattered(
        self, X: FloatArray, columns: int, evaluate: Callable[[IntArray, FloatArray], FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """What the patches say at X (m, 2), blended, and what the change of the weights adds to the derivatives.

        `evaluate` takes patches (p,) and places (p, q, 2) to (p, q, columns). The second result has the shape (m,
        columns, 2), per cell.
        """
        frame = self.cover.frame
        u = frame.scaled(X)
        inside = frame.clipped(u)
        codes = frame.codes(X)
        order = np.argsort(codes, kind="stable")
        u, inside, codes = u[order], inside[order], codes[order]
        runs = self.cover.runs(codes)
        total, weight = np.zeros((len(X), columns)), np.zeros(len(X))
        lean, shift = np.zeros((len(X), columns, 2)), np.zeros((len(X), 2))

        def work(piece: tuple[IntArray, IntArray, BoolArray]) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
            patches, rows, real = piece
            centres = self.cover.centres[patches, None]
            away = inside[rows] - centres
            wx, sx = self._weights(away[..., 0], patches)
            wy, sy = self._weights(away[..., 1], patches)
            found = evaluate(patches, (u[rows] - centres) / self.spacings[patches, None, None])[real]
            slope = (np.stack([sx * wy, wx * sy], axis=-1) * (u[rows] == inside[rows]))[real]
            return rows[real], found, (wx * wy)[real], slope

        for patches in self.cover.groups():
            position, row = self.cover.members(patches, inside, runs, *self.cover.squares(patches, BLEND_MARGIN))
            for at, found, w, slope in in_order(work, self._queries(patches, position, row)):
                np.add.at(total, at, w[:, None] * found)
                np.add.at(weight, at, w)
                np.add.at(lean, at, found[:, :, None] * slope[:, None, :])
                np.add.at(shift, at, slope)
        blended = total / weight[:, None]
        lean = (lean - blended[:, :, None] * shift[:, None, :]) / weight[:, None, None]
        values, slopes = np.empty_like(blended), np.empty_like(lean)
        values[order], slopes[order] = blended, lean
        return values, slopes

    def _weights(self, away: FloatArray, patches: IntArray) -> tuple[FloatArray, FloatArray]:
        """Weight along one axis at offsets (p, m) from the middle of the patches, in cells, and its slope."""
        side = self.cover.sides[patches, None]
        value, slope = step((0.5 + BLEND_MARGIN - np.abs(away) / side) / (2 * BLEND_MARGIN))
        return value, -slope * np.sign(away) / (2 * BLEND_MARGIN * side)

    def _axis(self, axis: FloatArray, which: int) -> tuple[FloatArray, FloatArray]:
        """Coordinates of a grid's columns or rows in cells, and the nearest inside the data's box."""
        frame = self.cover.frame
        u = (axis - frame.low[which]) / frame.side + frame.start[which]
        return u, np.clip(u, frame.start[which], frame.start[which] + frame.extent[which])

    def _pieces(self, axes: tuple[tuple[FloatArray, FloatArray], ...]) -> list[tuple[IntArray, IntArray]]:
        """Batches of patches and the grid rectangles (left, right, bottom, top) they are to evaluate."""
        reach = self.cover.sides * (0.5 + BLEND_MARGIN)
        bounds = []
        for (_, clipped), centre in zip(axes, self.cover.centres.T, strict=True):
            bounds.append(np.searchsorted(clipped, centre - reach, side="left"))
            bounds.append(np.searchsorted(clipped, centre + reach, side="right"))
        box = np.stack(bounds, axis=1)
        across, along = -(-(box[:, 1] - box[:, 0]) // TILE), -(-(box[:, 3] - box[:, 2]) // TILE)
        patches = np.repeat(np.arange(len(self.cover)), across * along)
        part = ragged(np.zeros(len(self.cover), dtype=np.int64), across * along)
        left = box[patches, 0] + TILE * (part % np.maximum(across[patches], 1))
        bottom = box[patches, 2] + TILE * (part // np.maximum(across[patches], 1))
        right, top = np.minimum(left + TILE, box[patches, 1]), np.minimum(bottom + TILE, box[patches, 3])
        counts = self.counts[patches]
        order = np.lexsort((counts, top - bottom, right - left))
        boxes = np.stack([left, right, bottom, top], axis=1)[order]
        patches, counts = patches[order], counts[order]
        size = np.maximum(boxes[:, 1] - boxes[:, 0], boxes[:, 3] - boxes[:, 2]) * counts
        return [(patches[part], boxes[part]) for part in _runs(size, GRID_CACHED)]

    def _rectangles(
        self,
        patches: IntArray,
        boxes: IntArray,
        axes: tuple[tuple[FloatArray, FloatArray], ...],
        evaluate: Callable[[IntArray, FloatArray, FloatArray], FloatArray],
    ) -> tuple[IntArray, FloatArray, FloatArray]:
        """Nodes, weighted values (outputs, ...) and weights of a batch of grid rectangles, (p, rows, columns)."""
        away, weights, nodes = [], [], []
        for axis, (u, clipped) in enumerate(axes):
            first, last = boxes[:, 2 * axis], boxes[:, 2 * axis + 1]
            at = first[:, None] + np.arange(int((last - first).max()))
            inside = at < last[:, None]
            at = np.where(inside, at, first[:, None])
            centre = self.cover.centres[patches, axis, None]
            nodes.append(at)
            weights.append(self._weights(clipped[at] - centre, patches)[0] * inside)
            away.append((u[at] - centre) / self.spacings[patches, None])
        values = evaluate(patches, away[0], away[1])
        weight = weights[1][:, :, None] * weights[0][:, None, :]
        values *= weight
        return nodes[1][:, :, None] * len(axes[0][0]) + nodes[0][:, None, :], values, weight

    def _queries(
        self, patches: IntArray, position: IntArray, row: IntArray
    ) -> list[tuple[IntArray, IntArray, BoolArray]]:
        """Batches of patches (p,), rows of queries (p, q), and which of those are not padding."""
        counts = np.bincount(position, minlength=len(patches))
        parts = -(-counts // QUERIES)
        which = np.repeat(np.arange(len(patches)), parts)
        first = (np.cumsum(counts) - counts)[which] + QUERIES * ragged(np.zeros_like(parts), parts)
        many = np.minimum(np.cumsum(counts)[which] - first, QUERIES)
        points = self.counts[patches[which]]
        order = np.lexsort((points, many))
        pieces = []
        for part in _runs((many * points)[order], CACHED):
            chosen = order[part]
            at = np.arange(int(many[chosen].max()))
            real = at < many[chosen, None]
            pieces.append(
                (patches[which[chosen]], row[np.where(real, first[chosen, None] + at, first[chosen, None])], real)
            )
        return pieces


def _runs(size: IntArray, budget: int) -> list[slice]:
    """Consecutive items whose number times their largest size stays within the budget, at least one each."""
    runs, start = [], 0
    while start < len(size):
        stop, largest = start + 1, int(size[start])
        while stop < len(size) and (stop + 1 - start) * max(largest, int(size[stop])) <= budget:
            largest = max(largest, int(size[stop]))
            stop += 1
        runs.append(slice(start, stop))
        start = stop
    return runs
