"""The sender service over ASGI: orders, uploads, and a problem for whatever is wrong with them."""

from __future__ import annotations

import io
import json
import re
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import anyio
import httpx
import numpy as np
import pytest
import tifffile

from common.version import product_version
from common.wire import PacketDecoder
from sender.app import create_app
from sender.client import ReceiverClient, RetryPolicy
from sender.settings import Settings
from tests.hanging_up import break_off

Handler = Callable[[httpx.Request], httpx.Response]


def receive(request: httpx.Request) -> httpx.Response:
    """A receiver that gets everything."""
    if request.url.path == "/health/live":
        return httpx.Response(200)
    packets = PacketDecoder().feed(request.content)
    counts = {"received": len(packets), "damaged": 0, "duplicate": 0, "total": len(packets), "missing": []}
    points = sum(len(packet.points) for packet in packets)
    name = request.url.path.rpartition("/")[2]
    return httpx.Response(
        202, json={"id": name, "packets": counts, "points": points, "complete": True, "state": "training"}
    )


def refuse(_request: httpx.Request) -> httpx.Response:
    raise httpx.ConnectError("refused")


@asynccontextmanager
async def service(handler: Handler = receive, **settings: Any) -> AsyncIterator[httpx.AsyncClient]:
    async def no_sleep(_seconds: float) -> None:
        pass

    def connect(url: str) -> ReceiverClient:
        http = httpx.AsyncClient(base_url=url, transport=httpx.MockTransport(handler))
        return ReceiverClient(http, RetryPolicy(tries=2), no_sleep)

    app = create_app(Settings(**settings), connect)
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://sender") as client,
    ):
        yield client


async def settled(client: httpx.AsyncClient, location: str) -> dict[str, Any]:
    with anyio.fail_after(30):
        while True:
            record: dict[str, Any] = (await client.get(location)).json()
            if record["state"] != "sending":
                return record
            await anyio.sleep(0.01)


def run(use: Callable[[httpx.AsyncClient], Any], handler: Handler = receive, **settings: Any) -> Any:
    async def go() -> Any:
        async with service(handler, **settings) as client:
            return await use(client)

    return anyio.run(go)


def test_it_lists_what_it_can_send() -> None:
    async def use(client: httpx.AsyncClient) -> None:
        names = {surface["name"]: surface for surface in (await client.get("/v1/surfaces")).json()}
        assert names["surface-1"]["points"] == 200
        assert names["elevation"]["units"] == {"xy": "m", "z": "m"}

    run(use)


def test_a_named_surface_is_sent_and_its_receipt_kept() -> None:
    async def use(client: httpx.AsyncClient) -> None:
        answer = await client.post("/v1/transmissions", json={"surface": "surface-1", "id": "first"})
        assert answer.status_code == 202
        record = await settled(client, answer.headers["Location"])
        assert record["state"] == "sent"
        assert (record["cloud_points"], record["feature_points"], record["receipt"]["points"]) == (200, 50, 50)
        assert record["surface"] == record["receipt"]["id"] == "first"
        assert record["bytes"] > 0

    run(use)


def test_a_file_is_sent() -> None:
    cloud = np.random.default_rng(0).uniform(size=(500, 3))
    text = "\n".join(",".join(map(repr, row)) for row in cloud.tolist())

    async def use(client: httpx.AsyncClient) -> None:
        answer = await client.post(
            "/v1/transmissions",
            files={"file": ("my field.csv", text)},
            data={"order": json.dumps({"gap": 0.25, "xy_unit": "km"})},
        )
        record = await settled(client, answer.headers["Location"])
        assert (record["surface"], record["state"], record["cloud_points"]) == ("my-field", "sent", 500)
        assert record["feature_points"] == 32

    run(use)


