"""ChannelMiddleware: harms what it should, exactly as the channel says, and leaves the rest alone."""

from __future__ import annotations

from collections.abc import AsyncIterator

import anyio
import httpx
import pytest
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route
from starlette.types import Message, Receive, Scope, Send

from common.channel import Channel
from receiver.middleware import ChannelMiddleware

LIMIT = 100_000


class Slept:
    """Stands for the clock."""

    def __init__(self) -> None:
        self.seconds: list[float] = []

    async def __call__(self, seconds: float) -> None:
        self.seconds.append(seconds)


async def echo(request: Request) -> Response:
    body = await request.body()
    declared = request.headers.get("content-length")
    return Response(body, headers={"declared": declared or "", "chunked": request.headers.get("transfer-encoding", "")})


def create(channel: str, sleep: Slept | None = None) -> Starlette:
    app = Starlette(
        routes=[Route("/{path:path}", echo, methods=["GET", "POST", "PUT"])],
        middleware=[Middleware(ChannelMiddleware, max_body_bytes=LIMIT, sleep=sleep or Slept())],
    )
    app.state.channel = Channel.parse(channel, seed=4)
    return app


async def post(
    app: Starlette, content: bytes | AsyncIterator[bytes], path: str = "/v1/transmissions/hills", **headers: str
) -> httpx.Response:
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://test") as client:
        return await client.post(path, content=content, headers={k.replace("_", "-"): v for k, v in headers.items()})


SPEC = "gaussian:std=0.1,axes=xyz;erasure:p=0.2;bit_errors:ber=1e-4"


@pytest.mark.anyio
async def test_the_application_gets_what_the_channel_delivers(packets: list[bytes]) -> None:
    expected = Channel.parse(SPEC, seed=4).transmit(packets, transmission="hills", attempt=3)
    answer = await post(create(SPEC), b"".join(packets), surfacelink_attempt="3")
    assert answer.content == expected.body != b"".join(packets)
    assert answer.headers["declared"] == str(len(expected.body))
    counts = dict(part.split("=") for part in answer.headers["surfacelink-faults"].split(", "))
    assert counts == {kind: str(count) for kind, count in expected.counts.items()}


@pytest.mark.anyio
async def test_it_draws_apart_from_channels_before_it(packets: list[bytes]) -> None:
    answer = await post(create(SPEC), b"".join(packets), surfacelink_faults="none")
    expected = Channel.parse(SPEC, seed=4).transmit(packets, transmission="hills", passed=1)
    assert answer.content == expected.body


@pytest.mark.anyio
async def test_a_chunked_body_is_the_same_to_the_channel(packets: list[bytes]) -> None:
    async def chunks() -> AsyncIterator[bytes]:
        body = b"".join(packets)
        for start in range(0, len(body), 100):
            yield body[start : start + 100]

    whole, chunked = await post(create(SPEC), b"".join(packets)), await post(create(SPEC), chunks())
    assert chunked.content == whole.content
    assert chunked.headers["declared"] == str(len(whole.content))
    assert chunked.headers["chunked"] == ""


@pytest.mark.anyio
async def test_each_attempt_meets_other_harm_and_the_same_attempt_the_same(packets: list[bytes]) -> None:
    body = b"".join(packets)
    app = create(SPEC)
    first, again, next_one = [await post(app, body, surfacelink_attempt=k) for k in ("0", "0", "1")]
    assert first.content == again.content != next_one.content
    assert (await post(app, body)).content == first.content


@pytest.mark.anyio
async def test_relative_noise_on_a_later_attempt_refers_to_the_first(packets: list[bytes]) -> None:
    channel = Channel.parse("gaussian:relative=0.1", seed=4)
    whole = channel.transmit(packets, transmission="hills").reference
    app = create("gaussian:relative=0.1")
    await post(app, b"".join(packets))
    later = await post(app, packets[0], surfacelink_attempt="1")
    expected = channel.transmit(packets[:1], transmission="hills", attempt=1, reference=whole)
    assert later.content == expected.body
    assert later.content != channel.transmit(packets[:1], transmission="hills", attempt=1).body


@pytest.mark.anyio
async def test_everything_else_passes_untouched(packets: list[bytes]) -> None:
    app, body = create("erasure:p=1"), b"".join(packets)
    for path in ("/v1/transmissions", "/v1/transmissions/a/b", "/v1/surfaces/hills", "/"):
        answer = await post(app, body, path)
        assert answer.content == body
        assert "surfacelink-faults" not in answer.headers
    assert (await post(app, body)).content == b""
    assert (await post(create("clean"), body)).content == body


@pytest.mark.anyio
async def test_a_body_that_is_no_packets_is_harmed_as_one_datagram() -> None:
    body = b"x,y,z\n" * 50
    answer = await post(create("bit_errors:ber=0.01"), body)
    assert len(answer.content) == len(body)
    assert answer.content != body
    assert (await post(create("erasure:p=1"), body)).content == b""


