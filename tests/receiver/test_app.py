from __future__ import annotations

import base64
import hashlib
import io
import itertools
import json
import re
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import anyio
import httpx
import msgpack
import numpy as np
import pytest
from PIL import Image

from common.network.model import NetworkSettings, SurfaceModel
from common.surface import FeatureSet, Region
from common.wire import WireOptions, encode, transmission_tag
from common.wire.header import Form, Header
from common.wire.limits import MAX_PACKETS
from common.wire.packet import write_datagrams
from sender.client import ReceiverClient
from tests.hanging_up import break_off
from tests.receiver.conftest import HEADERS, Client, Running, packets_of

pytestmark = [
    pytest.mark.anyio,
    # What it says is in the network's notes; what is tested here is the service.
    pytest.mark.filterwarnings("ignore::common.network.estimator.NetworkWarning"),
]


async def ready(client: Client, features: FeatureSet, name: str = "hills", **params: Any) -> dict[str, Any]:
    """Send the features; what the receiver says of the surface once it is trained."""
    answer = await client.transmit(name, b"".join(packets_of(features, name)), params=params)
    assert answer.status_code == 202, answer.text
    surface: dict[str, Any] = (await client.get(f"/v1/surfaces/{name}?wait=60")).json()
    assert surface["state"] == "ready", surface["error"]
    return surface


def assert_problem(answer: httpx.Response, status: int, *words: str) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    problem: dict[str, Any] = answer.json()
    assert problem["status"] == status
    assert problem["title"]
    for word in words:
        assert word in problem["detail"]
    return problem


async def test_a_transmission_becomes_a_surface(client: Client, features: FeatureSet) -> None:
    packets = packets_of(features, "hills")
    answer = await client.transmit("hills", b"".join(packets))
    assert answer.status_code == 202
    assert answer.headers["location"] == "/v1/surfaces/hills"
    receipt = answer.json()
    assert receipt["points"] == len(features)
    assert receipt["complete"]
    assert receipt["packets"] == {
        "received": len(packets),
        "damaged": 0,
        "duplicate": 0,
        "foreign": 0,
        "rebuilt": 0,
        "total": len(packets),
        "absent": 0,
        "missing": [],
    }
    surface = (await client.get(answer.headers["location"], params={"wait": 60})).json()
    assert surface["state"] == "ready"
    assert surface["region"] == {"x_min": -2, "x_max": 2, "y_min": -1, "y_max": 1}
    assert surface["gap"] == 1.0
    assert surface["network"]["centers"] == len(features)


async def test_the_receipt_says_what_is_missing_and_a_second_body_completes_it(
    client: Client, features: FeatureSet
) -> None:
    packets = packets_of(features, "hills")
    first = (await client.transmit("hills", packets[3] + packets[1])).json()
    assert first["packets"]["missing"] == [i for i in range(len(packets)) if i not in (1, 3)]
    assert not first["complete"]
    second = (await client.transmit("hills", b"".join(packets))).json()
    assert second["packets"]["missing"] == []
    assert second["complete"]
    assert second["delivery"] == {"new": len(packets) - 2, "duplicate": 2, "damaged": 0, "foreign": 0}


async def test_a_packet_s_claim_is_not_what_a_receipt_is_long_by(client: Client) -> None:
    claim = Header(transmission_tag("hills"), MAX_PACKETS, Region(0, 1, 0, 1), Form.FLOAT64)
    (body,) = write_datagrams(claim, [np.array([0, 0, 0, 1, 0, 0, 0, 1, 0.0]).tobytes()])
    answer = await client.transmit("hills", body)
    counts = answer.json()["packets"]
    assert counts["absent"] == MAX_PACKETS - 1
    assert counts["missing"] == list(range(1, 1_001))
    assert len(answer.content) < 10_000
    surface = (await client.get("/v1/surfaces/hills")).json()
    assert surface["packets"] == {name: count for name, count in counts.items() if name != "missing"}
    assert (await client.get("/v1/surfaces")).json()["surfaces"][0]["packets"] == surface["packets"]
    assert len(json.dumps(client.app.state.surfaces.store.get("hills").contents)) < 1_000


