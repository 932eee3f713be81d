"""The same campaign directly, through a receiver in this process, and over real sockets: the same numbers."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import anyio
import numpy as np
import pytest

from common.channel import Channel
from common.network.model import NetworkSettings
from common.surface import FeatureSet, Region
from common.wire import WireOptions, encode
from sender.client import Sent
from simulator.campaign import Campaign
from simulator.link import Link
from simulator.runner import Cell, Run
from simulator.transports import Way, opened
from simulator.trial import Transport, direct, run_trial

PLAN = Campaign.build(
    {
        "name": "ways",
        "surfaces": ["surface-1"],
        "channels": ["gaussian:std=0.05,axes=z;erasure:p=0.3", "bit_errors:ber=0.0005"],
        "wire": [{"min_packets": 8}, {"min_packets": 8, "precision": "float64"}],
        "methods": ["network", "network[spread=0.3]", "cubic", "network@cloud"],
        "rounds": 2,
        "seeds": 1,
        "grid": [9, 11],
    }
)


def rows(transport: Transport, workers: int = 1, plan: Campaign = PLAN) -> list[Mapping[str, Cell]]:
    results = Run(plan.trials(), partial(run_trial, transport=transport), workers).collect()
    return [row for result in results for row in result.rows]


def test_the_receiver_in_this_process_gives_the_numbers_of_the_direct_way() -> None:
    with opened(Way.DIRECT) as direct, opened(Way.ASGI) as asgi:
        assert rows(asgi) == rows(direct)


@pytest.mark.e2e
def test_a_receiver_over_real_sockets_gives_the_same_numbers() -> None:
    with opened(Way.DIRECT) as direct, opened(Way.HTTP) as http:
        assert rows(http, workers=2) == rows(direct)


def test_what_hardly_arrives_or_not_at_all_fails_alike() -> None:
    plan = Campaign.build(
        {
            "name": "hardly",
            "surfaces": ["surface-1"],
            "channels": ["erasure:p=1", "erasure:p=0.97", "bit_errors:ber=0.02"],
            "wire": [{"datagram": 80, "precision": "float64"}],
            "methods": ["network", "nearest"],
            "rounds": 2,
            "seeds": 2,
            "seed": 5,
            "grid": [9, 11],
        }
    )
    with opened(Way.DIRECT) as direct, opened(Way.ASGI) as asgi:
        expected = rows(direct, plan=plan)
        assert rows(asgi, plan=plan) == expected
    # One point is enough for the nearest neighbour, not for a network; of what is all damaged, the packets are counted.
    assert any(row["features_received"] == 1 and row["failure"] is None for row in expected)
    assert any(row["features_received"] is None and row["packets_damaged"] for row in expected)


def test_as_much_is_sent_again_as_a_receipt_names(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (2500, 3))
    features = FeatureSet(points, Region(-1, 1, -1, 1))
    options, channel = WireOptions(datagram=64, precision="float64"), Channel.parse("erasure:p=0.8", seed=1)
    quick = NetworkSettings(spread=0.3, smoothing=0.1)
    arrived = direct(features, transmission="t", channel=channel, options=options, rounds=3)

    async def send() -> Sent:
        async with Link.in_process(tmp_path) as link, link.client(channel) as client:
            packets = encode(features, transmission="t", options=options)
            return await client.send(packets, transmission="t", rounds=3, network=quick)

    sent = anyio.run(send)
    assert arrived.packets == sent.packets < 3 * 2500 * 0.8
    assert (arrived.sent_bytes, arrived.received) == (sent.bytes, sent.receipt.packets.received)


def test_only_what_is_reconstructed_here_is_timed() -> None:
    trial = PLAN.trials()[0]
    with opened(Way.DIRECT) as direct, opened(Way.ASGI) as asgi:
        timed = {
            way: [taken is not None for taken in run_trial(trial, transport=way).seconds] for way in (direct, asgi)
        }
    assert timed == {direct: [True, True, True, True], asgi: [False, True, True, True]}
