"""What the wire accepts at most; each number with its reason.

Nothing is ever allocated by a number that a body claims: only by bytes that are there and passed their checksum.
"""

from __future__ import annotations

MIN_DATAGRAM = 64
"""Bytes. Below this the header of a packet outweighs its points."""

MAX_DATAGRAM = 1400
"""Bytes. Fits the 1,500 of an Ethernet frame with the headers of IP, UDP and a tunnel, so no datagram is fragmented."""

DEFAULT_DATAGRAM = 256
"""Bytes. About what radio modems carry in one frame; four in five survive a bit-error rate of 1e-4."""

MAX_POINTS_PER_PACKET = 2_000
"""Points. As float64, the widest form, they still fit the 65,535 bytes that the length field of a packet can say."""

MAX_COMPACT_POINTS = 512
"""Points of a packet whose points are entropy-coded: more than fit the longest datagram unless hardly anything is said
of each. Alone, a packet of so many takes most of a tenth of a second; among others, less than a millisecond."""

MAX_CELLS_PER_PACKET = 4_096
"""Cells of a compact packet, empty ones included; a sender makes them so large that half of them hold points."""

MAX_CELLS_A_SIDE = 4_096
"""Cells, or nodes of a lattice, along x and along y: sixteen million in all."""

MAX_PACKETS = 262_144
"""Packets of one transmission, without parity and copies: four million points at 256 bytes a packet."""

MAX_POINTS = 4_000_000
"""Points of one transmission: 96 MB of coordinates at the receiver."""

MAX_DECODING_WORK = 13 * MAX_POINTS
"""Symbols that a decoder reads of entropy-coded packets, as `Effort` counts them; a point counts as eight. A packet of
30 bytes may hold 4,096 empty cells, or 512 points that say nothing, so bytes alone bound no time. Lattices take 8 for
each point, clouds and extrema 9 to 11, the track of a ship 12; the most points take about ten seconds."""

MAX_BODY = 128 * 1024 * 1024
"""Bytes fed to one decoder: the most points, in the widest form."""

MAX_COPIES = 8
"""Times a packet is sent; a link that needs more is better served by parity or by asking again."""

MAX_PARITY = 2.0
"""Packets of parity for each with points; beyond, copies do as well."""

MIN_BITS = 2
MAX_BITS = 32
"""Bits of a quantised coordinate. Beyond 32, float64 is as short."""

MIN_POINT_BITS = 8
"""Bits of a quantised point of a packet without cells. In fewer the zeros that fill up a block would be a point."""

MAX_FALSE_STARTS = 32
"""Bytes that a decoder checks in vain, as a multiple of the bytes fed to it (with `FALSE_START_GRACE` on top).

A look-alike of a packet's start claims a length, and the checksum over that length has to be computed to refute it. In
noise one byte in 32,768 starts a look-alike; only a body made to be slow comes near to this bound.
"""

MAX_CORRECTION_WORK = 2**18
"""Bytes of parity that a decoder works through to correct damaged datagrams of the inner code: 4,096 code words with 64
bytes of parity each, which is a megabyte of datagrams and takes most of a second. What is beyond counts as damaged."""

FALSE_START_GRACE = 1024 * 1024
"""Bytes, see `MAX_FALSE_STARTS`: keeps short bodies clear of the bound whatever they hold."""
