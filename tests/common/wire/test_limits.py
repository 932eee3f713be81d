"""The limits, and the packets that are intact and still impossible."""

from __future__ import annotations

import zlib

import numpy as np
import pytest

from common.errors import LimitError, PacketError, ParameterError, VersionError
from common.surface import FeatureSet, Region
from common.wire import PacketDecoder, Reassembly, WireOptions, encode, repack, split
from common.wire.framing import frame
from tests.common.wire.golden import GOLDEN

SQUARE = Region(-1.0, 1.0, -1.0, 1.0)


def some(n: int) -> FeatureSet:
    return FeatureSet(np.random.default_rng(n).uniform(-1, 1, (n, 3)), SQUARE)


def test_more_points_than_are_accepted_are_not_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("common.wire.encoder.MAX_POINTS", 100)
    assert encode(some(100), transmission="t")
    with pytest.raises(LimitError, match="101 points"):
        encode(some(101), transmission="t")


def test_more_packets_than_are_accepted_are_not_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("common.wire.encoder.MAX_PACKETS", 2)
    with pytest.raises(LimitError, match="longer datagrams"):
        encode(some(500), transmission="t")


def test_more_points_than_are_accepted_are_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    packets = PacketDecoder().feed(b"".join(encode(some(100), transmission="t")))
    monkeypatch.setattr("common.wire.reassembly.MAX_POINTS", 99)
    reassembly = Reassembly("t")
    for packet in packets[:-1]:
        reassembly.add(packet)
    with pytest.raises(LimitError, match="99 points"):
        reassembly.add(packets[-1])
    assert reassembly.points <= 99


def test_more_bytes_than_are_accepted_are_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    body = b"".join(encode(some(100), transmission="t"))
    for module in ("decoder", "framing"):
        monkeypatch.setattr(f"common.wire.{module}.MAX_BODY", len(body) - 1)
    with pytest.raises(LimitError):
        split(body)
    decoder = PacketDecoder()
    decoder.feed(body[:-1])
    with pytest.raises(LimitError):
        decoder.feed(body[-1:])


def test_a_datagram_too_short_for_a_point_says_what_it_takes() -> None:
    region = Region(-np.pi, np.e, -0.1 - 0.2, np.pi)
    features = FeatureSet(some(5).points, region)
    with pytest.raises(ParameterError, match="it takes at least 74, less with a region and") as error:
        encode(features, transmission="t", options=WireOptions(precision="float64", datagram=64))
    assert "datagram of 64 bytes" in str(error.value)
    assert encode(features, transmission="t", options=WireOptions(precision="float64", datagram=74))


@pytest.mark.parametrize(
    "options",
    [
        WireOptions(datagram=64, precision="float64"),
        WireOptions(datagram=64, precision="float64", parity=0.1),
        WireOptions(datagram=64, precision=32, position_bits=32, inner=16),
    ],
    ids=str,
)
def test_where_one_point_fits_a_datagram_any_number_of_them_is_sent(options: WireOptions) -> None:
    for n in range(1, 130, 4):
        datagrams = encode(some(n), transmission="t", options=options)
        assert max(map(len, datagrams)) <= 64
        packets = PacketDecoder().feed(b"".join(datagrams))
        assert sum(len(packet.points) for packet in packets) == n


def test_a_point_far_out_is_sent_in_short_datagrams() -> None:
    for n in range(3, 103, 5):
        points = some(n).points.copy()
        points[0, 0] = 50.0
        datagrams = encode(FeatureSet(points, SQUARE), transmission="t", options=WireOptions(datagram=64))
        packets = PacketDecoder().feed(b"".join(datagrams))
        assert sorted(map(tuple, np.concatenate([packet.points for packet in packets]))) == sorted(map(tuple, points))


def test_a_packet_with_too_many_points_cannot_be_made() -> None:
    (packet,) = PacketDecoder().feed(encode(some(5), transmission="t")[0])
    with pytest.raises(PacketError):
        repack(packet, np.zeros((5000, 3)))


def test_parity_is_not_repacked() -> None:
    datagrams = encode(some(5), transmission="t", options=WireOptions(parity=0.1))
    with pytest.raises(PacketError, match="parity"):
        repack(PacketDecoder().feed(datagrams[-1])[0], np.zeros((1, 3)))


def test_a_foreign_object_between_packets_is_no_run_of_packets() -> None:
    (datagram,) = encode(some(5), transmission="t")
    with pytest.raises(PacketError.__bases__[0], match="another msgpack object"):
        split(datagram + b"\x01" + datagram)


HEAD = bytes.fromhex("c74571013f413f41")
"""From tag to region."""

IMPOSSIBLE = {
    "cells without a gap": "130100" + HEAD.hex() + "0710093f40",
    "no rows": "130100" + HEAD.hex() + "8710093f400002",
    "too many columns": "130100" + HEAD.hex() + "8710093f4002ff7f",
    "too many cells": "130100" + HEAD.hex() + "8710093f40e807e807",
    "two bits in a cell": "130100" + HEAD.hex() + "8210093f400202",
    "a gap larger than the region": "130500" + HEAD.hex() + "480710093f40",
    "a lattice of pieces": "140500" + HEAD.hex() + "410010093f40",
    "heights of 40 bits": "140200" + HEAD.hex() + "8028093f400202",
    "a box on a lattice": "141200" + HEAD.hex() + "8010093f400202",
    "lattice heights that do not fit": "140200" + HEAD.hex() + "8010093f400202",
    "an endless number": "1001" + "ff" * 9,
    "an interval beyond a double": "120100" + HEAD.hex() + "1010ce0f01ffffffffffff7f",
    "a compact message too short": "130100" + HEAD.hex() + "8710093f400101",
}
"""Payloads up to the points."""


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_an_impossible_packet_counts_as_damaged(name: str) -> None:
    payload = bytes.fromhex(IMPOSSIBLE[name]) + bytes(3)
    decoder = PacketDecoder()
    assert decoder.feed(frame([payload + zlib.crc32(payload).to_bytes(4, "big")])[0]) == []
    assert decoder.damaged == 1


def test_a_compact_message_with_something_left_counts_as_damaged() -> None:
    (golden,) = (each for each in GOLDEN if each.name == "compact")
    longer = bytes.fromhex(golden.datagrams[0])[3:-4] + b"\1\2"
    decoder = PacketDecoder()
    assert decoder.feed(frame([longer + zlib.crc32(longer).to_bytes(4, "big")])[0]) == []
    assert decoder.damaged == 1


def test_points_that_are_not_finite_count_as_damaged() -> None:
    (datagram,) = encode(some(2), transmission="t", options=WireOptions(precision="float64"))
    payload = datagram[3:-12] + np.array([np.nan]).tobytes()
    decoder = PacketDecoder()
    assert decoder.feed(frame([payload + zlib.crc32(payload).to_bytes(4, "big")])[0]) == []
    assert decoder.damaged == 1


def test_an_unknown_version_in_the_inner_code_is_an_error() -> None:
    (datagram,) = encode(some(2), transmission="t", options=WireOptions(inner=16))
    payload = bytearray(datagram[6 : 6 + int.from_bytes(datagram[4:6], "big") - 4])
    payload[0] = 0x52
    whole = bytes(payload) + zlib.crc32(payload).to_bytes(4, "big")
    with pytest.raises(VersionError, match="version 5"):
        PacketDecoder().feed(datagram[:6] + whole + datagram[6 + len(whole) :])
