"""Bodies to datagrams, and the two headers."""

from __future__ import annotations

import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.channel import Channel, Delivery
from common.channel.carrying import References, attempt_of, carry, datagrams_of, faults_header, transmission_of
from common.errors import ParameterError
from common.surface import FeatureSet, FloatArray, Region
from common.wire import WireOptions, encode


def test_a_body_is_cut_into_its_datagrams(few_packets: list[bytes]) -> None:
    assert datagrams_of(b"".join(few_packets)) == few_packets
    assert datagrams_of(b"") == []


def test_a_damaged_body_of_coded_packets_is_cut_where_they_start(points: FloatArray) -> None:
    features = FeatureSet(points[:200], Region(-1, 1, -1, 1))
    packets = encode(features, transmission="hills", options=WireOptions(inner=16))
    body = b"".join([b"noise", *packets])
    assert datagrams_of(body) == [b"noise", *packets]


def test_a_damaged_body_loses_no_more_datagrams_than_were_damaged(few_packets: list[bytes]) -> None:
    broken = [*few_packets[:3], b"\x00noise", few_packets[3][:20], *few_packets[4:], few_packets[0][:-1]]
    found = datagrams_of(b"".join(broken))
    assert b"".join(found) == b"".join(broken)
    # The length that the cut one claims reaches into the next.
    assert set(found) >= {*few_packets[:3], *few_packets[6:]}


@given(st.binary(max_size=300) | st.lists(st.sampled_from([b"\xc7", b"\x20", b"\x53", b"\xc8", b"\x00"])).map(b"".join))
def test_the_datagrams_of_any_body_are_the_body(body: bytes) -> None:
    datagrams = datagrams_of(body)
    assert b"".join(datagrams) == body
    assert all(datagrams)


def test_channels_in_a_row_each_harm_packets(few_packets: list[bytes]) -> None:
    body = b"".join(few_packets)
    once = carry(Channel.parse("bit_errors:ber=1e-3;truncation:p=0.1"), body, transmission="hills").body
    twice = carry(Channel.parse("erasure:p=0.5"), once, transmission="hills")
    assert 0.3 < len(twice.body) / len(once) < 0.7


def test_channels_of_one_seed_in_a_row_draw_apart(few_packets: list[bytes]) -> None:
    channel, body = Channel.parse("erasure:p=0.5"), b"".join(few_packets)
    once = carry(channel, body, transmission="hills")
    twice = carry(channel, once.body, transmission="hills", passed=1)
    assert 0.3 < len(twice.packets) / len(once.packets) < 0.7
    thrice = carry(channel, twice.body, transmission="hills", passed=2)
    assert len(thrice.packets) < len(twice.packets)


def test_what_is_sent_again_refers_to_what_was_sent_first(
    few_packets: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    channel, references = Channel.parse("gaussian:relative=0.1"), References()
    body, part = b"".join(few_packets), few_packets[0]

    def send(body: bytes, attempt: int, transmission: str = "hills") -> Delivery:
        return carry(channel, body, transmission=transmission, attempt=attempt, references=references)

    first = send(body, 0)
    assert first == carry(channel, body, transmission="hills")
    for attempt in (1, 2):
        later = send(part, attempt)
        assert later == channel.transmit([part], transmission="hills", attempt=attempt, reference=first.reference)
        assert later != carry(channel, part, transmission="hills", attempt=attempt)
    assert send(part, 1, "dales") == carry(channel, part, transmission="dales", attempt=1)
    assert send(part, 0) == carry(channel, part, transmission="hills")
    monkeypatch.setattr("common.channel.carrying.MAX_REFERENCES", 2)
    send(body, 0)
    for other in ("a", "b"):
        send(body, 0, other)
        send(body, 0, other)
    assert send(part, 1) == carry(channel, part, transmission="hills", attempt=1)


SYMBOL_BY_SYMBOL = [
    "bit_errors:ber=1e-3",
    "awgn:ebn0_db=4",
    "awgn:ebn0_db=4,modulation=qpsk",
    "rayleigh:ebn0_db=10",
    "rayleigh:ebn0_db=10,coherence=1",
    "rayleigh:ebn0_db=10,coherence=600,modulation=qpsk",
]


@pytest.mark.parametrize("spec", SYMBOL_BY_SYMBOL)
def test_a_body_that_is_no_run_of_packets_takes_little_memory(spec: str) -> None:
    body = bytes(1_000_000)
    tracemalloc.start()
    try:
        harmed = carry(Channel.parse(spec), body, transmission="t").body
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(harmed) == len(body)
    assert harmed != body
    assert peak < 40_000_000


@pytest.mark.parametrize("spec", [*SYMBOL_BY_SYMBOL, "rayleigh:ebn0_db=10,coherence=10000000000"])
def test_in_how_large_blocks_symbols_are_drawn_makes_no_difference(spec: str, monkeypatch: pytest.MonkeyPatch) -> None:
    datagrams = [bytes(size) for size in (0, 1, 63, 64, 65, 1000)]
    whole = Channel.parse(spec, seed=3).transmit(datagrams, transmission="t")
    monkeypatch.setattr("common.channel.modulation.BLOCK", 64)
    assert Channel.parse(spec, seed=3).transmit(datagrams, transmission="t") == whole


def test_the_path_names_the_transmission() -> None:
    assert transmission_of("/v1/transmissions/a b") == "a b"
    for path in ("/v1/transmissions/", "/v1/transmissions", "/v1/transmissions/a/b", "/x/v1/transmissions/a", ""):
        assert transmission_of(path) is None


def test_the_attempt_is_a_count() -> None:
    assert [attempt_of(header) for header in (None, "0", " 7 ")] == [0, 0, 7]
    for header in ("", "-1", "1.0", "x", "٣", "99999999999", str(2**31)):
        with pytest.raises(ParameterError, match="integer"):
            attempt_of(header)


def test_the_faults_are_counted_by_kind(few_packets: list[bytes]) -> None:
    delivery = Channel.parse("erasure:p=1;gaussian:std=1").transmit(few_packets, transmission="t")
    assert faults_header(delivery) == f"erasure={len(few_packets)}"
    assert faults_header(Channel().transmit(few_packets, transmission="t")) == "none"
