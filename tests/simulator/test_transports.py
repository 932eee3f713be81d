"""The same campaign directly, through a receiver in this process, and over real sockets: the same numbers."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import pytest

from simulator.campaign import Campaign
from simulator.runner import Cell, Run
from simulator.transports import Way, opened
from simulator.trial import Transport, run_trial

PLAN = Campaign.build(
    {
        "name": "ways",
        "surfaces": ["surface-1"],
        "channels": ["gaussian:std=0.05,axes=z;erasure:p=0.3", "bit_errors:ber=0.0005"],
        "wire": [{"min_packets": 8}],
        "methods": ["network", "network[spread=0.3]", "cubic", "network@cloud"],
        "rounds": 2,
        "seeds": 1,
        "grid": [9, 11],
    }
)


def rows(transport: Transport, workers: int = 1) -> list[Mapping[str, Cell]]:
    results = Run(PLAN.trials(), partial(run_trial, transport=transport), workers).collect()
    return [row for result in results for row in result.rows]


def test_the_receiver_in_this_process_gives_the_numbers_of_the_direct_way() -> None:
    with opened(Way.DIRECT) as direct, opened(Way.ASGI) as asgi:
        assert rows(asgi) == rows(direct)


@pytest.mark.e2e
def test_a_receiver_over_real_sockets_gives_the_same_numbers() -> None:
    with opened(Way.DIRECT) as direct, opened(Way.HTTP) as http:
        assert rows(http, workers=2) == rows(direct)


def test_what_never_arrives_fails_alike() -> None:
    plan = PLAN.model_copy(update={"channels": Campaign.build(PLAN_LOST).channels})
    trial = plan.trials()[0]
    with opened(Way.DIRECT) as direct, opened(Way.ASGI) as asgi:
        assert run_trial(trial, transport=asgi).rows == run_trial(trial, transport=direct).rows


PLAN_LOST = {"surfaces": ["surface-1"], "channels": ["erasure:p=1"]}
