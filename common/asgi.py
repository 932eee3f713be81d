"""What both services do to a request before their routes see it, as ASGI has it: bound its body, take HEAD for GET."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any, TypeAlias

import anyio

from common.errors import LimitError

Message: TypeAlias = MutableMapping[str, Any]
Receive: TypeAlias = Callable[[], Awaitable[Message]]
Send: TypeAlias = Callable[[Message], Awaitable[None]]


def limited(scope: Message, receive: Receive, most: int) -> Receive:
    """`receive`, for bodies of at most `most` bytes.

    Raises LimitError at once where the request declares more, and from what is returned where more come.
    """

    def check(length: int) -> None:
        if length > most:
            raise LimitError(f"the body is longer than {most} bytes")

    declared = dict(scope["headers"]).get(b"content-length", b"")
    check(int(declared) if declared.isdigit() else 0)
    received = 0

    async def counted() -> Message:
        nonlocal received
        message = await receive()
        received += len(message.get("body", b""))
        check(received)
        return message

    return counted


class Head:
    """ASGI middleware: HEAD is GET up to the headers of the answer, for routes that know GET alone (RFC 9110, section
    9.1: a server must support both).

    There the application is called off: nothing of a body is made that is not sent, and a stream of events, which has
    no end, ends. Routes of its own for HEAD would stand beside each GET in the OpenAPI document.
    """

    def __init__(self, app: Callable[[Message, Receive, Send], Awaitable[None]]) -> None:
        self.app = app

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Handle one connection."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
        elif scope["method"] == "HEAD":
            await self._answer_head(scope, receive, send)
        else:
            await self.app(scope, receive, lambda message: send(_allowing_head(message)))

    async def _answer_head(self, scope: Message, receive: Receive, send: Send) -> None:
        # A copy: the server looks into its own for whether the answer has a body.
        asked = {**scope, "method": "GET"}

        async def only_headers(message: Message) -> None:
            if message["type"] != "http.response.start":
                return
            scope["route"] = asked.get("route")  # middleware outside counts by it
            await send(_allowing_head(message))
            await send({"type": "http.response.body"})
            answering.cancel()

        with anyio.CancelScope() as answering:
            await self.app(asked, receive, only_headers)


def _allowing_head(message: Message) -> Message:
    """The start of an answer, with HEAD in its header Allow beside GET."""
    if message["type"] != "http.response.start" or message["status"] != 405:
        return message
    return {**message, "headers": [_with_head(*field) for field in message["headers"]]}


def _with_head(name: bytes, value: bytes) -> tuple[bytes, bytes]:
    methods = [method.strip() for method in value.split(b",")]
    missing = name.lower() == b"allow" and b"GET" in methods and b"HEAD" not in methods
    return name, value + b", HEAD" if missing else value