async def test_more_missing_packets_than_a_receipt_names_are_sent_round_by_round(
    running: Running, features: FeatureSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("receiver.surfaces.MISSING_NAMED", 3)
    packets = encode(features, transmission="hills", options=WireOptions(datagram=64))
    async with running(channel="erasure:p=0.9", seed=2) as client:
        first = (await client.transmit("hills", b"".join(packets))).json()["packets"]
        assert 3 == len(first["missing"]) < first["absent"]
    async with running(channel="erasure:p=0.3", seed=2) as client:
        sent = await ReceiverClient(client).send(packets, transmission="hills", rounds=20)
    assert sent.receipt.complete
    assert (sent.receipt.packets.absent, sent.receipt.packets.missing) == (0, [])


async def test_a_repeated_body_changes_nothing(client: Client, features: FeatureSet) -> None:
    await ready(client, features)
    before = await client.get("/v1/surfaces/hills/grid")
    answer = await client.transmit("hills", b"".join(packets_of(features, "hills")))
    assert answer.json()["state"] == "ready"
    assert (await client.get("/v1/surfaces/hills/grid")).content == before.content


async def test_order_of_arrival_does_not_matter(client: Client, features: FeatureSet) -> None:
    packets = packets_of(features, "hills")
    grids = []
    for order in (packets, packets[::-1]):
        for packet in order:
            await client.transmit("hills", packet)
        grids.append((await client.get("/v1/surfaces/hills/grid?wait=60&f=npy")).content)
        await client.delete("/v1/surfaces/hills")
    assert grids[0] == grids[1]


async def test_concurrent_bodies_lose_no_packet(client: Client, features: FeatureSet) -> None:
    packets = packets_of(features, "hills")
    async with anyio.create_task_group() as group:
        for packet in packets:
            group.start_soon(client.transmit, "hills", packet)
    surface = (await client.get("/v1/surfaces/hills")).json()
    assert surface["complete"]
    assert surface["packets"]["received"] == len(packets)


async def test_network_settings_reach_the_network_and_hold_on(client: Client, features: FeatureSet) -> None:
    surface = await ready(client, features, spread="0.7", smoothing="0.01")
    assert surface["settings"] == {"spread": 0.7, "smoothing": 0.01}
    assert surface["network"]["spread"] == pytest.approx(0.7)
    repeated = await client.transmit("hills", packets_of(features, "hills")[0], params={"spread": "1.5"})
    assert repeated.json()["state"] == "training"
    surface = (await client.get("/v1/surfaces/hills?wait=60")).json()
    assert surface["settings"] == {"spread": 1.5, "smoothing": 0.01}
    assert surface["network"]["spread"] == pytest.approx(1.5)


async def test_every_network_setting_can_be_taken_back(client: Client, features: FeatureSet) -> None:
    await ready(client, features, spread="0.7", smoothing="0.01", tolerance="0.01", max_centers="5")
    back = {"spread": "auto", "smoothing": "auto", "tolerance": "0", "max_centers": "all"}
    repeated = await client.transmit("hills", packets_of(features, "hills")[0], params=back)
    assert repeated.json()["state"] == "training"
    surface = (await client.get("/v1/surfaces/hills?wait=60")).json()
    assert NetworkSettings(**surface["settings"]) == NetworkSettings()
    assert surface["network"]["centers"] == len(features)


@pytest.mark.parametrize(
    "query",
    [
        "spread=wide",
        "spread=nan",
        "smoothing=-1",
        "tolerance=inf",
        "max_centers=0",
        "max_centers=2.5",
        "mapping=up",
        "spred=1",
    ],
)
async def test_bad_network_settings_are_refused(client: Client, features: FeatureSet, query: str) -> None:
    answer = await client.transmit(f"hills?{query}", packets_of(features, "hills")[0])
    problem = assert_problem(answer, 422)
    assert query.partition("=")[0] in {error["name"].partition(".")[0] for error in problem["errors"]}
    assert (await client.get("/v1/surfaces")).json()["surfaces"] == []


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("spread=1e-160", "spread must be from"),
        ("spread=1e300", "times the extent of the points, got 1e+300"),
        ("smoothing=1e300", "smoothing must be at most 1e+09"),
    ],
)
async def test_a_training_says_which_setting_is_out_of_its_bounds(
    client: Client, features: FeatureSet, query: str, words: str
) -> None:
    await client.transmit(f"hills?{query}", b"".join(packets_of(features, "hills")))
    surface = (await client.get("/v1/surfaces/hills?wait=60")).json()
    assert surface["state"] == "failed"
    assert words in surface["error"]["detail"]
    assert surface["error"]["status"] == 422


@pytest.mark.parametrize("body", [b"", b"hello", b"\x00" * 1000, msgpack.packb({"points": [1, 2, 3]})])
async def test_a_body_without_packets_is_refused(client: Client, body: bytes) -> None:
    assert_problem(await client.transmit("hills", body), 400, "no packet")
    assert (await client.get("/v1/surfaces/hills")).status_code == 404


async def test_damaged_packets_are_counted_and_the_others_kept(client: Client, features: FeatureSet) -> None:
    packets = packets_of(features, "hills")
    harmed = bytearray(packets[1])
    harmed[-6] ^= 1
    receipt = (await client.transmit("hills", packets[0] + bytes(harmed) + packets[2])).json()
    assert receipt["packets"]["damaged"] == 1
    assert receipt["packets"]["received"] == 2
    assert 1 in receipt["packets"]["missing"]
    alone = await client.transmit("dales", bytes(harmed))
    assert alone.status_code == 202
    assert alone.json()["state"] == "receiving"
    assert alone.json()["packets"]["total"] is None


