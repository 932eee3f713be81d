"""Surfaces: what a row said when it was read, and what arrives meanwhile."""

from __future__ import annotations

import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import anyio
import pytest

from common.errors import StoreError
from common.network.model import SurfaceModel
from common.surface import FeatureSet
from receiver import schemas
from receiver.metrics import Metrics
from receiver.store import State, Store
from receiver.surfaces import StillTraining, Surfaces, Train
from tests.receiver.conftest import packets_of

pytestmark = [
    pytest.mark.anyio,
    pytest.mark.filterwarnings("ignore::common.network.estimator.NetworkWarning"),
]


@pytest.fixture
def opened(tmp_path: Path) -> Callable[..., Any]:
    @asynccontextmanager
    async def start(train: Train = SurfaceModel.train) -> AsyncIterator[Surfaces]:
        with Store(tmp_path) as store:
            async with Surfaces.open(store, trainings=1, cached=1, metrics=Metrics(), train=train) as here:
                yield here

    return start


async def test_a_model_is_the_one_that_its_row_names_or_none(opened: Callable[..., Any], features: FeatureSet) -> None:
    packets = packets_of(features, "hills")
    async with opened() as here:
        await here.receive("hills", b"".join(packets[: len(packets) // 2]), {}, sent=None)
        old, few = await here.model("hills", 60)
        assert old.summary["centers"] == len(few.network.centers_) < len(features)
        await here.receive("hills", b"".join(packets), {}, sent=None)
        new, all_of_them = await here.model("hills", 60)
        assert len(all_of_them.network.centers_) == len(features)
        with pytest.raises(StillTraining):  # its cache holds one model: the new one
            await here._load(old)
        row, model = await here.model("hills")
        assert row.digest == new.digest
        assert model is all_of_them


async def test_a_model_that_cannot_be_read_leaves_the_training_of_what_arrives_meanwhile_alone(
    opened: Callable[..., Any], features: FeatureSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    packets = packets_of(features, "hills")
    async with opened() as here:
        await here.receive("hills", b"".join(packets[: len(packets) // 2]), {}, sent=None)
        row = await here.settle("hills", 60)
    read, arrived = threading.Event(), threading.Event()

    def unreadable(store: Store, n: int, digest: str) -> State:
        read.set()
        arrived.wait(10)
        raise StoreError("a stored model cannot be read")

    trainings: list[int] = []

    def train(features: FeatureSet, *args: Any, **options: Any) -> SurfaceModel:
        trainings.append(len(features))
        return SurfaceModel.train(features, *args, **options)

    async def ask() -> None:
        with pytest.raises(StillTraining):
            await here.model("hills")

    monkeypatch.setattr(Store, "model", unreadable)
    async with opened(train=train) as here:
        async with anyio.create_task_group() as group:
            group.start_soon(ask)
            while not read.is_set():
                await anyio.sleep(0.005)
            await here.receive("hills", b"".join(packets), {}, sent=None)
            arrived.set()
        latest = await here.settle("hills", 60)
        assert schemas.state_of(latest) == "ready"
        assert latest.trained == latest.revision == row.revision + 1
        assert trainings == [len(features)]
        _, model = await here.model("hills")
        assert len(model.network.centers_) == len(features)
