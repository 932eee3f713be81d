"""A FeatureSet to packets."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from common.errors import LimitError, ParameterError
from common.surface import FeatureSet, FloatArray, IntArray, Region
from common.wire import inner
from common.wire.cells import Cells
from common.wire.compact import MIN_BLOCK
from common.wire.erasure import SYMBOL_OVERHEAD, parity_blocks
from common.wire.framing import frame, framing_bytes
from common.wire.header import COMPACTS, MAX_CELL_BITS, MIN_CELL_BITS, Form, Grid, Header, transmission_tag
from common.wire.lattice import find_lattice
from common.wire.limits import MAX_BITS, MAX_CELLS_A_SIDE, MAX_PACKETS, MAX_POINTS, MIN_POINT_BITS
from common.wire.numbers import Interval, write_varint
from common.wire.options import WireOptions
from common.wire.packet import CRC_BYTES, write_payloads
from common.wire.plain import point_bits
from common.wire.points import load, write

CELL_BITS = 7
"""Bits of a position in its cell, where they are chosen by itself and the coding is compact.

The error of a position, uniform over 1/128 of the side of a cell, has a deviation of 1/443 of it.
"""

EXPECTED_SAVING = 3
"""Bits a point that compact coding saves, roughly: where the search for the number of packets begins."""

MAX_ROUNDS = 16
"""Tries to find a number of packets; points so crowded that it takes more are not coded compactly."""

STEPS_PER_DISTANCE = 512
"""Position steps in the mean distance between points, at least, where the bits of a position are chosen by itself.

