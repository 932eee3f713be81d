"""What every packet of a transmission says of it, so that each can be decoded alone.

The layout is the specification's (docs/wire.md); `Header.lead` and `Header.rest` write it, `Header.parse` reads it.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from enum import IntEnum

from common.errors import LimitError, PacketError, ParameterError, VersionError
from common.surface import FEATURE_KINDS, UNITS, FeatureKind, Region, Units
from common.wire.cells import Cells
from common.wire.limits import (
    MAX_BITS,
    MAX_CELLS_A_SIDE,
    MAX_CELLS_PER_PACKET,
    MAX_PACKETS,
    MIN_BITS,
    MIN_POINT_BITS,
)
from common.wire.numbers import Interval, Reader, write_real, write_varint

VERSION = 1

_KIND = 0b0000_0011
_HAS_GAP = 0b0000_0100
_HAS_UNITS = 0b0000_1000
_HAS_BOX = 0b0001_0000
_HAS_PARITY = 0b0010_0000
_ALTERED = 0b0100_0000
_RESERVED = 0b1000_0000

_TAG_BYTES = 3
_NO_UNITS = Units()


class Form(IntEnum):
    """How the points of a packet are written."""

    FLOAT64 = 0
    FLOAT32 = 1
    QUANTISED = 2
    COMPACT = 3
    LATTICE = 4
    COMPACT_LATTICE = 5


LATTICES = frozenset({Form.LATTICE, Form.COMPACT_LATTICE})
COMPACTS = frozenset({Form.COMPACT, Form.COMPACT_LATTICE})
_OWN_CELLS = 0b1000_0000
_FLOATING = frozenset({Form.FLOAT64, Form.FLOAT32})

MIN_CELL_BITS = 3
MAX_CELL_BITS = 16
"""Bits of a position in its cell: at least the eighth that it lies in, at most what a word of the coder holds."""


def transmission_tag(transmission: str) -> int:
    """The number that stands for a transmission's id in its packets: the low 24 bits of the CRC-32 of its UTF-8."""
    return zlib.crc32(transmission.encode()) & (1 << 8 * _TAG_BYTES) - 1


@dataclass(frozen=True, slots=True)
class Grid:
    """The grid of quantised coordinates.

    Parameters
    ----------
    position_bits : int
        Bits of x and of y: over the region, or over a cell where there are cells; 0 on a lattice.
    height_bits : int
        Bits of z.
    x, y : Interval or None
        What the positions are quantised over; None is the region.
    z : Interval
        What the heights are quantised over.
    cells : Cells or None
        The cells that positions are relative to, or whose points a lattice consists of.
    centred : bool
        Whether the points of a lattice are the centres of the cells; if not, they divide the region from edge to edge.
    """

    position_bits: int
    height_bits: int
    z: Interval
    x: Interval | None = None
    y: Interval | None = None
    cells: Cells | None = None
    centred: bool = False

    def ranges(self, region: Region) -> tuple[tuple[float, float, int], ...]:
        """(low, high, bits) of x, y and z."""
        x = self.x.bounds if self.x else (region.x_min, region.x_max)
        y = self.y.bounds if self.y else (region.y_min, region.y_max)
        return (*x, self.position_bits), (*y, self.position_bits), (*self.z.bounds, self.height_bits)


