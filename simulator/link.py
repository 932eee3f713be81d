"""Sender, channel, receiver as one object: in one process without sockets, or over real HTTP; one code path."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from common.channel import Channel
from common.network.model import NetworkSettings
from common.surface import FeatureSet, FloatArray, HeightGrid
from common.wire import WireOptions, encode
from receiver.app import create_app
from receiver.settings import Settings
from sender.client import ReceiverClient, Sent
from sender.transport import ChannelTransport

IN_PROCESS_URL = "http://receiver.invalid"
"""Base URL where there is no network; the top-level domain is reserved for that (RFC 2606)."""


@dataclass(frozen=True)
class Outcome:
    """What a transmission gave.

    Attributes
    ----------
    sent : Sent
        Bytes and packets on the air, and the last receipt.
    features : ndarray, shape (n, 3)
        The feature points that arrived.
    grid : HeightGrid
        The reconstruction.
    surface : dict
        The receiver's description of the surface: counts, network.
    """

    sent: Sent
    features: FloatArray
    grid: HeightGrid
    surface: dict[str, Any]


async def _virtual(_seconds: float) -> None:
    """Let the channel's delays pass without waiting for them."""


class Link:
    """A receiver, and a channel of one's choice in front of it.

    Use `in_process` or `over_http`; both give the same numbers for the same arguments.
    """

    def __init__(self, url: str, transport: Callable[[], httpx.AsyncBaseTransport]) -> None:
        self._url = url
        self.transport = transport

    @classmethod
    @asynccontextmanager
    async def in_process(cls, folder: Path) -> AsyncIterator[Link]:
        """A link to a receiver application of its own that keeps its data in `folder`; no socket is opened."""
        app = create_app(Settings(data=folder))
        lifespan = app.router.lifespan_context(app)
        await lifespan.__aenter__()
        try:
            yield cls(IN_PROCESS_URL, lambda: httpx.ASGITransport(app))
        finally:
            # An error of the caller's is none of the application's: its task group would wrap it in a group.
            await lifespan.__aexit__(None, None, None)

    @classmethod
    @asynccontextmanager
    async def over_http(cls, url: str) -> AsyncIterator[Link]:
        """A link to the receiver that runs at `url`."""
        yield cls(url, httpx.AsyncHTTPTransport)

    def client(self, channel: Channel = Channel(), draws: str | None = None) -> ReceiverClient:
        """A client of the receiver that sends through `channel`, whose delays pass in virtual time; to be entered.

        The channel's draws follow from the id of the transmission, or from `draws`, where there is but one.
        """
        return ReceiverClient.connect(
            self._url, ChannelTransport(self.transport(), channel, draws=draws, sleep=_virtual)
        )

    async def send(
        self,
        features: FeatureSet,
        *,
        transmission: str,
        shape: tuple[int, int],
        channel: Channel = Channel(),
        options: WireOptions = WireOptions(),
        network: NetworkSettings = NetworkSettings(),
        rounds: int = 1,
    ) -> Outcome:
        """Send features through the channel, wait for the network, fetch its grid.

        Parameters
        ----------
        features : FeatureSet
        transmission : str
            Id at the receiver; one that was not used before.
        shape : (rows, columns)
            Of the height grid, over the region of the features.
        channel : Channel
            Harms the packets between sender and receiver; its delays pass in virtual time.
        options : WireOptions
            Packets: size, precision, coding, protection.
        network : NetworkSettings
            The network the receiver trains; what was not given to the settings is left to the receiver.
        rounds : int
            More than 1 sends again what the receipt calls missing.

        Raises
        ------
        TrainingError
            If nothing arrived, or too little to train on.
        SurfacelinkError
            As the receiver's problem says.
        """
        packets = encode(features, transmission=transmission, options=options)
        async with self.client(channel) as client:
            sent = await client.send(packets, transmission=transmission, rounds=rounds, network=network)
            surface = await client.wait_ready(transmission)
            return Outcome(sent, await client.features(transmission), await client.grid(transmission, shape), surface)