async def test_a_channel_that_swallows_everything_is_no_error_of_the_sender(
    running: Running, features: FeatureSet
) -> None:
    async with running(channel="erasure:p=1") as client:
        answer = await client.transmit("hills", b"".join(packets_of(features, "hills")))
        assert answer.status_code == 202
        assert answer.json()["packets"]["received"] == 0
        assert answer.json()["state"] == "receiving"
        assert_problem(await client.get("/v1/surfaces/hills/grid"), 409, "no point")
        for body in (b"", b"hello"):
            assert_problem(await client.transmit("dales", body), 400)


async def test_the_channel_harms_what_arrives(running: Running, features: FeatureSet) -> None:
    async with running(channel="gaussian:std=0.5,axes=z", seed=3) as client:
        await ready(client, features)
        arrived = np.load(io.BytesIO((await client.get("/v1/surfaces/hills/features?f=npy")).content))
    deviation = arrived[:, 2] - np.sin(2 * arrived[:, :2]).sum(axis=1)
    assert 0.3 < deviation.std() < 0.7


async def test_other_features_under_the_same_id_conflict_and_leave_it_as_it_was(
    client: Client, features: FeatureSet
) -> None:
    await ready(client, features)
    before = (await client.get("/v1/surfaces/hills/features")).content
    other = FeatureSet(features.points * 2, Region(-4, 4, -2, 2))
    conflict = await client.transmit("hills", b"".join(encode(other, transmission="hills")))
    assert_problem(conflict, 409, "region -4.0,4.0,-2.0,2.0 instead of -2.0,2.0,-1.0,")
    assert_problem(conflict, 409, "take another id, or remove it first (DELETE /v1/surfaces/hills)")
    assert_problem(await client.transmit("hills", b"".join(packets_of(features, "dales"))), 409, "another transmission")
    assert (await client.get("/v1/surfaces/hills/features")).content == before


async def test_media_types(client: Client, features: FeatureSet) -> None:
    packet = packets_of(features, "hills")[0]
    for kind in ("application/vnd.msgpack", "application/msgpack", "application/x-msgpack; charset=binary"):
        answer = await client.post("/v1/transmissions/hills", content=packet, headers={"Content-Type": kind})
        assert answer.status_code == 202
    for headers in ({"Content-Type": "application/json"}, {}, HEADERS | {"Content-Encoding": "gzip"}):
        assert_problem(await client.post("/v1/transmissions/hills", content=packet, headers=headers), 415)


@pytest.mark.parametrize("name", ["a" * 65, "a b", "ä", "a%2Fb", "%00"])
async def test_bad_ids(client: Client, features: FeatureSet, name: str) -> None:
    answer = await client.transmit(name, packets_of(features, "hills")[0])
    assert answer.status_code in (404, 422)
    assert answer.headers["content-type"] == "application/problem+json"


async def test_bodies_are_limited(running: Running, features: FeatureSet) -> None:
    async def endless() -> Any:
        for _ in range(100):
            yield bytes(1_000)

    async with running(max_body_bytes=1_024, channel="clean") as client:
        assert_problem(await client.transmit("hills", bytes(1_025)), 413, "1024 bytes")
        answer = await client.post("/v1/transmissions/hills", content=endless(), headers=HEADERS)
        assert_problem(answer, 413)
        json = {"Content-Type": "application/json"}
        assert_problem(await client.put("/v1/channel", content=endless(), headers=json), 413, "1024 bytes")
    async with running(max_body_bytes=1_024, channel="erasure:p=0.5") as client:
        assert_problem(await client.transmit("hills", bytes(1_025)), 413)
        answer = await client.post("/v1/transmissions/hills", content=endless(), headers=HEADERS)
        assert_problem(answer, 413)


