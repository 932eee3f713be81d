"""The whole path over ASGI: points, features, packets, channel, network, grid."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import anyio
import httpx
import numpy as np
import pytest

from common.channel import Channel
from common.errors import NotFoundError, RefusedError, TrainingError
from common.metrics import nrmse
from common.network.model import NetworkSettings
from common.surface import FeatureSet, FloatArray
from common.wire import WireOptions, encode
from receiver.app import create_app
from receiver.settings import Settings
from sender.client import ReceiverClient
from sender.features import extract_features
from sender.surfaces import SURFACES
from simulator.link import Link, Outcome
from simulator.trial import direct

SHAPE = (41, 41)
NOISE = Channel.parse("gaussian:std=0.05,axes=xyz;erasure:p=0.2", seed=1)
SMALL = WireOptions(datagram=64)
"""Packets small enough that a transmission of the paper's features has several."""


def features_of(name: str, seed: int = 0) -> FeatureSet:
    surface = SURFACES[name]
    cloud = surface.sample(np.random.default_rng(seed))
    return extract_features(cloud, gap=surface.gap, region=surface.region)


def linked(folder: Path, use: Callable[[Link], Any]) -> Any:
    async def go() -> Any:
        async with Link.in_process(folder) as link:
            return await use(link)

    return anyio.run(go)


def sent(folder: Path, transmission: str = "a", name: str = "surface-1", **options: Any) -> Outcome:
    outcome = linked(
        folder, lambda link: link.send(features_of(name), transmission=transmission, shape=SHAPE, **options)
    )
    assert isinstance(outcome, Outcome)
    return outcome


@pytest.mark.parametrize(("name", "features", "bound"), [("surface-1", 50, 0.005), ("surface-3", 32, 0.05)])
def test_a_clean_channel_brings_the_surface_back(tmp_path: Path, name: str, features: int, bound: float) -> None:
    outcome = sent(tmp_path, name=name)
    assert len(outcome.features) == outcome.sent.receipt.points == features
    assert outcome.sent.receipt.complete
    assert nrmse(SURFACES[name].grid(SHAPE).z, outcome.grid.z) < bound
    assert outcome.surface["network"]["centers"] == features


def test_the_same_seed_gives_the_same_features_and_the_same_grid(tmp_path: Path) -> None:
    first, second = (sent(tmp_path / name, channel=NOISE, options=SMALL) for name in ("first", "second"))
    np.testing.assert_array_equal(first.features, second.features)
    np.testing.assert_array_equal(first.grid.z, second.grid.z)
    other = sent(tmp_path / "third", channel=Channel(NOISE.impairments, seed=2), options=SMALL)
    assert not np.array_equal(first.grid.z, other.grid.z)


def test_the_order_and_the_bodies_in_which_packets_arrive_do_not_matter(tmp_path: Path) -> None:
    packets = encode(features_of("surface-1"), transmission="a", options=SMALL)
    assert len(packets) > 4

    async def deliver(folder: Path, bodies: list[bytes]) -> bytes:
        app = create_app(Settings(data=folder, channel=str(NOISE), seed=NOISE.seed))
        async with (
            app.router.lifespan_context(app),
            ReceiverClient.connect("http://receiver.invalid", httpx.ASGITransport(app)) as client,
        ):
            for body in bodies:
                await client.send([body], transmission="a")
            await client.wait_ready("a")
            grid = await client.grid("a", SHAPE)
            return grid.z.tobytes()

    expected = anyio.run(deliver, tmp_path / "whole", [b"".join(packets)])
    shuffled = np.random.default_rng(0).permutation(len(packets))
    assert anyio.run(deliver, tmp_path / "apart", [packets[number] for number in shuffled]) == expected
    assert anyio.run(deliver, tmp_path / "twice", [b"".join(packets[::-1]), b"".join(packets)]) == expected


