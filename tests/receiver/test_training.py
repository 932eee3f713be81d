from __future__ import annotations

import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest

from common.errors import StoreError, SurfacelinkError, TrainingError
from common.network.model import SurfaceModel
from receiver.training import Trainings

pytestmark = pytest.mark.anyio

Report = Callable[[str, float], None]


class Bench:
    """Trainings, what they reported, and what came of them."""

    def __init__(self) -> None:
        self.changed: list[str] = []
        self.ended: dict[str, Any] = {}
        self.clock = 0.0
        self.slept: list[float] = []

    async def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        await anyio.sleep(0)

    @asynccontextmanager
    async def trainings(self, limit: int = 4) -> AsyncIterator[Trainings]:
        with anyio.fail_after(20):
            async with anyio.create_task_group() as group:
                trainings = Trainings(group, limit, self.changed.append, lambda: self.clock, self.sleep)
                yield trainings
                while len(trainings):
                    await anyio.sleep(0.005)
                group.cancel_scope.cancel()

    def start(self, trainings: Trainings, work: Callable[[Report], Any], label: str, surface: str = "hills") -> None:
        async def finish(outcome: SurfaceModel | SurfacelinkError) -> None:
            self.ended[label] = outcome

        trainings.start(surface, work, finish)


async def until(condition: Callable[[], bool]) -> None:
    with anyio.fail_after(20):
        while not condition():
            await anyio.sleep(0.002)


def held(go: threading.Event, begun: threading.Event | None = None) -> Callable[[Report], Any]:
    def work(report: Report) -> Any:
        if begun is not None:
            begun.set()
        while not go.wait(0.002):
            report("waiting", 0.5)
        return "model"

    return work


async def test_a_job_ends_with_its_model_and_is_forgotten() -> None:
    bench = Bench()
    async with bench.trainings() as trainings:
        bench.start(trainings, lambda _: "model", "a")
        job = trainings.get("hills")
        assert job is not None
        assert (job.stage, job.fraction) == ("queued", 0.0)
        await until(lambda: not len(trainings))
    assert bench.ended == {"a": "model"}
    assert bench.changed[-1] == "hills"


async def test_the_newest_supersedes_and_the_older_is_never_finished() -> None:
    bench, go, begun = Bench(), threading.Event(), threading.Event()
    async with bench.trainings() as trainings:
        bench.start(trainings, held(go, begun), "old")
        await until(begun.is_set)
        bench.start(trainings, lambda _: "newer", "new")
        await until(lambda: "new" in bench.ended)
    assert bench.ended == {"new": "newer"}
    assert not go.is_set()


async def test_a_superseded_job_that_no_longer_reports_is_not_finished_either() -> None:
    bench, go = Bench(), threading.Event()
    async with bench.trainings() as trainings:
        bench.start(trainings, lambda _: go.wait(10) and "stale", "old")
        bench.start(trainings, lambda _: "newer", "new")
        await until(lambda: "new" in bench.ended)
        go.set()
    assert bench.ended == {"new": "newer"}


async def test_other_surfaces_are_left_alone() -> None:
    bench, go = Bench(), threading.Event()
    async with bench.trainings() as trainings:
        bench.start(trainings, held(go), "hills")
        bench.start(trainings, lambda _: "model", "dales", "dales")
        await until(lambda: "dales" in bench.ended)
        assert trainings.get("hills") is not None
        go.set()
    assert set(bench.ended) == {"hills", "dales"}


async def test_no_more_than_the_limit_run_at_the_same_time() -> None:
    bench, go, begun = Bench(), threading.Event(), threading.Event()
    async with bench.trainings(limit=1) as trainings:
        bench.start(trainings, held(go), "first", "first")
        await until(lambda: trainings.get("first").stage == "waiting")  # type: ignore[union-attr]
        bench.start(trainings, held(go, begun), "second", "second")
        await anyio.sleep(0.05)
        assert not begun.is_set()
        assert trainings.get("second").stage == "queued"  # type: ignore[union-attr]
        go.set()
    assert set(bench.ended) == {"first", "second"}