async def test_grid_forms_agree(client: Client, features: FeatureSet) -> None:
    await ready(client, features)
    url = "/v1/surfaces/hills/grid?shape=5,7&std=true"
    told = (await client.get(url, headers={"Accept": "application/json"})).json()
    x, y, z, std = (np.array(told[name]) for name in ("x", "y", "z", "std"))
    assert z.shape == std.shape == (5, 7)
    np.testing.assert_array_equal(x, np.linspace(-2, 2, 7))
    np.testing.assert_array_equal(y, np.linspace(-1, 1, 5))
    np.testing.assert_allclose(z, np.sin(2 * x) + np.sin(2 * y)[:, None], atol=0.1)

    lines = (await client.get(url + "&f=csv")).text.splitlines()
    assert lines[0] == "x,y,z,std"
    table = np.array([[float(cell) for cell in line.split(",")] for line in lines[1:]])
    np.testing.assert_array_equal(table[:, 2].reshape(5, 7), z)
    np.testing.assert_array_equal(table[:7, 0], x)
    np.testing.assert_array_equal(table[::7, 1], y)
    np.testing.assert_array_equal(table[:, 3].reshape(5, 7), std)

    np.testing.assert_array_equal(np.load(io.BytesIO((await client.get(url + "&f=npy")).content)), [z, std])
    with np.load(io.BytesIO((await client.get(url + "&f=npz")).content)) as archive:
        np.testing.assert_array_equal(archive["z"], z)
        np.testing.assert_array_equal(archive["y"], y)
    packed = msgpack.unpackb((await client.get(url + "&f=msgpack")).content)
    np.testing.assert_array_equal(np.frombuffer(packed["z"], packed["dtype"]).reshape(packed["shape"]), z)


async def test_bbox_is_a_part_of_the_same_surface(client: Client, features: FeatureSet) -> None:
    await ready(client, features)
    whole = (await client.get("/v1/surfaces/hills/grid?shape=9,9")).json()
    part = (await client.get("/v1/surfaces/hills/grid?shape=5,5&bbox=-2,-1,0,0")).json()
    np.testing.assert_allclose(np.array(whole["z"])[:5, :5], part["z"], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "query",
    [
        "shape=2",
        "shape=a,b",
        "shape=1,5",
        "shape=-3,5",
        "shape=1e3,5",
        "shape=2001,2000",
        "shape=400,400&std=true",
        "shape=999999999,2",
        "bbox=0,0,1",
        "bbox=0,0,nan,1",
        "bbox=1,0,0,1",
        "bbox=0,0,5,1",
        "std=maybe",
        "wait=-1",
        "wait=1e9",
        "wait=nan",
        "palette=jet",
    ],
)
async def test_bad_grid_requests_are_refused(client: Client, features: FeatureSet, query: str) -> None:
    await ready(client, features)
    assert_problem(await client.get(f"/v1/surfaces/hills/grid?{query}"), 422, query.partition("=")[0])


async def test_the_picture_is_a_png_in_the_proportions_of_the_region(client: Client, features: FeatureSet) -> None:
    await ready(client, features)
    framed = Image.open(io.BytesIO((await client.get("/v1/surfaces/hills/grid?f=png")).content))
    assert framed.width == 1_000
    bare = Image.open(io.BytesIO((await client.get("/v1/surfaces/hills/grid?f=png&colorbar=false")).content))
    assert bare.size == (600, 300)
    other = await client.get("/v1/surfaces/hills/grid?f=png&colorbar=false&palette=gray")
    assert np.ptp(np.asarray(Image.open(io.BytesIO(other.content))), axis=2).max() <= 1


async def test_etag(client: Client, features: FeatureSet) -> None:
    await ready(client, features)
    url = "/v1/surfaces/hills/grid?shape=3,3"
    first = await client.get(url)
    again = await client.get(url, headers={"If-None-Match": f'"other", {first.headers["etag"]}'})
    assert again.status_code == 304
    assert not again.content
    for other in (url + "&std=true", url + "&f=csv", url.replace("3,3", "3,4"), url + "&bbox=0,0,1,1"):
        assert (await client.get(other)).headers["etag"] != first.headers["etag"]


async def test_an_etag_is_found_in_any_line_of_the_header(client: Client, features: FeatureSet) -> None:
    await ready(client, features)
    url = "/v1/surfaces/hills/features"
    tag = (await client.get(url)).headers["etag"]
    again = await client.get(url, headers=[("If-None-Match", '"other"'), ("If-None-Match", tag)])
    assert again.status_code == 304


async def test_other_points_in_a_new_folder_have_another_etag(
    running: Running, features: FeatureSet, tmp_path: Path
) -> None:
    others = replace(features, points=features.points[:40])
    coarser = replace(features, gap=0.5)
    tags = set()
    for number, sent in enumerate((features, others, coarser)):
        async with running(data=tmp_path / str(number)) as client:
            await ready(client, sent)
            tags.add((await client.get("/v1/surfaces/hills/features")).headers["etag"])
    assert len(tags) == 3


async def test_a_parameter_that_is_given_twice_is_refused(client: Client, features: FeatureSet) -> None:
    await ready(client, features)
    twice = await client.get("/v1/surfaces/hills/grid?shape=3,3&f=csv&shape=4,4")
    assert_problem(twice, 422, "shape: given more than once; one value is taken")
    body = b"".join(packets_of(features, "hills"))
    assert_problem(
        await client.transmit("hills", body, params=[("spread", 1), ("spread", 2)]), 422, "spread: given more"
    )


