"""The channel on the sender's side: an httpx transport that harms what is sent through it."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import TypeAlias

import anyio
import httpx
from anyio import to_thread

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

Sleep: TypeAlias = Callable[[float], Awaitable[None]]


class ChannelTransport(httpx.AsyncBaseTransport):
    """Sends the body of each ``POST /v1/transmissions/{id}`` through a channel, everything else as it is.

    Parameters
    ----------
    transport : httpx.AsyncBaseTransport
        What carries the requests (``httpx.AsyncHTTPTransport()``, ``httpx.ASGITransport(app)``).
    channel : Channel
        The channel in force; may be replaced at any time, for the requests that start later.
    draws : str, optional
        What random draws follow from in the place of the transmission's id; for a transport that sends only one.
    sleep : callable
        Waits for the seconds that the channel delays a transmission (``anyio.sleep``).

    Request and answer carry the header ``Surfacelink-Faults``. Raises ParameterError for a request whose header
    ``Surfacelink-Attempt`` is no count.
    """

    def __init__(
        self,
        transport: httpx.AsyncBaseTransport,
        channel: Channel,
        *,
        draws: str | None = None,
        sleep: Sleep = anyio.sleep,
    ) -> None:
        self.transport = transport
        self.channel = channel
        self.draws = draws
        self.sleep = sleep
        self._references = References()

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        """Send one request."""
        channel = self.channel
        transmission = transmission_of(request.url.path) if request.method == "POST" else None
        if transmission is None or not channel:
            return await self.transport.handle_async_request(request)
        attempt = attempt_of(request.headers.get(ATTEMPT_HEADER))
        passed = len(request.headers.get_list(FAULTS_HEADER))
        body = await request.aread()
        delivery = await to_thread.run_sync(
            lambda: carry(
                channel,
                body,
                transmission=self.draws or transmission,
                attempt=attempt,
                passed=passed,
                references=self._references,
            ),
            abandon_on_cancel=True,
        )
        if delivery.seconds:
            await self.sleep(delivery.seconds)
        headers = [
            pair for pair in request.headers.raw if pair[0].lower() not in (b"content-length", b"transfer-encoding")
        ]
        faults = faults_header(delivery)
        headers.append((FAULTS_HEADER.encode(), faults.encode()))
        harmed = httpx.Request(
            request.method, request.url, headers=headers, content=delivery.body, extensions=request.extensions
        )
        response = await self.transport.handle_async_request(harmed)
        response.headers[FAULTS_HEADER] = with_faults(faults, response.headers.get(FAULTS_HEADER))
        return response

    async def aclose(self) -> None:
        """Close the transport inside."""
        await self.transport.aclose()