@pytest.mark.parametrize(("length", "status"), [(100_000, 202), (100_001, 413), (300_000, 413)])
def test_an_upload_need_not_declare_its_length(length: int, status: int) -> None:
    file = b"0,0,1\n1,0,2\n0,1,3\n1,1,5\n".ljust(length)
    head = b'--edge\r\nContent-Disposition: form-data; name="file"; filename="a.csv"\r\n\r\n'
    taken = 0

    async def parts() -> AsyncIterator[bytes]:
        nonlocal taken
        for part in (head, *(file[start : start + 5_000] for start in range(0, length, 5_000)), b"\r\n--edge--\r\n"):
            yield part
            taken += len(part)

    async def use(client: httpx.AsyncClient) -> None:
        kind = {"Content-Type": "multipart/form-data; boundary=edge"}
        answer = await client.post("/v1/transmissions", content=parts(), headers=kind)
        assert answer.status_code == status, answer.text
        assert taken < 180_000  # what is beyond the limit is not read
        if status == 413:
            assert "longer than" in answer.json()["detail"]

    run(use, max_upload_bytes=100_000)


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        ("application/json", b"{"),
        (
            "multipart/form-data; boundary=x",
            b'--x\r\nContent-Disposition: form-data; name="file"; filename="a.csv"\r\n\r\n1,2,3',
        ),
    ],
    ids=["order", "file"],
)
@pytest.mark.anyio
async def test_an_upload_that_is_broken_off_is_no_fault_of_the_sender(kind: str, body: bytes) -> None:
    app = create_app(Settings())
    async with app.router.lifespan_context(app):
        await break_off(app, "POST", "/v1/transmissions", kind, body)


def test_a_raster_is_sent_and_held_to_the_limits() -> None:
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, np.random.default_rng(0).normal(size=(20, 30)), photometric="minisblack", metadata=None)

    async def use(client: httpx.AsyncClient) -> None:
        answer = await client.post("/v1/transmissions", files={"file": ("hill.tif", buffer.getvalue())})
        record = await settled(client, answer.headers["Location"])
        assert (record["surface"], record["state"], record["cloud_points"]) == ("hill", "sent", 600)
        assert "does not say where it lies" in record["notes"][0]

    async def limited(client: httpx.AsyncClient) -> None:
        answer = await client.post("/v1/transmissions", files={"file": ("hill.tif", buffer.getvalue())})
        assert answer.status_code == 413
        assert answer.json()["detail"] == "hill.tif holds 600 points; at most 500 are accepted"

    run(use)
    run(limited, max_points=500)


def test_a_package_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "tifffile", None)

    async def use(client: httpx.AsyncClient) -> None:
        answer = await client.post("/v1/transmissions", files={"file": ("hill.tif", b"II*")})
        assert answer.status_code == 501
        assert "pip install 'surfacelink[tif]'" in answer.json()["detail"]

    run(use)


def test_points_of_a_file_without_a_height_are_left_out_and_told() -> None:
    text = "0,0,1\n1,0,2\n0,1,-9999\n1,1,\n2,2,4\n3,1,4\n"

    async def use(client: httpx.AsyncClient) -> None:
        files = {"file": ("a.csv", text)}
        answer = await client.post("/v1/transmissions", files=files, data={"order": '{"no_data": -9999}'})
        assert answer.json()["cloud_points"] == 4
        assert answer.json()["notes"] == ["a.csv: 2 of 6 points have no height and are left out"]
        answer = await client.post("/v1/transmissions", files=files, data={"order": '{"no_data": "nan"}'})
        assert answer.json()["cloud_points"] == 5

    run(use)


@pytest.mark.parametrize(
    ("network", "asked"),
    [
        ({"spread": 0.3, "smoothing": 0}, {"spread": "0.3", "smoothing": "0.0"}),
        ({"spread": "auto", "smoothing": "auto"}, {"spread": "auto", "smoothing": "auto"}),
        ({"tolerance": 0, "max_centers": "all"}, {"tolerance": "0.0", "max_centers": "all"}),
        ({}, {}),
        (None, {}),
    ],
)
def test_the_receiver_is_asked_for_every_setting_that_is_given(
    network: dict[str, Any] | None, asked: dict[str, str]
) -> None:
    found: list[dict[str, str]] = []

    def note(request: httpx.Request) -> httpx.Response:
        found.append(dict(request.url.params))
        return receive(request)

    async def use(client: httpx.AsyncClient) -> None:
        answer = await client.post("/v1/transmissions", json={"surface": "surface-1", "network": network})
        await settled(client, answer.headers["Location"])

    run(use, note)
    assert found == [asked]


