"""Packets as msgpack: each is one extension object, a body is a run of them. The only place that knows msgpack."""

from __future__ import annotations

import re
from collections.abc import Iterable

import msgpack

from common.errors import LimitError, PacketError, WireError
from common.wire.limits import MAX_BODY

MEDIA_TYPE = "application/vnd.msgpack"
"""The registered one."""

MEDIA_TYPES = frozenset({MEDIA_TYPE, "application/msgpack", "application/x-msgpack"})
"""What a receiver accepts: the registered one and the two that were in use before it."""

EXTENSION = 0x53
"""The extension type of a packet; with the length before it, its magic."""

CODED_EXTENSION = 0x2C
"""The extension type of a packet in the inner code; seven bits away from the other."""

MIN_PAYLOAD = 17
"""Bytes. A header and a point are longer; below 17 msgpack has other, shorter framings, which are so never needed."""

MAX_PAYLOAD = 0xFFFF

START = re.compile(
    b"(?:\xc7(?P<short>[%c-\xff])|\xc8(?P<long>..))[%c%c]" % (MIN_PAYLOAD, EXTENSION, CODED_EXTENSION), re.DOTALL
)
"""How a packet starts: an extension of one of our types, its length in one byte or in two."""

LONGEST_START = 4


def frame(payloads: Iterable[bytes], extension: int = EXTENSION) -> list[bytes]:
    """The datagrams that carry `payloads`; raises PacketError where one is too short or too long."""
    packer, datagrams = msgpack.Packer(), []
    for payload in payloads:
        if not MIN_PAYLOAD <= len(payload) <= MAX_PAYLOAD:
            raise PacketError(f"a packet of {len(payload)} bytes; accepted are {MIN_PAYLOAD} to {MAX_PAYLOAD}")
        datagrams.append(packer.pack_ext_type(extension, payload))
    return datagrams


def framing_bytes(datagram: int) -> int:
    """Bytes that `frame` adds to a datagram of `datagram` bytes in all."""
    return 3 if datagram <= 0xFF + 3 else 4


def length_after(start: re.Match[bytes]) -> int:
    """The length that a match of `START` claims for what follows it."""
    return int.from_bytes(start["short"] or start["long"], "big")


def split(body: bytes) -> list[bytes]:
    """The datagrams of a well-formed body, undecoded and unchecked.

    Raises LimitError beyond MAX_BODY and WireError where the body is no run of packets; says where.
    """
    if len(body) > MAX_BODY:
        raise LimitError(f"a body of {len(body)} bytes; at most {MAX_BODY} are accepted")
    unpacker = msgpack.Unpacker(
        max_buffer_size=max(1, len(body)),
        max_ext_len=MAX_PAYLOAD,
        max_str_len=0,
        max_bin_len=0,
        max_array_len=0,
        max_map_len=0,
        ext_hook=msgpack.ExtType,
    )
    unpacker.feed(body)
    datagrams, start = [], 0
    while start < len(body):
        try:
            extension = unpacker.unpack()
        except (msgpack.UnpackException, ValueError) as error:
            raise WireError(f"the body is no run of packets: at byte {start}, {_reason(error)}") from error
        end = unpacker.tell()
        if not isinstance(extension, msgpack.ExtType) or extension.code not in (EXTENSION, CODED_EXTENSION):
            raise WireError(f"the body is no run of packets: at byte {start} stands another msgpack object")
        datagrams.append(body[start:end])
        start = end
    return datagrams


def _reason(error: Exception) -> str:
    if isinstance(error, msgpack.OutOfData):
        return "an object is cut off"
    if isinstance(error, msgpack.StackError):
        return "objects are nested too deeply"
    if isinstance(error, msgpack.FormatError):
        return "a byte is no msgpack"
    return "an object is longer than accepted"
