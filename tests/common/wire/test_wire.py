"""The whole way: features to packets to bytes and back, through damage."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.errors import ConflictError, NotReadyError, WireError
from common.surface import FeatureSet, FloatArray, Region, Units
from common.wire import Packet, PacketDecoder, Reassembly, WireOptions, encode, repack, split

REGION = Region(-2.0, 2.0, -1.0, 3.0)


def features(n: int = 100, seed: int = 0) -> FeatureSet:
    rng = np.random.default_rng(seed)
    xy = rng.uniform((-2, -1), (2, 3), (n, 2))
    points = np.column_stack([xy, np.sin(2 * xy[:, 0]) + np.sin(2 * xy[:, 1])])
    return FeatureSet(points, REGION, 0.4, "extrema", Units("m", "mm"))


def decode(body: bytes) -> tuple[list[Packet], int]:
    decoder = PacketDecoder()
    packets = decoder.feed(body) + decoder.close()
    return packets, decoder.damaged


def by_coordinates(points: FloatArray) -> FloatArray:
    ordered: FloatArray = points[np.lexsort(points.T)]
    return ordered


def reassembled(packets: list[Packet], transmission: str = "t") -> Reassembly:
    reassembly = Reassembly(transmission)
    for packet in packets:
        reassembly.add(packet)
    return reassembly


@pytest.mark.parametrize(("precision", "tolerance"), [("float64", 0.0), ("float32", 1e-6), (16, 5e-4), (11, 4e-3)])
@pytest.mark.parametrize("datagram", [96, 256, 1400])
def test_what_is_sent_arrives(precision: str | int, tolerance: float, datagram: int) -> None:
    sent = features()
    datagrams = encode(
        sent, transmission="t", options=WireOptions.model_validate({"precision": precision, "datagram": datagram})
    )
    assert max(map(len, datagrams)) <= datagram
    packets, damaged = decode(b"".join(datagrams))
    assert (len(packets), damaged) == (len(datagrams), 0)
    got = reassembled(packets).features()
    assert (got.region, got.gap, got.kind, got.units) == (sent.region, sent.gap, sent.kind, sent.units)
    assert np.max(np.abs(np.sort(got.points, axis=0) - np.sort(sent.points, axis=0))) <= tolerance


def test_points_outside_of_the_region_are_not_clipped() -> None:
    inside = features()
    near = FeatureSet(inside.points + np.array([0.5, -0.5, 0.0]), REGION)
    far = FeatureSet(inside.points + np.array([1e6, 0.0, 0.0]), REGION)
    for sent, tolerance in ((near, 1e-3), (far, 0.0)):
        got = reassembled(decode(b"".join(encode(sent, transmission="t")))[0]).features()
        assert np.max(np.abs(np.sort(got.points, axis=0) - np.sort(sent.points, axis=0))) <= tolerance


@given(st.lists(st.tuples(st.integers(0, 5000), st.integers(1, 255)), max_size=12), st.integers(0, 200))
def test_undamaged_packets_of_a_damaged_body_are_recovered(harm: list[tuple[int, int]], inserted: int) -> None:
    datagrams = encode(features(), transmission="t", options=WireOptions(datagram=100))
    body = bytearray(b"".join(datagrams))
    for place, mask in harm:
        body[place % len(body)] ^= mask
    intact = {
        i
        for i, datagram in enumerate(datagrams)
        if body[(start := sum(map(len, datagrams[:i]))) : start + len(datagram)] == datagram
    }
    packets, damaged = decode(bytes(inserted) + bytes(body))
    assert {packet.number for packet in packets} == intact
    assert (damaged > 0) == (inserted > 0 or len(intact) < len(datagrams))


@given(st.binary(max_size=2000))
def test_any_bytes_yield_packets_or_our_error(data: bytes) -> None:
    try:
        decode(data)
        split(data)
    except WireError:
        pass


@given(st.lists(st.integers(1, 40), max_size=100))
def test_how_bytes_are_fed_makes_no_difference(cuts: list[int]) -> None:
    body = bytearray(b"".join(encode(features(), transmission="t")))
    body[300] ^= 1
    whole = decode(bytes(body))
    decoder, packets, start = PacketDecoder(), [], 0
    for cut in cuts:
        packets += decoder.feed(bytes(body[start : start + cut]))
        start += cut
    packets += decoder.feed(bytes(body[start:])) + decoder.close()
    assert ([p.number for p in packets], decoder.damaged) == ([p.number for p in whole[0]], whole[1])


@given(st.permutations(range(5)))
def test_the_order_of_arrival_makes_no_difference(order: list[int]) -> None:
    datagrams = encode(features(), transmission="t", options=WireOptions(datagram=140))
    packets = decode(b"".join(datagrams))[0]
    expected = reassembled(packets[:5]).features().points
    assert np.array_equal(reassembled([packets[i] for i in order]).features().points, expected)


def test_a_receipt_says_what_is_missing() -> None:
    datagrams = encode(features(), transmission="t", options=WireOptions(datagram=140))
    packets = decode(b"".join(datagrams))[0]
    reassembly = Reassembly("t")
    assert (reassembly.total, reassembly.received, reassembly.missing, reassembly.complete) == (None, 0, (), False)
    with pytest.raises(NotReadyError):
        reassembly.features()
    assert reassembly.add(packets[1]) == "new"
    assert reassembly.add(packets[1]) == "duplicate"
    assert Reassembly("other").add(packets[1]) == "foreign"
    assert reassembly.total == len(datagrams)
    assert reassembly.missing == tuple(i for i in range(len(datagrams)) if i != 1)
    assert reassembly.points == len(packets[1].points)


def test_another_feature_set_under_the_same_id_is_a_conflict() -> None:
    first = decode(b"".join(encode(features(), transmission="t")))[0]
    for other in (features(300), features(100, seed=1)):
        with pytest.raises(ConflictError, match=r"does not go with those before it: (packets|range of heights) "):
            reassembled(first + decode(b"".join(encode(other, transmission="t")))[0])


def test_repacked_points_arrive_as_they_are() -> None:
    packets = decode(b"".join(encode(features(), transmission="t")))[0]
    noisy = [packet.points + 1e3 for packet in packets]
    again = decode(b"".join(repack(p, points) for p, points in zip(packets, noisy, strict=True)))[0]
    assert [p.number for p in again] == [p.number for p in packets]
    assert np.array_equal(reassembled(again).features().points, np.concatenate(noisy))


def test_split_gives_the_datagrams_back() -> None:
    datagrams = encode(features(), transmission="t")
    assert split(b"".join(datagrams)) == datagrams
    for body in (b"hello", b"\x80" * 10, datagrams[0][:-1], b"\xc1", b"\x91" * 100_000, b"\xdb\xff\xff\xff\xff"):
        with pytest.raises(WireError):
            split(body)


@pytest.mark.parametrize("bits", [2, 3, 4])
@pytest.mark.parametrize("n", range(1, 17))
def test_what_fills_up_a_block_is_no_point(bits: int, n: int) -> None:
    options = WireOptions(precision=bits, position_bits=2)
    packets, damaged = decode(b"".join(encode(features(n), transmission="t", options=options)))
    assert (sum(len(packet.points) for packet in packets), damaged) == (n, 0)


def test_points_of_fewer_bits_than_a_byte_are_not_read() -> None:
    options = WireOptions(precision=2, position_bits=3)
    packet = encode(features(3), transmission="t", options=options)[0]
    at = packet.index(bytes([3, 2]), 10)
    payload = bytearray(packet[:-4])
    payload[at] = 2
    framed = bytes(payload) + zlib.crc32(bytes(payload[3:])).to_bytes(4, "big")
    assert decode(framed) == ([], 1)


@pytest.mark.parametrize("side", [3e-291, 1e-300, 5e-324])
def test_points_so_near_that_their_steps_would_overflow_arrive_exactly(side: float) -> None:
    points = np.array([[0, 0, 1.0], [side, 0, 2.0], [0, side, 3.0], [side, side, 4.0], [0.3 * side, 0.6 * side, 5.0]])
    sent = FeatureSet(points, Region(0, side, 0, side), None, "cloud")
    packets, _ = decode(b"".join(encode(sent, transmission="t", options=WireOptions(position_bits=32))))
    got = reassembled(packets).features().points
    assert np.array_equal(by_coordinates(got)[:, :2], by_coordinates(points)[:, :2])
