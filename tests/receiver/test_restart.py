from __future__ import annotations

import sqlite3
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import anyio
import pytest

from common.errors import StoreError
from common.network.model import NetworkSettings, SurfaceModel
from common.surface import FeatureSet
from common.wire import WireOptions, encode
from receiver.app import _events
from receiver.store import Store
from tests.receiver.conftest import Running, packets_of

pytestmark = [
    pytest.mark.anyio,
    pytest.mark.filterwarnings("ignore::common.network.estimator.NetworkWarning"),
]

FORMS = ("json", "csv", "npy", "msgpack", "png")


def never(features: FeatureSet, settings: NetworkSettings, *, callback: Any) -> SurfaceModel:
    raise AssertionError("nothing is left to train")


def stuck(features: FeatureSet, settings: NetworkSettings, *, callback: Callable[[str, float], None]) -> SurfaceModel:
    while True:
        callback("stuck", 0.0)
        threading.Event().wait(0.005)


async def test_a_ready_surface_answers_with_the_same_bytes(running: Running, features: FeatureSet) -> None:
    urls = [
        *(f"/v1/surfaces/hills/grid?f={form}&shape=20,30&std=true" for form in FORMS),
        "/v1/surfaces/hills/network",
        "/v1/surfaces/hills/features",
        "/v1/surfaces/hills",
        "/v1/surfaces",
    ]
    async with running() as client:
        await client.transmit("hills", b"".join(packets_of(features, "hills")), params={"spread": "0.8"})
        assert (await client.get("/v1/surfaces/hills?wait=60")).json()["state"] == "ready"
        before = [await client.get(url) for url in urls]
    async with running(train=never) as client:
        after = [await client.get(url) for url in urls]
    assert [answer.content for answer in after] == [answer.content for answer in before]
    assert [answer.headers.get("etag") for answer in after] == [answer.headers.get("etag") for answer in before]


async def test_an_interrupted_training_is_resumed(running: Running, features: FeatureSet) -> None:
    async with running() as client:
        await client.transmit("hills", b"".join(packets_of(features, "hills")))
        expected = (await client.get("/v1/surfaces/hills/grid?wait=60&f=npy")).content
        await client.delete("/v1/surfaces/hills")
    async with running(train=stuck) as client:
        await client.transmit("hills", b"".join(packets_of(features, "hills")))
        assert (await client.get("/v1/surfaces/hills")).json()["state"] == "training"
    async with running() as client:
        assert (await client.get("/v1/surfaces/hills/grid?wait=60&f=npy")).content == expected


async def test_packets_of_several_bodies_are_joined_across_restarts(running: Running, features: FeatureSet) -> None:
    packets = packets_of(features, "hills")
    for packet in packets:
        async with running(train=stuck) as client:
            receipt = (await client.transmit("hills", packet)).json()
    assert receipt["complete"]
    assert receipt["packets"]["received"] == len(packets)
    async with running() as client:
        surface = (await client.get("/v1/surfaces/hills?wait=60")).json()
        assert surface["network"]["centers"] == len(features)
        assert (await client.transmit("hills", packets[0])).json()["delivery"]["duplicate"] == 1


@pytest.mark.parametrize(
    "options",
    [
        WireOptions(datagram=96, precision="float64"),
        WireOptions(datagram=96, precision="float32"),
        WireOptions(datagram=96, coding="compact"),
        WireOptions(datagram=96, parity=0.5),
        WireOptions(datagram=96, copies=2, inner=16),
    ],
    ids=["float64", "float32", "compact", "parity", "copies and inner code"],
)
async def test_however_packets_were_written_they_are_the_same_after_a_restart(
    running: Running, features: FeatureSet, options: WireOptions
) -> None:
    packets = encode(features, transmission="hills", options=options)
    body = b"".join(packets[1:])  # one is lost, and with parity rebuilt
    async with running(train=stuck) as client:
        receipt = (await client.transmit("hills", body)).json()
        before = (await client.get("/v1/surfaces/hills/features")).content
    async with running(train=stuck) as client:
        assert (await client.get("/v1/surfaces/hills/features")).content == before
        again = (await client.transmit("hills", body)).json()
    assert again["packets"]["received"] == receipt["packets"]["received"]
    assert again["packets"]["rebuilt"] == receipt["packets"]["rebuilt"] == (1 if options.parity else 0)
    assert again["packets"]["missing"] == receipt["packets"]["missing"]
    assert again["delivery"]["new"] == 0


