"""Trainings: off the event loop, with progress, to be called off; the latest of a surface goes before."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from typing import TypeAlias

import anyio
from anyio.abc import TaskGroup
from anyio.from_thread import run_sync as run_in_loop
from anyio.lowlevel import current_token
from anyio.to_thread import run_sync as run_in_thread

from common.errors import StoreError, SurfacelinkError, TrainingCancelled, TrainingError
from common.network.model import SurfaceModel

PAUSE = 0.1
"""Least seconds between two reports of progress: what an eye can follow."""

FIRST_PAUSE, LONGEST_PAUSE = 0.5, 60.0
"""Seconds before an outcome that could not be stored is stored again: doubled each time, up to what one waits who made
room on the disk."""

STORING = "storing"
"""Stage of a job whose outcome could not be stored yet."""

logger = logging.getLogger(__name__)

Work: TypeAlias = Callable[[Callable[[str, float], None]], SurfaceModel]
"""Trains; is given the callback to report progress to, whose exception must end the training."""

Finish: TypeAlias = Callable[[SurfaceModel | SurfacelinkError], Awaitable[None]]
"""Is given what came of it; called only while no later training of the surface was started, and again after a
StoreError."""

Sleep: TypeAlias = Callable[[float], Awaitable[None]]


@dataclass(eq=False)
class Job:
    """One training.

    Attributes
    ----------
    stage, fraction : str, float
        How far it is; "queued" until it starts, `STORING` where its outcome could not be stored yet.
    """

    surface: str
    work: Work
    finish: Finish
    stage: str = "queued"
    fraction: float = 0.0
    cancelled: threading.Event = field(default_factory=threading.Event)


class Trainings:
    """Runs jobs in threads, at most `limit` at the same time.

    Parameters
    ----------
    group : TaskGroup
        Where the jobs' tasks live; cancelling it calls them off.
    limit : int
    changed : callable
        Called on the event loop with a surface's name whenever its job has moved.
    clock : callable
        Seconds that grow; spaces the reports of progress.
    sleep : callable
        Waits for seconds; spaces the tries to store an outcome.
    """

    def __init__(
        self,
        group: TaskGroup,
        limit: int,
        changed: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
        sleep: Sleep = anyio.sleep,
    ) -> None:
        self._group = group
        self._limiter = anyio.CapacityLimiter(limit)
        self._changed = changed
        self._clock = clock
        self._sleep = sleep
        self._loop = current_token()
        self._jobs: dict[str, Job] = {}

    def __len__(self) -> int:
        return len(self._jobs)

    def get(self, surface: str) -> Job | None:
        """The job of `surface`, None where there is none."""
        return self._jobs.get(surface)

    def start(self, surface: str, work: Work, finish: Finish) -> None:
        """Train `surface`; a job of the same surface is called off."""
        self.cancel(surface)
        job = Job(surface, work, finish)
        self._jobs[surface] = job
        self._group.start_soon(self._run, job)

    def cancel(self, surface: str) -> None:
        """Call the job of `surface` off, where there is one; it ends at its next report of progress."""
        job = self._jobs.pop(surface, None)
        if job is not None:
            job.cancelled.set()

    def cancel_all(self) -> None:
        """Call all jobs off."""
        for surface in list(self._jobs):
            self.cancel(surface)

    async def _run(self, job: Job) -> None:
        outcome: SurfaceModel | SurfacelinkError
        try:
            outcome = await run_in_thread(self._work, job, limiter=self._limiter)
        except TrainingCancelled:
            return
        except SurfacelinkError as error:
            outcome = error
        except Exception:  # a defect of ours must end this job, not the receiver
            logger.exception("training of %s failed", job.surface)
            outcome = _unforeseen()
        pause = FIRST_PAUSE
        while self._jobs.get(job.surface) is job:
            try:
                await job.finish(outcome)
            except Exception as error:
                # A disk that is full now need not be so later; anything else is a defect of ours, and the outcome.
                ours = not isinstance(error, StoreError)
                logger.warning("the outcome of training %s could not be stored: %s", job.surface, error, exc_info=ours)
                outcome = _unforeseen() if ours else outcome
                job.stage, job.fraction = STORING, 0.0
                self._changed(job.surface)
                await self._sleep(pause)
                pause = min(2 * pause, LONGEST_PAUSE)
            else:
                # A later training may have come while this one was stored.
                if self._jobs.get(job.surface) is job:
                    del self._jobs[job.surface]
                self._changed(job.surface)
                return

    def _work(self, job: Job) -> SurfaceModel:
        reported = -math.inf

        def report(stage: str, fraction: float) -> None:
            nonlocal reported
            if job.cancelled.is_set():
                raise TrainingCancelled("a later training of the surface took over")
            moved = stage != job.stage
            job.stage, job.fraction = stage, min(1.0, max(0.0, fraction))
            now = self._clock()
            if moved or now - reported >= PAUSE:
                reported = now
                run_in_loop(self._changed, job.surface, token=self._loop)

        report("started", 0.0)
        return job.work(report)


def _unforeseen() -> TrainingError:
    return TrainingError("the training failed for a reason that is the receiver's; its log says more")
