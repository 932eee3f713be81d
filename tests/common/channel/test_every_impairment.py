"""What holds for every impairment in the registry, also for those that are added later."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from common.channel import IMPAIRMENTS, Channel, Delivery, Impairment, PointImpairment, Reference
from common.channel.datagram import decode, launch
from common.channel.impairments.clean import Clean
from common.channel.impairments.rate import Rate
from common.surface import FeatureSet, FloatArray, Region
from common.wire import PacketDecoder, WireOptions, encode

HARMFUL = [model for model in IMPAIRMENTS if model is not Clean]


def candidates(schema: dict[str, Any]) -> list[Any]:
    """Values of a parameter, well apart, from its JSON schema."""
    if "anyOf" in schema:
        return [value for option in schema["anyOf"] for value in candidates(option)]
    if "const" in schema or "enum" in schema:
        return list(schema.get("enum", [schema.get("const")]))
    if schema["type"] in ("number", "integer"):
        low = max(schema.get("minimum", schema.get("exclusiveMinimum", -1.0)), -1000.0)
        high = min(schema.get("maximum", schema.get("exclusiveMaximum", np.inf)), low + 40)
        values = [low + 0.3 * (high - low), low + 0.7 * (high - low)]
        return [int(value) for value in values] if schema["type"] == "integer" else values
    return []


def pairs() -> list[tuple[type[Impairment], str, Any, Any]]:
    """For every parameter, two values of it."""
    found: list[tuple[type[Impairment], str, Any, Any]] = []
    for model in HARMFUL:
        for name, schema in model.model_json_schema()["properties"].items():
            if name != "kind":
                values = candidates(schema)
                assert len(values) >= 2, f"{model.__name__}.{name} has no two values to compare"
                found.extend((model, name, values[0], other) for other in values[1:])
    return found


def name_of(value: object) -> str:
    return getattr(value, "__name__", str(value))


def build(model: type[Impairment], **given: Any) -> Impairment:
    """The impairment with what is given, and whatever else it needs."""
    properties = model.model_json_schema()
    needed = {name: candidates(properties["properties"][name])[0] for name in properties.get("required", [])}
    if issubclass(model, PointImpairment) and not given.keys() & {model.in_data_units, "relative", "snr_db"}:
        needed[model.in_data_units] = 0.1
    return model(**{**needed, **given})


def send(impairment: Impairment, packets: list[bytes], *, seed: int = 1, attempt: int = 0) -> Delivery:
    return Channel([impairment], seed=seed).transmit(packets, transmission="hills", attempt=attempt)


@pytest.mark.parametrize(
    ("model", "name", "one", "other"), pairs(), ids=lambda value: getattr(value, "__name__", str(value))
)
def test_changing_a_parameter_changes_the_outcome(
    model: type[Impairment], name: str, one: Any, other: Any, few_packets: list[bytes]
) -> None:
    first, second = (send(build(model, **{name: value}), few_packets) for value in (one, other))
    assert first != second


@pytest.mark.parametrize("model", HARMFUL)
def test_changing_seed_transmission_or_attempt_changes_the_outcome(
    model: type[Impairment], few_packets: list[bytes]
) -> None:
    channel = Channel([build(model, probability=0.5)], seed=1)
    second_place = Channel([build(model, probability=0.0), *channel.impairments], seed=1)
    outcomes = [
        channel.transmit(few_packets, transmission="hills"),
        channel.transmit(few_packets, transmission="dales"),
        channel.transmit(few_packets, transmission="hills", attempt=1),
        Channel(channel.impairments, seed=2).transmit(few_packets, transmission="hills"),
        second_place.transmit(few_packets, transmission="hills"),
    ]
    assert all(a != b for i, a in enumerate(outcomes) for b in outcomes[:i])


@pytest.mark.parametrize("model", IMPAIRMENTS)
def test_the_same_seed_does_the_same_harm_in_any_order(model: type[Impairment], few_packets: list[bytes]) -> None:
    impairment = build(model, probability=0.7)
    expected = send(impairment, few_packets)
    assert send(impairment, few_packets) == expected
    rng = np.random.default_rng(0)
    for _ in range(3):
        shuffled = send(impairment, [few_packets[i] for i in rng.permutation(len(few_packets))])
        assert sorted(shuffled.packets) == sorted(expected.packets)
        if model is not Rate:  # a queue: who comes first is served first
            assert shuffled.faults == expected.faults
            assert shuffled.times == expected.times


@pytest.mark.parametrize("model", IMPAIRMENTS)
def test_any_number_of_workers_does_the_same_harm(model: type[Impairment], few_packets: list[bytes]) -> None:
    if issubclass(model, PointImpairment):
        impairment = build(model, probability=0.7, snr_db=10, axes="xyz")
    else:
        impairment = build(model, probability=0.7)
    channel = Channel([impairment], seed=3)
    expected = channel.transmit(few_packets, transmission="hills")
    reference = Reference.of(launch(few_packets))

    def work(part: list[bytes]) -> Delivery:
        return channel.transmit(part, transmission="hills", reference=reference)

    for workers in (2, 5):
        with ThreadPoolExecutor(workers) as pool:
            deliveries = list(pool.map(work, [few_packets[i::workers] for i in range(workers)]))
        assert sorted(p for delivery in deliveries for p in delivery.packets) == sorted(expected.packets)
        if model is not Rate:
            faults = sorted(
                (fault for delivery in deliveries for fault in delivery.faults), key=lambda fault: fault.packet
            )
            assert faults == list(expected.faults)


RELATIVE = [{"relative": 0.1}, {"snr_db": 10.0}]
POINT_NOISE = [model for model in HARMFUL if issubclass(model, PointImpairment)]


@pytest.mark.parametrize("model", POINT_NOISE)
def test_noise_in_data_units_is_the_same_in_any_company(model: type[PointImpairment], few_packets: list[bytes]) -> None:
    impairment = build(model)
    alone = [send(impairment, [packet]).packets[0] for packet in few_packets]
    assert tuple(alone) == send(impairment, few_packets).packets


@pytest.mark.parametrize("strength", RELATIVE, ids=str)
@pytest.mark.parametrize("model", POINT_NOISE)
def test_relative_noise_refers_to_the_points_of_the_call_or_to_what_is_given(
    model: type[PointImpairment], strength: dict[str, float], few_packets: list[bytes]
) -> None:
    if model.model_fields["kind"].default == "impulse":
        strength = {**strength, "p": 0.9}
    channel = Channel([build(model, **strength)], seed=1)
    whole = channel.transmit(few_packets, transmission="hills")
    alone = channel.transmit(few_packets[:1], transmission="hills")
    assert alone.packets[0] != whole.packets[0]
    again = channel.transmit(few_packets[:1], transmission="hills", reference=whole.reference)
    assert again.packets[0] == whole.packets[0]
    assert again.reference is whole.reference


def test_who_has_no_relative_strength_refers_to_nothing(few_packets: list[bytes]) -> None:
    assert send(build(POINT_NOISE[0]), few_packets).reference is None


@pytest.mark.parametrize("model", HARMFUL)
def test_applied_with_probability_0_it_does_nothing(model: type[Impairment], few_packets: list[bytes]) -> None:
    delivery = send(build(model, probability=0.0), few_packets)
    assert delivery.packets == tuple(few_packets)
    assert not delivery.faults
    assert not delivery.seconds


def plain_or_idle() -> list[Impairment]:
    """Every impairment, as it comes and with each of its parameters at 0 or 1, where it may be."""
    built = [build(model) for model in IMPAIRMENTS]
    for model in HARMFUL:
        for name in model.model_fields:
            for value in (0, 1):
                with suppress(ValidationError):
                    built.append(build(model, **{name: value}))
    return built


@pytest.mark.parametrize("impairment", plain_or_idle(), ids=repr)
def test_it_knows_whether_it_acts(impairment: Impairment, few_packets: list[bytes]) -> None:
    assert impairment.acts == any(send(impairment, few_packets, seed=seed).faults for seed in range(5))


@pytest.mark.parametrize("model", IMPAIRMENTS)
def test_the_log_tells_the_touched_from_the_untouched(model: type[Impairment], few_packets: list[bytes]) -> None:
    delivery = send(build(model, probability=0.5), few_packets)
    touched = {fault.packet for fault in delivery.faults}
    assert {fault.kind for fault in delivery.faults} <= {model.model_fields["kind"].default}
    came = list(delivery.packets)
    for sequence, data in enumerate(few_packets):
        if sequence not in touched:
            came.remove(data)
    if model is not Clean:
        assert touched
        assert touched < set(range(len(few_packets)))
        assert sum(delivery.counts.values()) == len(delivery.faults)
    assert all(fault.amount > 0 and str(round(fault.amount, 6))[:1] in fault.detail for fault in delivery.faults)


@pytest.mark.parametrize("model", IMPAIRMENTS)
def test_a_model_is_frozen_and_takes_no_unknown_parameter(model: type[Impairment]) -> None:
    impairment = build(model)
    with pytest.raises(ValidationError):
        impairment.probability = 0.3  # type: ignore[misc]
    with pytest.raises(ValidationError):
        model.model_validate({**impairment.model_dump(), "unknown": 1})


EVERYTHING = Channel([build(model, probability=0.9) for model in HARMFUL], seed=8)


@pytest.fixture(scope="module")
def sample() -> list[bytes]:
    points = np.random.default_rng(1).normal(size=(40, 3))
    options = WireOptions(datagram=120)
    return encode(FeatureSet(points, Region(-1, 1, -1, 1)), transmission="t", options=options)


@given(data=st.data())
def test_transmit_never_raises(sample: list[bytes], data: st.DataObject) -> None:
    datagrams = st.binary(max_size=80) | st.sampled_from(sample) | st.sampled_from(sample).map(lambda b: b[:-3])
    joined = st.lists(st.sampled_from(sample), max_size=3).map(b"".join)
    packets = data.draw(st.lists(datagrams | joined, max_size=12))
    attempt = data.draw(st.integers(0, 2**31))
    delivery = EVERYTHING.transmit(packets, transmission=data.draw(st.text(max_size=5)), attempt=attempt)
    assert all(isinstance(packet, bytes) for packet in delivery.packets)
    assert len(delivery.times) == len(delivery.packets)
    assert list(delivery.times) == sorted(delivery.times)


@pytest.mark.parametrize("strength", [{"relative": 1e6}, {"snr_db": -200}])
@pytest.mark.parametrize("model", [model for model in HARMFUL if issubclass(model, PointImpairment)])
def test_the_largest_numbers_stay_finite(model: type[PointImpairment], strength: dict[str, float]) -> None:
    limit = float(np.finfo(float).max)
    points = np.array([[0.0, 0.0, limit], [1.0, 1.0, -limit], [0.5, 0.2, 0.0]])
    packets = encode(FeatureSet(points, Region(0, 1, 0, 1)), transmission="t", options=WireOptions(precision="float64"))
    delivery = send(build(model, axes="xyz", **strength), packets)
    arrived = [decode(packet) for packet in delivery.packets]
    assert all(packet is not None and np.isfinite(packet.points).all() for packet in arrived)


def test_point_noise_marks_what_it_changed_and_keeps_the_rest_of_the_packet(few_packets: list[bytes]) -> None:
    delivery = Channel.parse("gaussian:std=0.1").transmit(few_packets, transmission="hills")
    for sent, came in zip(map(decode, few_packets), map(decode, delivery.packets), strict=True):
        assert sent is not None
        assert came is not None
        assert (came.tag, came.number, came.total, came.region) == (sent.tag, sent.number, sent.total, sent.region)
        assert np.array_equal(came.points[:, :2], sent.points[:, :2])
        assert not np.any(came.points[:, 2] == sent.points[:, 2])


def test_a_delivery_decodes_as_one_body(few_packets: list[bytes]) -> None:
    delivery = Channel.parse("gaussian:std=0.1;erasure:p=0.3;bit_errors:ber=3e-4").transmit(
        few_packets, transmission="hills"
    )
    decoder = PacketDecoder()
    found = [*decoder.feed(delivery.body), *decoder.close()]
    assert [packet.number for packet in found] == [
        packet.number for packet in map(decode, delivery.packets) if packet is not None
    ]


PROTECTED = [
    WireOptions(parity=0.5),
    WireOptions(copies=3),
    WireOptions(inner=16),
    WireOptions(coding="compact", parity=0.2),
]


@pytest.mark.parametrize("options", PROTECTED, ids=str)
def test_protected_packets_are_told_apart_and_harmed_by_themselves(points: FloatArray, options: WireOptions) -> None:
    packets = encode(FeatureSet(points[:500], Region(-1, 1, -1, 1)), transmission="hills", options=options)
    decoded = [datagram.sent.packet for datagram in launch(packets)]
    assert [packet.number for packet in decoded if packet is not None] == list(range(len(packets)))
    delivery = Channel.parse("erasure:p=0.3;gaussian:std=0.1", seed=2).transmit(packets, transmission="hills")
    lost = {(fault.packet, fault.copy) for fault in delivery.faults if fault.kind == "erasure"}
    assert len(lost) == len(packets) - len(delivery.packets)
    moved = {(fault.packet, fault.copy) for fault in delivery.faults if fault.kind == "gaussian"}
    assert (
        moved
        == {(packet.sequence, packet.copy) for packet in decoded if packet is not None and len(packet.points)} - lost
    )


def test_noise_reaches_what_the_inner_code_repairs(points: FloatArray) -> None:
    options = WireOptions(inner=16)
    packets = encode(FeatureSet(points[:500], Region(-1, 1, -1, 1)), transmission="hills", options=options)
    delivery = Channel.parse("bit_errors:ber=1e-3;gaussian:std=0.1", seed=2).transmit(packets, transmission="hills")
    hit = {fault.packet for fault in delivery.faults if fault.kind == "bit_errors"}
    moved = {fault.packet for fault in delivery.faults if fault.kind == "gaussian"}
    assert hit & moved
    # Sent on, a repaired packet is itself again: what comes first of two channels does not upset the second.
    harmed = Channel.parse("bit_errors:ber=1e-3", seed=2).transmit(packets, transmission="hills").packets
    numbers = [datagram.sent.packet.number for datagram in launch(harmed) if datagram.sent.packet is not None]
    assert numbers == sorted(numbers)
    assert len(numbers) > 0.9 * len(packets)
