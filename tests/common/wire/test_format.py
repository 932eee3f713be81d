"""The bytes of the format: fixed for good, documented, and readable by a decoder that knows only the documentation."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import numpy as np
import pytest

from common.errors import ConflictError, LimitError, PacketError, VersionError, WireError
from common.surface import FeatureSet, Region, Units
from common.wire import MEDIA_TYPE, MEDIA_TYPES, PacketDecoder, Reassembly, WireOptions, encode, split, transmission_tag
from common.wire.limits import MAX_COPIES, MAX_PACKETS
from common.wire.numbers import Interval, Reader, write_real, write_signed, write_varint
from tests.common.wire.golden import GOLDEN, Golden, written
from tests.common.wire.reference import read

DOCUMENT = Path(__file__).parents[3] / "docs" / "wire.md"


@pytest.mark.parametrize("golden", GOLDEN, ids=lambda golden: golden.name)
def test_golden_bytes_are_written(golden: Golden) -> None:
    assert written(golden) == golden.datagrams


@pytest.mark.parametrize("golden", GOLDEN, ids=lambda golden: golden.name)
def test_golden_bytes_are_read(golden: Golden) -> None:
    datagrams = [bytes.fromhex(datagram) for datagram in golden.datagrams]
    assert split(b"".join(datagrams)) == datagrams
    decoder = PacketDecoder()
    packets = decoder.feed(b"".join(datagrams)) + decoder.close()
    assert [packet.number for packet in packets] == list(range(len(datagrams)))
    reassembly = Reassembly(golden.transmission)
    for packet in packets:
        said = read(datagrams[packet.number])
        assert reassembly.add(packet) in ("new", "duplicate")
        assert (said["kind"], said["number"], said["tag"]) == (packet.kind, packet.number, packet.tag)
        assert (said["region"], said["gap"]) == (packet.region.bounds, packet.gap)
        assert said["units"] == (packet.units.xy, packet.units.z)
        if not packet.is_parity:
            assert np.allclose(packet.points, said["points"], rtol=1e-15, atol=1e-15)
    got, sent = reassembly.features(), golden.features
    assert reassembly.complete
    assert (got.region, got.gap, got.kind, got.units) == (sent.region, sent.gap, sent.kind, sent.units)
    assert len(got) == len(sent)


@pytest.mark.parametrize(
    "options", [{}, {"coding": "compact"}, {"coding": "compact", "precision": 30, "datagram": 900}]
)
@pytest.mark.parametrize("seed", range(3))
def test_a_decoder_written_from_the_document_finds_the_same_points(options: dict[str, object], seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(300, 3)) * (0.4, 0.4, 1e3)
    points[200:] = points[:100] + rng.normal(size=(100, 3)) * 1e-3
    features = FeatureSet(points, Region(-1.0, 1.0, -1.0, 1.0), 0.25, "extrema")
    datagrams = encode(features, transmission="t", options=WireOptions.model_validate(options))
    decoder = PacketDecoder()
    for packet in decoder.feed(b"".join(datagrams)):
        said = np.array(read(datagrams[packet.number])["points"])
        assert np.allclose(packet.points, said, rtol=1e-12, atol=1e-12)


def test_the_document_quotes_golden_bytes() -> None:
    quoted = re.findall(r"^[0-9a-f]{40,}$", DOCUMENT.read_text(encoding="utf-8"), re.MULTILINE)
    golden = {datagram for each in GOLDEN for datagram in each.datagrams}
    assert len(quoted) >= 5
    assert set(quoted) <= golden


def test_the_media_type_is_the_registered_one() -> None:
    assert MEDIA_TYPE == "application/vnd.msgpack"
    assert frozenset({MEDIA_TYPE, "application/msgpack", "application/x-msgpack"}) == MEDIA_TYPES


REALS = [
    0.0,
    -0.0,
    1.0,
    -64.0,
    127.0,
    128.0,
    -65.0,
    0.1,
    0.4,
    -1e-5,
    0.1 + 0.2,
    np.pi,
    1e15,
    1e16,
    1e300,
    5e-324,
    2.0**-30,
]
NUMBERS = [0, 1, 127, 128, 300, 16383, 16384, 2**53]


def test_numbers_are_exact() -> None:
    for value in REALS:
        assert Reader(write_real(value)).real().hex() == value.hex()
    for number in NUMBERS:
        assert Reader(write_varint(number)).varint() == number
        assert [Reader(write_signed(v)).signed() for v in (number, -number)] == [number, -number]


@pytest.mark.parametrize(
    ("least", "greatest"),
    [
        (0.0, 0.0),
        (0.0, 1.0),
        (-3.7, 1e-3),
        (1e9, 1e9 + 1e-3),
        (5.0, 5.0),
        (-1e300, 1e300),
        (1e-300, 2e-300),
        (0, 5e-324),
    ],
)
def test_an_interval_covers_its_values(least: float, greatest: float) -> None:
    interval = Interval.covering(least, greatest)
    if interval is None:
        assert not 1e-290 < max(abs(least), abs(greatest)) < 1e290
        return
    low, high = interval.bounds
    assert low <= least <= greatest <= high
    assert high - low <= (greatest - least) * (1 + 1 / 31) or high - low <= abs(greatest) * 1e-12 or greatest == 0
    assert Reader(interval.to_bytes()).interval() == interval


QUANTISED = bytes.fromhex("c72153120c00c74571013f413f41c108140c100910780000000000bfffffffff53280da1")


def with_payload(change: dict[int, int], length: int | None = None) -> bytes:
    """The quantised golden datagram with other bytes in its payload, and a checksum that fits them."""
    payload = bytearray(QUANTISED[3:-4])[:length]
    for place, byte in change.items():
        payload[place] = byte
    payload += zlib.crc32(payload).to_bytes(4, "big")
    return bytes([0xC7, len(payload), 0x53]) + bytes(payload)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({0: 0x22}, "version 2"),
        ({0: 0x02}, "version 0"),
        ({0: 0x16}, "unknown form 6"),
        ({1: 0x8C}, "unknown flags 0x8c"),
        ({13: 0x19}, "unknown unit, number 9"),
    ],
)
def test_what_is_not_known_here_is_an_error(change: dict[int, int], message: str) -> None:
    with pytest.raises(VersionError, match=message):
        PacketDecoder().feed(with_payload(change))


@pytest.mark.parametrize(
    "change",
    [
        {2: 8},  # the ninth copy
        {6: 0},  # one packet of none
        {7: 0x41},  # region without extent
        {7: 0xFF},  # a number of unknown form
        {12: 0x07},  # negative gap
        {14: 1},  # positions of one bit
        {15: 33},  # heights of 33 bits
        {18: 0},  # an interval without extent
        {1: 0x1C},  # a box that is not there
    ],
)
def test_an_intact_packet_that_makes_no_sense_is_damaged(change: dict[int, int]) -> None:
    decoder = PacketDecoder()
    assert decoder.feed(with_payload(change) + QUANTISED)[0].number == 0
    assert decoder.damaged == 1


@pytest.mark.parametrize("length", [14, 17, 19, 26])
def test_an_intact_packet_that_is_too_short_is_damaged(length: int) -> None:
    decoder = PacketDecoder()
    assert len(decoder.feed(with_payload({}, length) + QUANTISED)) == 1
    assert decoder.damaged == 1


def test_a_total_that_lies_is_refused_or_harmless() -> None:
    features = FeatureSet(np.array([[0.0, 0.0, 1.0]]), Region(0.0, 1.0, 0.0, 1.0))
    (datagram,) = encode(features, transmission="t")
    place = datagram.index(transmission_tag("t").to_bytes(3, "big")) + 3
    lying = datagram[3:place] + write_varint(MAX_PACKETS + 1) + datagram[place + 1 : -4]
    payload = lying + zlib.crc32(lying).to_bytes(4, "big")
    with pytest.raises(LimitError, match=f"at most {MAX_PACKETS}"):
        PacketDecoder().feed(bytes([0xC7, len(payload), 0x53]) + payload)


def test_a_closed_decoder_takes_no_more() -> None:
    decoder = PacketDecoder()
    decoder.close()
    with pytest.raises(PacketError):
        decoder.feed(b"")
    assert decoder.close() == []


def test_copies_are_limited() -> None:
    assert MAX_COPIES * 2 == 16
    with pytest.raises(ValueError, match="copies"):
        WireOptions(copies=MAX_COPIES + 1)


def test_contradictions_are_conflicts() -> None:
    one = FeatureSet(np.array([[0.1, 0.2, 1.0], [0.3, 0.4, 2.0]]), Region(0.0, 1.0, 0.0, 1.0))
    with_units = FeatureSet(one.points, one.region, units=Units("km", "m"))
    for other, options, said in (
        (FeatureSet(one.points, Region(0.0, 2.0, 0.0, 1.0)), {}, "region 0.0,2.0,0.0,1.0 instead of 0.0,1.0,0.0,1.0"),
        (FeatureSet(one.points, one.region, 0.5), {}, "segment gap 0.5 instead of none"),
        (FeatureSet(one.points, one.region, kind="greedy"), {}, "kind greedy instead of cloud"),
        (with_units, {}, "unit of x and y km instead of none, unit of z m instead of none"),
        (one, {"precision": "float64"}, "precision float64 instead of 16 bits"),
        (one, {"precision": 12}, "precision 12 bits instead of 16 bits"),
        (one, {"parity": 0.5}, "packets of parity 1 instead of 0"),
        (one, {"min_packets": 2}, "packets 2 instead of 1"),
        (FeatureSet(one.points[:, [1, 0, 2]], one.region), {}, "two packets are number 0, with other points each"),
    ):
        reassembly = Reassembly("t")
        for packet in PacketDecoder().feed(b"".join(encode(one, transmission="t"))):
            reassembly.add(packet)
        (packet, *_) = PacketDecoder().feed(
            b"".join(encode(other, transmission="t", options=WireOptions.model_validate(options)))
        )
        with pytest.raises(ConflictError, match=re.escape(said)) as conflict:
            reassembly.add(packet)
        assert "DELETE" not in conflict.value.detail
        assert issubclass(PacketError, WireError)
