"""The inner code: each datagram protected against bit errors by Reed-Solomon code words of its own.

A coded datagram is systematic: framing, strength, length, payload, zeros up to the common length, parity. The code
words cover all of it, the framing too, so that nothing in it has to arrive unharmed. Datagrams longer than one code
word hold several, interleaved byte by byte. All coded datagrams of a transmission are of one length: in a body where
they stand end to end, a few legible starts tell where all the others begin.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeAlias, get_args

import numpy as np

from common.wire.framing import CODED_EXTENSION, MIN_PAYLOAD, frame, framing_bytes
from common.wire.gf256 import ByteArray
from common.wire.limits import MAX_DATAGRAM
from common.wire.reedsolomon import MAX_WORD, correct, encode

Strength: TypeAlias = Literal[16, 32, 64, 128]
"""Bytes of parity in a code word of at most 255; half as many wrong bytes are corrected."""

STRENGTHS: tuple[int, ...] = get_args(Strength)

_PREFIX = 3  # strength, length of the payload


class Shape(NamedTuple):
    """What has to be known to correct a coded datagram: its length, and its bytes of parity in a code word."""

    size: int
    strength: int


def room(datagram: int, strength: int) -> int:
    """The longest payload that a coded datagram of at most `datagram` bytes can hold."""
    full_words = datagram // MAX_WORD * MAX_WORD
    return max(_capacity(size, strength) for size in {datagram, full_words} if size)


def protect(payloads: Sequence[bytes], strength: int) -> list[bytes]:
    """The coded datagrams of `payloads`, all of one length: the least that holds the longest."""
    longest = max(map(len, payloads))
    size = longest
    while _capacity(size, strength) < longest:
        size += 1
    bodies = (bytes([strength]) + len(payload).to_bytes(2, "big") + payload for payload in payloads)
    datagrams = frame((body.ljust(size - framing_bytes(size), b"\0") for body in bodies), CODED_EXTENSION)
    array = np.frombuffer(b"".join(datagrams), dtype=np.uint8).reshape(len(payloads), size).copy()
    words, depth = _words(array, strength), _depth(size)
    parity = encode(words[:, :-strength], strength)
    _tail(array, strength)[:] = _interleave(parity, depth)
    return [row.tobytes() for row in array]


def recover(datagrams: ByteArray, strength: int) -> ByteArray:
    """(count, size) coded datagrams with their errors corrected, those that can be."""
    size = datagrams.shape[1]
    depth = _depth(size)
    words = correct(_words(datagrams, strength), strength)
    out = datagrams.copy()
    data = size - depth * strength
    out[:, :data] = _interleave(words[:, :-strength], depth)[:, depth * (words.shape[1] - strength) - data :]
    _tail(out, strength)[:] = _interleave(words[:, -strength:], depth)
    return out


def shape_of(datagram: memoryview) -> Shape | None:
    """The shape of a coded datagram by its own account; None if that is impossible."""
    shape = Shape(len(datagram), datagram[framing_bytes(len(datagram))])
    return shape if _plausible(shape) else None


def payload_of(datagram: memoryview) -> memoryview | None:
    """The payload of a coded datagram by its own account, uncorrected; None if that is impossible."""
    shape = shape_of(datagram)
    if shape is None:
        return None
    start = framing_bytes(shape.size) + _PREFIX
    length = int.from_bytes(datagram[start - 2 : start], "big")
    return datagram[start : start + length] if length <= _capacity(*shape) else None


def end_of(datagram: memoryview) -> int:
    """Where an intact coded datagram ends: at its length, or, if its parity was cut off, where the next one begins."""
    shape, payload = shape_of(datagram), payload_of(datagram)
    if shape is None or payload is None:
        return len(datagram)
    following = bytes(datagram).find(prefix(shape), framing_bytes(shape.size) + _PREFIX + len(payload))
    return len(datagram) if following < 0 else following


def prefix(shape: Shape) -> bytes:
    """The bytes that all coded datagrams of a shape begin with."""
    body = bytes([shape.strength]).ljust(shape.size - framing_bytes(shape.size), b"\0")
    return frame([body], CODED_EXTENSION)[0][: framing_bytes(shape.size) + 1]


def shapes_of_size(size: int) -> list[Shape]:
    """All the shapes that coded datagrams of `size` bytes can have."""
    return [shape for shape in (Shape(size, strength) for strength in STRENGTHS) if _plausible(shape)]


def correction_work(shape: Shape) -> int:
    """What it takes to correct one datagram, in bytes of parity."""
    return _depth(shape.size) * shape.strength


def _plausible(shape: Shape) -> bool:
    return shape.strength in STRENGTHS and shape.size <= MAX_DATAGRAM and _capacity(*shape) >= MIN_PAYLOAD


def _depth(size: int) -> int:
    return -(-size // MAX_WORD)


def _capacity(size: int, strength: int) -> int:
    return size - framing_bytes(size) - _PREFIX - _depth(size) * strength


def _tail(datagrams: ByteArray, strength: int) -> ByteArray:
    return datagrams[:, datagrams.shape[1] - _depth(datagrams.shape[1]) * strength :]


def _words(datagrams: ByteArray, strength: int) -> ByteArray:
    """The (count * depth, n) code words of (count, size) datagrams.

    Interleaved from the end of the data backwards, with zeros in front where a word is a byte short: a shortened code.
    """
    count, size = datagrams.shape
    depth = _depth(size)
    data = size - depth * strength
    columns = -(-data // depth)
    padded = np.zeros((count, columns * depth), dtype=np.uint8)
    padded[:, columns * depth - data :] = datagrams[:, :data]
    parts = [_deinterleave(part, depth) for part in (padded, datagrams[:, data:])]
    return np.concatenate(parts, axis=1)


def _deinterleave(rows: ByteArray, depth: int) -> ByteArray:
    return rows.reshape(len(rows), -1, depth).transpose(0, 2, 1).reshape(len(rows) * depth, -1)


def _interleave(words: ByteArray, depth: int) -> ByteArray:
    return words.reshape(-1, depth, words.shape[1]).transpose(0, 2, 1).reshape(len(words) // depth, -1)
