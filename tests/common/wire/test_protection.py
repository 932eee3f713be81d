"""Parity, copies and the inner code: what each survives, and what it costs."""

from __future__ import annotations

import math

import numpy as np
import pytest
import reedsolo
from hypothesis import given, settings
from hypothesis import strategies as st

from common.errors import PacketError
from common.surface import FeatureSet, FloatArray, Region
from common.wire import Packet, PacketDecoder, Reassembly, WireOptions, cost, encode, repack
from common.wire.erasure import groups, parity_blocks, rebuild
from common.wire.reedsolomon import correct
from common.wire.reedsolomon import encode as rs_encode

REGION = Region(-2.0, 2.0, -2.0, 2.0)


def features(n: int = 400) -> FeatureSet:
    rng = np.random.default_rng(5)
    xy = rng.uniform(-2, 2, (n, 2))
    return FeatureSet(np.column_stack([xy, np.cos(xy[:, 0] * xy[:, 1])]), REGION, 0.5, "extrema")


def decode(body: bytes) -> tuple[list[Packet], PacketDecoder]:
    decoder = PacketDecoder()
    return decoder.feed(body) + decoder.close(), decoder


def reassembled(packets: list[Packet]) -> Reassembly:
    reassembly = Reassembly("t")
    for packet in packets:
        reassembly.add(packet)
    return reassembly


def points(datagrams: list[bytes]) -> FloatArray:
    return reassembled(decode(b"".join(datagrams))[0]).features().points


def flip(body: bytes, rate: float, rng: np.random.Generator) -> bytes:
    bits = np.unpackbits(np.frombuffer(body, dtype=np.uint8))
    return np.packbits(bits ^ (rng.random(bits.size) < rate)).tobytes()


@pytest.mark.parametrize("parity", [16, 32, 64, 128])
def test_code_words_are_those_of_another_library(parity: int) -> None:
    rng = np.random.default_rng(parity)
    reference = reedsolo.RSCodec(parity)
    data = rng.integers(0, 256, (4, 255 - parity), dtype=np.uint8)
    words = np.concatenate([data, rs_encode(data, parity)], axis=1)
    assert [word.tobytes() for word in words] == [bytes(reference.encode(row.tobytes())) for row in data]
    harmed = words.copy()
    for i, word in enumerate(harmed):
        places = rng.choice(255, parity // 2 - i, replace=False)
        word[places] ^= rng.integers(1, 256, places.size, dtype=np.uint8)
        assert bytes(reference.decode(word.tobytes())[0]) == data[i].tobytes()
    assert np.array_equal(correct(harmed, parity), words)


def test_a_word_beyond_repair_is_left_as_it_is() -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (500, 255), dtype=np.uint8)
    assert np.array_equal(correct(noise, 32), noise)


@settings(max_examples=40)
@given(st.integers(1, 40), st.integers(1, 40), st.data())
def test_any_k_of_n_rebuild_all(total: int, parity: int, data: st.DataObject) -> None:
    blocks = [data.draw(st.binary(min_size=1, max_size=30)) for _ in range(total)]
    rows = parity_blocks(blocks, parity)
    lost = data.draw(st.sets(st.integers(0, total + parity - 1), max_size=parity))
    here = {i: block for i, block in enumerate(blocks) if i not in lost}
    parities = {i: row for i, row in enumerate(rows) if i + total not in lost}
    assert here | rebuild(total, parity, 0, here, parities) == dict(enumerate(blocks))


def test_large_transmissions_are_several_code_words() -> None:
    rng = np.random.default_rng(1)
    blocks = [rng.bytes(int(size)) for size in rng.integers(5, 9, 700)]
    assert groups(700, 210) == 4
    rows = dict(enumerate(parity_blocks(blocks, 210)))
    burst = {i: block for i, block in enumerate(blocks) if not 100 <= i < 300}
    found = burst.copy()
    for group in range(4):
        found |= rebuild(700, 210, group, burst, rows)
    assert [found[i] for i in range(700)] == blocks


def test_parity_that_does_not_fit_rebuilds_nothing() -> None:
    blocks = [b"one", b"two", b"three"]
    rows = parity_blocks(blocks, 2)
    with pytest.raises(PacketError, match="2 packets are lost and 1"):
        rebuild(3, 2, 0, {0: b"one"}, {0: rows[0]})
    with pytest.raises(PacketError, match="checksum"):
        rebuild(3, 2, 0, {0: b"eno"}, dict(enumerate(rows)))


@pytest.mark.parametrize("precision", [16, "float64"])
def test_parity_makes_up_for_lost_packets(precision: str | int) -> None:
    options = WireOptions.model_validate({"parity": 0.3, "precision": precision, "datagram": 128})
    datagrams = encode(features(), transmission="t", options=options)
    assert max(map(len, datagrams)) <= 128
    whole = points(datagrams)
    total = decode(datagrams[0])[0][0].total
    parity = len(datagrams) - total
    assert parity == math.ceil(0.3 * total)
    rng = np.random.default_rng(2)
    for _ in range(5):
        kept = [datagrams[i] for i in rng.permutation(len(datagrams))[parity:]]
        reassembly = reassembled(decode(b"".join(kept))[0])
        assert reassembly.complete
        assert reassembly.received + reassembly.rebuilt == total
        assert np.array_equal(reassembly.features().points, whole)
        assert reassembly.points == len(whole)