The error of a position, uniform over a step, then has a deviation below 1/1700 of the distance, which moves a height by
1/1700 of what it differs from its neighbour's.
"""

ROUNDING = 1e-9
"""Of a binary logarithm: what is above a whole number by no more is that number."""

SMALLEST_EXTENT = 1e-300
"""Points that are nearer to each other are not ordered along the curve: their distances would overflow its scale."""

SMALLEST_QUANTISED = SMALLEST_EXTENT * 2**MAX_BITS
"""What is narrower is not quantised: its steps would overflow likewise."""

MAX_EXTENSION = 2.0
"""How far beyond the region, in sides of it, positions stay quantised: beyond, the step would coarsen for all."""


def encode(features: FeatureSet, *, transmission: str, options: WireOptions | None = None) -> list[bytes]:
    """The datagrams that carry `features`; the list's index is the datagram's number.

    The points are ordered along a space-filling curve and dealt out to the packets one by one, so each packet is a
    thinning of the whole surface. The same features give the same bytes.

    Quantised coordinates are never clipped: where points lie outside of the region the packets carry a box that covers
    them, and where that box is out of proportion (`MAX_EXTENSION`) the points travel as float64.

    Raises LimitError for more points or packets than are accepted, ParameterError where not one point fits a datagram.
    """
    options = options or WireOptions()
    return protect(draft(features, transmission, options), options)


class Draft(NamedTuple):
    """A transmission that is not yet protected: its header, and the points of each of its packets."""

    header: Header
    blocks: list[bytes]

    @property
    def size(self) -> int:
        """Bytes that differ from form to form."""
        return len(self.header.rest()) * len(self.blocks) + sum(map(len, self.blocks))


def draft(features: FeatureSet, transmission: str, options: WireOptions) -> Draft:
    """The points of a transmission in packets.

    Of the forms that the options allow, the one that takes fewest bytes. Raises what `encode` raises.
    """
    if len(features) > MAX_POINTS:
        raise LimitError(f"{len(features)} points; a transmission carries at most {MAX_POINTS}")
    ordered = features.points[_along_curve(features)]
    # The search may step over the most packets there can be: they are tried where it finds nothing.
    for find in (_Search.fit, _Search.fit_most):
        for forms in _forms(features, options):
            drafts = [find(_Search(features, transmission, options, form, grid), ordered) for form, grid in forms]
            if found := [each for each in drafts if each is not None]:
                return min(found, key=lambda each: each.size)
    raise LimitError(
        f"{len(features)} points take more than {MAX_PACKETS} packets of {options.datagram} bytes; "
        "choose longer datagrams"
    )


def protect(unprotected: Draft, options: WireOptions) -> list[bytes]:
    """The datagrams: parity, copies and the inner code added as the options say."""
    header, blocks = unprotected
    parity = parity_blocks(blocks, header.parity) if header.parity else []
    payloads = write_payloads(header, [*blocks, *parity] * options.copies)
    return inner.protect(payloads, options.inner) if options.inner else frame(payloads)


class _Search:
    """Finds with how many packets every datagram is short enough, for one form of the points."""

    def __init__(
        self, features: FeatureSet, transmission: str, options: WireOptions, form: Form, grid: Grid | None
    ) -> None:
        self._options, self._count = options, len(features)
        self._most = min(MAX_PACKETS, self._count)
        self._header = Header(
            transmission_tag(transmission), 1, features.region, form, features.gap, features.kind, features.units,
            grid=grid,
        )  # fmt: skip
        self._payload = (
            inner.room(options.datagram, options.inner)
            if options.inner
            else options.datagram - framing_bytes(options.datagram)
        )

    def fit(self, points: FloatArray) -> Draft | None:
        """The draft; None where this form does not lead to packets that are short enough.

        Raises ParameterError where not one point fits into a datagram.
        """
        total = self._first_total()
        for _ in range(MAX_ROUNDS):
            if total > self._most:
                return None
            found, excess = self._try(points, total)
            if found is not None:
                return found
            total = max(total + 1, math.ceil(total * excess))
        return None

    def fit_most(self, points: FloatArray) -> Draft | None:
        """What `fit` returns and raises, with the most packets there can be: one for each point, or `MAX_PACKETS`."""
        return self._try(points, self._most)[0]

    def _try(self, points: FloatArray, total: int) -> tuple[Draft | None, float]:
        """The draft, or None where a block is too long; and how long the longest is over what fits."""
        header, room = self._with(total)
        most_bytes, share = load(points, header)
        excess = max(most_bytes / room, share)
        if excess > 1:
            return None, excess
        blocks = write(points, header)
        excess = max(map(len, blocks)) / room
        return (Draft(header, blocks) if excess <= 1 else None), excess

    def _with(self, total: int) -> tuple[Header, int]:
        """The header of so many packets, and the bytes that it leaves for the points of each."""
        header = replace(self._header, total=total, parity=math.ceil(self._options.parity * total))
        number = write_varint(self._options.copies * header.period - 1)
        spent = len(header.lead()) + len(number) + len(header.rest()) + CRC_BYTES
        spent += SYMBOL_OVERHEAD if header.parity else 0
        room, least = self._payload - spent, self._least_block()
        if room < least:
            raise ParameterError(
                f"no point fits into a datagram of {self._options.datagram} bytes; with these coordinates and this "
                f"protection it takes at least {self._options.datagram - self._payload + spent + least}, less with a "
                "region and a segment gap of fewer digits, which stand in every packet"
            )
        return header, room

    def _least_block(self) -> int:
        return MIN_BLOCK if self._header.form in COMPACTS else -(-point_bits(self._header) // 8)

    def _first_total(self) -> int:
        """Where to begin: about what the points take, or less."""
        least = min(self._options.min_packets, self._count)
        _, room = self._with(least)
        saved = EXPECTED_SAVING if self._header.form in COMPACTS else 0
        return max(least, math.ceil(self._count * (point_bits(self._header) - saved) / (8 * room)))


def _forms(features: FeatureSet, options: WireOptions) -> Iterator[list[tuple[Form, Grid | None]]]:
    """The forms that can carry the features as the options want them; of each group one is as good as the other."""
    precision = options.precision
    if precision == "float32" and np.all(np.abs(features.points) <= np.finfo(np.float32).max):
        yield [(Form.FLOAT32, None)]
    elif isinstance(precision, int) and (boxes := _boxes(features)):
        x, y, z = boxes
        is_compact = options.coding == "compact"
        if features.kind == "lattice" and (lattice := find_lattice(features)):
            grid = Grid(0, precision, z, cells=lattice[0], centred=lattice[1])
            yield [(Form.COMPACT_LATTICE, grid), (Form.LATTICE, grid)] if is_compact else [(Form.LATTICE, grid)]
        bits = options.position_bits
        fine = max(bits or _position_bits(len(features)), math.ceil((MIN_POINT_BITS - precision) / 2))
        plain = Form.QUANTISED, Grid(fine, precision, z, x, y)
        if is_compact:
            sides = _sides(features.region, (x, y))
            cells = _cells(features, (x, y))
            in_cell = CELL_BITS if bits is None else max(_bits_in_cell(bits, cells, sides), MIN_CELL_BITS)
            if in_cell <= MAX_CELL_BITS:
                yield [(Form.COMPACT, Grid(in_cell, precision, z, x, y, cells)), plain]
        yield [plain]
    # Doubles carry whatever the other forms cannot.
    yield [(Form.FLOAT64, None)]


def _cells(features: FeatureSet, boxes: tuple[Interval | None, Interval | None]) -> Cells:
    """The pieces of the features if they are neither crowded nor mostly empty, or else cells of two points each."""
    n, region = len(features), features.region
    if features.gap is not None and boxes == (None, None):
        rows, columns = region.pieces(features.gap)
        if 0.7 <= n / (rows * columns) <= 6 and max(rows, columns) <= MAX_CELLS_A_SIDE:
            return Cells(rows, columns, features.gap)
    width, height = (high - low for low, high in _sides(region, boxes))
    side = math.sqrt(width) * math.sqrt(height) * math.sqrt(2 / n)
    columns, rows = (min(max(1, round(extent / side)), MAX_CELLS_A_SIDE, n) for extent in (width, height))
    return Cells(rows, columns)


def _bits_in_cell(bits: int, cells: Cells, sides: Sequence[tuple[float, float]]) -> int:
    """Bits of a position in its cell that are as fine, along x and along y, as `bits` over the whole of that side."""
    shares = (
        (cells.side or (high - low) / count) / (high - low)
        for (low, high), count in zip(sides, (cells.columns, cells.rows), strict=True)
    )
    return math.ceil(bits + math.log2(max(shares)) - ROUNDING)


def _sides(
    region: Region, boxes: tuple[Interval | None, Interval | None] = (None, None)
) -> tuple[tuple[float, float], tuple[float, float]]:
    """(low, high) of x and of y: those of the box, or else of the region."""
    x, y = boxes
    return (
        x.bounds if x else (region.x_min, region.x_max),
        y.bounds if y else (region.y_min, region.y_max),
    )


def _boxes(features: FeatureSet) -> tuple[Interval | None, Interval | None, Interval] | None:
    """Boxes of x, y (None: the region) and z; None where quantising would lose what was asked for."""
    # Column by column: a reduction along the long axis takes several times as long.
    least, greatest = ([float(reduce(column)) for column in features.points.T] for reduce in (np.min, np.max))
    z = Interval.covering(least[2], greatest[2])
    sides = _sides(features.region)
    if z is None or any(high - low < SMALLEST_QUANTISED for low, high in (*sides, z.bounds)):
        return None
    if all(low <= a and b <= high for (low, high), a, b in zip(sides, least, greatest, strict=False)):
        return None, None, z
    boxes = []
    for (low, high), a, b in zip(sides, least, greatest, strict=False):
        reach = MAX_EXTENSION * (high - low)
        box = Interval.covering(min(a, low), max(b, high))
        if box is None or a < low - reach or b > high + reach:
            return None
        boxes.append(box)
    return boxes[0], boxes[1], z


def _position_bits(n: int) -> int:
    # Multiples of four make a point of 16-bit heights whole bytes, which is the fast path of both ends.
    bits = math.ceil(math.log2(STEPS_PER_DISTANCE * math.sqrt(n)))
    return -(-bits // 4) * 4


def _along_curve(features: FeatureSet) -> IntArray:
    """The order of the points along a Morton curve over their bounding box."""
    codes = morton(features.xy)
    # Two stable sorts of 16 bits each are radix sorts, four times as fast as one of 32.
    low = np.argsort((codes & 0xFFFF).astype(np.uint16), kind="stable")
    return low[np.argsort((codes >> 16).astype(np.uint16)[low], kind="stable")]


def morton(xy: FloatArray) -> IntArray:
    """The place of (n, 2) positions on a Morton curve of 2^16 x 2^16 cells over their bounding box."""
    return _interleaved(xy[:, 1]) << 1 | _interleaved(xy[:, 0])


def _interleaved(values: FloatArray) -> IntArray:
    """The values in 16 bits over their range, with a zero before each bit."""
    halves = values * 0.5  # the range of doubles may exceed a double, that of their halves does not
    low = float(halves.min())
    extent = float(halves.max()) - low
    scale = 65535 / extent if extent > SMALLEST_EXTENT else 0.0
    bits = ((halves - low) * scale).astype(np.int64)
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        bits = (bits | bits << shift) & mask
    return bits
