"""How a campaign's features reach the other end: directly, through the receiver in this process, or over real HTTP.

All three give the same numbers. The direct way is the fastest; the other two go through the product's own client,
receiver, store and training, and so show that what is simulated is the product. What the receiver's own network took is
not known here.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import AbstractAsyncContextManager, contextmanager
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import anyio

from common.channel import Channel
from common.errors import TrainingError
from common.surface import FeatureSet
from common.wire import WireOptions, encode
from simulator.link import Link
from simulator.services import running
from simulator.trial import Arrived, Transport, direct


class Way(StrEnum):
    """Name of a transport on the command line."""

    DIRECT = "direct"
    ASGI = "asgi"
    HTTP = "http"


@dataclass(frozen=True)
class OverLink:
    """Through a receiver: the one at `url`, or one of its own in this process. Workers can be sent it."""

    url: str | None = None

    def __call__(
        self,
        features: FeatureSet,
        *,
        transmission: str,
        draws: str,
        channel: Channel,
        options: WireOptions,
        rounds: int,
        shape: tuple[int, int],
    ) -> Arrived:
        """Send, and have the receiver's default network where it can be trained on what arrived."""
        packets = encode(features, transmission=transmission, options=options)

        async def send() -> Arrived:
            with tempfile.TemporaryDirectory() as folder:
                async with self._link(Path(folder)) as link, link.client(channel, draws) as client:
                    sent = await client.send(packets, transmission=transmission, rounds=rounds)
                    counts = sent.receipt.packets
                    arrived = Arrived(None, sent.packets, sent.bytes, counts.received, counts.damaged)
                    if not sent.receipt.points:
                        return arrived
                    points = await client.features(transmission)
                    came = FeatureSet(points, features.region, features.gap, features.kind, features.units)
                    arrived = replace(arrived, features=came)
                    try:
                        await client.wait_ready(transmission)
                    except TrainingError:
                        return arrived
                    return replace(arrived, grid=await client.grid(transmission, shape))

        return anyio.run(send)

    def _link(self, folder: Path) -> AbstractAsyncContextManager[Link]:
        return Link.in_process(folder) if self.url is None else Link.over_http(self.url)


@contextmanager
def opened(way: Way) -> Iterator[Transport]:
    """The transport of that name; for HTTP, a receiver runs as a process of its own as long as it is needed."""
    if way is Way.HTTP:
        with tempfile.TemporaryDirectory() as folder, running(Path(folder)) as services:
            yield OverLink(services.receiver)
    else:
        yield OverLink() if way is Way.ASGI else direct
