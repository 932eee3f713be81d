"""HEAD is GET up to the headers of the answer, for any ASGI application; a body is bounded as it comes."""

from __future__ import annotations

from typing import Any

import anyio
import pytest

from common.asgi import Head, Message, Receive, Send

pytestmark = pytest.mark.anyio


async def ask(application: Any, method: str) -> tuple[Message, list[Message]]:
    """The scope after one request, and what was sent."""
    scope: Message = {"type": "http", "method": method}
    sent: list[Message] = []

    async def receive() -> Message:
        await anyio.sleep_forever()
        raise AssertionError

    async def send(message: Message) -> None:
        await anyio.lowlevel.checkpoint()
        sent.append(message)

    with anyio.fail_after(10):
        await Head(application)(scope, receive, send)
    return scope, sent


async def endless(scope: Message, receive: Receive, send: Send) -> None:
    assert scope["method"] == "GET"
    scope["route"] = "the route"
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"7")]})
    await send({"type": "http.response.body", "body": b"some of", "more_body": True})
    await receive()


async def test_an_answer_without_an_end_ends_with_its_headers() -> None:
    scope, sent = await ask(endless, "HEAD")
    assert sent == [
        {"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"7")]},
        {"type": "http.response.body"},
    ]
    assert scope == {"type": "http", "method": "HEAD", "route": "the route"}


@pytest.mark.parametrize("method", ["HEAD", "PUT"])
@pytest.mark.parametrize(
    ("allow", "told"),
    [(b"GET", b"GET, HEAD"), (b"DELETE, GET", b"DELETE, GET, HEAD"), (b"GET, HEAD", b"GET, HEAD"), (b"POST", b"POST")],
)
async def test_where_get_is_allowed_head_is(method: str, allow: bytes, told: bytes) -> None:
    async def refuse(scope: Message, receive: Receive, send: Send) -> None:
        await send({"type": "http.response.start", "status": 405, "headers": [(b"allow", allow)]})
        await send({"type": "http.response.body"})

    _, sent = await ask(refuse, method)
    assert [message["type"] for message in sent] == ["http.response.start", "http.response.body"]
    assert sent[0]["headers"] == [(b"allow", told)]
