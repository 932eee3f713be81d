"""Bytes to packets: sans-IO, resynchronising.

Whatever is fed, a decoder yields packets that passed their checksum, counts what it could not use, and raises nothing
but errors of the WireError family. How the bytes are cut into feeds makes no difference.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from itertools import accumulate, groupby, pairwise
from typing import NamedTuple

import numpy as np

from common.errors import LimitError, PacketError
from common.wire.framing import EXTENSION, MIN_PAYLOAD
from common.wire.header import Header
from common.wire.limits import (
    DEFAULT_DATAGRAM,
    FALSE_START_GRACE,
    MAX_BODY,
    MAX_FALSE_STARTS,
    MAX_POINTS_PER_PACKET,
)
from common.wire.numbers import Reader
from common.wire.packet import CRC_BYTES, NO_POINTS, Packet
from common.wire.plain import point_bits, read_points

_EXT8 = 0xC7
_START = re.compile(rb"\xc7[\x%02x-\xff]\x%02x|\xc8..\x%02x" % (MIN_PAYLOAD, EXTENSION, EXTENSION), re.DOTALL)
_LONGEST_START = 4


class _Found(NamedTuple):
    header: Header
    number: int
    block: bytes

    @property
    def has_points(self) -> bool:
        return self.number % self.header.period < self.header.total


class PacketDecoder:
    """Takes bytes as they come, gives packets as they are complete.

    `feed` and `close` return the packets found, in the order in which they stand. They raise VersionError where an
    intact packet is of a version, form or unit that is not known here, and LimitError where a limit of
    `common.wire.limits` is exceeded; a decoder that raised is of no further use.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._position = 0
        self._closed = False
        self._fed = 0
        self._checked_in_vain = 0
        self._gaps = [0]
        self._malformed = 0
        self._longest = 0
        self._last: tuple[bytes, bytes, Header] | None = None

    @property
    def damaged(self) -> int:
        """Packets that were found damaged.

        A run of bytes that is no packet counts as one, or as many as the longest intact packet goes into it.
        """
        unit = self._longest or DEFAULT_DATAGRAM
        return self._malformed + sum(max(1, round(gap / unit)) for gap in self._gaps if gap)

    def feed(self, data: bytes) -> list[Packet]:
        """Take more bytes; return the packets that they complete."""
        if self._closed:
            raise PacketError("the decoder is closed; a new body takes a new decoder")
        self._fed += len(data)
        if self._fed > MAX_BODY:
            raise LimitError(f"a body of more than {MAX_BODY} bytes")
        self._buffer += data
        return self._packets()

    def close(self) -> list[Packet]:
        """Say that no more bytes come; return the packets that could still be found."""
        self._closed = True
        return self._packets()

    def _packets(self) -> list[Packet]:
        with memoryview(self._buffer) as view:
            found = self._scan(view)
        del self._buffer[: self._position]
        self._position = 0
        packets = []
        for _, run in groupby(found, key=lambda item: (id(item.header), item.has_points)):
            packets.extend(self._decode(list(run)))
        return packets

    def _scan(self, view: memoryview) -> list[_Found]:
        found: list[_Found] = []
        end = len(view)
        while match := _START.search(view, self._position):
            self._skip_to(match.start())
            first, payload = match.span()
            length = view[first + 1] if view[first] == _EXT8 else int.from_bytes(view[first + 1 : first + 3], "big")
            stop = payload + length
            if stop > end and not self._closed:
                return found
            if stop > end or length < MIN_PAYLOAD or not self._intact(view[payload:stop]):
                self._skip_to(first + 1)
                continue
            if self._gaps[-1]:
                self._gaps.append(0)
            self._position = stop
            self._longest = max(self._longest, stop - first)
            try:
                found.append(self._parse(bytes(view[payload : stop - CRC_BYTES])))
            except PacketError:
                self._malformed += 1
        # The start of a packet may be cut in two by the end of what was fed.
        self._skip_to(max(self._position, end if self._closed else end - _LONGEST_START + 1))
        return found

    def _skip_to(self, position: int) -> None:
        self._gaps[-1] += position - self._position
        self._position = position

    def _intact(self, payload: memoryview) -> bool:
        if zlib.crc32(payload[:-CRC_BYTES]) == int.from_bytes(payload[-CRC_BYTES:], "big"):
            return True
        self._checked_in_vain += len(payload)
        if self._checked_in_vain > MAX_FALSE_STARTS * self._fed + FALSE_START_GRACE:
            raise LimitError("the body is full of false starts of packets")
        return False

    def _parse(self, payload: bytes) -> _Found:
        lead, reader = payload[:2], Reader(payload, 2)
        number = reader.varint()
        begin = reader.position
        # Packets of one transmission repeat the header to the byte: it is parsed once.
        if self._last and self._last[0] == lead and payload.startswith(self._last[1], begin):
            header, start = self._last[2], begin + len(self._last[1])
        else:
            header = Header.parse(lead, reader)
            start = reader.position
            self._last = (lead, payload[begin:start], header)
        header.check_number(number)
        found = _Found(header, number, payload[start:])
        if found.has_points:
            _check_block(header, found.block)
        return found

    def _decode(self, run: Sequence[_Found]) -> list[Packet]:
        """Packets that share one header object, decoded at once; those with points that are not finite are damaged."""
        if not run[0].has_points:
            return [Packet(header, number, NO_POINTS, block) for header, number, block in run]
        points, sizes = read_points([item.block for item in run], run[0].header)
        points.setflags(write=False)
        packets = [
            Packet(header, number, points[a:b], block)
            for (header, number, block), (a, b) in zip(run, pairwise(accumulate(sizes, initial=0)), strict=True)
        ]
        if np.all(np.isfinite(points)):
            return packets
        finite = [packet for packet in packets if np.all(np.isfinite(packet.points))]
        self._malformed += len(packets) - len(finite)
        return finite


def _check_block(header: Header, block: bytes) -> None:
    width = point_bits(header)
    count = 8 * len(block) // width
    if not 0 < count <= MAX_POINTS_PER_PACKET or len(block) != -(-count * width // 8):
        raise PacketError(f"the points of a packet are no whole number of {width} bits")
