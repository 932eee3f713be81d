"""A poor link between any client and any server: a reverse proxy with a channel in it.

Packets on their way to a receiver (``POST /v1/transmissions/{id}``) go through the channel, everything else passes as
it is, streams included. ``GET`` and ``PUT /v1/channel`` are answered here: they show and set the proxy's own channel.
"""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Iterable
from contextlib import asynccontextmanager
from typing import TypeAlias

import anyio
import httpx
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import ClientDisconnect, Request
from starlette.responses import JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from common.asgi import limited
from common.channel import Channel
from common.channel.carrying import FAULTS_HEADER
from common.errors import ChannelError, LinkError, SurfacelinkError
from common.problems import problem_of
from common.wire.limits import MAX_BODY
from receiver.middleware import FAULTS, ChannelMiddleware, Sleep
from receiver.problems import on_disconnect, respond
from sender.client import http_client, server_url

TIMEOUT = httpx.Timeout(connect=5.0, write=60.0, pool=60.0, read=None)
"""Seconds. Reading has no limit: a stream of events may be silent for as long as it likes."""

MAX_CHANNEL_BYTES = 65_536
"""Of the body of PUT /v1/channel: 32 impairments with every parameter spelled out stay far below."""

METHODS = ["DELETE", "GET", "HEAD", "OPTIONS", "PATCH", "POST", "PUT"]

HOP_BY_HOP = frozenset(
    b"connection keep-alive proxy-authenticate proxy-authorization proxy-connection te trailer transfer-encoding "
    b"upgrade".split()
)
"""Header fields that concern one connection only (RFC 9110, section 7.6.1)."""

OF_THE_SERVER = (b"date", b"server")
"""Header fields that the server which runs the proxy writes itself; twice they would contradict each other."""

Headers: TypeAlias = list[tuple[bytes, bytes]]


def create_proxy(
    upstream: str,
    channel: Channel,
    *,
    max_body_bytes: int = MAX_BODY,
    transport: httpx.AsyncBaseTransport | None = None,
    sleep: Sleep = anyio.sleep,
) -> Starlette:
    """An ASGI application that stands for the server at `upstream`, seen through `channel`.

    Parameters
    ----------
    upstream : str
        Where the server is, such as ``http://127.0.0.1:8001``.
    channel : Channel
        The channel in force at first; ``app.state.channel`` from then on.
    max_body_bytes : int
        A longer body of packets is answered by 413.
    transport : httpx.AsyncBaseTransport, optional
        What carries the requests on; by default HTTP over the network.
    sleep : callable
        Waits for the seconds that the channel delays a transmission.

    Raises
    ------
    ParameterError
        If `upstream` is not the address of an HTTP server, or the proxy of the environment cannot be used.
    """
    base = server_url(upstream, "an upstream")
    client = http_client(base, TIMEOUT, transport)

    @asynccontextmanager
    async def lifespan(_app: Starlette) -> AsyncIterator[None]:
        async with client:
            yield

    async def forward(request: Request) -> Response:
        outward = client.build_request(
            request.method,
            base.copy_with(raw_path=_target(base, request)),
            headers=_end_to_end(request.headers.raw, without=(b"host",)) + _faults(request),
            content=request.stream() if _has_body(request) else None,
        )
        try:
            answer = await client.send(outward, stream=True)
        except httpx.TransportError as error:
            raise LinkError(f"the server at {base} does not answer ({type(error).__name__})") from error
        response = StreamingResponse(_relay(answer), status_code=answer.status_code)
        response.raw_headers = _end_to_end(answer.headers.raw, without=OF_THE_SERVER)
        return response

    app = Starlette(
        routes=[
            Route("/v1/channel", _get_channel, methods=["GET"]),
            Route("/v1/channel", _put_channel, methods=["PUT"]),
            Route("/{path:path}", forward, methods=METHODS),
        ],
        middleware=[Middleware(ChannelMiddleware, max_body_bytes=max_body_bytes, sleep=sleep)],
        exception_handlers={SurfacelinkError: _on_error, ClientDisconnect: on_disconnect},
        lifespan=lifespan,
    )
    app.state.channel = channel
    return app


def _target(base: httpx.URL, request: Request) -> bytes:
    path: bytes = request.scope.get("raw_path") or request.scope["path"].encode()
    query: bytes = request.scope["query_string"]
    return base.raw_path.rstrip(b"/") + path.partition(b"?")[0] + (b"?" + query if query else b"")


def _has_body(request: Request) -> bool:
    return "content-length" in request.headers or "transfer-encoding" in request.headers


def _faults(request: Request) -> Headers:
    """Tells the receiver that a link stood before it: what arrives may be nothing at all."""
    faults: str | None = request.scope.get(FAULTS)
    return [] if faults is None else [(FAULTS_HEADER.lower().encode(), faults.encode())]


def _end_to_end(headers: Iterable[tuple[bytes, bytes]], without: tuple[bytes, ...] = ()) -> Headers:
    """The header fields that go on: not those of this connection, nor those that `Connection` names."""
    fields = [(name.lower(), value) for name, value in headers]
    named = {word.strip().lower() for name, value in fields if name == b"connection" for word in value.split(b",")}
    return [(name, value) for name, value in fields if name not in HOP_BY_HOP | named and name not in without]


async def _relay(answer: httpx.Response) -> AsyncIterator[bytes]:
    """The body of an answer as it comes, still in its content coding."""
    try:
        async for chunk in answer.aiter_raw():
            yield chunk
    finally:
        with anyio.CancelScope(shield=True):
            await answer.aclose()


def _describe(channel: Channel) -> JSONResponse:
    return JSONResponse({**channel.to_json(), "spec": str(channel)})


async def _get_channel(request: Request) -> Response:
    return _describe(request.app.state.channel)


async def _put_channel(request: Request) -> Response:
    body = await Request(request.scope, limited(request.scope, request.receive, MAX_CHANNEL_BYTES)).body()
    try:
        document = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise ChannelError('the body must be JSON, such as {"spec": "erasure:p=0.05"}') from error
    request.app.state.channel = Channel.from_json(document)
    return _describe(request.app.state.channel)


async def _on_error(_request: Request, error: Exception) -> Response:
    if not isinstance(error, SurfacelinkError):
        raise error
    return respond(problem_of(error))
