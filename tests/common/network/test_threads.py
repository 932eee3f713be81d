from __future__ import annotations

from threading import Barrier
from time import sleep

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from common.network.threads import parallel, single_threaded_blas


def blas_threads() -> set[int]:
    return {entry["num_threads"] for entry in threadpool_info() if entry["user_api"] == "blas"}


def test_blas_is_held_to_one_thread_until_the_last_use_ends() -> None:
    np.ones((2, 2)) @ np.ones((2, 2))
    with threadpool_limits(limits=2, user_api="blas"):
        before = blas_threads()
        first, second = single_threaded_blas(), single_threaded_blas()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert blas_threads() == {1}
        second.__exit__(None, None, None)
        assert blas_threads() == before


def test_results_come_in_order_from_several_threads() -> None:
    meeting = Barrier(2, timeout=20)

    def work(item: int) -> int:
        meeting.wait()
        return item * item

    fractions: list[float] = []
    assert parallel(work, range(6), workers=2, tick=fractions.append) == [0, 1, 4, 9, 16, 25]
    assert fractions == [(i + 1) / 6 for i in range(6)]


@pytest.mark.parametrize("workers", [1, 2])
def test_what_the_work_or_the_caller_raises_ends_it(workers: int) -> None:
    before = blas_threads()
    done: list[int] = []

    def work(item: int) -> None:
        done.append(item)
        if item == 3:
            raise ZeroDivisionError
        sleep(1e-3)

    with pytest.raises(ZeroDivisionError):
        parallel(work, range(1000), workers=workers)
    assert len(done) < 1000

    def stop(_: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        parallel(done.append, range(10), workers=workers, tick=stop)
    assert blas_threads() == before
