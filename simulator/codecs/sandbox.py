"""Calls that may crash, hang or eat the memory, in child processes: the caller only ever sees a failure counted.

Decoders written for intact streams read beyond their buffers when a stream is damaged. A child that dies is replaced,
one that takes too long is killed.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from time import monotonic
from typing import Any, Literal, Self, TypeAlias, TypeVar

from common.errors import ParameterError
from simulator.runner import WorkerError

SECONDS = 10.0
"""Default for the longest call: a thousand times what an intact stream takes."""

MEMORY = 1 << 30
"""Default for the memory a call may take beyond what the child holds: a thousand times an ordinary grid."""

STARTUP = 120.0
"""Seconds a child may take to start on a busy machine."""

Kind: TypeAlias = Literal["crash", "timeout", "memory", "error"]

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Failure:
    """A call that gave nothing: `crash` (ended by a signal), `timeout`, `memory` or `error` (it raised)."""

    kind: Kind
    detail: str


@dataclass(slots=True)
class _Child:
    process: BaseProcess
    pipe: Connection
    call: int = -1
    deadline: float = 0.0


class Sandbox:
    """Children that run calls; use it as a context manager.

    Parameters
    ----------
    workers : int
        Children at work at once, 1 or more.
    seconds : float
        Longest time a call may take.
    memory : int
        Bytes a call may take beyond what the child holds when it starts (where the system can limit it).

    Raises
    ------
    ParameterError
        If a parameter is not positive.
    WorkerError
        If a child does not start, from `run` and `map`.
    """

    def __init__(self, *, workers: int = 1, seconds: float = SECONDS, memory: int = MEMORY) -> None:
        if workers < 1 or not seconds > 0 or memory < 1:
            raise ParameterError(f"workers, seconds and memory must be positive, got {workers}, {seconds}, {memory}")
        self.workers, self.seconds, self.memory = workers, seconds, memory
        self._children: list[_Child] = []
        method = "forkserver" if "forkserver" in multiprocessing.get_all_start_methods() else "spawn"
        self._context: Any = multiprocessing.get_context(method)

    def __enter__(self) -> Self:
        if self._context.get_start_method() == "forkserver":
            self._context.set_forkserver_preload(["simulator.codecs"])
        return self

    def __exit__(self, *exc: object) -> None:
        while self._children:
            self._end(self._children[-1])

    def run(self, function: Callable[..., Result], *arguments: Any) -> Result | Failure:
        """What `function(*arguments)` returns, or a Failure; `function` is importable, the arguments can be pickled."""
        return next(iter(self.map(function, [arguments])))

    def map(self, function: Callable[..., Result], calls: Sequence[tuple[Any, ...]]) -> Iterator[Result | Failure]:
        """For each of the calls, in their order, what `function(*call)` returns, or a Failure."""
        results: dict[int, Any] = {}
        pending = iter(range(len(calls)))
        try:
            for wanted in range(len(calls)):
                while wanted not in results:
                    self._hire(min(self.workers, len(calls)))
                    for child in list(self._children):
                        if child.call < 0 and (call := next(pending, None)) is not None:
                            self._give(child, call, function, calls[call], results)
                    self._collect(results)
                yield results.pop(wanted)
        finally:  # given up halfway, what still runs must not answer a later call
            for child in [child for child in self._children if child.call >= 0]:
                self._end(child)

    def _hire(self, count: int) -> None:
        while len(self._children) < count:
            ours, theirs = self._context.Pipe()
            process = self._context.Process(target=_serve, args=(theirs, self.memory), daemon=True)
            process.start()
            theirs.close()
            self._children.append(_Child(process, ours))
            with contextlib.suppress(EOFError, OSError):
                if ours.poll(STARTUP) and ours.recv() == "ready":
                    continue
            raise WorkerError(
                "a child process did not start; does a script that starts some do its work below "
                "if __name__ == '__main__':?"
            )

    def _give(
        self,
        child: _Child,
        call: int,
        function: Callable[..., Any],
        arguments: tuple[Any, ...],
        results: dict[int, Any],
    ) -> None:
        try:
            child.pipe.send((function, arguments))
        except OSError:  # it died while it had nothing to do
            results[call] = Failure("crash", "the child was gone")
            self._end(child)
            return
        child.call, child.deadline = call, monotonic() + self.seconds

    def _collect(self, results: dict[int, Any]) -> None:
        """Wait until a call ends or its time is up."""
        busy = {child.pipe: child for child in self._children if child.call >= 0}
        if not busy:
            return
        left = min(child.deadline for child in busy.values()) - monotonic()
        ended = wait(list(busy), max(0.0, left))
        for pipe, child in busy.items():
            if pipe in ended:
                call, child.call = child.call, -1
                try:
                    results[call] = pipe.recv()
                except (EOFError, OSError, pickle.UnpicklingError):
                    self._end(child)
                    results[call] = Failure("crash", _death(child.process.exitcode))
            elif monotonic() >= child.deadline:
                results[child.call] = Failure("timeout", f"took more than {self.seconds:g} s")
                self._end(child)

    def _end(self, child: _Child) -> None:
        self._children.remove(child)
        child.pipe.close()
        if child.call >= 0 or not child.process.is_alive():
            child.process.kill()
        child.process.join(5)
        if child.process.is_alive():
            child.process.kill()
            child.process.join()


def _death(exitcode: int | None) -> str:
    if exitcode is not None and exitcode < 0:
        return signal.Signals(-exitcode).name
    return f"the child ended with status {exitcode}"


def _serve(pipe: Connection, memory: int) -> None:
    """Run calls until the other end of the pipe is closed."""
    _limit(memory)
    with contextlib.suppress(EOFError, OSError, KeyboardInterrupt):
        pipe.send("ready")
        while True:
            function, arguments = pipe.recv()
            pipe.send(_called(function, arguments))


def _called(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    try:
        return function(*arguments)
    except MemoryError as error:
        return Failure("memory", str(error))
    except Exception as error:  # noqa: BLE001 - whatever a call raises is its failure, and reported as such
        return Failure("error", f"{type(error).__name__}: {error}")


def _limit(memory: int) -> None:
    """No core files, no more than `memory` bytes, and nothing said on the terminal by a decoder's own messages."""
    silence = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(silence, stream)
    if sys.platform == "win32":
        return
    import resource

    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    held = 0
    with contextlib.suppress(FileNotFoundError):
        held = int(Path("/proc/self/statm").read_text("ascii").split()[0]) * resource.getpagesize()
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    limit = held + memory if hard == resource.RLIM_INFINITY else min(held + memory, hard)
    if held:  # without what is held, the limit might be below it
        resource.setrlimit(resource.RLIMIT_AS, (limit, hard))