def test_a_receiver_that_is_down_is_a_failed_transmission_not_a_lost_one() -> None:
    async def use(client: httpx.AsyncClient) -> None:
        answer = await client.post("/v1/transmissions", json={"surface": "surface-1"})
        record = await settled(client, answer.headers["Location"])
        assert record["state"] == "failed"
        assert "does not answer" in record["error"]["detail"]
        assert (await client.get("/health/ready")).status_code == 503
        assert (await client.get("/health/live")).status_code == 200

    run(use, refuse)


@pytest.mark.parametrize(
    ("request_", "status", "detail"),
    [
        ({"json": {"surface": "surface1"}}, 404, "did you mean 'surface-1'"),
        ({"json": {}}, 422, "name a surface or give a file"),
        ({"json": {"surface": "surface-1", "gap": -1}}, 422, "gap: Input should be greater than 0"),
        ({"json": {"surface": "surface-1", "gap": 5}}, 422, "larger than the region"),
        ({"json": {"surface": "surface-1", "gap": 1e-6}}, 422, "pieces"),
        ({"json": {"surface": "surface-1", "palette": "red"}}, 422, "palette: no such member; accepted are surface,"),
        ({"json": {"surface": "surface-1", "sede": 1}}, 422, "sede: no such member; did you mean 'seed'?"),
        (
            {"json": {"surface": "surface-1", "wire": {"copy": 2}}},
            422,
            "wire.copy: no such member; did you mean 'copies",
        ),
        (
            {"json": {"surface": "surface-1", "network": {"kernel": 2}}},
            422,
            "kernel: no such member; accepted are spread",
        ),
        ({"json": {"surface": "surface-1", "id": "a/b"}}, 422, "id: expected 1 to 64 characters: letters"),
        ({"json": {"surface": "surface-1", "points": 2}}, 422, "at least 3"),
        ({"json": {"surface": "surface-1", "points": 10**9}}, 413, "at most"),
        ({"json": {"surface": "surface-1", "wire": {"datagram": 1}}}, 422, "wire.datagram"),
        ({"content": b"{", "headers": {"Content-Type": "application/json"}}, 422, "Invalid JSON"),
        ({"content": b" " * 70_000, "headers": {"Content-Type": "application/json"}}, 413, "longer than"),
        ({"content": b"x", "headers": {"Content-Type": "text/plain"}}, 415, "application/json"),
        ({"content": b"x"}, 415, "application/json"),
        ({"files": [("file", ("a.csv", "1")), ("file", ("b.csv", "2"))]}, 400, "Too many files"),
        ({"content": b"1,2", "headers": {"Content-Type": "multipart/form-data"}}, 400, "accepted are one 'file'"),
        ({"json": {"surface": "surface-1"}, "params": [("x", 1)]}, 422, "x: no such parameter"),
        ({"files": {"other": ("a.csv", "1,2,3")}}, 422, "no file"),
        ({"files": {"file": ("a.csv", "1,2,3")}, "data": {"gap": 1}}, 422, "gap: no such field; accepted are file and"),
        ({"json": {"surface": "surface-1"}, "headers": {"Content-Encoding": "gzip"}}, 415, "content coding"),
        ({"files": {"file": ("a.csv", "1,2,3")}}, 422, "at least 3"),
        ({"files": {"file": ("a.csv", "1,2,nan\n4,5,6\n7,8,8")}}, 422, "1 of 3 points have no height"),
        ({"files": {"file": ("a.csv", "0,0,1\n0,0,2\n1,1,1\n2,1,3")}}, 422, "more than one height"),
        ({"files": {"file": ("a.csv", "1,2,3\n" * 50_000)}}, 413, "the body is longer than 165536 bytes"),
        ({"files": {"file": ("a.csv", "1,2,3\n" * 16_667)}}, 413, "the file is longer than 100000 bytes"),
        ({"files": {"file": ("a.grd", "II*")}}, 422, "accepted endings"),
        ({"files": {"file": ("a.tiff", "II*")}}, 422, "a.tiff is not a GeoTIFF that can be read"),
    ],
)
def test_a_bad_order_is_a_problem_that_says_what_is_accepted(
    request_: dict[str, Any], status: int, detail: str
) -> None:
    async def use(client: httpx.AsyncClient) -> None:
        answer = await client.post("/v1/transmissions", **request_)
        assert answer.status_code == status
        assert answer.headers["Content-Type"] == "application/problem+json"
        assert detail in answer.json()["detail"]
        assert answer.json()["status"] == status

    run(use, max_upload_bytes=100_000)


