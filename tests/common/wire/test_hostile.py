"""Bodies made to hurt: they cost little and end in our errors, or in packets found damaged."""

from __future__ import annotations

import contextlib
import tracemalloc
import zlib
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.errors import WireError
from common.surface import FeatureSet, Region
from common.wire import PacketDecoder, Reassembly, WireOptions, encode, split
from common.wire.framing import frame

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
