"""Real processes, real sockets: the demo from the command line, and the link over HTTP."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import anyio
import httpx
import numpy as np
import pytest

from common.channel import Channel
from common.errors import LinkError
from common.surface import FeatureSet
from sender.features import extract_features
from sender.surfaces import SURFACES
from simulator import services
from simulator.link import Link, Outcome

pytestmark = pytest.mark.e2e

ROOT = Path(__file__).resolve().parents[2]


def test_the_demo_prints_its_table_and_draws_its_picture(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "simulator", "demo", "--surface", "surface-1", "--out", str(tmp_path / "out")],
        cwd=ROOT,
        env={
            "COLUMNS": "160",
            "PATH": "",
            "HOME": str(tmp_path),
            "OMP_NUM_THREADS": "1",
            "http_proxy": "http://127.0.0.1:9",  # that nobody listens on; what is on this machine needs none
        },
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    table = dict(line.strip().rsplit(maxsplit=1) for line in done.stdout.splitlines() if len(line.split()) > 1)
    assert (table["points"], table["features"], table["dense bytes"]) == ("200", "50", "4,800")
    for channel in ("clean", "noisy"):
        network, linear, cubic = (
            float(table[f"NRMSE, {channel} channel: {method}"]) for method in ("network", "linear", "cubic")
        )
        assert 0 < network < min(linear, cubic)
    picture = (tmp_path / "out" / "surface-1.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert len(picture) > 50_000
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"surface-1.png"}, "the demo leaves data behind"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_the_demo_and_what_it_started(tmp_path: Path, number: signal.Signals) -> None:
    command = [sys.executable, "-m", "simulator", "demo", "--surface", "surface-1", "--serve", "--out", str(tmp_path)]
    with subprocess.Popen(
        command, cwd=ROOT, env=os.environ | {"PYTHONUNBUFFERED": "1"}, stdout=subprocess.PIPE, text=True
    ) as demo:
        assert demo.stdout is not None
        urls = []
        for line in demo.stdout:
            urls += re.findall(r"^(?:receiver|sender) +(http://[0-9.:]+)", line)
            if "Ctrl-C" in line:
                break
        assert [httpx.get(f"{url}/health/ready").status_code for url in urls] == [200, 200]
        demo.send_signal(number)
        assert demo.wait(timeout=30) == 0
    for url in urls:
        with pytest.raises(httpx.ConnectError):
            httpx.get(url)
    assert {path.name for path in tmp_path.iterdir()} == {"surface-1.png"}


def test_the_link_gives_the_same_numbers_in_process_and_over_sockets(tmp_path: Path) -> None:
    surface = SURFACES["surface-2"]
    features = extract_features(surface.sample(np.random.default_rng(0)), gap=surface.gap, region=surface.region)
    channel = Channel.parse("uniform:amplitude=0.1,axes=xyz;erasure:p=0.1", seed=3)

    async def send(link: Link, features: FeatureSet) -> Outcome:
        return await link.send(features, transmission="a", shape=(30, 30), channel=channel, rounds=3)

    async def in_process() -> Outcome:
        async with Link.in_process(tmp_path / "asgi") as link:
            return await send(link, features)

    async def over_http(url: str) -> Outcome:
        async with Link.over_http(url) as link:
            return await send(link, features)

    expected = anyio.run(in_process)
    with services.running(tmp_path / "http") as running:
        found = anyio.run(over_http, running.receiver)
        urls = (running.receiver, running.sender)
    np.testing.assert_array_equal(found.features, expected.features)
    np.testing.assert_array_equal(found.grid.z, expected.grid.z)
    assert found.sent.bytes == expected.sent.bytes
    for url in urls:
        with pytest.raises(httpx.ConnectError):
            httpx.get(url)


def test_a_service_that_does_not_start_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RECEIVER_CHANNEL", "nonsense")
    with (
        pytest.raises(LinkError, match=re.compile("the receiver did not start.*nonsense", re.S)),
        services.running(tmp_path),
    ):
        pass
