"""A FeatureSet to packets."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from common.errors import LimitError, ParameterError
from common.surface import FeatureSet, FloatArray, IntArray
from common.wire import inner
from common.wire.erasure import SYMBOL_OVERHEAD, parity_blocks
from common.wire.framing import frame, framing_bytes
from common.wire.header import Form, Grid, Header, transmission_tag
from common.wire.limits import MAX_PACKETS, MAX_POINTS, MAX_POINTS_PER_PACKET
from common.wire.numbers import Interval, write_varint
from common.wire.options import WireOptions
from common.wire.packet import CRC_BYTES, write_payloads
from common.wire.plain import point_bits, write_points

STEPS_PER_DISTANCE = 512
"""Position steps in the mean distance between points, at least, where the bits of a position are chosen by itself.

The error of a position, uniform over a step, then has a deviation below 1/1700 of the distance, which moves a height by
1/1700 of what it differs from its neighbour's.
"""

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
    if len(features) > MAX_POINTS:
        raise LimitError(f"{len(features)} points; a transmission carries at most {MAX_POINTS}")
    return protect_blocks(*write_blocks(features, transmission, options), options)


def write_blocks(features: FeatureSet, transmission: str, options: WireOptions) -> tuple[Header, list[bytes]]:
    """The header of a transmission and the points of each of its packets, not yet protected."""
    header = _plan(features, transmission, options)
    points, sizes = _deal(features.points[_along_curve(features)], header.total)
    return header, write_points(points, sizes, header)


def protect_blocks(header: Header, blocks: Sequence[bytes], options: WireOptions) -> list[bytes]:
    """The datagrams: parity, copies and the inner code added to `blocks` as the options say."""
    parity = parity_blocks(blocks, header.parity) if header.parity else []
    payloads = write_payloads(header, [*blocks, *parity] * options.copies)
    return inner.protect(payloads, options.inner) if options.inner else [frame(payload) for payload in payloads]


def _plan(features: FeatureSet, transmission: str, options: WireOptions) -> Header:
    """The header, with the number of packets that keeps every datagram short enough."""
    room = (
        inner.room(options.datagram, options.inner)
        if options.inner
        else options.datagram - framing_bytes(options.datagram)
    )
    form, grid = _form(features, options)
    n = len(features)
    count = min(options.min_packets, n)
    while count <= MAX_PACKETS:
        header = Header(
            transmission_tag(transmission), count, features.region, form, features.gap, features.kind, features.units,
            parity=math.ceil(options.parity * count), grid=grid,
        )  # fmt: skip
        number = write_varint(options.copies * header.period - 1)
        spent = len(header.lead()) + len(number) + len(header.rest()) + CRC_BYTES
        spent += SYMBOL_OVERHEAD if header.parity else 0
        fitting = 8 * (room - spent) // point_bits(header)
        if fitting < 1:
            least = options.datagram - room + spent + -(-point_bits(header) // 8)
            raise ParameterError(
                f"no point fits into a datagram of {options.datagram} bytes; with these coordinates and this "
                f"protection it takes {least}"
            )
        needed = max(-(-n // min(fitting, MAX_POINTS_PER_PACKET)), count)
        if needed == count:
            return header
        count = needed
    raise LimitError(
        f"{n} points take more than {MAX_PACKETS} packets of {options.datagram} bytes; choose longer datagrams"
    )


def _form(features: FeatureSet, options: WireOptions) -> tuple[Form, Grid | None]:
    precision = options.precision
    if precision == "float64":
        return Form.FLOAT64, None
    if precision == "float32":
        # Doubles beyond float32 would arrive as infinities.
        fits = bool(np.all(np.abs(features.points) <= np.finfo(np.float32).max))
        return (Form.FLOAT32 if fits else Form.FLOAT64), None
    boxes = _boxes(features)
    if boxes is None:
        return Form.FLOAT64, None
    x, y, z = boxes
    return Form.QUANTISED, Grid(options.position_bits or _position_bits(len(features)), precision, z, x, y)


def _boxes(features: FeatureSet) -> tuple[Interval | None, Interval | None, Interval] | None:
    """Boxes of x, y (None: the region) and z; None where quantising would lose what was asked for."""
    least, greatest = features.points.min(axis=0).tolist(), features.points.max(axis=0).tolist()
    z = Interval.covering(least[2], greatest[2])
    if z is None:
        return None
    region = features.region
    lows, highs = (region.x_min, region.y_min), (region.x_max, region.y_max)
    if all(low <= a and b <= high for low, high, a, b in zip(lows, highs, least, greatest, strict=False)):
        return None, None, z
    boxes = []
    for low, high, a, b in zip(lows, highs, least, greatest, strict=False):
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
    """The order of the points along a Morton curve over their bounding box; ties by their coordinates."""
    codes = morton(features.xy)
    order: IntArray = np.argsort(codes, kind="stable")
    return order


def morton(xy: FloatArray) -> IntArray:
    """The place of (n, 2) positions on a Morton curve of 2^16 x 2^16 cells over their bounding box."""
    low = xy.min(axis=0)
    extent = np.maximum(xy.max(axis=0) - low, np.finfo(np.float64).tiny)
    cells = ((xy - low) / extent * 65535).astype(np.uint64)
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        cells = (cells | cells << np.uint64(shift)) & np.uint64(mask)
    codes: IntArray = (cells[:, 1] << np.uint64(1) | cells[:, 0]).astype(np.int64)
    return codes


def _deal(points: FloatArray, count: int) -> tuple[FloatArray, list[int]]:
    """The points packet by packet, as cards are dealt, and how many each packet holds."""
    n = len(points)
    sizes = [len(range(i, n, count)) for i in range(count)]
    rounds = -(-n // count)
    padded = np.full(rounds * count, -1)
    padded[:n] = np.arange(n)
    dealt = padded.reshape(rounds, count).T.ravel()
    return points[dealt[dealt >= 0]], sizes