async def test_what_a_switch_may_be_is_said(client: Client) -> None:
    assert_problem(await client.get("/v1/surfaces/hills/grid?std=maybe"), 422, "std: Input should be true or false")


async def test_features_and_network(client: Client, features: FeatureSet) -> None:
    await ready(client, features)
    told = (await client.get("/v1/surfaces/hills/features")).json()
    arrived = np.column_stack([told[axis] for axis in "xyz"])
    by_x = np.argsort(arrived[:, 0]), np.argsort(features.points[:, 0])
    np.testing.assert_allclose(arrived[by_x[0]], features.points[by_x[1]], atol=1e-3)
    assert (await client.get("/v1/surfaces/hills/features?f=csv")).text.startswith("x,y,z\n")
    network = (await client.get("/v1/surfaces/hills/network")).json()
    assert len(network["x"]) == network["centers"] == len(features)
    with np.load(io.BytesIO((await client.get("/v1/surfaces/hills/network?f=npz")).content)) as archive:
        np.testing.assert_array_equal(archive["x"], network["x"])
    assert_problem(await client.get("/v1/surfaces/hills/features?f=png"), 406, "json, csv")


@pytest.mark.parametrize(
    ("query", "columns"),
    [
        ("spread=0.8", ["x", "y", "coefficient"]),
        (
            "mapping=autoassociative",
            ["x", "y", "z", "coefficient_x", "coefficient_y", "coefficient_z"],
        ),
    ],
)
async def test_the_network_is_its_centres_and_coefficients(
    client: Client, features: FeatureSet, query: str, columns: list[str]
) -> None:
    await client.transmit(f"hills?{query}", b"".join(packets_of(features, "hills")))
    lines = (await client.get("/v1/surfaces/hills/network?f=csv&wait=60")).text.splitlines()
    assert lines[0].split(",") == columns
    network = (await client.get("/v1/surfaces/hills/network")).json()
    centers = np.column_stack([network["x"], network["y"]])
    arrived = np.load(io.BytesIO((await client.get("/v1/surfaces/hills/features?f=npy")).content))
    np.testing.assert_allclose(centers, arrived[:, :2], atol=1e-9)
    if columns[-1] == "coefficient":
        # What the columns say is the network: sum the neurons, and up to the bias the heights come out.
        distances = np.sum((centers[:, None] - centers) ** 2, axis=2)
        heights = np.exp(-distances / (2 * network["spread"] ** 2)) @ network["coefficient"]
        assert np.ptp(arrived[:, 2] - heights) < 0.1


async def test_list_is_in_pages_and_delete_removes(client: Client, features: FeatureSet) -> None:
    for name in ("a", "b", "c"):
        await ready(client, features, name)
    page = (await client.get("/v1/surfaces?limit=2")).json()
    assert [surface["id"] for surface in page["surfaces"]] == ["c", "b"]
    rest = (await client.get(page["next"])).json()
    assert [surface["id"] for surface in rest["surfaces"]] == ["a"]
    assert rest["next"] is None
    answer = await client.delete("/v1/surfaces/b")
    assert (answer.status_code, answer.content) == (204, b"")
    for call in (client.delete, client.get):
        assert_problem(await call("/v1/surfaces/b"), 404, "no surface 'b'")
    assert len((await client.get("/v1/surfaces")).json()["surfaces"]) == 2


class Held:
    """A training that waits in its thread until it is let go."""

    def __init__(self) -> None:
        self.go = threading.Event()
        self.started = itertools.count()

    def __call__(
        self, features: FeatureSet, settings: NetworkSettings, *, callback: Callable[[str, float], None]
    ) -> SurfaceModel:
        next(self.started)
        while not self.go.wait(0.005):
            callback("waiting", 0.5)
        return SurfaceModel.train(features, settings, callback=callback)


async def test_while_a_training_runs(running: Running, features: FeatureSet) -> None:
    held = Held()
    async with running(train=held) as client:
        packets = packets_of(features, "hills")
        await client.transmit("hills", packets[0])
        problem = await client.get("/v1/surfaces/hills/grid")
        assert_problem(problem, 409, "being trained")
        assert problem.headers["retry-after"] == "1"
        assert (await client.get("/health/live")).json() == {"status": "ok"}
        await client.transmit("hills", b"".join(packets))
        held.go.set()
        surface = (await client.get("/v1/surfaces/hills?wait=60")).json()
        assert surface["state"] == "ready"
        assert surface["network"]["centers"] == len(features)


async def test_delete_calls_the_training_off(running: Running, features: FeatureSet) -> None:
    async with running(train=Held()) as client:
        await client.transmit("hills", packets_of(features, "hills")[0])
        assert (await client.delete("/v1/surfaces/hills")).status_code == 204
        with anyio.fail_after(10):
            while len(client.app.state.surfaces.trainings):
                await anyio.sleep(0.01)
        assert (await client.get("/v1/surfaces/hills")).status_code == 404


