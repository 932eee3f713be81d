"""Runs trials in worker processes and keeps every finished one in an append-only journal.

A campaign may be stopped or killed at any instant: what the journal holds is not run again, a line torn by the kill is
run again, and the table that comes out is the same to the byte, whatever the number of workers.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Generic, Protocol, Self, TypeAlias, TypeVar

from threadpoolctl import threadpool_limits

from common.errors import FileFormatError, ParameterError, SurfacelinkError

Cell: TypeAlias = str | int | float | bool | None
Row: TypeAlias = Mapping[str, Cell]
"""A row of the table: column -> value; every float is finite."""

_HEADER = {"journal": "surfacelink campaign", "version": 1}

AHEAD = 4
"""Trials handed to the pool per worker: enough that none waits, few enough that a stop comes soon."""


@dataclass(frozen=True)
class Result:
    """What a trial found: its rows, and the seconds each of them took, None where that was not measured.

    Seconds are kept apart from the rows: they differ from run to run, the rows do not.
    """

    rows: tuple[Row, ...]
    seconds: tuple[float | None, ...]


class WorkerError(SurfacelinkError):
    """A worker process died, or did not start."""

    title = "A worker failed"


class Keyed(Protocol):
    """Anything with a key that determines the outcome."""

    @property
    def key(self) -> str: ...


Task = TypeVar("Task", bound=Keyed)

Progress: TypeAlias = Callable[[int, int], None]
"""Told (finished, all) at the start and after each task; what it raises stops the run."""


def silent(done: int, total: int) -> None:
    """A Progress that shows nothing."""


class Journal:
    """Finished trials, one JSON object a line, in the order in which they finished.

    Use it as a context manager. A line that a kill has torn is no JSON object; its trial counts as unfinished.

    Raises
    ------
    FileFormatError
        If the file is there and is not a journal, or cannot be read or written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.finished: dict[str, Result] = {}
        try:
            data = path.read_bytes() if path.exists() else b""
            whole, newline, _ = data.rpartition(b"\n")
            lines = whole.split(b"\n") if newline else []
            if lines:
                self._read(lines)
            elif not json.dumps(_HEADER).encode().startswith(data):
                raise FileFormatError(f"{path} is not a journal of a campaign; move it away or choose another folder")
            path.parent.mkdir(parents=True, exist_ok=True)
            # Unbuffered: a finished trial is with the operating system before the next one starts.
            self._file = path.open("ab" if lines else "wb", buffering=0)
        except OSError as error:
            raise FileFormatError(f"cannot use {path} as a journal: {error.strerror or error}") from error
        if not lines:
            self._write(_HEADER)
        elif not data.endswith(b"\n"):
            self._file.write(b"\n")

    def _read(self, lines: Sequence[bytes]) -> None:
        if _json_object(lines[0]) != _HEADER:
            raise FileFormatError(f"{self.path} is not a journal of a campaign; move it away or choose another folder")
        for record in map(_json_object, lines[1:]):
            if record is not None:
                self.finished[record["key"]] = Result(tuple(record["rows"]), tuple(record["seconds"]))

    def _write(self, record: Mapping[str, object]) -> None:
        line = json.dumps(record, allow_nan=False).encode() + b"\n"
        try:
            while line:  # a disk that fills up takes a part first
                line = line[self._file.write(line) :]
        except OSError as error:
            raise FileFormatError(f"cannot write {self.path}: {error.strerror}; run again to go on") from error

    def add(self, key: str, result: Result) -> None:
        """Keep a finished trial; raises FileFormatError where the disk is full."""
        self._write({"key": key, "rows": list(result.rows), "seconds": list(result.seconds)})
        self.finished[key] = result

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self._file.close()


def _json_object(line: bytes) -> dict[str, Any] | None:
    try:
        record = json.loads(line)
    except ValueError:
        return None
    return record if isinstance(record, dict) else None


@dataclass(frozen=True)
class Run(Generic[Task]):
    """Tasks, what does them, and in how many processes.

    Parameters
    ----------
    tasks : sequence of picklable tasks with a `key`.
    work : picklable function of a task. Its outcome must follow from the task alone.
    workers : number of processes; 1 runs in this process.
    stamp : what else determines the outcome, such as a digest of the code: a result under another stamp is not reused.
    """

    tasks: Sequence[Task]
    work: Callable[[Task], Result]
    workers: int = 1
    stamp: str = ""

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise ParameterError(f"workers must be 1 or more, got {self.workers}")

    def collect(self, journal: Journal | None = None, *, progress: Progress = silent) -> list[Result]:
        """Do what the journal does not hold; the results of all tasks, in the order of the tasks.

        Parameters
        ----------
        journal : Journal, optional
            Gets every result as it comes.
        progress : Progress

        Raises
        ------
        ParameterError
            If two tasks have the same key.
        WorkerError
            If a worker process died; what had finished is in the journal.
        """
        keys = [self.stamp + task.key for task in self.tasks]
        repeated = len(keys) - len(set(keys))
        if repeated:
            raise ParameterError(
                f"{repeated} of {len(keys)} trials repeat another: something in the campaign stands twice"
            )
        finished = {} if journal is None else {key: journal.finished[key] for key in keys if key in journal.finished}
        todo = {key: task for key, task in zip(keys, self.tasks, strict=True) if key not in finished}
        total = len(finished) + len(todo)
        progress(len(finished), total)
        for key, result in self._serial(todo) if self.workers == 1 else self._parallel(todo):
            if journal is not None:
                journal.add(key, result)
            finished[key] = result
            progress(len(finished), total)
        return [finished[key] for key in keys]

    def _serial(self, todo: Mapping[str, Task]) -> Iterator[tuple[str, Result]]:
        for key, task in todo.items():
            yield key, _alone(self.work, task)

    def _parallel(self, todo: Mapping[str, Task]) -> Iterator[tuple[str, Result]]:
        pool = ProcessPoolExecutor(self.workers, multiprocessing.get_context("spawn"), initializer=_start_worker)
        waiting: dict[Future[Result], str] = {}
        queue = iter(todo.items())
        try:
            while True:
                for key, task in islice(queue, AHEAD * self.workers - len(waiting)):
                    waiting[pool.submit(_alone, self.work, task)] = key
                if not waiting:
                    return
                for future in wait(waiting, return_when=FIRST_COMPLETED).done:
                    result = future.result()
                    yield waiting.pop(future), result
        except BrokenProcessPool as error:
            raise WorkerError("a worker process died (out of memory, or killed); run again to go on") from error
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _alone(work: Callable[[Task], Result], task: Task) -> Result:
    """Do one task with one BLAS thread: the order of a sum depends on their number, and workers use the other cores."""
    with threadpool_limits(1):
        return work(task)


def _start_worker() -> None:
    """Ctrl-C is the parent's affair; no worker outlives its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_leave_with, args=(parent,), daemon=True).start()


def _leave_with(parent: multiprocessing.process.BaseProcess) -> None:
    with suppress(OSError):
        parent.join()
    os._exit(1)
