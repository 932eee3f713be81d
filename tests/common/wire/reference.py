"""A second decoder of intact packets, written from docs/wire.md and nothing else: slow, plain, one number at a time."""

from __future__ import annotations

import math
import struct
import zlib
from typing import Any

Point = tuple[float, float, float]


class Bytes:
    """Takes things off the front."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def take(self, n: int) -> bytes:
        taken, self.data = self.data[:n], self.data[n:]
        return taken

    def u(self, n: int = 1) -> int:
        return int.from_bytes(self.take(n), "big")

    def varint(self) -> int:
        byte = self.u()
        return byte if byte < 128 else byte - 128 + 128 * self.varint()

    def signed(self) -> int:
        v = self.varint()
        return v // 2 if v % 2 == 0 else -(v + 1) // 2

    def real(self) -> float:
        b = self.u()
        if b < 192:
            return float(b - 64)
        if b < 215:
            return float(self.signed() / 10 ** (b - 192))
        value = struct.unpack("<f" if b == 215 else "<d", self.take(4 if b == 215 else 8))[0]
        return float(value)

    def interval(self) -> tuple[float, float]:
        e, low, divisions = self.signed(), self.signed(), self.varint()
        return math.ldexp(low, e), math.ldexp(low + divisions, e)


class Bits:
    """Takes integers off a bit string."""

    def __init__(self, data: bytes) -> None:
        self.text = "".join(f"{byte:08b}" for byte in data)

    def take(self, n: int) -> int:
        taken, self.text = self.text[:n], self.text[n:]
        return int(taken, 2)


def payload_of(datagram: bytes) -> bytes:
    """Sections 1 and 7, of an intact datagram."""
    stream = Bytes(datagram)
    length = stream.u(1 if stream.u() == 0xC7 else 2)
    coded = stream.u() == 0x2C
    assert len(stream.data) == length
    if coded:
        stream.u()
        return stream.take(stream.u(2))
    return stream.data


def read(datagram: bytes) -> dict[str, Any]:
    """What a packet says; `points` are its points, `block` its block."""
    payload = payload_of(datagram)
    assert zlib.crc32(payload[:-4]) == int.from_bytes(payload[-4:], "big")
    s = Bytes(payload[:-4])
    version, form = divmod(s.u(), 16)
    assert version == 1
    flags = s.u()
    said: dict[str, Any] = {"form": form, "kind": ("extrema", "cloud", "lattice", "greedy")[flags & 3]}
    said["number"], said["tag"], said["total"] = s.varint(), s.u(3), s.varint()
    said["parity"] = s.varint() if flags & 32 else 0
    region = s.real(), s.real(), s.real(), s.real()
    said["region"] = region
    said["gap"] = s.real() if flags & 4 else None
    units = ("", "m", "km", "cm", "mm", "um", "nm", "ft", "deg")
    xy, z = divmod(s.u(), 16) if flags & 8 else (0, 0)
    said["units"] = units[xy], units[z]
    x_range, y_range = region[:2], region[2:]
    if form >= 2:
        p, h = s.u(), s.u()
        if flags & 16:
            x_range, y_range = s.interval(), s.interval()
        z_range = s.interval()
        if form >= 3:
            own, p = divmod(p, 128)
            width, height = x_range[1] - x_range[0], y_range[1] - y_range[0]
            if own:
                rows, columns = s.varint(), s.varint()
                sides = width / columns, height / rows
            else:
                columns, rows = (max(1, math.ceil(side / said["gap"] * (1 - 1e-9))) for side in (width, height))
                sides = said["gap"], said["gap"]
    said["block"] = block = s.data
    sequence = said["number"] % (said["total"] + said["parity"])
    if sequence >= said["total"]:
        return said
    points: list[Point] = []
    if form < 2:
        points = list(struct.iter_unpack("<ddd" if form == 0 else "<fff", block))
    elif form == 2:
        bits = Bits(block)
        for _ in range(8 * len(block) // (2 * p + h)):
            points.append(
                (value(bits.take(p), x_range, p), value(bits.take(p), y_range, p), value(bits.take(h), z_range, h))
            )
    else:
        own_cells = [
            (r, c)
            for r in range(rows)
            for c in range(columns)
            if (c + skew(said["total"]) * r) % said["total"] == sequence
        ]
        if form == 4:
            bits = Bits(block)
            steps = [(c, r, bits.take(h)) for r, c in own_cells]
        else:
            steps = message(block, own_cells, None if form == 5 else p, h)
        for a, b, height_step in steps:
            if form == 3:
                x = x_range[0] + (a + 0.5) * (sides[0] / 2**p)
                y = y_range[0] + (b + 0.5) * (sides[1] / 2**p)
            elif p == 1:
                x, y = x_range[0] + (a + 0.5) * sides[0], y_range[0] + (b + 0.5) * sides[1]
            else:
                x = x_range[0] + a * width / max(1, columns - 1)
                y = y_range[0] + b * height / max(1, rows - 1)
            points.append((x, y, value(height_step, z_range, h)))
    said["points"] = points
    return said


def value(s: int, limits: tuple[float, float], bits: int) -> float:
    low, high = limits
    return min(low + s * ((high - low) / ((1 << bits) - 1)), high)


def skew(total: int) -> int:
    s = max(1, round(0.6180339887498949 * total))
    while math.gcd(s, total) != 1:
        s += 1
    return s


def frequencies(weights: list[int]) -> list[int]:
    found = [max(1, w * 4096 // sum(weights)) for w in weights]
    found[found.index(max(found))] += 4096 - sum(found)
    return found


C = [
    frequencies(list(row))
    for row in (
        (1, 1, 1, 1),
        (20, 4056, 16, 4),
        (16, 40, 4024, 16),
        (200, 500, 3200, 196),
        (607, 303, 76, 14),
        (368, 368, 184, 80),
        (135, 271, 271, 323),
        (900, 70, 25, 5),
    )
]
N = [frequencies([1, 1]), frequencies([31, 1])]
weights = [65536]
for _ in range(31):
    weights.append(weights[-1] * 3 // 4)
M = frequencies([w + 64 for w in weights])


def eighths(k: int, first: int | None) -> list[int]:
    a = [65536]
    for _ in range(7):
        a.append(a[-1] * (8 - k) // 8)
    if first is None:
        return frequencies([a[b] + a[7 - b] + 1 for b in range(8)])
    if first >= 4:
        mirrored = [0] * 8
        e = (1, 3, 7, 14)[7 - first]
        for b in range(8):
            mirrored[7 - b] = e * a[b] + (32 - e) * a[7 - b] + 1
        return frequencies(mirrored)
    e = (1, 3, 7, 14)[first]
    return frequencies([e * a[b] + (32 - e) * a[7 - b] + 1 for b in range(8)])


class Coder:
    """Section 5, the coder."""

    def __init__(self, data: bytes) -> None:
        self.stream = Bytes(data)
        self.state = self.stream.u(4 if len(data) % 2 == 0 else 3)

    def refill(self) -> None:
        if self.state < 65536 and self.stream.data:
            self.state = 65536 * self.state + self.stream.u(2)

    def symbol(self, table: list[int]) -> int:
        slot, symbol, start = self.state % 4096, 0, 0
        while start + table[symbol] <= slot:
            start += table[symbol]
            symbol += 1
        self.state = table[symbol] * (self.state // 4096) + slot - start
        self.refill()
        return symbol

    def raw(self, bits: int) -> int:
        if bits > 16:
            return self.raw(bits - 16) << 16 | self.raw(16)
        found = self.state % (1 << bits)
        self.state >>= bits
        self.refill()
        return found


def message(block: bytes, own_cells: list[tuple[int, int]], q: int | None, h: int) -> list[tuple[int, int, int]]:
    """Section 5; without `q`, on a lattice."""
    parameters = int.from_bytes(block[:2], "big")
    t, k, f, g = parameters >> 13, parameters >> 10 & 7, parameters >> 5 & 31, parameters & 31
    coder = Coder(block[2:])
    cells = []
    for cell in own_cells:
        count = symbol = 1 if q is None else coder.symbol(C[t])
        while symbol == 3:
            symbol = coder.symbol(C[t])
            count += symbol
        cells += [(cell, place) for place in range(count)]
    positions = []
    before = (0, 0)
    for (row, column), place in cells:
        if q is None:
            positions.append((column, row))
            continue
        tables = [
            eighths(k, None) if place == 0 else eighths(k, before[axis]) if place == 1 else [512] * 8 for axis in (0, 1)
        ]
        before = coder.symbol(tables[0]), coder.symbol(tables[1])
        rest = coder.raw(2 * (q - 3))
        u = before[0] << q - 3 | rest >> q - 3
        v = before[1] << q - 3 | rest & (1 << q - 3) - 1
        positions.append((column << q | u, row << q | v))
    sums, weight_sums = [0.0] * len(cells), [0.0] * len(cells)
    heights: list[int] = []
    for i, (x, y) in enumerate(positions):
        place = cells[i][1]
        guess = math.floor(sums[i] / weight_sums[i]) if i else 1 << h - 1
        guess = max(min(guess, (1 << h) - 1), heights[-1] if place else 0)
        negative, bucket, scale = coder.symbol(N[min(place, 1)]), coder.symbol(M), g if place else f
        if bucket == 31:
            z = coder.raw(h)
        else:
            m = bucket << scale | coder.raw(scale)
            z = guess + (-1 - m if negative else m)
        heights.append(z)
        for j in range(i + 1, min(i + 65, len(cells))):
            dx, dy = float(positions[j][0] - x), float(positions[j][1] - y)
            d = dx * dx + dy * dy + 1.0
            w = 1.0 / (d * d)
            sums[j] += w * z
            weight_sums[j] += w
    assert coder.state == 0
    assert not coder.stream.data
    return [(x, y, z) for (x, y), z in zip(positions, heights, strict=True)]