def test_what_arrived_is_usable_where_rebuilding_is_not_possible() -> None:
    datagrams = encode(features(), transmission="t", options=WireOptions(parity=0.2))
    packets = decode(b"".join(datagrams))[0]
    total = packets[0].total
    reassembly = reassembled(packets[: total // 2])
    assert reassembly.missing == tuple(range(total // 2, total))
    assert reassembly.points == sum(len(packet.points) for packet in packets[: total // 2])
    for packet in packets[total // 2 + 2 :]:
        reassembly.add(packet)
    assert (reassembly.missing, reassembly.rebuilt) == ((), 2)


def test_altered_points_are_not_rebuilt_from() -> None:
    datagrams = encode(features(), transmission="t", options=WireOptions(parity=0.5))
    packets = decode(b"".join(datagrams))[0]
    noisy = [
        packet if packet.is_parity else decode(repack(packet, packet.points + 1.0))[0][0] for packet in packets[1:]
    ]
    reassembly = reassembled(noisy)
    assert reassembly.missing == (0,)
    assert np.allclose(reassembly.features().points, np.concatenate([p.points for p in packets[1:]]) + 1.0)


def test_copies_make_up_for_lost_packets() -> None:
    datagrams = encode(features(), transmission="t", options=WireOptions(copies=3))
    whole = points(datagrams)
    third = len(datagrams) // 3
    kept = [datagrams[i % 3 * third + i] for i in range(third)]
    assert np.array_equal(points(kept), whole)
    assert [packet.copy for packet in decode(b"".join(kept))[0]] == [i % 3 for i in range(third)]


@pytest.mark.parametrize("datagram", [200, 255, 256, 700])
def test_the_inner_code_delivers_through_bit_errors(datagram: int) -> None:
    datagrams = encode(features(), transmission="t", options=WireOptions(inner=64, datagram=datagram))
    assert max(map(len, datagrams)) <= datagram
    assert len(set(map(len, datagrams))) == 1
    whole = decode(b"".join(datagrams))[0]
    rng = np.random.default_rng(3)
    delivered = 0
    for _ in range(10):
        packets, decoder = decode(flip(b"".join(datagrams), 1e-2, rng))
        delivered += len(packets)
        assert decoder.corrected > 0
        for packet in packets:
            assert np.array_equal(packet.points, whole[packet.number].points)
    assert delivered >= 0.9 * 10 * len(datagrams)


def test_a_single_coded_datagram_is_found_without_a_legible_start() -> None:
    (datagram,) = encode(features(20), transmission="t", options=WireOptions(inner=32))
    for masks in ({0: 0x5A}, {1: 0x5A}, {2: 0x5A}, {3: 0x5A}, {0: 1, 1: 2, 2: 4, 3: 8, 4: 16, 5: 32, 6: 64}):
        harmed = bytearray(datagram)
        for place, mask in masks.items():
            harmed[place] ^= mask
        packets, decoder = decode(bytes(harmed))
        assert (len(packets), decoder.corrected, decoder.damaged) == (1, 1, 0)


def test_coded_datagrams_are_found_beside_lost_and_truncated_ones() -> None:
    datagrams = encode(features(), transmission="t", options=WireOptions(inner=32))
    body = datagrams[0] + datagrams[2][:100] + datagrams[3] + datagrams[4][:-10] + datagrams[5]
    harmed = bytearray(body)
    for start in (0, len(datagrams[0]) + 100):
        harmed[start] ^= 1
        harmed[start + 50] ^= 0xFF
    packets, decoder = decode(bytes(harmed))
    assert sorted(packet.number for packet in packets) == [0, 3, 4, 5]
    assert decoder.damaged == 1


def test_protections_combine() -> None:
    options = WireOptions(inner=32, parity=0.5, copies=2)
    datagrams = encode(features(), transmission="t", options=options)
    whole = points(encode(features(), transmission="t", options=options))
    rng = np.random.default_rng(4)
    kept = [datagram for datagram in datagrams if rng.random() > 0.3]
    reassembly = reassembled(decode(flip(b"".join(kept), 3e-3, rng))[0])
    assert reassembly.complete
    assert np.array_equal(reassembly.features().points, whole)


@pytest.mark.parametrize("name", ["parity", "copies", "inner"])
def test_the_cost_of_each_protection_is_reported(name: str) -> None:
    protections = {"parity": 0.3, "copies": 2, "inner": 32}
    options = WireOptions.model_validate({name: protections[name]})
    reported = cost(features(), transmission="t", options=options)
    assert reported.total == sum(map(len, encode(features(), transmission="t", options=options)))
    assert reported.count == 400
    assert reported.bytes_per_point == reported.total / 400
    assert {part for part in protections if getattr(reported, part)} == {name}
    assert reported.protection == getattr(reported, name)
    assert reported.points >= 400 * 6
