"""The numbers of a packet's header in few bytes: varints, exact reals, dyadic intervals.

Writers return bytes; a `Reader` takes them off the front of a payload and raises PacketError where they run out.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from decimal import Decimal

from common.errors import PacketError

MAX_VARINT_BYTES = 8
"""Seven bits a byte: 56 bits, more than the 53 that a double holds exactly."""

_SMALL_OFFSET = 64
_SMALL_COUNT = 192
_DECIMAL = 192
_MAX_DECIMALS = 22  # 10**22 is the largest power of ten that a double holds exactly
_FLOAT32 = _DECIMAL + _MAX_DECIMALS + 1
_FLOAT64 = _FLOAT32 + 1
_EXACT = 2**53
_TERSE_DIVISIONS = 127  # the most that one byte of a varint can say
_MAX_EXPONENT = 1000  # of an interval: within those of doubles, with room for its divisions

_RELATIVE_GRAIN = 2.0**-44
"""Finer than this against its offset, a range is rounding noise and the interval no longer exact."""


def write_varint(value: int) -> bytes:
    """Little-endian base 128; the high bit says that more follow.

    >>> write_varint(300).hex()
    'ac02'
    """
    if value < 0x80:
        return bytes((value,))
    if value < 0x4000:
        return bytes((value & 0x7F | 0x80, value >> 7))
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def write_signed(value: int) -> bytes:
    """A varint of 2v for v >= 0, of -2v - 1 for v < 0."""
    return write_varint(2 * value if value >= 0 else -2 * value - 1)


def write_real(value: float) -> bytes:
    """The shortest of four exact forms: a small integer, a decimal fraction, a float32, a float64.

    >>> [write_real(v).hex() for v in (-1.0, 0.4, 0.1 + 0.2)]
    ['3f', 'c108', 'd8343333333333d33f']
    """
    value = float(value)
    if (
        value.is_integer()
        and 0 <= value + _SMALL_OFFSET < _SMALL_COUNT
        and not (value == 0 and math.copysign(1, value) < 0)
    ):
        return bytes([int(value) + _SMALL_OFFSET])
    forms = [bytes([_FLOAT64]) + struct.pack("<d", value)]
    if abs(value) < 3e38 and struct.unpack("<f", struct.pack("<f", value))[0] == value:
        forms.append(bytes([_FLOAT32]) + struct.pack("<f", value))
    digits = Decimal(repr(value)).normalize()
    exponent = digits.as_tuple().exponent
    if value and isinstance(exponent, int) and -_MAX_DECIMALS <= exponent <= 15:
        decimals = max(0, -exponent)
        mantissa = int(digits.scaleb(decimals))
        if abs(mantissa) < _EXACT and mantissa / 10**decimals == value:
            forms.append(bytes([_DECIMAL + decimals]) + write_signed(mantissa))
    return min(reversed(forms), key=len)


@dataclass(frozen=True, slots=True)
class Interval:
    """The interval [low, low + divisions] * 2**exponent: exact in doubles, and a few bytes on the wire."""

    exponent: int
    low: int
    divisions: int

    @classmethod
    def covering(cls, least: float, greatest: float) -> Interval | None:
        """The interval of at most 127 divisions that covers [least, greatest], or None where doubles cannot say it.

        At most 2 divisions of 64 or more are surplus, so quantising loses at most 1/32 of its resolution to the short
        form.
        """
        extent = max(greatest - least, _RELATIVE_GRAIN * max(abs(least), abs(greatest)))
        if not math.isfinite(extent):
            return None
        exponent = math.frexp(extent)[1] - 7 if extent else 0
        if not -_MAX_EXPONENT < exponent < _MAX_EXPONENT:
            return None
        for e in (exponent, exponent + 1):
            low = math.floor(math.ldexp(least, -e))
            divisions = max(1, math.ceil(math.ldexp(greatest, -e)) - low)
            if divisions <= _TERSE_DIVISIONS:
                return cls(e, low, divisions)
        return None

    @property
    def bounds(self) -> tuple[float, float]:
        """(low, high) in the unit of the coordinate."""
        return math.ldexp(self.low, self.exponent), math.ldexp(self.low + self.divisions, self.exponent)

    def to_bytes(self) -> bytes:
        """Exponent, low, divisions."""
        return write_signed(self.exponent) + write_signed(self.low) + write_varint(self.divisions)


class Reader:
    """Takes numbers off the front of a payload."""

    __slots__ = ("_data", "position")

    def __init__(self, data: bytes, position: int = 0) -> None:
        self._data = data
        self.position = position

    def take(self, count: int) -> bytes:
        """The next `count` bytes."""
        end = self.position + count
        if end > len(self._data):
            raise PacketError("the packet ends inside its header")
        taken = self._data[self.position : end]
        self.position = end
        return taken

    def byte(self) -> int:
        """The next byte."""
        return self.take(1)[0]

    def varint(self) -> int:
        """The next varint; PacketError beyond 56 bits."""
        value = 0
        for shift in range(0, 7 * MAX_VARINT_BYTES, 7):
            byte = self.byte()
            value |= (byte & 0x7F) << shift
            if byte < 0x80:
                return value
        raise PacketError(f"a number in the header is longer than {MAX_VARINT_BYTES} bytes")

    def signed(self) -> int:
        """The next signed varint."""
        value = self.varint()
        return -(value + 1) // 2 if value & 1 else value // 2

    def real(self) -> float:
        """The next real; PacketError unless finite."""
        form = self.byte()
        if form < _SMALL_COUNT:
            return float(form - _SMALL_OFFSET)
        if form < _FLOAT32:
            return float(self.signed() / 10 ** (form - _DECIMAL))
        if form > _FLOAT64:
            raise PacketError(f"a number in the header has the unknown form {form}")
        value: float = struct.unpack("<f" if form == _FLOAT32 else "<d", self.take(4 if form == _FLOAT32 else 8))[0]
        if not math.isfinite(value):
            raise PacketError("a number in the header is not finite")
        return value

    def interval(self) -> Interval:
        """The next interval; PacketError unless it has finite bounds and an extent."""
        interval = Interval(self.signed(), self.signed(), self.varint())
        far = not -_MAX_EXPONENT < interval.exponent <= _MAX_EXPONENT
        if far or abs(interval.low) >= _EXACT or not 0 < interval.divisions < _EXACT:
            raise PacketError("a quantisation interval in the header is out of bounds")
        try:
            low, high = interval.bounds
        except OverflowError as error:
            raise PacketError("a quantisation interval in the header exceeds a double") from error
        if not 0 < high - low < math.inf:
            raise PacketError("a quantisation interval in the header has no extent")
        return interval
