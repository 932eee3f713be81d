"""The client against a receiver that fails in every way it can: retries, problems, selective retransmission."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from typing import Any

import anyio
import anyio.lowlevel
import httpx
import numpy as np
import pytest

from common.channel import Channel
from common.channel.carrying import ATTEMPT_HEADER
from common.errors import LinkError, NotFoundError, ParameterError, RefusedError, TrainingError
from sender import client as module
from sender.client import ReceiverClient, RetryPolicy

URL = "http://receiver.test"
PACKETS = [bytes([number]) * 10 for number in range(6)]


def accepted(missing: list[int], total: int | None = 6) -> httpx.Response:
    counts = {"received": 0, "damaged": 0, "duplicate": 0, "total": total, "missing": missing}
    complete = total is not None and not missing
    return httpx.Response(
        202, json={"id": "a", "packets": counts, "points": 3, "complete": complete, "state": "training"}
    )


class Receiver:
    """Answers from a list, and remembers what it was asked and how long the client slept."""

    def __init__(self, *answers: httpx.Response | Exception) -> None:
        self.answers = list(answers)
        self.requests: list[httpx.Request] = []
        self.slept: list[float] = []

    def handle(self, request: httpx.Request) -> httpx.Response:
        self.requests.append(request)
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer

    async def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)

    def run(self, use: Callable[[ReceiverClient], Any]) -> Any:
        async def go() -> Any:
            http = httpx.AsyncClient(base_url=URL, transport=httpx.MockTransport(self.handle))
            async with ReceiverClient(http, sleep=self.sleep, rng=np.random.default_rng(0)) as client:
                return await use(client)

        return anyio.run(go)


def send(client: ReceiverClient, rounds: int = 1) -> Any:
    return client.send(PACKETS, transmission="a", rounds=rounds)


def test_a_clean_transmission_is_one_post_of_all_packets() -> None:
    receiver = Receiver(accepted([]))
    sent = receiver.run(send)
    (request,) = receiver.requests
    assert request.content == b"".join(PACKETS)
    assert request.headers["Content-Type"] == "application/vnd.msgpack"
    assert (sent.packets, sent.bytes, sent.retransmitted) == (6, 60, 0)


def test_only_what_is_missing_is_sent_again_with_the_number_of_the_attempt() -> None:
    receiver = Receiver(
        accepted([1, 4]),
        accepted([4]),
        accepted([]),
    )
    sent = receiver.run(lambda client: send(client, rounds=9))
    assert [request.content for request in receiver.requests] == [
        b"".join(PACKETS),
        PACKETS[1] + PACKETS[4],
        PACKETS[4],
    ]
    assert [request.headers[ATTEMPT_HEADER] for request in receiver.requests] == ["0", "1", "2"]
    assert (sent.packets, sent.bytes, sent.retransmitted) == (9, 90, 3)
    assert sent.receipt.complete


def test_rounds_bound_the_retransmissions() -> None:
    receiver = Receiver(*[accepted([0]) for _ in range(2)])
    assert not receiver.run(lambda client: send(client, rounds=2)).receipt.complete


def test_where_nothing_got_through_everything_is_sent_again() -> None:
    receiver = Receiver(accepted([], total=None), accepted([]))
    sent = receiver.run(lambda client: send(client, rounds=3))
    assert receiver.requests[1].content == b"".join(PACKETS)
    assert sent.retransmitted == 6


def test_long_bodies_are_cut_between_packets(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_BODY_BYTES", 25)
    receiver = Receiver(*[accepted([]) for _ in range(3)])
    receiver.run(send)
    assert [request.content for request in receiver.requests] == [b"".join(PACKETS[i : i + 2]) for i in (0, 2, 4)]


@pytest.mark.parametrize("size", [10, 20_000])
def test_a_body_is_given_its_time_on_the_slowest_link(size: int) -> None:
    receiver = Receiver(accepted([], total=1))
    receiver.run(lambda client: client.send([bytes(size)], transmission="a"))
    on_the_link = Channel.parse("rate:bits_per_second=250").transmit([bytes(size)], transmission="a").seconds
    timeout = receiver.requests[0].extensions["timeout"]
    assert timeout["read"] >= module.READ_TIMEOUT + on_the_link
    assert timeout["connect"] == module.CONNECT_TIMEOUT


class SlowReceiver:
    """Answers a POST after as many ticks as `signs`, one of which each sign of life answers or owes; or never."""

    def __init__(self, signs: list[httpx.Response | Exception], *, answers: bool) -> None:
        self.signs = list(signs)
        self.answers = answers
        self.ticks: list[float] = []
        self.heard_out = anyio.Event()

    async def handle(self, request: httpx.Request) -> httpx.Response:
        if request.method == "POST":
            await (self.heard_out.wait() if self.answers else anyio.sleep_forever())
            return accepted([])
        assert request.url.path == "/health/live"
        sign = self.signs.pop(0)
        if not self.signs:
            self.heard_out.set()
        if isinstance(sign, Exception):
            raise sign
        return sign

    async def tick(self, seconds: float) -> None:
        self.ticks.append(seconds)
        await anyio.lowlevel.checkpoint()

    def send(self) -> Any:
        async def go() -> Any:
            http = httpx.AsyncClient(base_url=URL, transport=httpx.MockTransport(self.handle))
            async with ReceiverClient(http, tick=self.tick) as client:
                with anyio.fail_after(20):
                    return await client.send([bytes(module.MAX_BODY_BYTES)], transmission="a")

        return anyio.run(go)


OWED: list[httpx.Response | Exception] = [
    httpx.ReadTimeout(""),
    httpx.ConnectTimeout(""),
    httpx.DecodingError(""),
    httpx.Response(502),
]


def test_a_slow_link_is_waited_for_while_the_receiver_is_alive() -> None:
    seldom = [*OWED, httpx.Response(200), *OWED[:1], httpx.Response(404)]
    receiver = SlowReceiver(seldom * 100, answers=True)
    assert receiver.send().receipt.complete
    assert len(receiver.ticks) >= 600


@pytest.mark.parametrize("sign", OWED, ids=repr)
def test_a_receiver_that_hangs_is_noticed_within_minutes(sign: httpx.Response | Exception) -> None:
    receiver = SlowReceiver([httpx.Response(200), *[sign] * 100], answers=False)
    with pytest.raises(LinkError, match="hangs"):
        receiver.send()
    assert len(receiver.ticks) == 1 + module.PROBES
    assert 2 * module.READ_TIMEOUT * module.PROBES <= 600


def test_a_receiver_that_takes_too_long_is_not_said_to_be_down() -> None:
    receiver = Receiver(*[httpx.ReadTimeout("")] * 4)
    with pytest.raises(LinkError, match=r"ReadTimeout.*link slower than 100 bit/s.*may still arrive") as raised:
        receiver.run(send)
    assert "receiver serve" not in str(raised.value)


def test_failures_that_may_pass_are_tried_again_with_growing_pauses() -> None:
    receiver = Receiver(
        httpx.ConnectError("refused"),
        httpx.Response(503, headers={"Retry-After": "7"}),
        httpx.ReadTimeout("slow"),
        accepted([]),
    )
    receiver.run(send)
    policy = RetryPolicy()
    assert len(receiver.requests) == policy.tries
    assert policy.first * (1 - policy.jitter) <= receiver.slept[0] <= policy.first
    assert receiver.slept[1] == 7.0
    assert 4 * policy.first * (1 - policy.jitter) <= receiver.slept[2] <= 4 * policy.first


def test_a_pause_that_is_no_number_is_not_kept() -> None:
    receiver = Receiver(httpx.Response(503, headers=[(b"Retry-After", b"\xb2")]), accepted([]))  # a superscript two
    receiver.run(send)
    assert 0 < receiver.slept[0] <= RetryPolicy().first


def test_a_receiver_that_is_not_running_is_named_with_what_to_do() -> None:
    receiver = Receiver(*[httpx.ConnectError("All connection attempts failed")] * 4)
    with pytest.raises(LinkError, match=r"receiver\.test does not answer.*receiver serve"):
        receiver.run(send)


@pytest.mark.parametrize(
    ("answer", "error", "message"),
    [
        (
            httpx.Response(422, json={"title": "t", "detail": "bad spread"}),
            RefusedError,
            "422: bad spread",
        ),
        (httpx.Response(404, json={"title": "t", "detail": "no such surface"}), NotFoundError, "no such surface"),
        (httpx.Response(418, text="teapot"), LinkError, "418.*is it a receiver"),
        (httpx.Response(202, text="<html>"), LinkError, "not answer with a receipt"),
        (httpx.Response(202, json={"id": "a"}), LinkError, "not answer with a receipt"),
    ],
)
def test_answers_that_no_retry_would_change(answer: httpx.Response, error: type[Exception], message: str) -> None:
    receiver = Receiver(answer)
    with pytest.raises(error, match=message):
        receiver.run(send)
    assert len(receiver.requests) == 1


def test_https_where_http_is_spoken_is_not_said_to_be_down() -> None:
    receiver = Receiver(*[httpx.ConnectError("[SSL: WRONG_VERSION_NUMBER] wrong version number")] * 4)
    with pytest.raises(LinkError, match=r"it speaks no https there.*receiver serve speaks http://") as told:
        receiver.run(send)
    assert "start it" not in str(told.value)


def test_every_error_of_httpx_that_a_transport_raises_is_ours_at_the_end() -> None:
    kinds = [httpx.ConnectError, httpx.ConnectTimeout, httpx.ReadError, httpx.ReadTimeout, httpx.WriteError,
             httpx.WriteTimeout, httpx.PoolTimeout, httpx.RemoteProtocolError, httpx.ProxyError]  # fmt: skip
    for kind in kinds:
        with pytest.raises(LinkError):
            Receiver(*[kind("x")] * 4).run(send)


def test_waiting_ends_with_ready_with_failure_or_with_the_time() -> None:
    def states(*names: str) -> Receiver:
        return Receiver(*[httpx.Response(200, json={"state": name, "error": {"detail": "too few"}}) for name in names])

    assert states("training", "ready").run(lambda client: client.wait_ready("a"))["state"] == "ready"
    with pytest.raises(TrainingError, match="too few"):
        states("training", "failed").run(lambda client: client.wait_ready("a"))
    with pytest.raises(TrainingError, match="nothing of a reached"):
        states("receiving").run(lambda client: client.wait_ready("a"))
    with pytest.raises(LinkError, match=r"not ready after 0\.2"):
        states("training", "training").run(lambda client: client.wait_ready("a", timeout=0.2))


@pytest.mark.parametrize(
    "url", ["ftp://x", "localhost:8001", "", "http://", "http://a:b", "http://a?b=1", "http://a#b", "http://a:99999"]
)
def test_a_url_that_is_none_is_refused(url: str) -> None:
    with pytest.raises(ParameterError, match="URL"):
        ReceiverClient.connect(url)


def test_an_array_that_is_none_is_refused() -> None:
    receiver = Receiver(httpx.Response(200, content=json.dumps([1]).encode()))
    with pytest.raises(LinkError, match="did not answer with an array"):
        receiver.run(lambda client: client.features("a"))


@pytest.mark.parametrize(
    ("url", "proxied"),
    [
        ("http://127.0.0.1:8001", False),
        ("http://localhost", False),
        ("http://[::1]:8001", False),
        ("http://192.0.2.7:8001", True),
        ("http://receiver.test", True),
    ],
)
def test_no_proxy_stands_before_a_receiver_on_this_machine(
    url: str, proxied: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("http_proxy", "http://192.0.2.1:3128")

    async def pool() -> object:
        async with ReceiverClient.connect(url) as client:
            return client.http._transport_for_url(httpx.URL(url))._pool  # type: ignore[attr-defined]

    assert ("Proxy" in type(anyio.run(pool)).__name__) == proxied


@pytest.mark.parametrize("proxy", ["socks5://127.0.0.1:9", "carrier-pigeon://loft"])
def test_a_proxy_that_cannot_be_used_is_told(proxy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("all_proxy", proxy)
    monkeypatch.setitem(sys.modules, "socksio", None)
    with pytest.raises(ParameterError, match=r"ALL_PROXY names cannot be used: .*; NO_PROXY=receiver\.test goes"):
        ReceiverClient.connect(URL)
