"""The proxy: a poor link between any client and any server."""

from __future__ import annotations

import socket
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio
import httpx
import pytest
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.routing import Route

from common.channel import Channel
from common.errors import ParameterError
from simulator.__main__ import main
from simulator.proxy import MAX_CHANNEL_BYTES, create_proxy
from tests.hanging_up import break_off

SPEC = "gaussian:std=0.1;erasure:p=0.3"


async def echo(request: Request) -> Response:
    body = await request.body()
    answer = Response(body, status_code=207)
    answer.headers.update(
        {
            "method": request.method,
            "target": request.scope["raw_path"].decode() + "?" + request.url.query,
            "seen-host": request.headers["host"],
            "seen-length": request.headers.get("content-length", "none"),
            "seen-faults": request.headers.get("surfacelink-faults", "none seen"),
            "seen-hop": request.headers.get("x-hop", "none"),
            "connection": "x-secret",
            "x-secret": "of this hop",
            "date": "Sun, 06 Nov 1994 08:49:37 GMT",
        }
    )
    answer.headers.append("set-cookie", "a=1")
    answer.headers.append("set-cookie", "b=2")
    return answer


async def stream(request: Request) -> Response:
    async def parts() -> AsyncIterator[bytes]:
        for part in (b"one ", b"two ", b"three"):
            yield part

    return StreamingResponse(parts(), media_type="text/event-stream")


SERVER = Starlette(routes=[Route("/base/stream", stream), Route("/{path:path}", echo, methods=["GET", "POST", "PUT"])])


class Slept:
    def __init__(self) -> None:
        self.seconds: list[float] = []

    async def __call__(self, seconds: float) -> None:
        self.seconds.append(seconds)


@asynccontextmanager
async def through(
    channel: str, server: httpx.AsyncBaseTransport | None = None, sleep: Slept | None = None
) -> AsyncIterator[httpx.AsyncClient]:
    """A client of the proxy that stands before the echoing server."""
    proxy = create_proxy(
        "http://server:99/base/",
        Channel.parse(channel, seed=5),
        transport=server or httpx.ASGITransport(SERVER),
        sleep=sleep or Slept(),
    )
    async with (
        proxy.router.lifespan_context(proxy),
        httpx.AsyncClient(transport=httpx.ASGITransport(proxy), base_url="http://proxy") as client,
    ):
        yield client


@pytest.mark.anyio
async def test_packets_are_harmed_as_the_channel_says(packets: list[bytes]) -> None:
    sleep = Slept()
    async with through(f"{SPEC};delay:seconds=2", sleep=sleep) as client:
        answer = await client.post("/v1/transmissions/hills", content=b"".join(packets))
    expected = Channel.parse(f"{SPEC};delay:seconds=2", seed=5).transmit(packets, transmission="hills")
    assert answer.content == expected.body
    assert answer.headers["seen-length"] == str(len(expected.body))
    assert "erasure=" in answer.headers["surfacelink-faults"]
    assert answer.headers["seen-faults"] == answer.headers["surfacelink-faults"]
    assert sleep.seconds == [2]


@pytest.mark.anyio
async def test_everything_else_passes_as_it_is() -> None:
    async with through("erasure:p=1") as client:
        answer = await client.put(
            "/a%20b/c?x=1&x=%2F", content=b"body", headers={"Connection": "x-hop", "X-Hop": "of this hop"}
        )
        assert answer.status_code == 207
        assert answer.content == b"body"
        assert answer.headers["method"] == "PUT"
        assert answer.headers["target"] == "/base/a%20b/c?x=1&x=%2F"
        assert answer.headers["seen-host"] == "server:99"
        assert answer.headers["seen-hop"] == "none"
        assert answer.headers["seen-faults"] == "none seen"
        assert "x-secret" not in answer.headers
        assert "date" not in answer.headers
        assert answer.headers.get_list("set-cookie") == ["a=1", "b=2"]
        assert (await client.get("/")).headers["seen-length"] == "none"
        assert (await client.get("/stream")).text == "one two three"


@pytest.mark.anyio
async def test_the_channel_is_steered_at_run_time(packets: list[bytes]) -> None:
    body = b"".join(packets)
    async with through("clean") as client:
        assert (await client.get("/v1/channel")).json() == {"impairments": [], "seed": 5, "spec": "clean;seed=5"}
        assert (await client.post("/v1/transmissions/hills", content=body)).content == body
        for document in ({"spec": "erasure:p=1"}, "erasure:p=1", {"impairments": [{"kind": "erasure", "p": 1}]}):
            answer = await client.put("/v1/channel", json=document)
            assert answer.json()["spec"] == "erasure:p=1"
            assert (await client.get("/v1/channel")).json() == answer.json()
        assert (await client.post("/v1/transmissions/hills", content=body)).content == b""


@pytest.mark.anyio
async def test_head_is_answered_as_get_is_without_a_body() -> None:
    async with through(SPEC) as client:
        for url, status in (("/v1/channel", 200), ("/a", 207)):
            head, get = await client.head(url), await client.get(url)
            assert (head.status_code, head.content) == (status, b"")
            assert head.headers["content-length"] == get.headers["content-length"]


