"""What a codec promises: round trip within its bound, bytes within the budget, its own errors on damaged bytes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from common.errors import MissingExtraError, NotFoundError, ParameterError, PointsError
from common.metrics import max_error, nrmse
from common.surface import FloatArray
from sender.surfaces import find_surface
from simulator import codecs
from simulator.codecs import CODECS, Failure, Sandbox, best, decode, find_codec, smallest
from simulator.codecs.message import HEADER, deflate, inflate, pack_bits, unpack_bits
from simulator.fields import FIELDS, field

AVAILABLE = [
    pytest.param(
        name, marks=pytest.mark.skipif(not codec.available, reason=f"needs {codec.package}, of the extra 'codecs'")
    )
    for name, codec in CODECS.items()
]
OWN = ("dense_cloud", "lattice_spline", "scattered_samples", "dct")
BOUNDED = ("zfp", "sz3", "lerc")


def heights(shape: tuple[int, int] = (48, 64)) -> FloatArray:
    """A corner of the elevation grid: rough, and not square."""
    return np.array(find_surface("elevation").grid().z[100 : 100 + shape[0], 150 : 150 + shape[1]])


@pytest.mark.parametrize("name", AVAILABLE)
def test_round_trip_from_coarse_to_fine(name: str) -> None:
    z = heights()
    rough, fine = smallest(name, z, 0.1), smallest(name, z, 0.02)
    assert len(rough.data) < len(fine.data)
    for message in (rough, fine):
        decoded = decode(name, message.data)
        assert decoded.shape == z.shape
        assert nrmse(z, decoded) == pytest.approx(message.nrmse)
    assert rough.nrmse <= 0.1
    assert fine.nrmse <= 0.02


@pytest.mark.parametrize("name", AVAILABLE)
def test_the_budget_is_kept_and_used(name: str) -> None:
    z = heights()
    tight = len(smallest(name, z, 0.1).data)
    small, large = best(name, z, tight), best(name, z, 2 * tight)
    assert len(small.data) <= tight
    assert len(large.data) <= 2 * tight
    assert large.nrmse < small.nrmse


@pytest.mark.parametrize("name", [p for p in AVAILABLE if p.values[0] in BOUNDED])
def test_bounded_codecs_keep_their_bound(name: str) -> None:
    z, bound = heights(), 0.01
    decoded = decode(name, CODECS[name].encode(z, (bound,)))
    # float32 heights and a float32 scale add their own rounding.
    assert max_error(z, decoded) <= 1.001 * bound * np.ptp(z)


@pytest.mark.parametrize("name", AVAILABLE)
def test_messages_know_their_shape_and_level(name: str) -> None:
    z = heights((24, 40))
    message = smallest(name, z, 0.1)
    moved = smallest(name, z + 10000, 0.1)
    assert decode(name, moved.data).shape == (24, 40)
    assert decode(name, moved.data).mean() == pytest.approx(
        decode(name, message.data).mean() + 10000, abs=0.1 * np.ptp(z)
    )


@pytest.mark.parametrize("name", OWN)
def test_a_flat_surface_is_flat(name: str) -> None:
    z = np.full((16, 16), 3.25)
    ladder = CODECS[name].ladders((16, 16))[0]
    np.testing.assert_allclose(decode(name, CODECS[name].encode(z, ladder[len(ladder) // 2])), 3.25, atol=1e-6)


@pytest.mark.parametrize("name", OWN)
@settings(max_examples=30, deadline=None)
@given(damage=st.data())
def test_damage_is_an_answer_or_an_error(name: str, damage: st.DataObject) -> None:
    """Our own decoders need no sandbox: whatever the bytes, finite heights or an Exception."""
    data = bytearray(best(name, heights((16, 16)), 200).data)
    flips = st.lists(st.tuples(st.integers(0, len(data) - 1), st.integers(1, 255)), max_size=40)
    for position, change in damage.draw(flips):
        data[position] ^= change
    cut = damage.draw(st.integers(0, len(data)))
    try:
        decoded = decode(name, bytes(data[:cut]))
    except (ValueError, PointsError):
        return
    assert np.isfinite(decoded).all()


@pytest.mark.parametrize("name", [p for p in AVAILABLE if p.values[0] not in OWN])
def test_damage_to_any_codec_stays_in_the_sandbox(name: str) -> None:
    """Several of these decoders crash on such bytes; each call ends as heights or as a Failure."""
    rng = np.random.default_rng(1)
    data = np.frombuffer(smallest(name, heights(), 0.02).data, dtype=np.uint8)
    calls = []
    for _ in range(12):
        body = data[HEADER.size :].copy()
        body[rng.integers(0, len(body), 6)] ^= rng.integers(1, 256, 6).astype(np.uint8)
        calls.append((name, data[: HEADER.size].tobytes() + body.tobytes()))
    with Sandbox(seconds=5.0) as box:
        results = list(box.map(decode, calls))
    assert len(results) == 12
    assert all(isinstance(result, Failure) or np.isfinite(result).all() for result in results)
    assert any(isinstance(result, Failure) or nrmse(heights(), result) > 0.021 for result in results)


def test_scattered_samples_outlive_wild_and_lost_ones() -> None:
    """Without its filter a few wild samples cost more than all else; lost ones are interpolated."""
    z = find_surface("franke").grid((64, 64)).z
    message = smallest("scattered_samples", z, 0.002)
    data = np.frombuffer(message.data, dtype=np.uint8).copy()
    rng = np.random.default_rng(0)
    body = np.arange(HEADER.size + 3, len(data) - HEADER.size - 3)
    hit = rng.choice(body, len(body) // 25, replace=False)
    wild = data.copy()
    wild[hit] ^= 0b10000000
    assert nrmse(z, decode("scattered_samples", wild.tobytes())) < 2 * message.nrmse
    lost = np.zeros(len(data), dtype=np.bool_)
    lost[rng.choice(body, len(body) // 4, replace=False)] = True
    holes = np.where(lost, 0, data).astype(np.uint8)
    assert nrmse(z, decode("scattered_samples", holes.tobytes())) > 0.05  # unless the receiver knows what is lost
    assert nrmse(z, decode("scattered_samples", holes.tobytes(), lost)) < 0.015


def test_codecs_make_the_best_of_a_stream_with_a_gap() -> None:
    """What SPERR and the transform codec read behind a gap leads them astray; JPEG 2000 needs its length."""
    z = find_surface("franke").grid((64, 64)).z
    for name, cut in (("sperr", True), ("dct", True), ("jpeg2000", False), ("mesh", False)):
        if not CODECS[name].available:
            continue
        data = best(name, z, 600).data
        errors: list[list[float]] = []
        with Sandbox(seconds=5.0) as box:
            for seed in range(9):
                start = int(np.random.default_rng(seed).integers(150, len(data) - 64))
                lost = np.zeros(len(data), dtype=np.bool_)
                lost[start : start + 64] = True
                holed = data[:start] + bytes(64) + data[start + 64 :]
                found = [box.run(decode, name, holed, known) for known in (None, lost)]
                errors.append([np.inf if isinstance(h, Failure) else nrmse(z, h) for h in found])
        zeros, told = np.median(errors, axis=0)
        if cut:
            assert told < zeros
        else:
            assert all(one == other for one, other in errors)


@pytest.mark.skipif(not CODECS["sperr"].available, reason="needs imagecodecs, of the extra 'codecs'")
def test_sperr_outlives_a_gap_at_its_start() -> None:
    z = heights()
    data = bytearray(best("sperr", z, 400).data)
    lost = np.zeros(len(data), dtype=np.bool_)
    lost[16:32], data[16:32] = True, bytes(16)
    with Sandbox(seconds=5.0) as box:
        assert not isinstance(box.run(decode, "sperr", bytes(data), lost), Failure)


def test_two_of_three_headers_are_enough() -> None:
    message = smallest("scattered_samples", heights(), 0.05)
    size = HEADER.size + 3
    for start in (0, len(message.data) - size):
        data = bytearray(message.data)
        data[start : start + size] = bytes(size)
        np.testing.assert_array_equal(
            decode("scattered_samples", bytes(data)), decode("scattered_samples", message.data)
        )
    lost = np.zeros(len(message.data), dtype=np.bool_)
    lost[:size] = lost[-size:] = True
    data[:size] = bytes(size)  # two lost, and known to be: the third counts
    np.testing.assert_array_equal(
        decode("scattered_samples", bytes(data), lost), decode("scattered_samples", message.data)
    )


@given(st.integers(1, 16), st.lists(st.integers(0, 2**16 - 1), min_size=1, max_size=50))
def test_bits_round_trip(bits: int, values: list[int]) -> None:
    array = np.array(values, dtype=np.int64) % (1 << bits)
    packed = pack_bits(array, bits)
    assert len(packed) == -(-len(values) * bits // 8)
    np.testing.assert_array_equal(unpack_bits(packed, bits, len(values)), array)


@given(st.binary(max_size=3000), st.integers(0, 3500))
def test_inflate_gives_the_length_asked_for(data: bytes, length: int) -> None:
    assert inflate(deflate(data), length) == data[:length].ljust(length, b"\0")


def test_what_cannot_be_is_a_typed_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(NotFoundError, match="accepted are dense_cloud"):
        best("gif", heights(), 1000)
    with pytest.raises(ParameterError, match="its coarsest takes"):
        best("dct", heights(), 10)
    with pytest.raises(ParameterError, match="does not reach"):
        smallest("lattice_spline", heights(), 1e-9)
    with pytest.raises(PointsError, match="8 x 8"):
        best("dct", np.zeros((3, 3)), 1000)
    monkeypatch.setattr(codecs, "CODECS", {"absent": dataclasses.replace(CODECS["dct"], package="surfacelink_absent")})
    with pytest.raises(MissingExtraError, match=r"surfacelink\[codecs\]"):
        find_codec("absent")


def test_the_fields_are_the_six() -> None:
    assert len(FIELDS) == 6
    for name in FIELDS:
        assert field(name).shape == (256, 256)
    with pytest.raises(NotFoundError):
        field("moon")
