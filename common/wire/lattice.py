"""Points at the nodes of a regular lattice: where they lie is known from the number of their packet.

The nodes are dealt out to the packets as the cells of the compact forms are, so any packets that arrive are a usable
thinning; the heights of a packet stand in ascending order of their nodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate, pairwise

import numpy as np

from common.surface import FeatureSet, IntArray
from common.wire.cells import Cells
from common.wire.compact import LANES, Steps
from common.wire.header import Header
from common.wire.limits import MAX_CELLS_A_SIDE, MAX_POINTS_PER_PACKET

TOLERANCE = 1e-9
"""Of the region's sides: how far from its node a point may lie to be taken for it."""


def find_lattice(features: FeatureSet) -> tuple[Cells, bool] | None:
    """The lattice that the points are all the nodes of, and whether it is centred; None where there is none."""
    region = features.region
    scaled = (features.xy - (region.x_min, region.y_min)) / (region.width, region.height)
    columns, rows = (len(np.unique(np.rint(values / TOLERANCE))) for values in scaled.T)
    if rows * columns != len(features) or max(rows, columns) > MAX_CELLS_A_SIDE:
        return None
    order = np.lexsort((features.points[:, 0], np.rint(scaled[:, 1] / TOLERANCE)))
    for centred in (False, True):
        x, y = np.meshgrid(*region.axes((rows, columns), centred=centred))
        nodes = np.column_stack([x.ravel(), y.ravel()])
        error = np.abs(features.xy[order] - nodes)
        if np.all(error <= TOLERANCE * np.array([region.width, region.height])):
            return Cells(rows, columns), centred
    return None


def write_heights(steps: IntArray, header: Header) -> list[bytes]:
    """The heights of each packet; `steps` holds one for each node, row by row."""
    grid, cells = header.grid_and_cells()
    bits = grid.height_bits
    blocks: list[bytes] = []
    for start in range(0, header.total, LANES):
        nodes, counts = cells.of_packets(range(start, min(start + LANES, header.total)), header.total)
        values = np.unpackbits(steps[nodes].astype(">u4").view(np.uint8)).reshape(-1, 32)[:, 32 - bits :]
        blocks += [np.packbits(values[a:b]).tobytes() for a, b in pairwise(accumulate(counts, initial=0))]
    return blocks


def read_heights(blocks: Sequence[bytes], sequences: Sequence[int], header: Header) -> list[Steps | None]:
    """Node and height of the points of the packets of the numbers `sequences`; None for a malformed one."""
    found: list[Steps | None] = []
    for start in range(0, len(blocks), LANES):
        found += _read(blocks[start : start + LANES], sequences[start : start + LANES], header)
    return found


def _read(blocks: Sequence[bytes], sequences: Sequence[int], header: Header) -> list[Steps | None]:
    grid, cells = header.grid_and_cells()
    bits = grid.height_bits
    nodes, counts = cells.of_packets(sequences, header.total)
    rows, columns = np.divmod(nodes, cells.columns)
    found: list[Steps | None] = []
    for block, (a, b) in zip(blocks, pairwise(accumulate(counts.tolist(), initial=0)), strict=True):
        count = b - a
        if count > MAX_POINTS_PER_PACKET or len(block) != -(-count * bits // 8):
            found.append(None)
            continue
        padded = np.zeros((count, 32), dtype=np.uint8)
        found_bits = np.unpackbits(np.frombuffer(block, dtype=np.uint8), count=count * bits)
        padded[:, 32 - bits :] = found_bits.reshape(count, bits)
        found.append(Steps(columns[a:b], rows[a:b], np.packbits(padded).view(">u4").astype(np.int64)))
    return found
