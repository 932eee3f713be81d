"""Bodies made to hurt: they cost little and end in our errors, or in packets found damaged."""

from __future__ import annotations

import contextlib
import tracemalloc
import zlib
from collections.abc import Callable
from itertools import zip_longest
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.channel import Channel
from common.errors import LimitError, WireError
from common.surface import BoolArray, FeatureSet, IntArray, Region
from common.wire import PacketDecoder, Reassembly, WireOptions, encode, rans, split
from common.wire.cells import Cells
from common.wire.framing import frame
from common.wire.header import Form, Grid, Header
from common.wire.limits import MAX_DECODING_WORK, MAX_POINTS
from common.wire.numbers import Interval
from common.wire.packet import write_datagrams

MEGABYTE = 1_000_000
BUDGET = 50_000_000
SHARE = 5
"""Memory is traced on a fifth of each body, against a fifth of the budget; benchmarks/wire.py takes all of it."""

FEATURES = FeatureSet(np.random.default_rng(0).uniform(-1, 1, (60, 3)), Region(-1.0, 1.0, -1.0, 1.0), 0.4, "extrema")


def lying_lengths() -> bytes:
    return b"\xc8\xff\xff\x53" * (MEGABYTE // 4)


def lying_short_lengths() -> bytes:
    return b"\xc7\xff\x53" * (MEGABYTE // 3)


def coded_starts() -> bytes:
    (datagram,) = encode(
        FeatureSet(FEATURES.points[:9], FEATURES.region), transmission="t", options=WireOptions(inner=64)
    )
    harmed = bytearray(datagram)
    harmed[20:100] = bytes(80)
    return bytes(harmed) * (MEGABYTE // len(harmed))


def wrong_total() -> bytes:
    """Intact packets, each of another transmission of 262,144 packets."""
    datagrams = []
    for i in range(MEGABYTE // 40):
        payload = (
            bytes.fromhex("1001") + bytes([0]) + i.to_bytes(3, "big") + bytes.fromhex("808010") + b"\x3f\x41\x3f\x41"
        )
        payload += bytes(24)
        datagrams.append(frame([payload + zlib.crc32(payload).to_bytes(4, "big")])[0])
    return b"".join(datagrams)


def hollow(form: Form, rows: int, columns: int, count: int) -> list[bytes]:
    """Entropy-coded packets of 30 bytes, each of another transmission, that hold many cells and say nothing of them."""
    z = Interval.covering(0.0, 1.0)
    assert z is not None
    grid = Grid(0 if form is Form.COMPACT_LATTICE else 7, 16, z, cells=Cells(rows, columns))
    headers = [Header(tag, 1, FEATURES.region, form, grid=grid) for tag in range(count)]
    return [write_datagrams(header, [bytes(5)])[0] for header in headers]


HOSTILE: dict[str, Callable[[], bytes]] = {
    "deep nesting": lambda: b"\x91" * MEGABYTE,
    "deep maps": lambda: b"\x81\xc0" * (MEGABYTE // 2),
    "empty maps": lambda: b"\x80" * MEGABYTE,
    "lying array": lambda: b"\xdd\xff\xff\xff\xff" * (MEGABYTE // 5),
    "lying binary": lambda: b"\xc6\xff\xff\xff\xff" * (MEGABYTE // 5),
    "lying extension": lambda: b"\xc9\xff\xff\xff\xff\x53" * (MEGABYTE // 6),
    "lying lengths": lying_lengths,
    "lying short lengths": lying_short_lengths,
    "coded starts": coded_starts,
    "wrong total": wrong_total,
    "zeros": lambda: bytes(MEGABYTE),
    "noise": lambda: np.random.default_rng(1).bytes(MEGABYTE),
}
"""A megabyte of each."""


def receive(body: bytes) -> tuple[int, int]:
    """Packets of the transmission "t" and packets found damaged, the way a receiver finds them."""
    with contextlib.suppress(WireError):
        split(body)
    decoder, reassembly, known = PacketDecoder(), Reassembly("t"), 0
    for packet in decoder.feed(body) + decoder.close():
        known += reassembly.add(packet) != "foreign"
    return known, decoder.damaged


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_body_costs_little(name: str) -> None:
    body = HOSTILE[name]()[: MEGABYTE // SHARE]
    tracemalloc.start()
    try:
        known, damaged = receive(body)
        assert known == 0
        assert damaged > 0 or name == "wrong total"
    except WireError:
        pass
    finally:
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    assert peak < BUDGET / SHARE


def test_a_damaged_packet_is_never_accepted() -> None:
    """Every single bit flip, and many double ones, of a packet of every form."""
    rng = np.random.default_rng(2)
    for choice in ({}, {"precision": "float64"}, {"coding": "compact"}, {"inner": 16}):
        datagram = encode(FEATURES, transmission="t", options=WireOptions.model_validate(choice))[0]
        bits = np.unpackbits(np.frombuffer(datagram, dtype=np.uint8))
        flips = np.arange(bits.size)
        first, second = rng.integers(0, bits.size, (2, 4000))
        pairs = np.column_stack([first, second])[first != second]
        if "inner" in choice:
            # The inner code puts them right: what is accepted then is the packet that was sent.
            pairs, flips = pairs[:100], flips[:: bits.size // 100]
        for places in (flips[:, None], pairs):
            harmed = np.repeat(bits[None], len(places), axis=0)
            np.put_along_axis(harmed, places, 1 - np.take_along_axis(harmed, places, axis=1), axis=1)
            bodies = np.packbits(harmed, axis=1)
            decoder = PacketDecoder()
            found = decoder.feed(bodies.tobytes()) + decoder.close()
            if "inner" in choice:
                (sent,) = PacketDecoder().feed(datagram)
                assert all(packet.block == sent.block for packet in found)
                assert len(found) >= len(places) - 1
            else:
                assert not found
                assert decoder.damaged > 0


@settings(max_examples=80)
@given(st.data())
def test_damaged_bodies_of_any_form_yield_packets_or_our_error(data: st.DataObject) -> None:
    choices: list[dict[str, object]] = [{"coding": "compact"}, {"inner": 16}, {"parity": 0.5}, {"precision": "float32"}]
    options = WireOptions.model_validate({"datagram": 110, **data.draw(st.sampled_from(choices))})
    datagrams = encode(FEATURES, transmission="t", options=options)
    body = bytearray(b"".join(datagrams))
    for place, mask in data.draw(st.lists(st.tuples(st.integers(0, len(body) - 1), st.integers(1, 255)), max_size=9)):
        body[place] ^= mask
    start, stop = sorted(data.draw(st.tuples(st.integers(0, len(body)), st.integers(0, len(body)))))
    if data.draw(st.booleans()):
        del body[start:stop]
    decoder, reassembly = PacketDecoder(), Reassembly("t")
    try:
        for packet in decoder.feed(bytes(body)) + decoder.close():
            assert packet.block == PacketDecoder().feed(datagrams[packet.number])[0].block
            reassembly.add(packet)
        _ = reassembly.missing, reassembly.points, decoder.damaged
    except WireError:
        pass


@settings(max_examples=300)
@given(st.data())
def test_any_payload_with_a_right_checksum_yields_a_packet_or_our_error(data: st.DataObject) -> None:
    """Beyond the checksum: whatever a header says, however absurd, is read, counted as damaged or refused."""
    form = data.draw(st.integers(0, 6))
    flags = data.draw(st.integers(0, 127))
    head = bytes([0x10 | form, flags, 0]) + bytes(3) + bytes([1])
    region = b"\x3f\x41\x3f\x41" if data.draw(st.booleans()) else data.draw(st.binary(min_size=4, max_size=36))
    payload = head + region + data.draw(st.binary(min_size=10, max_size=120))
    decoder = PacketDecoder()
    try:
        packets = decoder.feed(frame([payload + zlib.crc32(payload).to_bytes(4, "big")])[0]) + decoder.close()
        assert len(packets) + decoder.damaged == 1
        for packet in packets:
            assert np.all(np.isfinite(packet.points))
            Reassembly("t").add(packet)
    except WireError:
        pass


@pytest.fixture
def symbols(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Packets in each step of the entropy decoder."""
    steps: list[int] = []
    symbol = rans.Reader.symbol

    def counted(self: rans.Reader, model: rans.Tables, table: IntArray, value: IntArray, active: BoolArray) -> IntArray:
        steps.append(len(active))
        return symbol(self, model, table, value, active)

    monkeypatch.setattr(rans.Reader, "symbol", counted)
    return steps


HOLLOW = {"points": (Form.COMPACT_LATTICE, 16, 32), "cells": (Form.COMPACT, 64, 64)}


@pytest.mark.parametrize("name", HOLLOW)
def test_packets_with_a_header_each_are_decoded_together(name: str, symbols: list[int]) -> None:
    one, *_ = bodies = hollow(*HOLLOW[name], count=100)
    PacketDecoder().feed(one)
    alone = len(symbols)
    symbols.clear()
    assert len(PacketDecoder().feed(b"".join(bodies))) == 100
    assert len(symbols) == alone


def test_a_channel_decodes_packets_together_where_one_is_damaged(symbols: list[int]) -> None:
    datagrams = hollow(*HOLLOW["points"], count=100)
    delivery = Channel.parse("gaussian:std=0.1").transmit([*datagrams, b"noise"], transmission="t")
    assert delivery.counts == {"gaussian": 100}
    assert len(symbols) <= 2 * 512


@pytest.mark.parametrize("name", HOLLOW)
@pytest.mark.parametrize("size", [1, 7, 100])
def test_what_a_body_takes_to_decode_is_bounded_however_it_is_fed(
    name: str, size: int, monkeypatch: pytest.MonkeyPatch, symbols: list[int]
) -> None:
    datagrams = hollow(*HOLLOW[name], count=20)

    def feed(most: int) -> None:
        monkeypatch.setattr("common.wire.compact.MAX_DECODING_WORK", most)
        decoder = PacketDecoder()
        for start in range(0, 20, size):
            decoder.feed(b"".join(datagrams[start : start + size]))

    # 512 points of eight symbols; or 4,096 cells, and no more than the look at their points.
    work = 20 * (4096 if name == "points" else 4096 + 8)
    feed(work)
    symbols.clear()
    with pytest.raises(LimitError, match="symbols to decode"):
        feed(work - 1)
    assert sum(symbols) < work


def track(n: int) -> FeatureSet:
    """`n` points along a line that meanders, dense in few cells."""
    x = np.linspace(-1, 1, n)
    return FeatureSet(np.column_stack([x, np.sin(40 * x), np.random.default_rng(4).normal(size=n)]), FEATURES.region)


def spread_out(n: int) -> FeatureSet:
    """`n` points at random places, all of one height."""
    return FeatureSet(np.column_stack([np.random.default_rng(5).uniform(-1, 1, (n, 2)), np.zeros(n)]), FEATURES.region)


@pytest.mark.parametrize(
    ("features", "options"),
    [
        (track(150_000), {"datagram": 1400}),
        (track(150_000), {"datagram": 1400, "copies": 2}),
        (spread_out(60_000), {"datagram": 96}),
        (spread_out(60_000), {"datagram": 256, "precision": 4}),
        (spread_out(60_000), {"datagram": 1400, "precision": 24}),
    ],
    ids=["track", "copies", "short datagrams", "few bits", "long datagrams"],
)
def test_the_most_points_are_decoded_within_the_bound(
    features: FeatureSet, options: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("common.wire.compact.MAX_DECODING_WORK", MAX_DECODING_WORK * len(features) // MAX_POINTS)
    datagrams = encode(features, transmission="t", options=WireOptions(coding="compact", **options))
    packets = PacketDecoder().feed(b"".join(datagrams))
    assert packets[0].header.form == Form.COMPACT
    assert len(packets) == len(datagrams)
    copies = options.get("copies", 1)
    assert sum(len(packet.points) for packet in packets) == copies * len(features)


@pytest.mark.parametrize("size", [1, 4, 100])
def test_copies_cost_nothing_and_are_the_same(size: int, monkeypatch: pytest.MonkeyPatch, symbols: list[int]) -> None:
    datagrams = encode(FEATURES, transmission="t", options=WireOptions(coding="compact", datagram=96, copies=3))
    once = len(datagrams) // 3
    steps = []
    for feeds in (datagrams[:once], datagrams):
        symbols.clear()
        decoder = PacketDecoder()
        packets = [p for i in range(0, len(feeds), size) for p in decoder.feed(b"".join(feeds[i : i + size]))]
        steps.append(sum(symbols))
    assert steps[0] == steps[1]
    assert [packet.number for packet in packets] == list(range(3 * once))
    for packet in packets:
        assert np.array_equal(packet.points, packets[packet.sequence].points)
        assert packet.points.size


def test_what_a_channel_cannot_decode_within_bounds_is_no_packet(monkeypatch: pytest.MonkeyPatch) -> None:
    datagrams = hollow(*HOLLOW["points"], count=20)
    monkeypatch.setattr("common.wire.compact.MAX_DECODING_WORK", 20 * 4096 - 1)
    delivery = Channel.parse("gaussian:std=0.1").transmit(datagrams, transmission="t")
    assert delivery.packets == tuple(datagrams)


def test_what_parity_rebuilds_is_decoded_together(symbols: list[int]) -> None:
    """Every code word loses a packet."""
    features = FeatureSet(np.random.default_rng(3).uniform(-1, 1, (3000, 3)), FEATURES.region)
    datagrams = encode(features, transmission="t", options=WireOptions(coding="compact", datagram=96, parity=2.0))
    reassembly = Reassembly("t")
    packets = PacketDecoder().feed(b"".join(datagrams))
    total = packets[0].total
    for packet in packets[3:]:
        reassembly.add(packet)
    symbols.clear()
    assert reassembly.complete
    assert reassembly.rebuilt == 3
    assert set(symbols) == {3}
    assert len(packets) > 2 * 256 > total


def test_packets_of_several_compact_forms_in_a_body_are_told_apart() -> None:
    lattice = np.stack([axis.ravel() for axis in np.meshgrid(*[np.linspace(-1, 1, 20)] * 2)], axis=1)
    sets = [
        FeatureSet(np.column_stack([lattice, np.sign(lattice[:, 0])]), FEATURES.region, kind="lattice"),
        FEATURES,
        FeatureSet(10 * FEATURES.points, Region(-10.0, 10.0, -10.0, 10.0)),
    ]
    options = [
        WireOptions(coding="compact", datagram=size, precision=bits) for size, bits in ((256, 16), (80, 16), (80, 9))
    ]
    each = [encode(features, transmission="t", options=how) for features, how in zip(sets, options, strict=True)]
    mixed = [datagram for row in zip_longest(*each) for datagram in row if datagram]
    found = PacketDecoder().feed(b"".join(mixed))
    assert {packet.header.form for packet in found} == {Form.COMPACT_LATTICE, Form.COMPACT}
    expected = {datagram: PacketDecoder().feed(datagram)[0].points for datagram in mixed}
    for datagram, packet in zip(mixed, found, strict=True):
        assert np.array_equal(packet.points, expected[datagram])
