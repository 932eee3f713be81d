"""Compact coding and lattices: the same points, in fewer bytes, each packet by itself."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.errors import NotReadyError
from common.surface import FeatureSet, FloatArray, Region
from common.wire import Packet, PacketDecoder, Reassembly, WireOptions, cost, encode
from common.wire.cells import Cells
from common.wire.header import Form
from common.wire.rans import PRECISION, Reader, Writer, tables

COMPACT = WireOptions(coding="compact")
PAPER: list[tuple[Callable[[FloatArray, FloatArray], FloatArray], float, int, float, int]] = [
    (lambda x, y: 3 / (1 + x**2 + y**2), 1.0, 200, 0.4, 50),
    (lambda x, y: -5 / (1 + x**2 + y**2), 2.0, 200, 1.0, 32),
    (lambda x, y: np.sin(2 * x) + np.sin(2 * y), 2.0, 600, 1.0, 32),
]
"""Surface, half the side of its square region, points, segment gap, features."""


def extrema(surface: int, seed: int) -> FeatureSet:
    height, half, n, gap, _ = PAPER[surface]
    x, y = np.random.default_rng(seed).uniform(-half, half, (2, n))
    z = height(x, y)
    region = Region(-half, half, -half, half)
    columns = region.pieces(gap)[1]
    piece = np.floor((y + half) / gap).astype(int) * columns + np.floor((x + half) / gap).astype(int)
    chosen: list[int] = []
    for i in np.unique(piece):
        inside = np.flatnonzero(piece == i)
        chosen += {int(inside[np.argmin(z[inside])]), int(inside[np.argmax(z[inside])])}
    return FeatureSet(np.column_stack([x, y, z])[chosen], region, gap, "extrema")


def decode(datagrams: list[bytes]) -> list[Packet]:
    decoder = PacketDecoder()
    packets = decoder.feed(b"".join(datagrams)) + decoder.close()
    assert (len(packets), decoder.damaged) == (len(datagrams), 0)
    return packets


def received(datagrams: list[bytes]) -> FeatureSet:
    reassembly = Reassembly("t")
    for packet in decode(datagrams):
        reassembly.add(packet)
    return reassembly.features()


def farthest(sent: FeatureSet, got: FeatureSet) -> FloatArray:
    """For each axis, how far the farthest point is from the one that was sent for it."""
    nearest = np.argmin(np.sum((got.xy[:, None] - sent.xy[None]) ** 2, axis=2), axis=1)
    assert sorted(nearest) == list(range(len(sent)))
    distance: FloatArray = np.max(np.abs(got.points - sent.points[nearest]), axis=0)
    return distance


@pytest.mark.parametrize("surface", range(3))
def test_the_papers_features_take_few_bytes(surface: int) -> None:
    """All overhead included, 16-bit heights: plain with 12-bit positions, compact with 1/128 of a piece."""
    _, half, _, gap, count = PAPER[surface]
    for seed in range(10):
        sent = extrema(surface, seed)
        assert len(sent) >= count - 4
        assert cost(sent, transmission="t").total <= 6.5 * count
        assert cost(sent, transmission="t", options=COMPACT).total <= 4.5 * count
    step = np.array([gap / 128, gap / 128, np.ptp(sent.z) / 65535 * (1 + 1 / 31)])
    assert np.all(farthest(sent, received(encode(sent, transmission="t", options=COMPACT))) <= step / 2 + 1e-12)
    step = np.array([2 * half / 4095, 2 * half / 4095, step[2]])
    assert np.all(farthest(sent, received(encode(sent, transmission="t"))) <= step / 2 + 1e-12)


@pytest.mark.parametrize("datagram", [64, 256, 1400])
@pytest.mark.parametrize("precision", [2, 10, 16, 24, 32])
def test_any_precision_and_datagram(datagram: int, precision: int) -> None:
    rng = np.random.default_rng(7)
    xy = rng.uniform(-3, 5, (900, 2))
    sent = FeatureSet(np.column_stack([xy, np.sin(xy[:, 0]) * xy[:, 1]]), Region(-3, 5, -3, 5))
    options = WireOptions(coding="compact", precision=precision, datagram=datagram, position_bits=20)
    datagrams = encode(sent, transmission="t", options=options)
    assert max(map(len, datagrams)) <= datagram
    # In the shortest datagrams too few points share the two bytes of parameters: fixed width is shorter then.
    assert {packet.header.form for packet in decode(datagrams)} == {Form.QUANTISED if datagram == 64 else Form.COMPACT}
    far = farthest(sent, received(datagrams))
    assert np.all(far <= [8 / 2**20, 8 / 2**20, np.ptp(sent.z) / (2**precision - 1) * 0.52])


def test_more_bits_bring_positions_nearer() -> None:
    sent = extrema(2, 0)
    errors = [
        farthest(sent, received(encode(sent, transmission="t", options=WireOptions(coding="compact", position_bits=b))))
        for b in (8, 12, 16)
    ]
    assert errors[0][0] > 4 * errors[1][0] > 16 * errors[2][0]


@settings(max_examples=60)
@given(st.data())
def test_whatever_the_points_they_arrive(data: st.DataObject) -> None:
    """Crowds, repeated points, one point, points beyond the region: no point is lost, whatever form is chosen."""
    coordinate = st.floats(-1, 1) | st.sampled_from([-1.0, 0.0, 1.0]) | st.floats(-3, 3)
    points = data.draw(st.lists(st.tuples(coordinate, coordinate, st.floats(-1e6, 1e6)), min_size=1, max_size=80))
    points = points * data.draw(st.sampled_from([1, 1, 7]))
    gap = data.draw(st.none() | st.floats(0.05, 2.0))
    sent = FeatureSet(
        np.array(points), Region(-1, 1, -1, 1), gap, data.draw(st.sampled_from(["cloud", "lattice", "extrema"]))
    )
    got = received(encode(sent, transmission="t", options=WireOptions(coding="compact", datagram=128)))
    assert len(got) == len(sent)
    for axis, tolerance in ((0, 0.2), (1, 0.2), (2, np.ptp(sent.z) / 65535 + 1e-6)):
        assert np.max(np.abs(np.sort(got.points[:, axis]) - np.sort(sent.points[:, axis]))) <= tolerance


def test_points_too_crowded_for_cells_travel_plain() -> None:
    rng = np.random.default_rng(3)
    crowd = np.column_stack([rng.uniform(0.5, 0.5001, (600, 2)), rng.normal(size=600)])
    datagrams = encode(FeatureSet(crowd, Region(-1, 1, -1, 1)), transmission="t", options=COMPACT)
    assert {packet.header.form for packet in decode(datagrams)} == {Form.QUANTISED}


def grid(rows: int, columns: int, *, centred: bool = False) -> FeatureSet:
    region = Region(0.0, 10.0, -3.0, 4.0)
    if centred:
        x = (np.arange(columns) + 0.5) * region.width / columns
        y = region.y_min + (np.arange(rows) + 0.5) * region.height / rows
    else:
        x, y = region.axes((rows, columns))
    xx, yy = np.meshgrid(x, y)
    points = np.column_stack([xx.ravel(), yy.ravel(), np.sin(xx + yy).ravel()])
    return FeatureSet(np.random.default_rng(1).permutation(points), region, None, "lattice")


@pytest.mark.parametrize("coding", ["plain", "compact"])
@pytest.mark.parametrize("centred", [False, True])
@pytest.mark.parametrize(
    ("shape", "compact"),
    [
        ((20, 31), Form.LATTICE),  # few nodes, far from each other, foretell little: fixed width is as short
        ((64, 48), Form.COMPACT_LATTICE),
        ((1, 200), Form.COMPACT_LATTICE),
        ((200, 1), Form.COMPACT_LATTICE),
        ((2, 2), Form.LATTICE),
    ],
)
def test_positions_on_a_lattice_are_implied(coding: str, centred: bool, shape: tuple[int, int], compact: Form) -> None:
    sent = grid(*shape, centred=centred)
    options = WireOptions.model_validate({"coding": coding, "precision": 10})
    datagrams = encode(sent, transmission="t", options=options)
    forms = {packet.header.form for packet in decode(datagrams)}
    assert forms == {compact if coding == "compact" else Form.LATTICE}
    far = farthest(sent, received(datagrams))
    assert np.all(far[:2] <= 1e-12)
    assert far[2] <= np.ptp(sent.z) / 1023 * 0.52
    if len(sent) > 500:
        assert sum(map(len, datagrams)) < (1.45 if Form.LATTICE in forms else 1.35) * len(sent)


def test_a_lattice_with_a_hole_is_a_cloud() -> None:
    whole = grid(12, 12)
    holed = FeatureSet(whole.points[1:], whole.region, None, "lattice")
    packets = decode(encode(holed, transmission="t"))
    assert {packet.header.form for packet in packets} == {Form.QUANTISED}


@pytest.mark.parametrize("total", [1, 2, 3, 5, 8, 13, 40, 64, 100])
def test_cells_are_dealt_out_evenly(total: int) -> None:
    """Every cell belongs to one packet, and the packet's cells leave no hole much larger than their share."""
    cells = Cells(24, 40)
    parts = [cells.of_packets([i], total)[0] for i in range(total)]
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(len(cells)))
    assert max(map(len, parts)) == cells.most(total) <= cells.most_per_packet(total)
    together, counts = cells.of_packets(range(total), total)
    assert np.array_equal(together, np.concatenate(parts))
    assert counts.tolist() == [len(part) for part in parts]
    rows, columns = np.divmod(np.arange(len(cells)), 40)
    for part in parts:
        own_rows, own_columns = np.divmod(part, 40)
        away = np.hypot(rows[:, None] - own_rows, columns[:, None] - own_columns).min(axis=1)
        assert away.max() <= 2.0 * np.sqrt(total)


