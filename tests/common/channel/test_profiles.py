"""The named channels: their numbers follow from their sources."""

from __future__ import annotations

import math

import pytest
from scipy.special import j0
from scipy.stats import ncx2

from common.channel import PROFILES, Channel
from common.channel.impairments.gilbert_elliott import GilbertElliott


@pytest.mark.parametrize("name", PROFILES)
def test_a_profile_is_written_as_the_channel_it_is(name: str, few_packets: list[bytes]) -> None:
    channel = Channel.parse(name)
    assert str(channel) == PROFILES[name].channel
    assert channel == Channel.parse(f"profile:{name}") == Channel.parse(PROFILES[name].channel)
    assert len(PROFILES[name].source) > 40
    delivery = channel.transmit(few_packets, transmission="hills")
    assert 0 < len(delivery.packets) <= len(few_packets)
    assert delivery.faults


def test_a_profile_takes_its_place_among_other_impairments() -> None:
    assert Channel.parse("gaussian:std=0.1;lora;seed=3") == Channel.parse(
        f"gaussian:std=0.1;{PROFILES['lora'].channel}", seed=3
    )


def marcum_q(a: float, b: float) -> float:
    return float(ncx2.sf(b * b, 2, a * a))


def test_the_chain_of_the_wifi_profile_is_that_of_a_fading_link() -> None:
    margin, doppler, packet = 10.0, 1.4 * 2.437e9 / 299_792_458, 8 * 256 / 1e6
    correlation = float(j0(2 * math.pi * doppler * packet))
    theta = math.sqrt(2 / margin / (1 - correlation**2))
    loss = 1 - math.exp(-1 / margin)
    r = (marcum_q(theta, correlation * theta) - marcum_q(correlation * theta, theta)) / (math.exp(1 / margin) - 1)
    chain = Channel.parse("wifi").impairments[-1]
    assert isinstance(chain, GilbertElliott)
    assert chain.r == pytest.approx(r, rel=1e-3)
    assert chain.p == pytest.approx(r * loss / (1 - loss), rel=1e-3)


def test_the_delay_of_the_underwater_profile_is_that_of_sound() -> None:
    delay = Channel.parse("underwater").transmit([b""], transmission="t").seconds
    assert delay == pytest.approx(2362 / 1500, abs=0.01)
