"""The points of packets, written and read in the form that their header names."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np

from common.errors import PacketError
from common.surface import FloatArray, IntArray
from common.wire import compact, lattice
from common.wire.compact import Effort, Steps
from common.wire.header import COMPACTS, LATTICES, Form, Header
from common.wire.limits import MAX_COMPACT_POINTS, MAX_POINTS_PER_PACKET
from common.wire.packet import NO_POINTS, Packet
from common.wire.plain import dequantise, point_bits, quantise, read_points, write_points


class Load(NamedTuple):
    """What the fullest packet of a transmission holds."""

    bytes: int
    """Of points."""
    share: float
    """Of the points that are accepted at most."""


def load(points: FloatArray, header: Header) -> Load:
    """The load of the packets that `write` makes; of compact ones an estimate, from some of them."""
    if header.form in COMPACTS:
        messages = compact.write_steps(_steps(points, header), header, most=compact.LANES)
        return Load(max(map(len, messages.blocks)), messages.most / MAX_COMPACT_POINTS)
    if header.form is Form.LATTICE:
        most = header.grid_and_cells()[1].most(header.total)
    else:
        most = -(-len(points) // header.total)
    return Load(-(-most * point_bits(header) // 8), most / MAX_POINTS_PER_PACKET)


def write(points: FloatArray, header: Header) -> list[bytes]:
    """The points, shape (n, 3), packet by packet. Plain forms deal them out in the order in which they come."""
    if header.form in COMPACTS:
        return compact.write_steps(_steps(points, header), header).blocks
    if header.form is Form.LATTICE:
        steps, (_, cells) = _steps(points, header), header.grid_and_cells()
        heights = np.empty(len(points), dtype=np.int64)
        heights[steps.y * cells.columns + steps.x] = steps.z
        return lattice.write_heights(heights, header)
    return write_points(*deal(points, header.total), header)


def check_block(header: Header, block: bytes) -> None:
    """PacketError unless `block` can be the points of one packet; what takes decoding to see, passes."""
    if header.form in COMPACTS:
        if len(block) < compact.MIN_BLOCK:
            raise PacketError(f"the points of a packet take at least {compact.MIN_BLOCK} bytes")
        return
    if header.form is Form.LATTICE:
        return
    width = point_bits(header)
    count = 8 * len(block) // width
    if not 0 < count <= MAX_POINTS_PER_PACKET or len(block) != -(-count * width // 8):
        raise PacketError(f"the points of a packet are no whole number of {width} bits")


class Written(NamedTuple):
    """A packet whose points, if it carries any, are still to be read; `number` is that of its datagram."""

    header: Header
    number: int
    block: bytes

    @property
    def sequence(self) -> int:
        """Which packet it is, whichever copy."""
        return self.number % self.header.period

    @property
    def has_points(self) -> bool:
        """Whether it carries points, not parity."""
        return self.sequence < self.header.total


def decode_packets(written: Sequence[Written], effort: Effort) -> list[Packet | None]:
    """The packets, all at once; None for a malformed one, and for one with points that are not finite.

    The blocks must have passed `check_block`. Raises LimitError where that takes more than is left of `effort`.
    """
    packets: list[Packet | None] = [Packet(each.header, each.number, NO_POINTS, each.block) for each in written]
    alike: defaultdict[int, list[int]] = defaultdict(list)
    for index, each in enumerate(written):
        if each.has_points:
            alike[id(each.header)].append(index)
    # Those that are entropy-coded are read together even where each has a header of its own.
    keys: dict[int, tuple[int, int, bytes]] = {}
    for indices in alike.values():
        header = written[indices[0]].header
        if header.form in COMPACTS:
            place = effort.headers.setdefault(header, len(effort.headers))
            keys |= {i: (place, written[i].sequence, written[i].block) for i in indices}
    fresh = {key: i for i, key in reversed(keys.items()) if key not in effort.known}.values()
    chosen = [written[i] for i in fresh]
    steps = dict(
        zip(fresh, compact.read_steps(*_columns(chosen), [each.header for each in chosen], effort), strict=True)
    )
    for indices in alike.values():
        if first := [i for i in indices if i in steps]:
            located = _located([steps[i] for i in first], written[first[0]].header)
            effort.known.update(zip((keys[i] for i in first), located, strict=True))
    for indices in alike.values():
        header = written[indices[0]].header
        if header.form in COMPACTS:
            parts = [effort.known[keys[i]] for i in indices]
        else:
            parts = _read(*_columns([written[i] for i in indices]), header)
        for i, points in zip(indices, parts, strict=True):
            packets[i] = None if points is None else Packet(header, written[i].number, points, written[i].block)
    return packets


def _columns(written: Sequence[Written]) -> tuple[list[bytes], list[int]]:
    return [each.block for each in written], [each.sequence for each in written]


def _read(blocks: Sequence[bytes], sequences: Sequence[int], header: Header) -> list[FloatArray | None]:
    if header.form is Form.LATTICE:
        return _located(lattice.read_heights(blocks, sequences, header), header)
    points, sizes = read_points(blocks, header)
    return _cut(points, sizes)


def deal(points: FloatArray, count: int) -> tuple[FloatArray, list[int]]:
    """The points packet by packet, dealt out to `count` as cards are, and how many each packet holds."""
    n = len(points)
    sizes = [len(range(i, n, count)) for i in range(count)]
    rounds = -(-n // count)
    padded = np.full(rounds * count, -1)
    padded[:n] = np.arange(n)
    dealt = padded.reshape(rounds, count).T.ravel()
    return points[dealt[dealt >= 0]], sizes


def _cut(points: FloatArray, sizes: Sequence[int]) -> list[FloatArray | None]:
    points.setflags(write=False)
    parts: list[FloatArray | None] = [points[a:b] for a, b in pairwise(accumulate(sizes, initial=0))]
    if np.all(np.isfinite(points)):
        return parts
    return [part if part is not None and np.all(np.isfinite(part)) else None for part in parts]


def _steps(points: FloatArray, header: Header) -> Steps:
    """The points in steps of the grid; on a lattice a step is a node."""
    x_axis, y_axis, z_limits = _axes(header)
    z = quantise(points[:, 2], *z_limits).astype(np.int64)
    return Steps(x_axis.steps(points[:, 0]), y_axis.steps(points[:, 1]), z)


def _located(found: Sequence[Steps | None], header: Header) -> list[FloatArray | None]:
    """The points of packets in coordinates: the inverse of `_steps`, for all at once."""
    good = [steps for steps in found if steps is not None]
    if not good:
        return [None] * len(found)
    x, y, z = (np.concatenate(values) for values in zip(*good, strict=True))
    x_axis, y_axis, z_limits = _axes(header)
    points = np.stack([x_axis.coordinates(x), y_axis.coordinates(y), dequantise(z, *z_limits)], axis=1)
    parts = iter(_cut(points, [len(steps.z) for steps in good]))
    return [None if steps is None else next(parts) for steps in found]


@dataclass(frozen=True, slots=True)
class _Axis:
    """Steps along x or y: each stands for its middle, or for a node."""

    low: float
    step: float
    count: int
    nodes: FloatArray | None = None

    def steps(self, values: FloatArray) -> IntArray:
        if self.nodes is not None:
            return np.rint(np.interp(values, self.nodes, np.arange(self.count))).astype(np.int64)
        return np.clip(np.floor((values - self.low) / self.step), 0, self.count - 1).astype(np.int64)

    def coordinates(self, steps: IntArray) -> FloatArray:
        if self.nodes is not None:
            return self.nodes[steps]
        return np.asarray(self.low + (steps + 0.5) * self.step, dtype=np.float64)


def _axes(header: Header) -> tuple[_Axis, _Axis, tuple[float, float, int]]:
    """The axes of x and y, and (low, high, bits) of z."""
    grid, cells = header.grid_and_cells()
    *ranges, z_limits = grid.ranges(header.region)
    if header.form in LATTICES:
        x, y = header.region.axes((cells.rows, cells.columns), centred=grid.centred)
        return _Axis(0.0, 0.0, cells.columns, x), _Axis(0.0, 0.0, cells.rows, y), z_limits
    found = []
    for (low, high, bits), count in zip(ranges, (cells.columns, cells.rows), strict=True):
        side = cells.side or (high - low) / count
        found.append(_Axis(low, side / 2**bits, count << bits))
    return found[0], found[1], z_limits