def test_what_is_lost_is_sent_again_until_it_is_there(tmp_path: Path) -> None:
    lossy = Channel.parse("erasure:p=0.5", seed=1)
    once = sent(tmp_path / "once", channel=lossy, options=SMALL)
    assert not once.sent.receipt.complete
    assert 0 < len(once.features) < 50
    many = sent(tmp_path / "many", channel=lossy, options=SMALL, rounds=30)
    assert many.sent.receipt.complete
    assert len(many.features) == 50
    assert many.sent.retransmitted > 0
    clean = sent(tmp_path / "clean", options=SMALL)
    np.testing.assert_array_equal(many.grid.z, clean.grid.z)


def test_what_is_sent_again_meets_noise_as_strong_as_what_was_sent_first(tmp_path: Path) -> None:
    """Relative noise is that of the same strength in data units, over HTTP and without."""
    options = WireOptions(datagram=80, precision="float64")
    features = features_of("surface-1")

    def directly(noise: str) -> FloatArray:
        channel = Channel.parse(f"gaussian:{noise};erasure:p=0.5", seed=1)
        arrived = direct(features, transmission="a", channel=channel, options=options, rounds=30).features
        assert arrived is not None
        return arrived.points

    points = directly("relative=0.1")
    assert len(points) == 50
    np.testing.assert_allclose(points, directly(f"std={0.1 * np.ptp(features.z)}"), rtol=1e-12)
    channel = Channel.parse("gaussian:relative=0.1;erasure:p=0.5", seed=1)
    over_http = sent(tmp_path, channel=channel, options=options, rounds=30)
    assert over_http.sent.retransmitted > 0
    np.testing.assert_array_equal(over_http.features, points)


def test_parity_rebuilds_what_is_lost_and_keeps_it_over_a_restart(tmp_path: Path) -> None:
    protected = WireOptions(datagram=64, parity=0.5)
    outcome = sent(tmp_path, channel=Channel.parse("erasure:p=0.15", seed=2), options=protected)
    counts = outcome.sent.receipt.packets
    assert counts.rebuilt > 0
    assert counts.missing == []
    np.testing.assert_array_equal(outcome.features, sent(tmp_path / "clean", options=protected).features)

    async def again(link: Link) -> dict[str, Any]:
        client = ReceiverClient.connect("http://receiver.invalid", link.transport())
        async with client:
            return await client.surface("a")

    assert linked(tmp_path, again)["packets"] == outcome.surface["packets"]


def test_where_nothing_arrives_the_error_says_so(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match="nothing of a reached"):
        sent(tmp_path, channel=Channel.parse("erasure:p=1"))


def test_an_id_that_is_taken_by_other_features_is_refused(tmp_path: Path) -> None:
    async def use(link: Link) -> None:
        await link.send(features_of("surface-1"), transmission="a", shape=SHAPE)
        await link.send(features_of("surface-1", seed=1), transmission="a", shape=SHAPE)

    with pytest.raises(RefusedError, match="409"):
        linked(tmp_path, use)


def test_settings_given_anew_take_the_place_of_the_earlier_ones_even_where_they_are_the_defaults(
    tmp_path: Path,
) -> None:
    async def use(link: Link) -> list[dict[str, Any]]:
        return [
            (await link.send(features_of("surface-1"), transmission="a", shape=SHAPE, network=network)).surface
            for network in (NetworkSettings(), NetworkSettings(spread=0.3), NetworkSettings(spread="auto"))
        ]

    auto, own, again = linked(tmp_path, use)
    assert own["network"]["spread"] == 0.3
    assert again["network"] == auto["network"]


def test_what_was_received_survives_a_restart(tmp_path: Path) -> None:
    before = sent(tmp_path)

    async def after() -> bytes:
        app = create_app(Settings(data=tmp_path))
        async with (
            app.router.lifespan_context(app),
            ReceiverClient.connect("http://receiver.invalid", httpx.ASGITransport(app)) as client,
        ):
            await client.wait_ready("a")
            grid = await client.grid("a", SHAPE)
            await client.delete("a")
            with pytest.raises(NotFoundError):
                await client.surface("a")
            return grid.z.tobytes()

    assert anyio.run(after) == before.grid.z.tobytes()