async def test_a_harmed_copy_that_a_better_one_replaced_stays_replaced(running: Running, features: FeatureSet) -> None:
    body = b"".join(packets_of(features, "hills"))
    async with running(channel="gaussian:std=1,axes=z") as client:
        noisy = (await client.transmit("hills", body)).json()
        assert noisy["complete"]
        first = (await client.get("/v1/surfaces/hills/features")).content
    async with running() as client:
        assert (await client.transmit("hills", body)).json()["state"] == "training"
        second = (await client.get("/v1/surfaces/hills/features")).content
        assert second != first
    async with running() as client:
        assert (await client.get("/v1/surfaces/hills/features")).content == second


async def test_what_could_not_be_stored_is_new_when_it_comes_again(
    running: Running, features: FeatureSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    packets = packets_of(features, "hills")

    def full(*args: Any, **options: Any) -> Any:
        raise StoreError("the store failed: database or disk is full")

    async with running(train=stuck) as client:
        await client.transmit("hills", packets[0])
        with monkeypatch.context() as disk:
            disk.setattr(Store, "receive", full)
            assert (await client.transmit("hills", b"".join(packets))).status_code == 503
        again = (await client.transmit("hills", b"".join(packets))).json()
        assert (again["delivery"]["new"], again["complete"]) == (len(packets) - 1, True)
        before = (await client.get("/v1/surfaces/hills/features")).content
    async with running(train=stuck) as client:
        assert (await client.get("/v1/surfaces/hills/features")).content == before


async def test_a_failure_is_remembered(running: Running, features: FeatureSet) -> None:
    def fail(features: FeatureSet, settings: NetworkSettings, *, callback: Any) -> SurfaceModel:
        raise StoreError("no")

    async with running(train=fail) as client:
        await client.transmit("hills", packets_of(features, "hills")[0])
        before = (await client.get("/v1/surfaces/hills?wait=60")).json()
        assert before["state"] == "failed"
    async with running(train=never) as client:
        assert (await client.get("/v1/surfaces/hills")).json() == before


@pytest.mark.parametrize(
    "harm",
    [
        "x'00'",
        # The first member of the archive is said to be compressed in a way that nobody knows.
        "CAST(substr(state, 1, 8) || x'4d' || substr(state, 10) AS BLOB)",
        # A name in it.
        "CAST(replace(state, CAST('spread' AS BLOB), CAST('sprEad' AS BLOB)) AS BLOB)",
    ],
)
async def test_a_model_that_cannot_be_read_is_trained_again(
    running: Running, features: FeatureSet, tmp_path: Path, harm: str
) -> None:
    async with running() as client:
        await client.transmit("hills", b"".join(packets_of(features, "hills")))
        expected = (await client.get("/v1/surfaces/hills/grid?wait=60&f=npy")).content
    db = sqlite3.connect(tmp_path / "data" / "receiver.sqlite3")
    db.execute(f"UPDATE models SET state = {harm}")
    db.commit()
    db.close()
    async with running() as client:
        first = await client.get("/v1/surfaces/hills/grid?f=npy")
        assert first.status_code == 409
        assert (await client.get("/v1/surfaces/hills/grid?wait=60&f=npy")).content == expected


async def test_a_stop_ends_open_event_streams(running: Running) -> None:
    ended = anyio.Event()

    async with anyio.create_task_group() as group, running() as client:

        async def follow() -> None:
            answer = await client.get("/v1/events")
            assert answer.text == ""
            ended.set()

        group.start_soon(follow)
        with anyio.fail_after(10):
            while not client.app.state.surfaces.changes._subscriptions:
                await anyio.sleep(0.005)
            client.app.state.surfaces.changes.close()
            await ended.wait()


async def test_a_store_that_fails_once_delays_an_outcome_and_no_more(
    running: Running, features: FeatureSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with running() as client:
        store = client.app.state.surfaces.store
        trained, failures = store.trained, [StoreError("the store failed: database or disk is full")]

        def failing(*args: Any, **options: Any) -> Any:
            if failures:
                raise failures.pop()
            return trained(*args, **options)

        monkeypatch.setattr(store, "trained", failing)
        await client.transmit("hills", b"".join(packets_of(features, "hills")))
        assert (await client.get("/v1/surfaces/hills?wait=60")).json()["state"] == "ready"
        assert not failures


@pytest.mark.parametrize("action", ["wait", "post", "delete"])
async def test_an_outcome_that_cannot_be_stored_is_told_until_it_can(
    running: Running, features: FeatureSet, monkeypatch: pytest.MonkeyPatch, action: str
) -> None:
    body = b"".join(packets_of(features, "hills"))
    transaction, disk_is_full = Store._transaction, threading.Event()

    def limited(store: Store) -> Any:
        if disk_is_full.is_set():
            raise StoreError("the store failed: database or disk is full")
        return transaction(store)

    def train(features: FeatureSet, settings: NetworkSettings, *, callback: Any) -> SurfaceModel:
        model = SurfaceModel.train(features, settings, callback=callback)
        if not trained.is_set():
            trained.set()
            disk_is_full.set()
        return model

    trained = threading.Event()
    monkeypatch.setattr(Store, "_transaction", limited)
    async with running(train=train) as client:
        surfaces, states = client.app.state.surfaces, []
        await client.transmit("hills", body)
        with anyio.fail_after(20):
            async for event in _events(surfaces, "hills"):
                states += [event.data["state"]] if event.event == "surface" else []
        assert states[-1] == "failed"
        surface = (await client.get("/v1/surfaces/hills?wait=60")).json()
        assert (surface["state"], surface["error"]["type"]) == ("failed", "/problems/store")
        assert "could not be stored: the store failed: database or disk is full" in surface["error"]["detail"]
        assert "disk is full" in (await client.get("/v1/surfaces/hills/grid")).json()["detail"]
        assert (await client.get("/health/ready")).status_code == 503
        assert (await client.transmit("hills", body)).status_code == 503
        assert (await client.transmit("dales", b"".join(packets_of(features, "dales")))).status_code == 503
        assert (await client.get("/v1/surfaces/dales")).status_code == 404
        disk_is_full.clear()
        assert (await client.get("/health/ready")).status_code == 200
        if action == "post":
            assert (await client.transmit("hills", body)).json()["state"] == "training"
        if action == "delete":
            assert (await client.delete("/v1/surfaces/hills")).status_code == 204
            assert (await client.get("/v1/surfaces/hills")).status_code == 404
            assert (await client.transmit("hills", body)).json()["state"] == "training"
        with anyio.fail_after(20):
            while (await client.get("/v1/surfaces/hills?wait=60")).json()["state"] != "ready":
                await anyio.sleep(0.05)
        assert (await client.get("/v1/surfaces/hills")).json()["error"] is None


async def test_a_surface_that_cannot_be_resumed_has_failed_until_its_packets_come_again(
    running: Running, features: FeatureSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    body = b"".join(packets_of(features, "hills"))
    async with running(train=stuck) as client:
        await client.transmit("hills", body)
    arrivals, tried, healthy = Store.arrivals, threading.Event(), threading.Event()

    def failing(store: Store, n: int) -> list[bytes]:
        if healthy.is_set():
            return arrivals(store, n)
        tried.wait(10)
        raise StoreError("the store failed: disk I/O error")

    monkeypatch.setattr(Store, "arrivals", failing)
    async with running() as client:
        events = _events(client.app.state.surfaces, "hills")
        with anyio.fail_after(10):
            assert (await anext(events)).data["state"] == "training"
            tried.set()
            assert [event.data["state"] async for event in events] == ["failed"]
        surface = (await client.get("/v1/surfaces/hills?wait=60")).json()
        assert (surface["state"], surface["error"]["type"]) == ("failed", "/problems/store")
        assert "disk I/O error; send its packets again" in surface["error"]["detail"]
        assert (await client.get("/v1/surfaces")).json()["surfaces"] == [surface]
        assert "disk I/O error" in (await client.get("/v1/surfaces/hills/grid")).json()["detail"]
        healthy.set()
        receipt = (await client.transmit("hills", body)).json()
        assert (receipt["state"], receipt["delivery"]["new"]) == ("training", 0)
        assert (await client.get("/v1/surfaces/hills?wait=60")).json()["state"] == "ready"


async def test_kept_packets_that_are_harmed_fail_until_the_next_start(
    running: Running, features: FeatureSet, tmp_path: Path
) -> None:
    async with running(train=stuck) as client:
        await client.transmit("hills", b"".join(packets_of(features, "hills")))

    def write(packets: bytes) -> bytes:
        with closing(sqlite3.connect(tmp_path / "data" / "receiver.sqlite3")) as db, db:
            ((before,),) = db.execute("SELECT packets FROM arrivals").fetchall()
            db.execute("UPDATE arrivals SET packets = ?", (packets,))
        return bytes(before)

    kept = write(b"\x00" * 100)
    async with running() as client:
        with anyio.fail_after(10):
            surface = (await client.get("/v1/surfaces/hills?wait=60")).json()
        assert surface["state"] == "failed"
        assert "cannot be read" in surface["error"]["detail"]
    write(kept)
    async with running() as client:
        assert (await client.get("/v1/surfaces/hills?wait=60")).json()["state"] == "ready"


async def test_a_kept_packet_that_is_harmed_is_told_and_not_passed_over(
    running: Running, features: FeatureSet, tmp_path: Path
) -> None:
    packets = packets_of(features, "hills")
    async with running() as client:
        await client.transmit("hills", b"".join(packets))
        before = (await client.get("/v1/surfaces/hills/grid?wait=60&f=npy")).content
        points = (await client.get("/v1/surfaces/hills/features")).content
    with closing(sqlite3.connect(tmp_path / "data" / "receiver.sqlite3")) as db, db:
        ((kept,),) = db.execute("SELECT packets FROM arrivals").fetchall()
        db.execute("UPDATE arrivals SET packets = ?", (kept[:50] + b"?" + kept[51:],))
        db.execute("DELETE FROM models")
    async with running() as client:
        with anyio.fail_after(10):
            surface = (await client.get("/v1/surfaces/hills?wait=60")).json()
        assert surface["state"] == "failed"
        assert "cannot be read whole; send its packets again" in surface["error"]["detail"]
        answer = await client.get("/v1/surfaces/hills/features")
        assert (answer.status_code, answer.json()["detail"]) == (503, surface["error"]["detail"])
        assert (await client.transmit("hills", b"".join(packets))).json()["delivery"]["new"] == 1
        assert (await client.get("/v1/surfaces/hills/grid?wait=60&f=npy")).content == before
        assert (await client.get("/v1/surfaces/hills/features")).content == points
    async with running(train=never) as client:
        assert (await client.get("/v1/surfaces/hills/features")).content == points


async def test_packets_that_a_newer_version_kept_are_said_to_be_that(
    running: Running, features: FeatureSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    packets = packets_of(features, "hills")
    with monkeypatch.context() as newer:
        newer.setattr("common.wire.header.VERSION", 2)
        async with running(train=stuck) as client:
            assert (await client.transmit("hills", packets_of(features, "hills")[0])).status_code == 202
    told = "what is kept of hills needs a newer surfacelink (a packet is of version 2; this end reads version 1): start"
    async with running() as client:
        surface = (await client.get("/v1/surfaces/hills?wait=60")).json()
        assert surface["state"] == "failed"
        assert surface["error"]["detail"].startswith(told)
        for answer in (await client.transmit("hills", packets[1]), await client.get("/v1/surfaces/hills/features")):
            assert answer.status_code == 503
            assert answer.json()["detail"] == surface["error"]["detail"]
        assert (await client.delete("/v1/surfaces/hills")).status_code == 204
        assert (await client.transmit("hills", packets[1])).status_code == 202
