"""Bytes to packets: sans-IO, resynchronising.

Whatever is fed, a decoder yields packets that passed their checksum, counts what it could not use, and raises nothing
but errors of the WireError family. How the bytes are cut into feeds makes no difference.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from contextlib import suppress

from common.errors import LimitError, PacketError, WireError
from common.wire import inner
from common.wire.compact import Effort
from common.wire.framing import CODED_EXTENSION, LONGEST_START, MIN_PAYLOAD, START, length_after, split
from common.wire.gaps import Gaps
from common.wire.header import Header
from common.wire.limits import FALSE_START_GRACE, MAX_BODY, MAX_COPIES, MAX_FALSE_STARTS
from common.wire.numbers import Reader
from common.wire.packet import CRC_BYTES, Packet
from common.wire.points import Written, check_block, decode_packets

AT_ONCE = 4096
"""Packets decoded at once: bounds what is held besides their points."""


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
        self._gaps = Gaps()
        self._malformed = 0
        self._longest = 0
        self._corrected = 0
        self._last_length = -1
        self._last: tuple[bytes, bytes, Header] | None = None
        self._effort = Effort()

    @property
    def damaged(self) -> int:
        """Packets that were found damaged and could not be corrected.

        A run of bytes that is no packet counts as one, or as many as the longest intact packet goes into it.
        """
        return self._malformed + self._gaps.count(self._longest)

    @property
    def corrected(self) -> int:
        """Packets that were damaged and are intact thanks to the inner code; they come with `close`."""
        return self._corrected

    def feed(self, data: bytes) -> list[Packet]:
        """Take more bytes; return the packets that they complete."""
        return self._decode_all(self.find(data))

    def find(self, data: bytes) -> list[Written]:
        """What `feed` does, but for reading the points."""
        if self._closed:
            raise PacketError("the decoder is closed; a new body takes a new decoder")
        self._fed += len(data)
        if self._fed > MAX_BODY:
            raise LimitError(f"a body of more than {MAX_BODY} bytes")
        self._buffer += data
        return self._find()

    def close(self) -> list[Packet]:
        """Say that no more bytes come; return the packets that could still be found."""
        self._closed = True
        packets = self._decode_all(self._find())
        corrected: list[Written] = []
        self._gaps.correct(lambda datagram: self._accept(datagram, corrected), guess=not self._longest)
        self._corrected += len(corrected)
        return packets + self._decode_all(corrected)

    def _find(self) -> list[Written]:
        with memoryview(self._buffer) as view:
            found = self._scan(view)
        del self._buffer[: self._position]
        self._position = 0
        return found

    def _accept(self, datagram: bytes, found: list[Written]) -> bool:
        """Take a corrected datagram if it passes its checksum."""
        match = START.match(datagram)
        payload = inner.payload_of(memoryview(datagram)) if match and _is_coded(datagram, match.end()) else None
        if payload is None or not _passes(payload):
            return False
        self._take(bytes(payload), found)
        return True

    def _decode_all(self, found: Sequence[Written]) -> list[Packet]:
        packets: list[Packet] = []
        for start in range(0, len(found), AT_ONCE):
            decoded = decode_packets(found[start : start + AT_ONCE], self._effort)
            packets += [packet for packet in decoded if packet is not None]
            self._malformed += decoded.count(None)
        return packets

    def _scan(self, view: memoryview) -> list[Written]:
        found: list[Written] = []
        end = len(view)
        while match := START.search(view, self._position):
            first, start = match.span()
            self._skip_to(first, view)
            length = length_after(match)
            stop = start + length
            if stop > end and not self._closed:
                return found
            payload = self._intact(view[first:stop], start - first) if stop <= end and length >= MIN_PAYLOAD else None
            if payload is None:
                self._skip_to(first + 1, view)
                continue
            if _is_coded(view, start):
                stop = first + inner.end_of(view[first:stop])
            self._gaps.end()
            self._position = stop
            self._longest = max(self._longest, stop - first)
            self._take(payload, found)
        # The start of a packet may be cut in two by the end of what was fed.
        self._skip_to(max(self._position, end if self._closed else end - LONGEST_START + 1), view)
        return found

    def _skip_to(self, position: int, view: memoryview) -> None:
        self._gaps.extend(view[self._position : position])
        self._position = position

    def _intact(self, datagram: memoryview, start: int) -> bytes | None:
        """The payload of what looks like a datagram, framed by its first `start` bytes; None if it is damaged."""
        payload: memoryview | None = datagram[start:]
        if _is_coded(datagram, start):
            self._gaps.vote(datagram)
            payload = inner.payload_of(datagram)
        if payload is None:
            return None
        if _passes(payload):
            return bytes(payload)
        self._checked_in_vain += len(payload)
        if self._checked_in_vain > MAX_FALSE_STARTS * self._fed + FALSE_START_GRACE:
            raise LimitError("the body is full of false starts of packets")
        return None

    def _take(self, payload: bytes, found: list[Written]) -> None:
        try:
            found.append(self._parse(payload[:-CRC_BYTES]))
        except PacketError:
            self._malformed += 1

    def _parse(self, payload: bytes) -> Written:
        lead, number, begin = payload[:2], payload[2], 3
        if number > 0x7F:
            reader = Reader(payload, 2)
            number, begin = reader.varint(), reader.position
        # Packets of one transmission repeat the header to the byte: it is parsed once.
        if self._last and self._last[0] == lead and payload.startswith(self._last[1], begin):
            header, start = self._last[2], begin + len(self._last[1])
        else:
            reader = Reader(payload, begin)
            header = Header.parse(lead, reader)
            start = reader.position
            self._last = (lead, payload[begin:start], header)
            self._last_length = -1
        period = header.period
        if number >= MAX_COPIES * period:
            raise PacketError(f"a packet has the number {number} of {period} in at most {MAX_COPIES} copies")
        found = Written(header, number, payload[start:])
        # All that a block is checked for here is its length.
        if found.has_points and len(found.block) != self._last_length:
            check_block(header, found.block)
            self._last_length = len(found.block)
        return found


def decode_each(datagrams: Sequence[bytes], effort: Effort) -> list[Packet | None]:
    """Of each datagram the packet that it is, uncorrected; None where it is none, several or one that cannot be used.

    Where decoding takes more than is left of `effort`, none can.
    """
    found: list[Written] = []
    owners: list[int] = []
    for index, datagram in enumerate(datagrams):
        with suppress(WireError):
            here = PacketDecoder().find(datagram) if len(split(datagram)) == 1 else []
            found += here
            owners += [index] * len(here)
    packets: list[Packet | None] = [None] * len(datagrams)
    with suppress(LimitError):
        for index, packet in zip(owners, decode_packets(found, effort), strict=True):
            packets[index] = packets[index] or packet
    return packets


def _is_coded(datagram: bytes | memoryview, start: int) -> bool:
    return datagram[start - 1] == CODED_EXTENSION


def _passes(payload: memoryview) -> bool:
    return zlib.crc32(payload[:-CRC_BYTES]) == int.from_bytes(payload[-CRC_BYTES:], "big")
