"""ChannelTransport: the same harm as the channel's own, on the sender's side."""

from __future__ import annotations

from collections.abc import Sequence

import httpx
import pytest

from common.channel import Channel
from common.errors import ParameterError
from sender.transport import ChannelTransport

URL = "http://receiver/v1/transmissions/hills"


class Recorder:
    """A server that keeps what it is sent, and a clock."""

    def __init__(self) -> None:
        self.requests: list[httpx.Request] = []
        self.slept: list[float] = []
        self.headers: dict[str, str] = {}

    async def answer(self, request: httpx.Request) -> httpx.Response:
        await request.aread()
        self.requests.append(request)
        return httpx.Response(202, headers=self.headers)

    async def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)

    def client(self, channel: str) -> httpx.AsyncClient:
        transport = ChannelTransport(httpx.MockTransport(self.answer), Channel.parse(channel, seed=3), sleep=self.sleep)
        return httpx.AsyncClient(transport=transport)


SPEC = "gaussian:std=0.1;erasure:p=0.3;duplication:p=0.1"


@pytest.mark.anyio
async def test_the_server_gets_what_the_channel_delivers(packets: list[bytes]) -> None:
    recorder = Recorder()
    async with recorder.client(SPEC) as client:
        answer = await client.post(
            URL, content=b"".join(packets), headers={"Surfacelink-Attempt": "2", "X-Other": "kept"}
        )
    expected = Channel.parse(SPEC, seed=3).transmit(packets, transmission="hills", attempt=2)
    (request,) = recorder.requests
    assert request.content == expected.body
    assert request.headers.get_list("content-length") == [str(len(expected.body))]
    assert request.headers["x-other"] == "kept"
    counts = dict(part.split("=") for part in answer.headers["surfacelink-faults"].split(", "))
    assert counts == {kind: str(count) for kind, count in expected.counts.items()}


@pytest.mark.anyio
async def test_a_name_for_the_draws_goes_before_the_id(packets: list[bytes]) -> None:
    recorder, channel = Recorder(), Channel.parse(SPEC, seed=3)
    transport = ChannelTransport(httpx.MockTransport(recorder.answer), channel, draws="valleys", sleep=recorder.sleep)
    async with httpx.AsyncClient(transport=transport) as client:
        await client.post(URL, content=b"".join(packets))
    (request,) = recorder.requests
    assert request.url.path == "/v1/transmissions/hills"
    assert request.content == channel.transmit(packets, transmission="valleys").body


@pytest.mark.anyio
async def test_the_faults_of_an_inner_channel_are_added(packets: list[bytes]) -> None:
    recorder = Recorder()
    recorder.headers = {"Surfacelink-Faults": "gaussian=6, erasure=2"}
    async with recorder.client("erasure:p=1") as client:
        answer = await client.post(URL, content=b"".join(packets))
    assert answer.headers["surfacelink-faults"] == f"erasure={len(packets) + 2}, gaussian=6"
    async with recorder.client("erasure:p=0") as client:
        answer = await client.post(URL, content=b"".join(packets))
    assert answer.headers["surfacelink-faults"] == "gaussian=6, erasure=2"


@pytest.mark.anyio
async def test_channels_one_after_the_other_draw_apart(packets: list[bytes]) -> None:
    recorder, channel = Recorder(), Channel.parse("gaussian:std=0.1", seed=3)
    inner: httpx.AsyncBaseTransport = httpx.MockTransport(recorder.answer)
    for _ in range(3):
        inner = ChannelTransport(inner, channel, sleep=recorder.sleep)
    async with httpx.AsyncClient(transport=inner) as client:
        await client.post(URL, content=b"".join(packets))
    expected: Sequence[bytes] = packets
    for passed in range(3):
        expected = channel.transmit(expected, transmission="hills", passed=passed).packets
    assert recorder.requests[0].content == b"".join(expected)


@pytest.mark.anyio
async def test_everything_else_passes_untouched(packets: list[bytes]) -> None:
    recorder, body = Recorder(), b"".join(packets)
    async with recorder.client("erasure:p=1") as client:
        await client.post("http://receiver/v1/surfaces", content=body)
        await client.put(URL, content=body)
        await client.get(URL)
        await client.post(URL, content=body)
        client._transport.channel = Channel()  # type: ignore[attr-defined]
        await client.post(URL, content=body)
    assert [request.content for request in recorder.requests] == [body, body, b"", b"", body]


@pytest.mark.anyio
async def test_the_delay_of_the_link_is_waited_for(packets: list[bytes]) -> None:
    recorder = Recorder()
    async with recorder.client("delay:seconds=0.3;rate:bits_per_second=10000") as client:
        await client.post(URL, content=b"".join(packets))
    assert recorder.slept == [pytest.approx(0.3 + 8 * sum(map(len, packets)) / 10_000)]


@pytest.mark.anyio
async def test_a_wrong_attempt_is_our_error(packets: list[bytes]) -> None:
    recorder = Recorder()
    async with recorder.client(SPEC) as client:
        with pytest.raises(ParameterError, match="Surfacelink-Attempt"):
            await client.post(URL, content=b"".join(packets), headers={"Surfacelink-Attempt": "first"})
    assert not recorder.requests
