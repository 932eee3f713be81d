"""A receiver in this process: the whole application behind httpx, without a socket."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import Any, TypeAlias

import httpx
import numpy as np
import pytest
from fastapi import FastAPI

from common.surface import FeatureSet, Region
from common.wire import MEDIA_TYPE, WireOptions, encode
from receiver.app import create_app
from receiver.settings import Settings

HEADERS = {"Content-Type": MEDIA_TYPE}


class Client(httpx.AsyncClient):
    """httpx, with the application it speaks to."""

    app: FastAPI

    async def transmit(self, name: str, body: bytes, **options: Any) -> httpx.Response:
        """POST packets."""
        return await self.post(f"/v1/transmissions/{name}", content=body, headers=HEADERS, **options)


Running: TypeAlias = Callable[..., AbstractAsyncContextManager[Client]]


@pytest.fixture
def running(tmp_path: Path) -> Running:
    """Starts a receiver on this test's data folder; options are those of the settings, and `train`."""

    @asynccontextmanager
    async def start(train: Any = None, **options: Any) -> AsyncIterator[Client]:
        app = create_app(
            Settings(**({"data": tmp_path / "data"} | options)), **({} if train is None else {"train": train})
        )
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with app.router.lifespan_context(app), Client(transport=transport, base_url="http://receiver") as client:
            client.app = app
            yield client

    return start


@pytest.fixture
async def client(running: Running) -> AsyncIterator[Client]:
    async with running() as client:
        yield client


@pytest.fixture(scope="session")
def features() -> FeatureSet:
    """60 points of a smooth surface, z = sin 2x + sin 2y on [-2, 2] x [-1, 1]."""
    rng = np.random.default_rng(7)
    xy = rng.uniform((-2, -1), (2, 1), (60, 2))
    return FeatureSet(np.column_stack([xy, np.sin(2 * xy).sum(axis=1)]), Region(-2, 2, -1, 1), gap=1.0)


def packets_of(features: FeatureSet, name: str) -> list[bytes]:
    """Several packets that carry the features."""
    return encode(features, transmission=name, options=WireOptions(datagram=96))