@settings(max_examples=60)
@given(st.data())
def test_what_the_entropy_coder_writes_it_reads(data: st.DataObject) -> None:
    lanes, steps = data.draw(st.integers(1, 5)), data.draw(st.integers(0, 40))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    model = tables([[1, 1, 1, 1], [4000, 5, 1, 0], [1, 2, 3, 4]])
    table, value = rng.integers(0, 3, (steps, lanes)), rng.integers(0, 4, (steps, lanes))
    bits = rng.integers(0, 33, (steps, lanes))
    raw, active = rng.integers(0, 2**32, (steps, lanes)) & (1 << bits) - 1, rng.random((steps, lanes)) < 0.7
    writer = Writer(lanes)
    for i in range(steps):
        writer.symbol(model, table[i], value[i], active[i])
        writer.raw(bits[i], raw[i], active[i])
    messages = writer.finish()
    reader = Reader(messages)
    nothing = np.zeros(lanes, dtype=np.int64)
    for i in range(steps):
        assert np.array_equal(reader.symbol(model, table[i], nothing, active[i]), np.where(active[i], value[i], 0))
        assert np.array_equal(reader.raw(bits[i], nothing, active[i]), np.where(active[i], raw[i], 0))
    assert reader.finished().all()
    ideal = np.sum(active * (model.bits()[table, value] + bits), axis=0) / 8
    assert np.all(np.array([len(message) for message in messages]) <= ideal + 4)
    assert model.frequencies.sum(axis=1).tolist() == [1 << PRECISION] * 3