@dataclass(frozen=True, slots=True)
class Header:
    """What the packets of a transmission have in common.

    Parameters
    ----------
    tag : int
        Stands for the transmission's id.
    total : int
        Packets that carry points, copies not counted.
    parity : int
        Packets that carry parity, copies not counted.
    region, gap, kind, units
        Those of the FeatureSet.
    form : Form
        How the points are written.
    grid : Grid or None
        For the forms that quantise.
    altered : bool
        Whether the points were changed on the way (by `repack`).
    """

    tag: int
    total: int
    region: Region
    form: Form
    gap: float | None = None
    kind: FeatureKind = "cloud"
    units: Units = _NO_UNITS
    parity: int = 0
    grid: Grid | None = None
    altered: bool = False

    @property
    def period(self) -> int:
        """Datagrams of one copy of the transmission."""
        return self.total + self.parity

    def grid_and_cells(self) -> tuple[Grid, Cells]:
        """The grid and its cells; raises PacketError where the form has none."""
        if self.grid is None or self.grid.cells is None:
            raise PacketError(f"the form {self.form.name} has no cells")
        return self.grid, self.grid.cells

    def about(self) -> tuple[object, ...]:
        """What must agree between packets of one transmission, whatever happened to their points."""
        return (self.tag, self.total, self.parity, self.region, self.gap, self.kind, self.units)

    def described(self) -> dict[str, str]:
        """All of it for people, by name; of points that were altered not how they were written."""
        about = {
            "packets": str(self.total),
            "packets of parity": str(self.parity),
            "region": ",".join(map(str, self.region.bounds)),
            "segment gap": "none" if self.gap is None else str(self.gap),
            "kind": self.kind,
            "unit of x and y": self.units.xy or "none",
            "unit of z": self.units.z or "none",
        }
        if self.altered:
            return about
        grid, coding = self.grid, self.form.name.lower().replace("_", " ")
        if grid is None:
            return about | {"precision": coding}
        written = {"precision": f"{grid.height_bits} bits", "coding": coding.replace("quantised", "plain")}
        written["bits of a position"] = str(grid.position_bits)
        for name, box in (("x", grid.x), ("y", grid.y), ("heights", grid.z)):
            written[f"range of {name}"] = "that of the region" if box is None else "{} to {}".format(*box.bounds)
        if grid.cells is not None:
            written["cells"] = f"{grid.cells.rows} x {grid.cells.columns}"
            written["lattice"] = "of centres" if grid.centred else "from edge to edge"
        return about | written

    def as_altered(self) -> Header:
        """The header of a packet whose points were changed on the way."""
        return replace(self, form=Form.FLOAT64, grid=None, altered=True)

    def lead(self) -> bytes:
        """The two bytes before the packet's number."""
        flags = FEATURE_KINDS.index(self.kind)
        flags |= _HAS_GAP * (self.gap is not None)
        flags |= _HAS_UNITS * (self.units != _NO_UNITS)
        flags |= _HAS_BOX * (self.grid is not None and self.grid.x is not None)
        flags |= _HAS_PARITY * (self.parity > 0)
        flags |= _ALTERED * self.altered
        return bytes([VERSION << 4 | self.form, flags])

    def rest(self) -> bytes:
        """The bytes between the packet's number and its points."""
        parts = [self.tag.to_bytes(_TAG_BYTES, "big"), write_varint(self.total)]
        if self.parity:
            parts.append(write_varint(self.parity))
        parts.extend(write_real(bound) for bound in self.region.bounds)
        if self.gap is not None:
            parts.append(write_real(self.gap))
        if self.units != _NO_UNITS:
            parts.append(bytes([UNITS.index(self.units.xy) << 4 | UNITS.index(self.units.z)]))
        if self.grid is not None:
            parts.append(_write_grid(self.grid))
        return b"".join(parts)

    @classmethod
    def parse(cls, lead: bytes, reader: Reader) -> Header:
        """The inverse of `lead` and `rest`; leaves `reader` at the points.

        Raises VersionError for a version, form or flag that is not known here, LimitError for more packets than are
        accepted, PacketError for values that contradict each other.
        """
        version, form_number, flags = lead[0] >> 4, lead[0] & 0x0F, lead[1]
        if version != VERSION:
            raise VersionError(f"a packet is of version {version}; this end reads version {VERSION}")
        if form_number not in Form.__members__.values() or flags & _RESERVED:
            raise VersionError(f"a packet is of the unknown form {form_number} or has unknown flags {flags:#04x}")
        form = Form(form_number)
        tag = int.from_bytes(reader.take(_TAG_BYTES), "big")
        total = reader.varint()
        parity = reader.varint() if flags & _HAS_PARITY else 0
        if total > MAX_PACKETS or parity > MAX_PACKETS:
            raise LimitError(
                f"a packet claims {total} packets and {parity} of parity; at most {MAX_PACKETS} are accepted"
            )
        if not total or (flags & _HAS_PARITY and not parity):
            raise PacketError("a packet claims to be one of none")
        bounds = [reader.real() for _ in range(4)]
        gap = reader.real() if flags & _HAS_GAP else None
        if gap is not None and gap <= 0:
            raise PacketError(f"a packet has the segment gap {gap:g}; it must be positive")
        units = _NO_UNITS
        if flags & _HAS_UNITS:
            xy, z = divmod(reader.byte(), 16)
            if max(xy, z) >= len(UNITS):
                raise VersionError(f"a packet names an unknown unit, number {max(xy, z)}")
            units = Units(UNITS[xy], UNITS[z])
        try:
            region = Region(*bounds)
        except ParameterError as error:
            raise PacketError(f"a packet has an impossible region: {error}") from error
        if flags & _HAS_BOX and (form in LATTICES or form in _FLOATING):
            raise PacketError("a packet has a quantisation box, but its positions are not quantised")
        grid = None
        if form not in _FLOATING:
            grid = _parse_grid(reader, form, region, gap, boxed=bool(flags & _HAS_BOX))
            _require_few(grid, total)
        kind = FEATURE_KINDS[flags & _KIND]
        return cls(tag, total, region, form, gap, kind, units, parity, grid, bool(flags & _ALTERED))


