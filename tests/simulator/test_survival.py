"""Protection corrects what it promises; a channel does to a message what its name says; failures are counted."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from common.channel import Channel
from common.errors import ChannelError, NotFoundError
from sender.surfaces import find_surface
from simulator.codecs import Message, Sandbox, best, smallest
from simulator.codecs.protection import PROTECTIONS, Protection, find_protection
from simulator.codecs.survival import Survival, expose, received
from tests.simulator.decoders import misbehave

pytest.importorskip("reedsolo", reason="needs reedsolo, of the extra 'codecs'")

CODES = [PROTECTIONS["rs223"], PROTECTIONS["rs127"]]


def z() -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    return np.array(find_surface("franke").grid((48, 48)).z)


def nothing_lost(data: bytes) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    return np.zeros(len(data), dtype=np.bool_)


@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize("length", [1, 100, 223, 224, 700])
def test_codes_correct_what_they_promise_and_no_more(code: Protection, length: int) -> None:
    rng = np.random.default_rng(length)
    message = rng.bytes(length)
    sent = code.encode(message)
    assert len(sent) == code.sent(length)
    words = -(-len(sent) // 255)
    data = np.frombuffer(sent, np.uint8).copy()
    lost = nothing_lost(sent)
    # A burst takes the same number of bytes from each codeword: errors for half of the parity, losses for the rest.
    wrong, gone = (code.parity // 4) * words, (code.parity // 2) * words
    if wrong + gone <= length:
        data[:wrong] ^= 0x5A
        data[wrong : wrong + gone], lost[wrong : wrong + gone] = 0, True
    body, left = code.decode(data.tobytes(), lost)
    assert body == message
    assert not left.any()
    over = np.frombuffer(sent, np.uint8).copy()
    over[: min(length, (code.parity // 2 + 1) * words)] ^= 0x5A
    if length > (code.parity // 2 + 1) * words:
        assert code.decode(over.tobytes(), nothing_lost(sent))[0] == over.tobytes()[:length]


@pytest.mark.parametrize("code", CODES)
@settings(max_examples=15, deadline=None)
@given(length=st.integers(1, 600), seed=st.integers(0, 2**32 - 1), wrong=st.integers(0, 60), gone=st.integers(0, 60))
def test_counting_errors_is_the_same_as_decoding(
    code: Protection, length: int, seed: int, wrong: int, gone: int
) -> None:
    rng = np.random.default_rng(seed)
    sent = code.encode(rng.bytes(length))
    assume(wrong + gone <= len(sent))
    hit = rng.permutation(len(sent))
    data, lost = np.frombuffer(sent, np.uint8).copy(), nothing_lost(sent)
    data[hit[:wrong]] ^= rng.integers(1, 256, wrong).astype(np.uint8)
    data[hit[wrong : wrong + gone]], lost[hit[wrong : wrong + gone]] = 0, True
    real, counted = code.decode(data.tobytes(), lost), code.decode(data.tobytes(), lost, sent)
    assert real[0] == counted[0]
    np.testing.assert_array_equal(real[1], counted[1])


@pytest.mark.parametrize("code", PROTECTIONS.values(), ids=str)
@given(budget=st.integers(0, 5000))
def test_the_payload_is_the_most_that_fits(code: Protection, budget: int) -> None:
    payload = code.payload(budget)
    assert not payload or code.sent(payload) <= budget
    assert code.sent(payload + 1) > budget


def test_bytes_cross_a_channel_in_their_places() -> None:
    data = np.random.default_rng(0).bytes(1000)
    out, lost = received(data, Channel.parse("clean"), transmission="t")
    assert out == data
    assert not lost.any()
    out, lost = received(data, Channel.parse("erasure:p=0.5", seed=3), transmission="t", datagram=100)
    assert 0 < lost.sum() < 1000
    assert lost.reshape(10, 100).all(axis=1).sum() * 100 == lost.sum()
    sent, came = np.frombuffer(data, np.uint8), np.frombuffer(out, np.uint8)
    np.testing.assert_array_equal(came, np.where(lost, 0, sent))
    out, lost = received(data, Channel.parse("truncation:p=1,keep=0.5", seed=3), transmission="t", datagram=100)
    came = np.frombuffer(out, np.uint8)
    assert len(out) == 1000
    assert 0 < lost.sum() < 500
    np.testing.assert_array_equal(came, np.where(lost, 0, sent))


def test_bit_errors_come_at_their_rate() -> None:
    data = bytes(50_000)
    out, lost = received(data, Channel.parse("bit_errors:ber=0.01"), transmission="t")
    flips = int(np.unpackbits(np.frombuffer(out, np.uint8)).sum())
    assert abs(flips - 4000) < 4 * np.sqrt(4000)
    assert not lost.any()


@pytest.mark.parametrize("name", ["dct", "scattered_samples"])
def test_survival_is_repeatable_and_protection_protects(name: str) -> None:
    heights = z()
    link = Channel.parse("bit_errors:ber=0.003")
    with Sandbox() as box:

        def survive(protection: str) -> Survival:
            message = best(name, heights, find_protection(protection).payload(900))
            return expose(heights, message, link, range(8), protection=protection, sandbox=box)

        bare, strong = survive("none"), survive("rs127")
        assert bare == survive("none")
    assert bare.sent == len(bare.message.data) <= 900
    assert strong.sent == len(find_protection("rs127").encode(strong.message.data)) <= 900
    assert strong.sent >= 2 * len(strong.message.data)
    assert len(bare.errors) == 8
    assert strong.failed == 0
    assert strong.errors == (strong.message.nrmse,) * 8
    assert sum(error <= 1.01 * bare.message.nrmse for error in bare.decoded) < 4
    assert bare.channel == "bit_errors:ber=0.003"


def test_a_clean_channel_changes_nothing_and_seeds_matter() -> None:
    heights = z()
    message = smallest("dct", heights, 0.02)
    with Sandbox() as box:
        clean = expose(heights, message, Channel(), [1, 2], sandbox=box)
        noisy = expose(heights, message, Channel.parse("bit_errors:ber=0.002"), range(6), sandbox=box)
    assert clean.errors == (message.nrmse, message.nrmse)
    assert clean.median == message.nrmse
    assert clean.failed == 0
    assert len(set(noisy.errors)) > 1


def test_what_the_transport_undoes_and_what_has_no_meaning() -> None:
    heights = z()
    message = smallest("dct", heights, 0.02)
    shuffled = Channel.parse("reordering:p=1;duplication:p=1")
    assert expose(heights, message, shuffled, [0]).errors == (message.nrmse,)
    with pytest.raises(ChannelError, match="moves points"):
        expose(heights, message, Channel.parse("gaussian:std=0.1"), [0])
    with pytest.raises(NotFoundError, match="rs223"):
        expose(heights, message, Channel(), [0], protection="ldpc")


def test_decoders_that_crash_or_hang_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    """The decoder is replaced by one that misbehaves; the survey goes on and counts."""
    monkeypatch.setattr("simulator.codecs.survival.decode", misbehave)
    calls = iter(["crash", "hang", "refuse", "crash"])
    monkeypatch.setattr("simulator.codecs.survival._arrival", lambda *_: (next(calls),))
    message = Message("dct", (1.0, 0.5), b"any", 0.01)
    with Sandbox(seconds=1.0) as box:
        survival = expose(z(), message, Channel(), range(4), sandbox=box)
    assert survival.failures == {"crash": 2, "error": 1, "timeout": 1}
    assert survival.errors == (None,) * 4
    assert survival.failed == 1
    assert survival.median is None


def test_a_grid_of_another_shape_is_a_failure() -> None:
    heights = z()
    message = smallest("dct", heights[:24], 0.02)
    assert expose(heights, message, Channel(), [0]).failures == {"error": 1}
    assert find_protection("none").encode(message.data) == message.data
    assert dataclasses.replace(PROTECTIONS["none"]).decode(b"ab", nothing_lost(b"ab"))[0] == b"ab"