@pytest.mark.parametrize("secret", [True, False])
async def test_a_training_that_fails_says_so(running: Running, features: FeatureSet, secret: bool) -> None:
    def fail(features: FeatureSet, settings: NetworkSettings, *, callback: Any) -> SurfaceModel:
        if secret:
            raise RuntimeError("at /home/secret")
        return SurfaceModel.train(FeatureSet(np.zeros((1, 3)), features.region), settings)

    async with running(train=fail) as client:
        await client.transmit("hills", packets_of(features, "hills")[0])
        surface = (await client.get("/v1/surfaces/hills?wait=60")).json()
        assert surface["state"] == "failed"
        assert ("log says more" if secret else "at least") in surface["error"]["detail"]
        assert "secret" not in str(surface)
        assert_problem(await client.get("/v1/surfaces/hills/grid"), 409, "could not be trained")


async def test_events_until_ready(running: Running, features: FeatureSet) -> None:
    held = Held()
    async with running(train=held) as client:
        await client.transmit("hills", packets_of(features, "hills")[0])
        held.go.set()
        answer = await client.get("/v1/surfaces/hills/events")
    assert answer.headers["content-type"].startswith("text/event-stream")
    kinds = re.findall(r"^event: (\w+)$", answer.text, re.MULTILINE)
    assert set(kinds) <= {"surface", "progress"}
    assert kinds[-1] == "surface"
    last = [line for line in answer.text.splitlines() if line.startswith("data: ")][-1]
    assert json.loads(last.removeprefix("data: "))["state"] == "ready"


async def test_events_of_an_unknown_surface(client: Client) -> None:
    assert_problem(await client.get("/v1/surfaces/hills/events"), 404)


async def same_head(client: httpx.AsyncClient, url: str, **headers: str) -> httpx.Response:
    """The answer to HEAD, which is that to GET without its body."""
    head, get = await client.head(url, headers=headers), await client.get(url, headers=headers)
    assert head.content == b""
    assert (head.status_code, dict(head.headers)) == (get.status_code, dict(get.headers)), url
    return head


async def test_head_answers_as_get_does_without_a_body(client: Client, features: FeatureSet) -> None:
    await ready(client, features)
    pages = ["/", "/docs", "/openapi.json", "/health/live", "/health/ready", "/v1/channel", "/problems/not-found"]
    for url in (*pages, "/v1/surfaces", "/v1/surfaces/hills", "/v1/surfaces/hills?wait=1"):
        answer = await same_head(client, url)
        assert answer.status_code == 200
        assert int(answer.headers["content-length"]) > 0
    assert (await client.head("/metrics")).status_code == 200  # which counts the requests before: its length differs
    for part in ("grid?shape=3,4", "grid?f=png", "features", "network?f=csv"):
        answer = await same_head(client, f"/v1/surfaces/hills/{part}")
        assert answer.status_code == 200
        again = await same_head(client, f"/v1/surfaces/hills/{part}", **{"If-None-Match": answer.headers["etag"]})
        assert again.status_code == 304
    wrong = {"/v1/surfaces/hills/grid?shape=0,5": 422, "/v1/surfaces/hills/grid?shap=3,3": 422, "/nothing": 404}
    for url, status in (wrong | {"/v1/surfaces/dales": 404, "/v1/transmissions/hills": 405}).items():
        assert (await same_head(client, url)).status_code == status
    assert (await same_head(client, "/v1/surfaces/hills/grid", Accept="audio/ogg")).status_code == 406
    assert 'method="HEAD",route="/v1/surfaces/{id}/grid",status="200"' in (await client.get("/metrics")).text


async def test_head_ends_an_event_stream_at_once(running: Running, features: FeatureSet) -> None:
    held = Held()
    async with running(train=held) as client:
        await client.transmit("hills", packets_of(features, "hills")[0])
        with anyio.fail_after(10):
            for url in ("/v1/events", "/v1/surfaces/hills/events"):
                answer = await client.head(url)
                assert answer.headers["content-type"].startswith("text/event-stream")
        held.go.set()
        assert (await client.head("/v1/surfaces/dales/events")).status_code == 404


async def test_the_api_does_not_list_head(client: Client) -> None:
    calls = (await client.get("/openapi.json")).json()["paths"].values()
    assert not any("head" in call for call in calls)