async def test_progress_is_told_at_each_stage_and_no_oftener_than_the_pause() -> None:
    bench = Bench()
    seen: list[tuple[str, float]] = []

    def work(report: Report) -> Any:
        for stage in ("selection", "solve"):
            for step in range(100):
                report(stage, step / 50)
        bench.clock += 1
        report("solve", 1.0)
        return "model"

    async with bench.trainings() as trainings:
        bench.changed = []
        trainings._changed = lambda name: seen.append(
            (trainings.get(name).stage, trainings.get(name).fraction) if trainings.get(name) else ("ended", 1.0)  # type: ignore[union-attr]
        )
        bench.start(trainings, work, "a")
    assert seen == [("started", 0.0), ("selection", 0.0), ("solve", 0.0), ("solve", 1.0), ("ended", 1.0)]


async def test_errors_of_ours_are_told_and_others_hidden() -> None:
    def ours(_: Report) -> Any:
        raise TrainingError("too few points")

    def others(_: Report) -> Any:
        raise KeyError("secret")

    bench = Bench()
    async with bench.trainings() as trainings:
        bench.start(trainings, ours, "ours", "ours")
        bench.start(trainings, others, "others", "others")
    assert str(bench.ended["ours"]) == "too few points"
    assert isinstance(bench.ended["others"], TrainingError)
    assert "secret" not in str(bench.ended["others"])


async def test_an_outcome_that_cannot_be_stored_is_stored_when_that_is_possible_again() -> None:
    bench = Bench()
    told: list[tuple[Any, str]] = []

    async def finish(outcome: Any) -> None:
        job = trainings.get("hills")
        assert job is not None
        told.append((outcome, job.stage))
        if len(told) < 10:
            raise StoreError("database or disk is full")

    async with bench.trainings() as trainings:
        trainings.start("hills", lambda _: "model", finish)  # type: ignore[arg-type, return-value]
    assert told == [("model", "started")] + 9 * [("model", "storing")]
    assert bench.slept == [0.5, 1, 2, 4, 8, 16, 32, 60, 60]
    assert bench.changed[-1] == "hills"


async def test_an_outcome_that_waits_to_be_stored_gives_way_to_a_later_training() -> None:
    bench = Bench()

    async def never(outcome: SurfaceModel | SurfacelinkError) -> None:
        raise StoreError("database or disk is full")

    async with bench.trainings() as trainings:
        trainings.start("hills", lambda _: "old", never)  # type: ignore[arg-type, return-value]
        await until(lambda: len(bench.slept) > 1)
        bench.start(trainings, lambda _: "newer", "new")
    assert bench.ended == {"new": "newer"}


async def test_a_defect_in_storing_is_an_outcome_too() -> None:
    bench = Bench()
    told: list[Any] = []

    async def finish(outcome: Any) -> None:
        told.append(outcome)
        if not isinstance(outcome, SurfacelinkError):
            raise KeyError("secret")

    async with bench.trainings() as trainings:
        trainings.start("hills", lambda _: "model", finish)  # type: ignore[arg-type, return-value]
    assert told[0] == "model"
    assert isinstance(told[1], TrainingError)
    assert "secret" not in str(told[1])


async def test_reports_from_threads_of_the_training_s_own_are_taken() -> None:
    def work(report: Report) -> Any:
        thread = threading.Thread(target=report, args=("patches", 0.5))
        thread.start()
        thread.join()
        return "model"

    bench = Bench()
    async with bench.trainings() as trainings:
        bench.start(trainings, work, "a")
    assert bench.ended == {"a": "model"}


async def test_a_stop_calls_all_off() -> None:
    bench, go = Bench(), threading.Event()
    with anyio.fail_after(20):
        async with anyio.create_task_group() as group:
            trainings = Trainings(group, 1, bench.changed.append)
            bench.start(trainings, held(go), "running", "running")
            bench.start(trainings, held(go), "queued", "queued")
            await anyio.sleep(0.02)
            trainings.cancel_all()
            group.cancel_scope.cancel()
    assert bench.ended == {}