@pytest.mark.anyio
@pytest.mark.parametrize(
    ("content", "status", "detail"),
    [
        (b"{", 422, "must be JSON"),
        (b"[" * 60_000, 422, "must be JSON"),
        (b'{"spec": "erazure:p=1"}', 422, "did you mean 'erasure'"),
        (b" " * (MAX_CHANNEL_BYTES + 1), 413, "longer than"),
    ],
)
async def test_a_channel_that_is_none_leaves_the_old_one_in_force(content: bytes, status: int, detail: str) -> None:
    async with through(SPEC) as client:
        answer = await client.put("/v1/channel", content=content)
        assert answer.status_code == status
        assert answer.headers["content-type"] == "application/problem+json"
        assert detail in answer.json()["detail"]
        assert (await client.get("/v1/channel")).json()["spec"] == f"{SPEC};seed=5"


@pytest.mark.anyio
async def test_a_channel_is_no_longer_than_accepted_though_its_length_is_not_declared() -> None:
    async def parts() -> AsyncIterator[bytes]:
        for _ in range(5):
            yield b" " * (MAX_CHANNEL_BYTES // 4)

    async with through(SPEC) as client:
        assert (await client.put("/v1/channel", content=parts())).status_code == 413


@pytest.mark.anyio
async def test_a_server_that_does_not_answer_is_a_502() -> None:
    def refuse(request: httpx.Request) -> httpx.Response:
        raise httpx.ConnectError("no one there", request=request)

    async with through("clean", httpx.MockTransport(refuse)) as client:
        answer = await client.get("/v1/surfaces")
    assert answer.status_code == 502
    assert answer.headers["content-type"] == "application/problem+json"
    assert "http://server:99" in answer.json()["detail"]


@pytest.mark.anyio
async def test_a_body_beyond_the_limit_is_a_413() -> None:
    proxy = create_proxy("http://server", Channel.parse(SPEC), max_body_bytes=10)
    async with httpx.AsyncClient(transport=httpx.ASGITransport(proxy), base_url="http://proxy") as client:
        assert (await client.post("/v1/transmissions/hills", content=bytes(11))).status_code == 413


@pytest.mark.anyio
async def test_the_answer_is_closed_when_the_client_goes_away() -> None:
    closed = anyio.Event()

    class Endless(httpx.AsyncByteStream):
        async def __aiter__(self) -> AsyncIterator[bytes]:
            while True:
                yield b"data: more\n\n"
                await anyio.sleep(0)

        async def aclose(self) -> None:
            closed.set()

    class Server(httpx.AsyncBaseTransport):
        async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
            return httpx.Response(200, stream=Endless())

    proxy = create_proxy("http://server", Channel(), transport=Server())
    received = 0

    async def receive() -> dict[str, object]:
        while received < 5:
            await anyio.sleep(0)
        return {"type": "http.disconnect"}

    async def send(message: object) -> None:
        nonlocal received
        received += 1

    scope = {
        "type": "http", "method": "GET", "path": "/events", "raw_path": b"/events", "query_string": b"", "headers": [],
    }  # fmt: skip
    async with proxy.router.lifespan_context(proxy):
        with anyio.fail_after(10):
            await proxy(scope, receive, send)
            await closed.wait()


@pytest.mark.anyio
@pytest.mark.parametrize(("method", "path"), [("PUT", "/v1/channel"), ("PUT", "/a"), ("POST", "/v1/transmissions/a")])
async def test_an_upload_that_is_broken_off_is_no_fault_of_the_proxy(method: str, path: str) -> None:
    proxy = create_proxy("http://server", Channel.parse(SPEC), transport=httpx.ASGITransport(SERVER))
    async with proxy.router.lifespan_context(proxy):
        await break_off(proxy, method, path, "application/json", b"{")


@pytest.mark.parametrize(
    "upstream", ["", "server:80", "ftp://server", "http://", "http://a?b=1", "http://[::", "http://a:99999"]
)
def test_an_upstream_that_is_no_address_is_refused(upstream: str) -> None:
    with pytest.raises(ParameterError, match="upstream"):
        create_proxy(upstream, Channel())


def test_a_proxy_on_the_way_that_cannot_be_used_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("all_proxy", "socks5://127.0.0.1:9")
    monkeypatch.setitem(sys.modules, "socksio", None)
    monkeypatch.setattr(
        "sys.argv", ["simulate", "channel", "clean", "--port", "0", "--upstream", "http://upstream.test"]
    )
    monkeypatch.setattr("uvicorn.Server.run", lambda self, sockets: None)
    with pytest.raises(SystemExit) as stop:
        main()
    assert stop.value.code == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: the proxy that HTTP_PROXY, HTTPS_PROXY or ALL_PROXY names cannot be used")
    assert err.count("\n") == 1


@pytest.mark.parametrize("port", ["99999", "taken"])
def test_a_port_that_cannot_be_had_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], port: str
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        number = str(taken.getsockname()[1]) if port == "taken" else port
        monkeypatch.setattr("sys.argv", ["simulate", "channel", "clean", "--port", number])
        with pytest.raises(SystemExit) as stop:
            main()
    assert stop.value.code == 1
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert number in err
    assert err.count("\n") == 1