async def test_the_channel_is_shown_and_set_only_where_allowed(running: Running) -> None:
    async with running(channel="gaussian:std=0.1", seed=5) as client:
        shown = (await client.get("/v1/channel")).json()
        assert shown["impairments"] == [{"kind": "gaussian", "std": 0.1}]
        assert shown["seed"] == 5
        assert_problem(await client.put("/v1/channel", json={"spec": "clean"}), 403, "--channel-control")
    async with running(channel_control=True) as client:
        for document in ({"spec": "erasure:p=0.5", "seed": 9}, {"impairments": [{"kind": "erasure", "p": 0.5}]}):
            shown = (await client.put("/v1/channel", json=document)).json()
            assert shown["impairments"] == [{"kind": "erasure", "p": 0.5}]
            assert (await client.get("/v1/channel")).json() == shown
        wrong: list[Any] = [{"spec": "thunder"}, {"spec": 3}, {"spec": "clean", "sed": 1}, [], {"seed": -1}, "thunder"]
        for bad in wrong:
            assert_problem(await client.put("/v1/channel", json=bad), 422)
        assert_problem(await client.put("/v1/channel", json={"spec": "clean", "foo": 1}), 422, "no member 'foo'")
        assert (await client.get("/v1/channel")).json() == shown
        malformed = await client.put("/v1/channel", content=b"{", headers={"Content-Type": "application/json"})
        assert_problem(malformed, 422)
        garbled = await client.put("/v1/channel", content=b"\xff", headers={"Content-Type": "application/json"})
        assert_problem(garbled, 400, "JSON in UTF-8")
        for kind in ("application/x-www-form-urlencoded", "text/plain"):
            unsaid = await client.put("/v1/channel", content=b'{"spec": "clean"}', headers={"Content-Type": kind})
            assert_problem(unsaid, 415, "as application/json; say so in the header Content-Type")


async def test_health_and_metrics(client: Client, features: FeatureSet) -> None:
    assert (await client.get("/health/ready")).status_code == 200
    await ready(client, features)
    text = (await client.get("/metrics")).text
    assert f'receiver_packets_total{{fate="new"}} {len(packets_of(features, "hills")):.1f}' in text
    assert 'receiver_trainings_total{outcome="ready"} 1.0' in text
    assert "receiver_surfaces 1.0" in text
    assert 'route="/v1/transmissions/{id}",status="202"' in text


@pytest.mark.parametrize("name", ["a b", "a" * 65, "hills\n", "höhen", "%2e", "%2E."])
async def test_a_surface_id_that_is_none_is_told_what_is_accepted_in_words(client: Client, name: str) -> None:
    path = quote(name, safe="%")
    for answer in (await client.get(f"/v1/surfaces/{path}"), await client.transmit(path, b"")):
        problem = assert_problem(answer, 422, "id: expected 1 to 64 characters: letters from A to Z and a to z, digits")
        assert "[" not in problem["detail"]


async def test_an_upload_that_is_broken_off_is_no_fault_of_the_receiver(client: Client, features: FeatureSet) -> None:
    await break_off(
        client.app, "POST", "/v1/transmissions/hills", HEADERS["Content-Type"], packets_of(features, "a")[0]
    )
    await break_off(client.app, "PUT", "/v1/channel", "application/json", b"{")
    assert (
        'receiver_requests_total{method="POST",route="/v1/transmissions/{id}",status="400"} 1.0'
        in (await client.get("/metrics")).text
    )
    assert (await client.get("/v1/surfaces/hills")).status_code == 404


async def test_errors_of_routing_are_problems(client: Client) -> None:
    assert_problem(await client.get("/nothing/here"), 404, "/nothing/here")
    answer = await client.put("/v1/surfaces", json={})
    assert_problem(answer, 405)
    assert answer.headers["allow"] == "GET, HEAD"
    assert (await client.patch("/v1/channel")).headers["allow"] == "GET, PUT, HEAD"
    assert (await client.post("/v1/surfaces/hills")).headers["allow"] == "GET, DELETE, HEAD"
    assert (await client.post("/docs")).headers["allow"] == "GET, HEAD"
    assert (await client.get("/v1/transmissions/hills")).headers["allow"] == "POST"


async def test_kinds_of_problem_can_be_looked_up(client: Client) -> None:
    problem = assert_problem(await client.get("/v1/surfaces/none"), 404)
    explained = (await client.get(problem["type"])).json()
    assert explained["title"] == problem["title"]
    assert_problem(await client.get("/problems/none"), 404)