@pytest.mark.anyio
@pytest.mark.parametrize("attempt", ["-1", "one", "1.5", "99999999999", ""])
async def test_a_wrong_attempt_answers_for_itself(packets: list[bytes], attempt: str) -> None:
    answer = await post(create(SPEC), b"".join(packets), surfacelink_attempt=attempt)
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"
    assert "Surfacelink-Attempt" in answer.json()["detail"]


@pytest.mark.anyio
async def test_a_long_body_is_refused_before_it_is_read() -> None:
    read: list[int] = []

    async def endless() -> AsyncIterator[bytes]:
        for _ in range(100):
            read.append(10_000)
            yield bytes(10_000)

    for content in (bytes(LIMIT + 1), endless()):
        answer = await post(create(SPEC), content)
        assert answer.status_code == 413
        assert answer.headers["content-type"] == "application/problem+json"
    # httpx hands the chunks on one by one: the middleware stopped asking soon after the limit.
    assert sum(read) <= LIMIT + 20_000


@pytest.mark.anyio
async def test_the_delay_of_the_link_is_waited_for(packets: list[bytes]) -> None:
    slept = Slept()
    await post(create("delay:seconds=1.5;rate:bits_per_second=8000", slept), b"".join(packets))
    assert slept.seconds == [pytest.approx(1.5 + sum(map(len, packets)) / 1000)]
    slept.seconds.clear()
    await post(create("erasure:p=0.5", slept), b"".join(packets))
    assert slept.seconds == []


@pytest.mark.anyio
async def test_the_channel_in_force_is_swapped_for_the_requests_that_start_later(packets: list[bytes]) -> None:
    class Swap(Slept):
        async def __call__(self, seconds: float) -> None:
            app.state.channel = Channel.parse("erasure:p=1")

    app = create("delay:seconds=1", Swap())
    body = b"".join(packets)
    assert (await post(app, body)).content == body
    assert (await post(app, body)).content == b""


@pytest.mark.anyio
async def test_requests_at_the_same_time_do_not_meet(packets: list[bytes]) -> None:
    app = create(SPEC)
    alone = {name: (await post(app, b"".join(packets), f"/v1/transmissions/{name}")).content for name in "abcdef"}
    together: dict[str, bytes] = {}

    async def one(name: str) -> None:
        together[name] = (await post(app, b"".join(packets), f"/v1/transmissions/{name}")).content

    async with anyio.create_task_group() as group:
        for name in alone:
            group.start_soon(one, name)
    assert together == alone
    assert len(set(alone.values())) == len(alone)


@pytest.mark.anyio
async def test_a_client_that_goes_away_leaves_nothing_behind() -> None:
    sent: list[Message] = []
    messages: list[Message] = [
        {"type": "http.request", "body": b"abc", "more_body": True},
        {"type": "http.disconnect"},
    ]

    async def receive() -> Message:
        return messages.pop(0)

    async def send(message: Message) -> None:
        sent.append(message)

    scope: Scope = {
        "type": "http", "method": "POST", "path": "/v1/transmissions/hills", "headers": [], "query_string": b"",
    }  # fmt: skip
    await create(SPEC)(scope, receive, send)
    assert sent == []


@pytest.mark.anyio
async def test_what_is_on_the_air_arrives_although_its_sender_hung_up(packets: list[bytes]) -> None:
    bodies: list[bytes] = []
    hung_up = anyio.Event()

    async def application(scope: Scope, receive: Receive, send: Send) -> None:
        bodies.append(await Request(scope, receive).body())
        await Response()(scope, receive, send)

    messages: list[Message] = [{"type": "http.request", "body": packets[0]}, {"type": "http.disconnect"}]

    async def receive() -> Message:
        message = messages.pop(0)
        if message["type"] == "http.disconnect":
            hung_up.set()
        return message

    async def send(message: Message) -> None:
        """A server drops what is sent to a client that left."""

    async def sleep(seconds: float) -> None:
        assert seconds == 3600
        with anyio.move_on_after(0.1):
            await hung_up.wait()

    scope: Scope = {
        "type": "http", "method": "POST", "path": "/v1/transmissions/hills", "headers": [],
        "app": create("delay:seconds=3600"),
    }  # fmt: skip
    with anyio.fail_after(10):
        await ChannelMiddleware(application, max_body_bytes=LIMIT, sleep=sleep)(scope, receive, send)
    assert bodies == [packets[0]]


@pytest.mark.anyio
async def test_a_mounted_application_knows_its_own_path(packets: list[bytes]) -> None:
    app = create("erasure:p=1")
    transport = httpx.ASGITransport(app, root_path="/link")
    async with httpx.AsyncClient(transport=transport, base_url="http://test") as client:
        answer = await client.post("/link/v1/transmissions/hills", content=b"".join(packets))
    assert answer.content == b""
