"""Own threads for many small pieces of work, BLAS held to one thread inside them.

Batched small products and factorisations under a multi-threaded BLAS wait for its threads far longer than they
compute. `threadpoolctl` sets the limit of the whole process, so overlapping uses are counted and the last one restores
what the first one found.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Lock
from typing import TypeVar

from threadpoolctl import ThreadpoolController, threadpool_limits

Item = TypeVar("Item")
Result = TypeVar("Result")

_lock = Lock()
_users = 0
_limits: threadpool_limits | None = None


def cores() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def single_threaded_blas() -> Iterator[None]:
    """BLAS on one thread for the whole process until the last of the overlapping uses ends."""
    global _users, _limits
    with _lock:
        if _users == 0:
            _limits = ThreadpoolController().limit(limits=1, user_api="blas")
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
    """``[work(item) for item in items]`` on all cores, BLAS on one thread each.

    ``tick(fraction)`` is called in the caller's thread after each result; whatever it or `work` raises cancels what has
    not begun and is raised here.
    """
    waiting = list(items)
    count = min(workers or cores(), len(waiting))
    results: list[Result] = []
    with single_threaded_blas():
        if count < 2:
            for item in waiting:
                results.append(work(item))
                if tick is not None:
                    tick(len(results) / len(waiting))
            return results
        with ThreadPoolExecutor(count, thread_name_prefix="network") as pool:
            futures = [pool.submit(work, item) for item in waiting]
            try:
                for future in futures:
                    results.append(future.result())
                    if tick is not None:
                        tick(len(results) / len(waiting))
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
    return results
