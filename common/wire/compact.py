"""Compact coding: the order of the points carries nothing, so it is not sent; what can be foretold costs little.

Points are sorted by cell, within a cell by height. A packet then says how many points each of its cells holds, where in
their cell they lie, and by how much each height differs from a prediction, entropy-coded (`common.wire.rans`) with
probabilities that a few bits per packet choose from.

- Extrema lie towards the edges of their piece, and the greatest across from the least. So the eighth of the cell's side
  that a coordinate falls into is coded by a table, for the second point given the eighth of the first.
- A height is predicted by the heights before it, weighted by distance to the power -4. In a cell it is no less than the
  height before it.

The prediction is a sum of doubles, added in the order of the points; any IEEE 754 arithmetic without fused or extended
operations finds the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np

from common.errors import LimitError
from common.surface import BoolArray, FloatArray, IntArray
from common.wire.header import LATTICES, Header
from common.wire.limits import MAX_COMPACT_POINTS, MAX_DECODING_WORK
from common.wire.rans import Coder, Reader, Tables, Writer, tables

LANES = 256
"""Packets worked on at once: bounds the memory."""

WINDOW = 64
"""Heights before it that a height is predicted from."""

SYMBOLS_A_POINT = 8
"""What a point takes to decode, in symbols: those of its position and height, and the prediction."""

TYPICAL_BUCKET = 2.4
"""The mean of the coded differences, in units of their scale, for which the table of magnitudes is made."""

MIN_BLOCK = 5
PARAMETER_BYTES = 2

_COUNTS = tables(
    [
        (1, 1, 1, 1),
        (20, 4056, 16, 4),
        (16, 40, 4024, 16),
        (200, 500, 3200, 196),
        (607, 303, 76, 14),
        (368, 368, 184, 80),
        (135, 271, 271, 323),
        (900, 70, 25, 5),
    ]
)
"""Points in a cell: 0, 1, 2, or 3 and as many more as follow."""
_MORE = 3

_EIGHTHS = 8
_EIGHTH_BITS = 3
_SHARPNESSES = 8
_SAME_SIDE = (1, 3, 7, 14)  # of 32: that the second point lies towards the edge that the first is nearer to

_BUCKETS = 32
_ESCAPE = _BUCKETS - 1
_SIGNS = tables([(1, 1), (31, 1)])
"""A difference from the prediction is negative: in the first point of a cell, in the others."""


def _decay(numerator: int, denominator: int, count: int) -> list[int]:
    weights = [1 << 16]
    for _ in range(count - 1):
        weights.append(weights[-1] * numerator // denominator)
    return weights


def _eighths() -> Tables:
    """Nine tables a sharpness: one for the first point of a cell, eight for the second, by the eighth of the first."""
    rows = []
    for sharpness in range(_SHARPNESSES):
        edge = _decay(8 - sharpness, 8, _EIGHTHS)
        rows.append([edge[b] + edge[7 - b] for b in range(8)])
        for a in range(8):
            same = _SAME_SIDE[min(a, 7 - a)]
            near, far = (edge, edge[::-1]) if a < 4 else (edge[::-1], edge)
            rows.append([same * near[b] + (32 - same) * far[b] for b in range(8)])
    return tables([[weight + 1 for weight in row] for row in rows])


_POSITIONS = _eighths()
_MAGNITUDES = tables([[weight + 64 for weight in _decay(3, 4, _BUCKETS)]])


class Parameters(NamedTuple):
    """What a packet says of its probabilities, one value a packet."""

    counts: IntArray
    sharpness: IntArray
    first_scale: IntArray
    other_scale: IntArray

    def to_bytes(self) -> list[bytes]:
        """Two bytes a packet: 3, 3, 5 and 5 bits, most significant first."""
        words = self.counts << 13 | self.sharpness << 10 | self.first_scale << 5 | self.other_scale
        return [int(word).to_bytes(PARAMETER_BYTES, "big") for word in words]

    @classmethod
    def parse(cls, blocks: Sequence[bytes]) -> Parameters:
        """The inverse of `to_bytes`, from the first bytes of each block."""
        words = np.array([int.from_bytes(block[:PARAMETER_BYTES], "big") for block in blocks], dtype=np.int64)
        return cls(words >> 13, words >> 10 & 7, words >> 5 & 31, words & 31)


class Steps(NamedTuple):
    """Points in steps: of the grid in x and y, of the quantised heights in z; one value a point."""

    x: IntArray
    y: IntArray
    z: IntArray


class Batch(NamedTuple):
    """Points of several packets, one row a packet, filled up with zeros at the end of the rows."""

    active: BoolArray
    """Whether there is a point."""
    place: IntArray
    """The number of the point in its cell, from 0."""
    corner: tuple[IntArray, IntArray]
    """Steps of x and y at which its cell begins."""


class Effort:
    """What the entropy-coded packets of a body may cost.

    Packets are decoded `LANES` at a time, symbol by symbol: each costs as much as the longest beside it. A packet that
    came before, as copies do, costs nothing.

    Attributes
    ----------
    headers : dict
        The headers there were, numbered.
    known : dict
        The points of the packets that were read, None for malformed ones, by number of header, sequence and block.
    """

    def __init__(self) -> None:
        self._left = MAX_DECODING_WORK
        self.headers: dict[Header, int] = {}
        self.known: dict[tuple[int, int, bytes], FloatArray | None] = {}

    def spend(self, packets: int, symbols: int) -> None:
        """So many packets are about to be read so many symbols further; raises LimitError where that is too much."""
        self._left -= packets * symbols
        if self._left < 0:
            raise LimitError(f"the packets of a body take more than {MAX_DECODING_WORK} symbols to decode")


class Messages(NamedTuple):
    """The blocks of all packets, and how many points the fullest holds."""

    blocks: list[bytes]
    most: int


def write_steps(points: Steps, header: Header, most: int | None = None) -> Messages:
    """The points of each packet of a compact form; on a lattice there is one point in each cell.

    With `most`, only of so many packets.
    """
    grid, cells = header.grid_and_cells()
    row, column = points.y >> grid.position_bits, points.x >> grid.position_bits
    cell, owner = row * cells.columns + column, cells.owner(row, column, header.total)
    order = np.lexsort((points.x, points.y, points.z, cell, owner))
    ordered = np.stack(points)[:, order]
    occupied = np.bincount(cell, minlength=len(cells))
    ends = np.searchsorted(owner[order], np.arange(header.total + 1))
    blocks: list[bytes] = []
    total = min(most or header.total, header.total)
    for start in range(0, total, LANES):
        stop = min(start + LANES, total)
        layout = _Layout(range(start, stop), [header] * (stop - start))
        counts = np.where(layout.present, occupied[layout.indices], 0)
        batch = layout.batch(counts)
        part = Steps(*(_filled(batch.active, values) for values in ordered[:, ends[start] : ends[stop]]))
        blocks += _write(layout, batch, counts, part)
    return Messages(blocks, int(np.max(np.diff(ends))))


def read_steps(
    blocks: Sequence[bytes], sequences: Sequence[int], headers: Sequence[Header], effort: Effort
) -> list[Steps | None]:
    """The inverse of `write_steps` for packets of the numbers `sequences`, of any headers; None for a malformed one.

    Raises LimitError where that takes more than is left of `effort`.
    """
    found: list[Steps | None] = [None] * len(blocks)
    # Long ones beside long ones: each costs as much as the longest beside it.
    order = sorted(range(len(blocks)), key=lambda i: len(blocks[i]))
    for start in range(0, len(order), LANES):
        lanes = order[start : start + LANES]
        layout = _Layout([sequences[i] for i in lanes], [headers[i] for i in lanes])
        for i, steps in zip(lanes, _read(layout, [blocks[i] for i in lanes], effort), strict=True):
            found[i] = steps
    return found


class _Layout:
    """What their headers and numbers say of where the points of packets lie; one value, or one row, a packet.

    Attributes
    ----------
    present, indices : arrays, shape (packets, most cells)
        The cells of each packet, ``row * columns + column``, and which entries are cells at all.
    """

    def __init__(self, sequences: Sequence[int], headers: Sequence[Header]) -> None:
        grids = [header.grid_and_cells() for header in headers]
        self.bits = np.array([grid.position_bits for grid, _ in grids])
        self.height_bits = np.array([grid.height_bits for grid, _ in grids])
        self.columns = np.array([cells.columns for _, cells in grids])
        self.is_lattice = np.array([header.form in LATTICES for header in headers])
        parts = []
        for _, run in groupby(range(len(headers)), key=lambda lane: id(headers[lane])):
            lanes = list(run)
            cells = grids[lanes[0]][1]
            parts.append(cells.of_packets([sequences[lane] for lane in lanes], headers[lanes[0]].total))
        counts = np.concatenate([part for _, part in parts])
        self.present = np.arange(max(1, int(counts.max())))[None, :] < counts[:, None]
        self.indices = _filled(self.present, np.concatenate([part for part, _ in parts]))

    def batch(self, counts: IntArray) -> Batch:
        """The points of the packets, of which there are `counts` in their cells."""
        sizes = counts.sum(axis=1)
        active = np.arange(max(1, int(sizes.max())))[None, :] < sizes[:, None]
        each = counts.ravel()
        place = np.arange(each.sum()) - np.repeat(np.cumsum(each) - each, each)
        columns, bits = np.repeat(self.columns, sizes), np.repeat(self.bits, sizes)
        row, column = np.divmod(np.repeat(self.indices.ravel(), each), columns)
        corner = _filled(active, column << bits), _filled(active, row << bits)
        return Batch(active, _filled(active, place), corner)


def _write(layout: _Layout, batch: Batch, counts: IntArray, points: Steps) -> list[bytes]:
    u, v = points.x - batch.corner[0], points.y - batch.corner[1]
    magnitudes = _Heights(batch, points.x, points.y, layout.height_bits).magnitudes(points.z)
    first, other = (_scale(magnitudes, batch, chosen) for chosen in (batch.place == 0, batch.place > 0))
    zero = np.zeros(len(counts), dtype=np.int64)
    parameters = Parameters(zero, zero, first, other)
    writer = Writer(len(counts))
    if not layout.is_lattice.all():
        eighths = [values >> layout.bits[:, None] - _EIGHTH_BITS for values in (u, v)]
        parameters = Parameters(_best_counts(layout.present, counts), _best_sharpness(batch, eighths), first, other)
        _code_counts(writer, parameters, layout, counts)
        _code_positions(writer, parameters, layout, batch, u, v)
    _Heights(batch, points.x, points.y, layout.height_bits).code(writer, parameters, points.z)
    return [a + b for a, b in zip(parameters.to_bytes(), writer.finish(), strict=True)]


def _read(layout: _Layout, blocks: Sequence[bytes], effort: Effort) -> list[Steps | None]:
    parameters = Parameters.parse(blocks)
    reader = Reader([block[PARAMETER_BYTES:] for block in blocks])
    counts = layout.present.astype(np.int64)
    if not layout.is_lattice.all():
        counts = _code_counts(reader, parameters, layout, counts, effort)
    good = counts.sum(axis=1) <= MAX_COMPACT_POINTS
    counts[~good] = 0
    batch = layout.batch(counts)
    effort.spend(len(blocks), SYMBOLS_A_POINT * batch.active.shape[1])
    nothing = np.zeros_like(batch.place)
    x, y = batch.corner
    if not layout.is_lattice.all():
        u, v = _code_positions(reader, parameters, layout, batch, nothing, nothing)
        x, y = x + u, y + v
    z = _Heights(batch, x, y, layout.height_bits).code(reader, parameters, nothing)
    good &= reader.finished()
    return [Steps(x[i, row], y[i, row], z[i, row]) if good[i] else None for i, row in enumerate(batch.active)]


def _filled(where: BoolArray, values: IntArray) -> IntArray:
    out = np.zeros(where.shape, dtype=np.int64)
    out[where] = values
    return out


def _code_counts(
    coder: Coder, parameters: Parameters, layout: _Layout, counts: IntArray, effort: Effort | None = None
) -> IntArray:
    """How many points the cells hold: on a lattice one, else what is coded."""
    found = np.where(layout.is_lattice[:, None], counts, 0)
    cells = np.where(layout.is_lattice, 0, np.count_nonzero(layout.present, axis=1))
    lanes, cell = np.arange(len(counts)), np.zeros(len(counts), dtype=np.int64)
    # Each packet goes on to its next cell by itself: none waits for another that has a fuller one.
    while (active := cell < cells).any():
        if effort:
            effort.spend(len(counts), 1)
        here = lanes, np.minimum(cell, counts.shape[1] - 1)
        symbol = coder.symbol(_COUNTS, parameters.counts, np.minimum(counts[here] - found[here], _MORE), active)
        found[here] += symbol
        cell += (symbol < _MORE) | (found[here] > MAX_COMPACT_POINTS)
    return found


def _code_positions(
    coder: Coder, parameters: Parameters, layout: _Layout, batch: Batch, u: IntArray, v: IntArray
) -> tuple[IntArray, IntArray]:
    out = np.zeros_like(u), np.zeros_like(v)
    base = parameters.sharpness * (_EIGHTHS + 1)
    previous = [np.zeros_like(base), np.zeros_like(base)]
    rest = np.where(layout.is_lattice, 0, layout.bits - _EIGHTH_BITS)
    mask = (1 << rest) - 1
    for j in range(u.shape[1]):
        active, place = batch.active[:, j] & ~layout.is_lattice, batch.place[:, j]
        for axis, (values, found) in enumerate(zip((u, v), out, strict=True)):
            # Row 0, of the least sharpness, makes all eighths equally likely.
            table = np.where(place == 0, base, np.where(place == 1, base + 1 + previous[axis], 0))
            previous[axis] = coder.symbol(_POSITIONS, table, values[:, j] >> rest, active)
            found[:, j] = previous[axis] << rest
        low = coder.raw(2 * rest, (u[:, j] & mask) << rest | v[:, j] & mask, active)
        out[0][:, j] |= low >> rest
        out[1][:, j] |= low & mask
    return out


class _Heights:
    """Predicts heights one after the other, and codes by how much they differ."""

    def __init__(self, batch: Batch, x: IntArray, y: IntArray, bits: IntArray) -> None:
        self._batch, self._bits = batch, bits
        self._top = (1 << bits) - 1
        self._x, self._y = x.astype(np.float64), y.astype(np.float64)
        self._sum = np.zeros(x.shape)
        self._weight = np.zeros(x.shape)

    def magnitudes(self, z: IntArray) -> IntArray:
        """What is to be coded of each height of `z`, its sign apart."""
        out = np.zeros_like(z)
        for j in range(z.shape[1]):
            difference = z[:, j] - self._guess(j, z)
            out[:, j] = np.where(difference < 0, -1 - difference, difference)
            self._learn(j, z[:, j])
        return out

    def code(self, coder: Coder, parameters: Parameters, z: IntArray) -> IntArray:
        """The heights; `z` where they are written."""
        out = np.zeros_like(z)
        for j in range(z.shape[1]):
            out[:, j] = self._code(coder, parameters, j, z[:, j], self._guess(j, out))
            self._learn(j, out[:, j])
        return out

    def _code(self, coder: Coder, parameters: Parameters, j: int, z: IntArray, guess: IntArray) -> IntArray:
        active = self._batch.active[:, j]
        other = (self._batch.place[:, j] > 0).astype(np.int64)
        scale = np.where(other, parameters.other_scale, parameters.first_scale)
        difference = z - guess
        magnitude = np.where(difference < 0, -1 - difference, difference)
        negative = coder.symbol(_SIGNS, other, (difference < 0).astype(np.int64), active)
        bucket = coder.symbol(_MAGNITUDES, np.zeros_like(z), np.minimum(magnitude >> scale, _ESCAPE), active)
        escaped = active & (bucket == _ESCAPE)
        low = coder.raw(scale, magnitude & (np.int64(1) << scale) - 1, active & ~escaped)
        magnitude = bucket << scale | low
        found = np.clip(guess + np.where(negative, -1 - magnitude, magnitude), 0, self._top)
        if escaped.any():
            found = np.where(escaped, coder.raw(self._bits, z, escaped), found)
        return np.where(active, found, 0)

    def _guess(self, j: int, z: IntArray) -> IntArray:
        if not j:
            return 1 << self._bits - 1
        guess = np.floor(self._sum[:, j] / self._weight[:, j]).astype(np.int64)
        least = np.where(self._batch.place[:, j] > 0, z[:, j - 1], 0)
        return np.clip(guess, least, self._top)

    def _learn(self, j: int, z: IntArray) -> None:
        later = slice(j + 1, j + 1 + WINDOW)
        dx, dy = self._x[:, later] - self._x[:, j : j + 1], self._y[:, later] - self._y[:, j : j + 1]
        square = dx * dx + dy * dy + 1.0
        weight = 1.0 / (square * square)
        self._sum[:, later] += weight * z[:, None]
        self._weight[:, later] += weight


def _best_counts(present: BoolArray, counts: IntArray) -> IntArray:
    """The table of counts that is cheapest for each packet."""
    full, last = np.divmod(counts, _MORE)
    bits = _COUNTS.bits()
    spent = np.sum(bits[:, last] * present, axis=2) + bits[:, _MORE:] * full.sum(axis=1)
    best: IntArray = np.argmin(spent, axis=0)
    return best


def _best_sharpness(batch: Batch, eighths: Sequence[IntArray]) -> IntArray:
    """The sharpness that is cheapest for each packet."""
    cost = np.zeros((_SHARPNESSES, len(batch.active)))
    bits = _POSITIONS.bits().reshape(_SHARPNESSES, _EIGHTHS + 1, _EIGHTHS)
    for found in eighths:
        row = np.where(batch.place == 1, 1 + np.roll(found, 1, axis=1), 0)
        for sharpness in range(_SHARPNESSES):
            each = np.where(batch.place < 2, bits[sharpness][row, found], _EIGHTH_BITS)
            cost[sharpness] += np.sum(each * batch.active, axis=1)
    best: IntArray = np.argmin(cost, axis=0)
    return best


def _scale(magnitudes: IntArray, batch: Batch, chosen: BoolArray) -> IntArray:
    """Binary logarithm of the unit in which the chosen magnitudes of each packet are about `TYPICAL_BUCKET`."""
    counted = chosen & batch.active
    mean = np.sum(magnitudes * counted, axis=1) / np.maximum(1, counted.sum(axis=1))
    scale: IntArray = np.clip(np.floor(np.log2(np.maximum(mean, 1.0) / TYPICAL_BUCKET)), 0, 31).astype(np.int64)
    return scale
