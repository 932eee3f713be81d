"""Own threads for many small pieces of work, BLAS held to one thread inside them.

Batched small products and factorisations under a multi-threaded BLAS wait for its threads far longer than they
compute. `threadpoolctl` sets the limit of the whole process, so overlapping uses are counted and the last one restores
what the first one found.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, contextmanager
from functools import cache
from threading import Lock
from typing import TypeVar

import scipy.linalg  # noqa: F401 - loads SciPy's BLAS before the libraries are looked up
from threadpoolctl import ThreadpoolController, threadpool_limits

Item = TypeVar("Item")
Result = TypeVar("Result")

AHEAD = 4
"""Items a thread that are begun before their turn."""

_lock = Lock()
_users = 0
_limits: threadpool_limits | None = None


def cores() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@cache
def _controller() -> ThreadpoolController:
    """The libraries of this process, looked up once: that takes ten times as long as setting the limit."""
    return ThreadpoolController()


@contextmanager
def single_threaded_blas() -> Iterator[None]:
    """BLAS on one thread for the whole process until the last of the overlapping uses ends."""
    global _users, _limits
    with _lock:
        if _users == 0:
            _limits = _controller().limit(limits=1, user_api="blas")
        _users += 1
    try:
        yield
    finally:
        with _lock:
            _users -= 1
            if _users == 0 and _limits is not None:
                _limits.restore_original_limits()
                _limits = None


def parallel(
    work: Callable[[Item], Result],
    items: Iterable[Item],
    *,
    workers: int | None = None,
    tick: Callable[[float], None] | None = None,
) -> list[Result]:
    """``[work(item) for item in items]`` on all cores, BLAS on one thread each; see `in_order`."""
    waiting = list(items)
    results: list[Result] = []
    with closing(in_order(work, waiting, workers=workers)) as arriving:
        for result in arriving:
            results.append(result)
            if tick is not None:
                tick(len(results) / len(waiting))
    return results


def in_order(
    work: Callable[[Item], Result], items: Sequence[Item], *, workers: int | None = None
) -> Generator[Result, None, None]:
    """Results in the order of the items, only a few ahead of the one asked for.

    Whoever adds the results up gets the same sum to the last bit, however the threads were scheduled. What `work` or
    the caller raises cancels what has not begun.
    """
    count = min(workers or cores(), len(items))
    with single_threaded_blas():
        if count < 2:
            yield from map(work, items)
            return
        with ThreadPoolExecutor(count, thread_name_prefix="network") as pool:
            ahead: deque[Future[Result]] = deque()
            try:
                for item in items:
                    ahead.append(pool.submit(work, item))
                    if len(ahead) > AHEAD * count:
                        yield ahead.popleft().result()
                while ahead:
                    yield ahead.popleft().result()
            finally:
                pool.shutdown(wait=False, cancel_futures=True)