def _write_grid(grid: Grid) -> bytes:
    own_cells = grid.cells if grid.cells and grid.cells.side is None else None
    first = grid.position_bits | _OWN_CELLS * (own_cells is not None) | grid.centred
    parts = [bytes([first, grid.height_bits]), *(box.to_bytes() for box in (grid.x, grid.y) if box), grid.z.to_bytes()]
    if own_cells:
        parts += [write_varint(own_cells.rows), write_varint(own_cells.columns)]
    return b"".join(parts)


def _parse_grid(reader: Reader, form: Form, region: Region, gap: float | None, *, boxed: bool) -> Grid:
    first, height_bits = reader.byte(), reader.byte()
    if not MIN_BITS <= height_bits <= MAX_BITS:
        raise PacketError(f"heights of {height_bits} bits; accepted are {MIN_BITS} to {MAX_BITS}")
    x, y = (reader.interval(), reader.interval()) if boxed else (None, None)
    z = reader.interval()
    if form is Form.QUANTISED:
        if not MIN_BITS <= first <= MAX_BITS:
            raise PacketError(f"positions of {first} bits; accepted are {MIN_BITS} to {MAX_BITS}")
        if 2 * first + height_bits < MIN_POINT_BITS:
            raise PacketError(f"points of {2 * first + height_bits} bits; accepted are {MIN_POINT_BITS} or more")
        return Grid(first, height_bits, z, x, y)
    if not first & _OWN_CELLS and gap is None:
        raise PacketError("a packet refers to the pieces of a segment gap, but has none")
    cells = _parse_cells(reader, region, None if first & _OWN_CELLS else gap)
    bits = first & ~_OWN_CELLS
    if form in LATTICES:
        if bits > 1 or cells.side is not None:
            raise PacketError("a packet describes an impossible lattice")
        return Grid(0, height_bits, z, cells=cells, centred=bool(bits))
    if not MIN_CELL_BITS <= bits <= MAX_CELL_BITS:
        raise PacketError(f"positions of {bits} bits in a cell; accepted are {MIN_CELL_BITS} to {MAX_CELL_BITS}")
    return Grid(bits, height_bits, z, x, y, cells)


def _parse_cells(reader: Reader, region: Region, gap: float | None) -> Cells:
    if gap is None:
        cells = Cells(reader.varint(), reader.varint())
    else:
        try:
            cells = Cells(*region.pieces(gap), gap)
        except ParameterError as error:
            raise PacketError(f"a packet has an impossible segment gap: {error}") from error
    if not 0 < min(cells.rows, cells.columns) <= max(cells.rows, cells.columns) <= MAX_CELLS_A_SIDE:
        raise PacketError(f"a packet has {cells.rows} x {cells.columns} cells; accepted are 1 to {MAX_CELLS_A_SIDE}")
    return cells


def _require_few(grid: Grid, total: int) -> None:
    if grid.cells is not None:
        most = grid.cells.most_per_packet(total)
        if most > MAX_CELLS_PER_PACKET:
            raise PacketError(f"a packet has {most} cells, more than are accepted")
