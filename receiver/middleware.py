"""The channel in front of the receiver: harms the packets of each transmission before the application sees them."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TypeAlias

import anyio
from anyio import to_thread
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from common.asgi import limited
from common.channel import Channel
from common.channel.carrying import (
    ATTEMPT_HEADER,
    FAULTS_HEADER,
    References,
    attempt_of,
    carry,
    faults_header,
    transmission_of,
    with_faults,
)
from common.errors import SurfacelinkError
from common.problems import problem_of
from receiver.problems import respond

Sleep: TypeAlias = Callable[[float], Awaitable[None]]

SENT = "surfacelink.sent"
"""Key of the ASGI scope that holds the body as it was before the channel."""

FAULTS = "surfacelink.faults"
"""Key of the ASGI scope that holds what the channel did, as in the header ``Surfacelink-Faults``."""


class ChannelMiddleware:
    """Pure ASGI: sends the body of each ``POST /v1/transmissions/{id}`` through the channel in force.

    The channel in force is ``app.state.channel`` of the application it is mounted in; who replaces it there changes
    it for every request that starts later, and for none that is under way. Nothing of a request is kept here but what
    relative strengths of later attempts refer to.

    The answer carries the header ``Surfacelink-Faults``. An error of ours is answered here as problem+json, because
    middleware stands outside the exception handlers of the application.

    Parameters
    ----------
    app : ASGIApp
        What the harmed request is handed to.
    max_body_bytes : int
        A longer body is answered by 413 before it is buffered.
    sleep : callable
        Waits for the seconds that the channel delays a transmission (``anyio.sleep``).
    """

    def __init__(self, app: ASGIApp, *, max_body_bytes: int, sleep: Sleep = anyio.sleep) -> None:
        self.app = app
        self.max_body_bytes = max_body_bytes
        self.sleep = sleep
        self._references = References()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one connection."""
        transmission = _transmission(scope)
        channel: Channel = scope["app"].state.channel if transmission is not None else Channel()
        if transmission is None or not channel:
            await self.app(scope, receive, send)
            return
        try:
            headers = Headers(scope=scope)
            attempt = attempt_of(headers.get(ATTEMPT_HEADER))
            passed = len(headers.getlist(FAULTS_HEADER))
            body = await _read(limited(scope, receive, self.max_body_bytes))
        except SurfacelinkError as error:
            await respond(problem_of(error))(scope, receive, send)
            return
        if body is None:
            return
        # A large transmission takes seconds; the event loop has other connections to serve meanwhile.
        delivery = await to_thread.run_sync(
            lambda: carry(
                channel, body, transmission=transmission, attempt=attempt, passed=passed, references=self._references
            ),
            abandon_on_cancel=True,
        )
        if delivery.seconds:
            # Whether the client is still there or not: what is on the air arrives, although its sender hung up.
            await self.sleep(delivery.seconds)
        harmed, faults = delivery.body, faults_header(delivery)
        scope = {**scope, "headers": _with_length(headers, len(harmed)), SENT: body, FAULTS: faults}
        await self.app(scope, _replay(harmed, receive), _announce(faults, send))


def _transmission(scope: Scope) -> str | None:
    if scope["type"] != "http" or scope["method"] != "POST":
        return None
    return transmission_of(scope["path"].removeprefix(scope.get("root_path", "")))


async def _read(receive: Receive) -> bytes | None:
    """The whole body, or None where the client went away."""
    chunks: list[bytes] = []
    while True:
        message = await receive()
        if message["type"] != "http.request":
            return None
        chunks.append(message.get("body", b""))
        if not message.get("more_body", False):
            return b"".join(chunks)


def _with_length(headers: Headers, length: int) -> list[tuple[bytes, bytes]]:
    kept = [pair for pair in headers.raw if pair[0].lower() not in (b"content-length", b"transfer-encoding")]
    return [*kept, (b"content-length", str(length).encode())]


def _replay(body: bytes, receive: Receive) -> Receive:
    """A receive that hands out `body` once, then whatever comes from the server (a disconnect)."""
    unread = [body]

    async def replayed() -> Message:
        if unread:
            return {"type": "http.request", "body": unread.pop(), "more_body": False}
        return await receive()

    return replayed


def _announce(faults: str, send: Send) -> Send:
    async def announced(message: Message) -> None:
        if message["type"] == "http.response.start":
            message = dict(message, headers=list(message.get("headers", [])))
            headers = MutableHeaders(raw=message["headers"])
            headers[FAULTS_HEADER] = with_faults(faults, headers.get(FAULTS_HEADER))
        await send(message)

    return announced