@pytest.mark.parametrize("aspect", [0.1, 1.0, 7.3])
@pytest.mark.parametrize("bits", [8, 12, 16, 24, 32])
@pytest.mark.parametrize("gap", [None, 0.37])
def test_positions_are_as_near_as_their_bits_promise(aspect: float, bits: int, gap: float | None) -> None:
    """Bits count over each side of the region; where cells cannot hold so many, points are written plainly."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(0, 1, 60), rng.uniform(0, aspect, 60), rng.normal(size=60)])
    sent = FeatureSet(points, Region(0, 1, 0, aspect), gap, "cloud")
    for coding in ("plain", "compact"):
        options = WireOptions(coding=coding, position_bits=bits)
        far = farthest(sent, received(encode(sent, transmission="t", options=options)))
        assert np.all(far[:2] <= np.array([1, aspect]) / (2**bits - 1) / 2 * (1 + 1e-9) + 1e-15)


def test_a_packet_of_a_lattice_may_hold_no_node() -> None:
    x, y = Region(0, 1, 0, 1).axes((2, 3))
    nodes = np.stack([*np.meshgrid(x, y), np.arange(6.0).reshape(2, 3)], axis=-1).reshape(-1, 3)
    sent = FeatureSet(nodes, Region(0, 1, 0, 1), None, "lattice")
    for coding in ("plain", "compact"):
        datagrams = encode(sent, transmission="t", options=WireOptions(min_packets=6, coding=coding))
        packets = decode(datagrams)
        assert min(len(packet.points) for packet in packets) == 0
        reassembly = Reassembly("t")
        for packet in packets:
            reassembly.add(packet)
        assert reassembly.complete
        assert len(reassembly.features()) == 6


def test_of_packets_without_points_there_are_no_features() -> None:
    """Along a diagonal few cells hold points, and the packets of the others none."""
    along = np.random.default_rng(1).uniform(0, 1, 300)
    sent = FeatureSet(np.column_stack([along, along, np.sin(along)]), Region(0, 1, 0, 1), None, "cloud")
    packets = decode(encode(sent, transmission="t", options=WireOptions(coding="compact", precision=8, datagram=128)))
    reassembly = Reassembly("t")
    for packet in packets:
        if not len(packet.points):
            reassembly.add(packet)
    assert reassembly.received
    with pytest.raises(NotReadyError):
        reassembly.features()