@pytest.mark.parametrize(
    "request_",
    [
        {"json": {"surface": "surface-1", "points": 101}},
        {"files": {"file": ("a.csv", "0,0,1\n1,0,2\n" * 50 + "1,1,1\n")}},
        {"files": {"file": ("a.csv", "0,0,1\n1,0,2\n" * 50 + "1,1,1\n")}, "data": {"order": '{"points": 50}'}},
    ],
)
def test_a_cloud_of_too_many_points_is_refused_drawn_or_uploaded(request_: dict[str, Any]) -> None:
    async def use(client: httpx.AsyncClient) -> None:
        answer = await client.post("/v1/transmissions", **request_)
        assert answer.status_code == 413
        assert "101 points" in answer.json()["detail"]
        assert "at most 100 are accepted" in answer.json()["detail"]
        enough = await client.post("/v1/transmissions", json={"surface": "surface-1", "points": 100})
        assert enough.status_code == 202

    run(use, max_points=100)


def test_head_answers_as_get_does_without_a_body() -> None:
    async def use(client: httpx.AsyncClient) -> None:
        sent = (await client.post("/v1/transmissions", json={"surface": "surface-1"})).headers["Location"]
        await settled(client, sent)
        pages = {"/v1/surfaces": 200, sent: 200, "/health/live": 200, "/health/ready": 200, "/docs": 200, "/": 307}
        wrong = {"/v1/transmissions/none": 404, "/nothing": 404, "/v1/surfaces?x=1": 422, "/v1/transmissions": 405}
        for url, status in (pages | wrong).items():
            head, get = await client.head(url), await client.get(url)
            assert (head.status_code, head.content) == (status, b""), url
            assert dict(head.headers) == dict(get.headers)
        assert "head" not in str((await client.get("/openapi.json")).json()["paths"]["/v1/surfaces"])

    run(use)


@pytest.mark.parametrize(("method", "path", "status"), [("GET", "/nothing", 404), ("PUT", "/v1/surfaces", 405)])
def test_wrong_paths_and_methods_are_problems_too(method: str, path: str, status: int) -> None:
    async def use(client: httpx.AsyncClient) -> None:
        answer = await client.request(method, path)
        assert answer.status_code == status
        assert answer.headers["Content-Type"] == "application/problem+json"

    run(use)


def test_finished_transmissions_are_forgotten_only_beyond_the_limit() -> None:
    async def use(client: httpx.AsyncClient) -> None:
        locations = []
        for _ in range(4):
            answer = await client.post("/v1/transmissions", json={"surface": "surface-2"})
            locations.append(answer.headers["Location"])
            await settled(client, locations[-1])
        assert [(await client.get(location)).status_code for location in locations] == [404, 404, 200, 200]

    run(use, kept=2)


def test_the_api_describes_both_kinds_of_body() -> None:
    schema = create_app(Settings()).openapi()
    body = schema["paths"]["/v1/transmissions"]["post"]["requestBody"]["content"]
    assert set(body) == {"application/json", "multipart/form-data"}
    assert {"Order", "Problem", "InvalidField"} <= set(schema["components"]["schemas"])
    for call in (call for calls in schema["paths"].values() for call in calls.values()):
        refused = call["responses"]["422"]["content"]
        assert refused == {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
    assert schema["info"]["version"] == product_version()


@pytest.mark.anyio
async def test_the_page_of_the_api_needs_no_other_network() -> None:
    async with service() as client:
        page = await client.get("/", follow_redirects=True)
    assert page.headers["Content-Type"].startswith("text/html")
    assert "default-src 'none'" in page.headers["Content-Security-Policy"]
    assert not re.search(r"(src|href)=[\"'](https?:)?//", page.text)
    assert "Viewer" not in page.text


@pytest.mark.parametrize(
    ("method", "url"), [("GET", "/v1/surfaces"), ("POST", "/v1/transmissions"), ("GET", "/health/ready"), ("GET", "/")]
)
@pytest.mark.anyio
async def test_a_query_parameter_that_the_call_does_not_have_is_refused(method: str, url: str) -> None:
    async with service() as client:
        answer = await client.request(method, f"{url}?colum=64")
    assert answer.status_code == 422
    assert answer.json()["detail"] == "colum: no such parameter; none is accepted here"