async def test_an_unforeseen_error_tells_nothing(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    async def broken(*_args: Any, **_options: Any) -> None:
        raise RuntimeError("at /home/secret")

    monkeypatch.setattr(client.app.state.surfaces, "list", broken)
    answer = await client.get("/v1/surfaces")
    assert_problem(answer, 500)
    assert "secret" not in answer.text
    assert "Traceback" not in answer.text


async def test_nothing_is_answered_before_the_start(running: Running) -> None:
    async with running() as client:
        app = client.app
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://receiver") as late:
        answer = await late.get("/health/ready")
        assert_problem(answer, 503)
        assert answer.headers["retry-after"] == "1"
        assert (await late.get("/health/live")).status_code == 200


async def test_pages_run_their_own_script_and_ask_nobody_else(client: Client) -> None:
    for path in ("/", "/docs"):
        page = await client.get(path)
        assert page.headers["content-type"].startswith("text/html")
        script = page.text.partition("<script>")[2].partition("</script>")[0]
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        assert f"script-src 'sha256-{digest}'" in page.headers["content-security-policy"]
        assert not re.search(r"(src|href)=[\"'](https?:)?//", page.text)
        assert page.text.count("<script") == 1


async def test_the_openapi_document_is_complete(client: Client) -> None:
    document = (await client.get("/openapi.json")).json()
    for path, calls in document["paths"].items():
        for method, call in calls.items():
            assert call.get("summary"), (method, path)
            for status, answer in call["responses"].items():
                if int(status) >= 400:
                    assert list(answer["content"]) == ["application/problem+json"], (method, path, status)
    grid = document["paths"]["/v1/surfaces/{id}/grid"]["get"]
    assert "image/png" in grid["responses"]["200"]["content"]


def test_the_openapi_document_offers_only_what_is_installed() -> None:
    script = """if True:
        import sys
        sys.modules["tifffile"] = None
        from receiver.app import create_app
        call = create_app().openapi()["paths"]["/v1/surfaces/{id}/grid"]["get"]
        print(*next(p["schema"]["enum"] for p in call["parameters"] if p["name"] == "f"))
        print(*call["responses"]["200"]["content"])
    """
    forms, types = subprocess.check_output([sys.executable, "-c", script], text=True).splitlines()
    assert forms.split() == ["json", "csv", "npy", "npz", "msgpack", "png"]
    assert "image/png" in types
    assert "image/tiff" not in types


async def test_the_event_loop_turns_while_a_large_training_runs(client: Client) -> None:
    rng = np.random.default_rng(5)
    xy = rng.uniform(-2, 2, (1_500, 2))
    large = FeatureSet(np.column_stack([xy, np.sin(2 * xy).sum(axis=1)]), Region(-2, 2, -2, 2))
    await client.transmit("large", b"".join(encode(large, transmission="large")))
    answered = 0
    while (await client.get("/v1/surfaces/large")).json()["state"] == "training":
        assert (await client.get("/health/live")).status_code == 200
        answered += 1
    # A loop that the training blocks answers one request before it and the next after it.
    assert answered >= 10


async def test_a_network_of_many_points_is_a_table_too(client: Client) -> None:
    x, y = np.random.default_rng(0).uniform(-1, 1, (2, 5000))
    many = FeatureSet(np.column_stack([x, y, np.sin(3 * x) + y]), Region(-1, 1, -1, 1))
    await client.transmit("many", b"".join(packets_of(many, "many")))
    surface = (await client.get("/v1/surfaces/many", params={"wait": 60})).json()
    assert surface["network"]["patches"] > 1
    answer = await client.get("/v1/surfaces/many/network", params={"f": "npy"})
    table = np.load(io.BytesIO(answer.content))
    assert table.shape[1] == 3
    assert len(np.unique(table[:, :2], axis=0)) == surface["network"]["centers"] == 5000


@pytest.mark.parametrize(
    ("method", "url", "told"),
    [
        (
            "GET",
            "/v1/surfaces/hills/grid?colum=64&shape=4,4",
            "colum: no such parameter; accepted are shape, bbox, std, f",
        ),
        ("GET", "/v1/surfaces/hills/grid?shap=4,4", "shap: no such parameter; did you mean 'shape'?"),
        ("GET", "/v1/surfaces?limt=3", "limt: no such parameter; did you mean 'limit'? accepted are limit, before"),
        ("POST", "/v1/transmissions/hills?spred=1", "spred: no such parameter; did you mean 'spread'?"),
        ("DELETE", "/v1/surfaces/hills?x=1", "x: no such parameter; none is accepted here"),
        ("GET", "/v1/events?x=1", "x: no such parameter"),
        ("GET", "/health/live?x", "x: no such parameter"),
        ("GET", "/problems/store?x=1", "x: no such parameter"),
        ("GET", "/?x=1", "x: no such parameter"),
    ],
)
async def test_a_query_parameter_that_the_call_does_not_have_is_refused(
    client: Client, method: str, url: str, told: str
) -> None:
    problem = assert_problem(await client.request(method, url), 422, told)
    assert [error["place"] for error in problem["errors"]] == ["query"]


async def test_unknown_query_parameters_without_end_are_not_all_named(client: Client) -> None:
    answer = await client.get("/v1/surfaces?" + "&".join(f"x{n}" for n in range(2000)))
    assert len(assert_problem(answer, 422)["errors"]) == 8
