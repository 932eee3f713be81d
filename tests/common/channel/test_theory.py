"""Each impairment does what its equation says, within three standard errors."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from scipy.special import erfc

from common.channel import Channel, Delivery
from common.channel.datagram import decode, launch
from common.channel.impairments.gilbert_elliott import BLOCK, GilbertElliott
from common.channel.passage import Draws, Passage, Purpose, Reference
from common.surface import FloatArray

SIGMAS = 3


def send(text: str, packets: Sequence[bytes], seed: int = 1) -> Delivery:
    return Channel.parse(text, seed=seed).transmit(packets, transmission="hills")


def close(measured: float, expected: float, standard_error: float) -> bool:
    return abs(measured - expected) <= SIGMAS * standard_error


def added(packets: Sequence[bytes], delivery: Delivery) -> FloatArray:
    """What was added to each coordinate, shape (n, 3)."""
    assert len(packets) == len(delivery.packets)
    pairs = [(decode(sent), decode(came)) for sent, came in zip(packets, delivery.packets, strict=True)]
    return np.concatenate([came.points - sent.points for sent, came in pairs if sent is not None and came is not None])


def flips(packets: Sequence[bytes], delivery: Delivery) -> FloatArray:
    """Wrong bits of each datagram."""
    sent, came = (np.array([np.frombuffer(data, np.uint8) for data in run]) for run in (packets, delivery.packets))
    counts = np.bitwise_count(sent ^ came).sum(axis=1, dtype=np.float64)
    # The fault log counts the same bits.
    assert counts.sum() == sum(fault.amount for fault in delivery.faults)
    return np.asarray(counts)


def noise(count: int, length: int) -> list[bytes]:
    rng = np.random.default_rng(5)
    return [rng.bytes(length) for _ in range(count)]


# ---- points


@pytest.mark.parametrize("axes", ["z", "xyz"])
@pytest.mark.parametrize(
    ("text", "deviation"),
    [("gaussian:std=0.2", 0.2), ("uniform:amplitude=0.2", 0.2 / math.sqrt(3)), ("impulse:p=0.25,std=4", 2.0)],
)
def test_noise_has_the_deviation_asked_for_and_no_mean(
    packets: list[bytes], text: str, deviation: float, axes: str
) -> None:
    values = added(packets, send(f"{text},axes={axes}", packets))
    untouched = values[:, ["xyz".index(axis) for axis in "xyz" if axis not in axes]]
    assert not untouched.any()
    values = values[:, ["xyz".index(axis) for axis in axes]]
    # The standard error of a mean square follows from the fourth moment.
    square = values**2
    assert close(float(square.mean()), deviation**2, float(square.std()) / math.sqrt(values.size))
    assert close(float(values.mean()), 0.0, deviation / math.sqrt(values.size))
    if axes == "xyz":
        correlation = np.asarray(np.corrcoef(values.T))[np.triu_indices(3, 1)]
        assert np.abs(correlation).max() < SIGMAS * 1.5 / math.sqrt(len(values))


def test_gaussian_noise_is_gaussian_and_uniform_noise_is_bounded(packets: list[bytes]) -> None:
    gaussian = added(packets, send("gaussian:std=1", packets))[:, 2]
    for limit in (1.0, 2.0, 3.0):
        share, expected = float(np.mean(np.abs(gaussian) > limit)), math.erfc(limit / math.sqrt(2))
        assert close(share, expected, math.sqrt(expected / len(gaussian)))
    uniform = added(packets, send("uniform:amplitude=0.2", packets))[:, 2]
    # A height near 10^4 is rounded to 2^-40.
    assert 0.199 < np.abs(uniform).max() < 0.2 + 1e-11
    assert close(float(np.mean(np.abs(uniform) < 0.05)), 0.25, math.sqrt(0.25 * 0.75 / len(uniform)))


def test_impulses_hit_the_share_asked_for_and_the_log_counts_them(packets: list[bytes]) -> None:
    delivery = send("impulse:p=0.05,std=10", packets)
    hit = added(packets, delivery)[:, 2] != 0
    assert close(float(hit.mean()), 0.05, math.sqrt(0.05 * 0.95 / len(hit)))
    assert sum(fault.amount for fault in delivery.faults) == np.count_nonzero(hit)


def test_impulses_hit_each_axis_by_itself(packets: list[bytes]) -> None:
    hit = added(packets, send("impulse:p=0.3,std=10,axes=xyz", packets)) != 0
    for one, other in ((0, 1), (0, 2), (1, 2)):
        together = float(np.mean(hit[:, one] & hit[:, other]))
        assert close(together, 0.09, math.sqrt(0.09 * 0.91 / len(hit)))


def test_noises_in_a_row_add_up_and_are_independent(packets: list[bytes]) -> None:
    first = added(packets, send("gaussian:std=0.2", packets))[:, 2]
    both = added(packets, send("gaussian:std=0.2;uniform:amplitude=0.3;gaussian:std=0.2", packets))[:, 2]
    power = 2 * 0.04 + 0.03
    assert close(float(np.mean(both**2)), power, power * math.sqrt(2 / len(both)))
    assert close(float(np.mean(first * (both - first))), 0.0, 0.2 * math.sqrt(0.07 / len(both)))


@pytest.mark.parametrize("kind", ["gaussian", "uniform", "impulse", "bias"])
def test_snr_counts_the_heights_without_their_mean(packets: list[bytes], points: FloatArray, kind: str) -> None:
    values = added(packets, send(f"{kind}:snr_db=20", packets))[:, 2]
    square = values**2
    assert close(
        float(square.mean()), float(points[:, 2].var()) / 100, float(square.std()) / math.sqrt(values.size) + 1e-9
    )


def test_each_axis_is_relative_to_its_own_range(packets: list[bytes], points: FloatArray) -> None:
    values = added(packets, send("bias:relative=-0.5,axes=xyz", packets))
    assert np.allclose(values, -0.5 * np.ptp(points, axis=0), rtol=1e-9)
    spread = added(packets, send("gaussian:relative=0.1", packets))[:, 2].std()
    expected = 0.1 * np.ptp(points[:, 2])
    assert close(float(spread), expected, expected / math.sqrt(2 * len(points)))


def test_noise_is_not_clipped(packets: list[bytes]) -> None:
    values = added(packets, send("bias:offset=1e9,axes=xyz", packets))
    assert np.allclose(values, 1e9, rtol=1e-12)


# ---- bits


def q(x: float) -> float:
    return 0.5 * float(erfc(x / math.sqrt(2)))


def test_bit_errors_come_at_the_rate_asked_for() -> None:
    packets = noise(400, 500)
    for rate in (1e-5, 1e-3, 0.1, 0.5, 1.0):
        bits = 8 * 500 * 400
        measured = flips(packets, send(f"bit_errors:ber={rate}", packets)).sum() / bits
        assert close(measured, rate, math.sqrt(rate * (1 - rate) / bits))


@pytest.mark.parametrize("modulation", ["bpsk", "qpsk"])
@pytest.mark.parametrize("ebn0_db", range(11))
def test_errors_over_white_noise_follow_the_q_function(modulation: str, ebn0_db: int) -> None:
    packets = noise(40, 5000)
    bits = 8 * 5000 * 40
    measured = flips(packets, send(f"awgn:ebn0_db={ebn0_db},modulation={modulation}", packets)).sum() / bits
    expected = q(math.sqrt(2 * 10 ** (ebn0_db / 10)))
    assert close(measured, expected, math.sqrt(expected * (1 - expected) / bits))


def rayleigh(ebn0_db: float) -> float:
    g = 10 ** (ebn0_db / 10)
    return (1 - math.sqrt(g / (1 + g))) / 2


@pytest.mark.parametrize("modulation", ["bpsk", "qpsk"])
@pytest.mark.parametrize("ebn0_db", [0, 5, 10])
@pytest.mark.parametrize("coherence", ["packet", "1", "64"])
def test_errors_over_rayleigh_fading_follow_theory(modulation: str, ebn0_db: int, coherence: str) -> None:
    packets = noise(2500, 64)
    text = f"rayleigh:ebn0_db={ebn0_db},modulation={modulation},coherence={coherence}"
    shares = flips(packets, send(text, packets)) / (8 * 64)
    # The bits of a packet share gains, the packets do not: their spread gives the standard error.
    assert close(float(shares.mean()), rayleigh(ebn0_db), float(shares.std()) / math.sqrt(len(shares)))


def test_a_gain_that_lasts_longer_gathers_the_errors_in_fewer_packets() -> None:
    packets = noise(500, 64)
    spared = [
        float(np.mean(flips(packets, send(f"rayleigh:ebn0_db=15,coherence={coherence}", packets)) == 0))
        for coherence in ("1", "64", "packet")
    ]
    assert spared[0] < spared[1] < spared[2]


# ---- packets


def lost(count: int, delivery: Delivery) -> FloatArray:
    gone = np.zeros(count)
    gone[[fault.packet for fault in delivery.faults]] = 1
    assert len(delivery.packets) == count - gone.sum()
    return gone


@pytest.mark.parametrize("share", [0.0, 0.05, 0.3, 1.0])
def test_erasure_loses_the_share_asked_for_each_packet_by_itself(share: float) -> None:
    gone = lost(10_000, send(f"erasure:p={share}", [b""] * 10_000))
    assert close(float(gone.mean()), share, math.sqrt(share * (1 - share) / len(gone)))
    together = float(np.mean(gone[1:] * gone[:-1]))
    assert close(together, share**2, math.sqrt(share**2 * (1 - share**2) / len(gone)) * 1.5)


GE = [(0.02, 0.3, 1.0, 0.0), (0.1, 0.25, 0.98, 0.3), (0.6, 0.7, 1.0, 0.0), (0.9, 0.8, 0.9, 0.1)]


@pytest.mark.parametrize(("p", "r", "k", "h"), GE)
def test_gilbert_elliott_loss_follows_theory(p: float, r: float, k: float, h: float) -> None:
    gone = lost(20_000, send(f"gilbert_elliott:p={p},r={r},k={k},h={h}", [b""] * 20_000))
    expected = (1 - k) * r / (p + r) + (1 - h) * p / (p + r)
    # Losses lag by lag: covariance (k - h)^2 p r / (p + r)^2 (1 - p - r)^lag, summed over all lags.
    memory = 1 - p - r
    state = (k - h) ** 2 * p * r / (p + r) ** 2
    variance = expected * (1 - expected) + 2 * state * memory / (1 - memory)
    assert close(float(gone.mean()), expected, math.sqrt(variance / len(gone)))


@pytest.mark.parametrize(("p", "r"), [(0.02, 0.3), (0.05, 0.1), (0.6, 0.7)])
def test_gilbert_elliott_bursts_are_as_long_as_theory_says(p: float, r: float) -> None:
    gone = lost(20_000, send(f"gilbert_elliott:p={p},r={r}", [b""] * 20_000))
    edges = np.flatnonzero(np.diff(np.concatenate([[0.0], gone, [0.0]])))
    lengths, gaps = edges[1::2] - edges[::2], edges[2::2] - edges[1:-1:2]
    for measured, turn in ((lengths, r), (gaps, p)):
        assert close(float(measured.mean()), 1 / turn, math.sqrt(1 - turn) / turn / math.sqrt(len(measured)))


@pytest.mark.parametrize(("p", "r"), [(0.01, 0.03), (1.0, 1.0), (0.002, 0.001)])
def test_gilbert_elliott_is_as_bad_at_first_as_it_is_later(p: float, r: float) -> None:
    channel = Channel.parse(f"gilbert_elliott:p={p},r={r}", seed=1)
    first = [not channel.transmit([b""], transmission=str(name)).packets for name in range(2000)]
    bad = p / (p + r)
    assert close(float(np.mean(first)), bad, math.sqrt(bad * (1 - bad) / len(first)))


@pytest.mark.parametrize(("p", "r"), [(0.01, 0.1), (2e-4, 1e-4), (0.9, 0.8), (0.9999, 0.9999), (1.0, 1.0), (0.0, 0.0)])
def test_the_chain_found_by_going_back_is_the_chain_run_step_by_step(p: float, r: float) -> None:
    model = GilbertElliott(p=p, r=r)
    draws = Draws.of(3, "hills", 0, 0)
    passage = Passage(model.kind, draws, lambda: Reference.of([]))
    blocks = 5
    u = np.concatenate([draws.generator(Purpose.CHAIN, block).random(BLOCK) for block in range(blocks)])
    start = draws.generator(Purpose.CHAIN, 2**32).random()
    bad = p + r > 0 and start < p / (p + r)
    states = []
    for value in u:
        bad = value < (1 - r if bad else p)
        states.append(bad)
    numbers = np.random.default_rng(0).permutation(blocks * BLOCK)
    assert np.array_equal(model._bad(numbers, passage), np.array(states)[numbers])


def test_duplication_adds_copies_that_are_harmed_by_themselves(few_packets: list[bytes]) -> None:
    delivery = send("duplication:p=1,copies=3;gaussian:std=0.1", few_packets)
    assert len(delivery.packets) == 4 * len(few_packets) == len(set(delivery.packets))
    count = len(send("duplication:p=0.3", [b""] * 5000).packets) - 5000
    assert close(count / 5000, 0.3, math.sqrt(0.21 / 5000))


def test_duplications_in_a_row_make_independent_copies(few_packets: list[bytes]) -> None:
    delivery = send("duplication:p=1;duplication:p=1;bit_errors:ber=0.1", few_packets)
    assert len(set(delivery.packets)) == 4 * len(few_packets)


def test_reordering_moves_packets_back_by_at_most_its_depth() -> None:
    sent = [bytes([i // 256, i % 256]) for i in range(1000)]
    came = send("reordering:p=0.2,depth=5", sent)
    assert sorted(came.packets) == sent
    assert came.packets != tuple(sent)
    place = {data: index for index, data in enumerate(came.packets)}
    shifts = np.array([place[data] - index for index, data in enumerate(sent)])
    assert shifts.max() <= 5
    moved = {fault.packet for fault in came.faults}
    assert close(len(moved) / 1000, 0.2, math.sqrt(0.16 / 1000))
    # The others keep their order among themselves.
    others = [data for data in came.packets if int.from_bytes(data, "big") not in moved]
    assert others == sorted(others)


def test_reordering_moves_packets_within_the_order_that_jitter_left() -> None:
    sent = [bytes([i // 256, i % 256]) for i in range(1000)]
    before = send("jitter:seconds=1", sent).packets
    came = send("jitter:seconds=1;reordering:p=0.2,depth=5", sent)
    place = {data: index for index, data in enumerate(before)}
    moved = {fault.packet for fault in came.faults if fault.kind == "reordering"}
    others = [data for data in came.packets if int.from_bytes(data, "big") not in moved]
    assert others == sorted(others, key=place.__getitem__)
    shifts = np.array([index - place[data] for index, data in enumerate(came.packets)])
    assert 0 < shifts.max() <= 5
    assert list(came.times) == sorted(came.times)


def test_truncation_keeps_a_head_that_is_long_enough() -> None:
    sent = noise(1000, 100)
    came = send("truncation:p=1,keep=0.4", sent)
    assert all(data.startswith(head) for data, head in zip(sent, came.packets, strict=True))
    lengths = np.array([len(head) for head in came.packets])
    assert 40 <= lengths.min() < 45
    assert 95 < lengths.max() < 100
    assert sum(fault.amount for fault in came.faults) == 100 * 1000 - lengths.sum()


def test_delay_and_jitter_add_up_and_who_is_earlier_arrives_earlier() -> None:
    sent = [bytes([i]) for i in range(200)]
    came = send("delay:seconds=2;jitter:seconds=0.5", sent)
    assert min(came.times) >= 2
    assert 2.4 < came.seconds <= 2.5
    assert list(came.times) == sorted(came.times)
    assert came.packets != tuple(sent)


def test_rate_is_a_queue_that_counts_the_bytes_as_sent(few_packets: list[bytes]) -> None:
    # The point noise makes the datagrams longer in the end; on the line they are as long as sent.
    came = send("gaussian:std=0.1;rate:bits_per_second=1000", few_packets)
    expected = 8 * np.cumsum([len(data) for data in few_packets]) / 1000
    assert np.allclose(came.times, expected)


def test_rate_serves_who_comes_first_and_who_finds_the_line_free_does_not_wait() -> None:
    sent = [bytes([i]) * (i + 1) for i in range(50)]
    before = send("jitter:seconds=10", sent)
    came = send("jitter:seconds=10;rate:bits_per_second=1000", sent)
    assert came.packets == before.packets
    free, expected, waited = 0.0, [], 0
    for data, at in zip(before.packets, before.times, strict=True):
        waited += free > at
        free = max(free, at) + 8 * len(data) / 1000
        expected.append(free)
    assert 0 < waited < len(sent)
    assert np.allclose(came.times, expected, rtol=1e-12)


def test_point_noise_exposes_no_more_bits_to_errors(few_packets: list[bytes]) -> None:
    before = send("gaussian:std=0.1;bit_errors:ber=1e-3", few_packets)
    after = send("bit_errors:ber=1e-3;gaussian:std=0.1", few_packets)
    assert [len(data) for data in before.packets if decode(data) is None]
    harmed = [[decode(data) is None for data in delivery.packets] for delivery in (before, after)]
    assert 0 < sum(harmed[0]) < len(few_packets)
    assert {len(data) for data in before.packets if decode(data) is None} <= {len(data) for data in few_packets}


def test_probability_of_application_is_apart_from_strength(packets: list[bytes]) -> None:
    weak = send("gaussian:std=0.1,probability=0.5", packets)
    touched = {fault.packet for fault in weak.faults}
    assert close(len(touched) / len(packets), 0.5, 0.5 / math.sqrt(len(packets)))
    # A packet that is touched is touched exactly as it would be if all were.
    full = send("gaussian:std=0.1", packets)
    for index, (some, every, sent) in enumerate(zip(weak.packets, full.packets, packets, strict=True)):
        assert some == (every if index in touched else sent)


def test_who_is_touched_says_nothing_of_how_hard() -> None:
    gone = lost(10_000, send("erasure:p=0.5,probability=0.5", [b""] * 10_000))
    assert close(float(gone.mean()), 0.25, math.sqrt(0.25 * 0.75 / len(gone)))


def test_losses_in_a_row_are_independent() -> None:
    delivery = send("erasure:p=0.3;gilbert_elliott:p=0.1,r=0.3;erasure:p=0.3", [b""] * 20_000)
    arrived = 0.7 * 0.75 * 0.7
    # The bursts of the chain leave less to average over.
    error = math.sqrt(arrived * (1 - arrived) / 20_000) * math.sqrt(1.6 / 0.4)
    assert close(len(delivery.packets) / 20_000, arrived, error)


def test_a_damaged_packet_is_left_alone_by_point_noise(few_packets: list[bytes]) -> None:
    delivery = send("truncation:p=0.5;gaussian:std=0.1", few_packets)
    cut = {fault.packet for fault in delivery.faults if fault.kind == "truncation"}
    moved = {fault.packet for fault in delivery.faults if fault.kind == "gaussian"}
    assert cut
    assert moved
    assert not cut & moved
    assert cut | moved == set(range(len(few_packets)))


def test_the_copies_of_a_packet_meet_harm_by_themselves(few_packets: list[bytes]) -> None:
    thrice = few_packets * 3
    assert {len(launch(thrice)), 3 * len(few_packets)} == {len(thrice)}
    survivors = [decode(data) for data in send("erasure:p=0.5", thrice).packets]
    arrived = {packet.number for packet in survivors if packet is not None}
    # Lost together, half of the packets would be gone; each by itself, an eighth.
    assert len(arrived) > 0.7 * len(few_packets)
