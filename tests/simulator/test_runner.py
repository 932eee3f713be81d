"""Journal and workers: nothing finished is lost, nothing depends on the number of workers."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from common.errors import FileFormatError, ParameterError
from simulator.runner import Journal, Result, Run, WorkerError

ROOT = Path(__file__).parents[2]


@dataclass(frozen=True)
class Draw:
    """A task: the mean of some draws."""

    seed: int

    @property
    def key(self) -> str:
        return f"draw-{self.seed}"


def draw(task: Draw) -> Result:
    a = np.random.default_rng(task.seed).normal(size=(40, 40))
    return Result(({"seed": task.seed, "value": float(np.linalg.solve(a, a[0]).sum()), "note": None},), (0.0,))


def die(task: Draw) -> Result:
    os._exit(3)


class Stopped(Exception):  # noqa: N818 - a request
    pass


TASKS = [Draw(seed) for seed in range(7)]


def test_results_come_in_the_order_of_the_tasks_whatever_the_workers() -> None:
    alone = Run(TASKS, draw, 1).collect()
    assert [result.rows[0]["seed"] for result in alone] == list(range(7))
    assert Run(TASKS, draw, 2).collect() == alone


def threads(task: Draw) -> Result:
    np.ones((8, 8)) @ np.ones((8, 8))
    return Result(({"threads": max(pool["num_threads"] for pool in threadpool_info())},), (None,))


@pytest.mark.parametrize("workers", [1, 2])
def test_every_task_has_one_thread_for_its_sums(workers: int, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.setenv(name, "2")  # of the workers
    with threadpool_limits(2):
        results = Run(TASKS[:2], threads, workers).collect()
    assert [row["threads"] for result in results for row in result.rows] == [1, 1]


def test_a_journal_cut_at_any_byte_resumes_to_the_same_results(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    with Journal(path) as journal:
        whole = Run(TASKS[:3], draw).collect(journal)
    data = path.read_bytes()
    for cut in range(len(data)):
        path.write_bytes(data[:cut])
        with Journal(path) as journal:
            assert len(journal.finished) == max(0, data[:cut].count(b"\n") - 1)
            assert Run(TASKS[:3], draw).collect(journal) == whole
        with Journal(path) as journal:
            assert len(journal.finished) == 3


def test_only_what_is_not_in_the_journal_is_run(tmp_path: Path) -> None:
    done: list[int] = []

    def counted(task: Draw) -> Result:
        done.append(task.seed)
        return draw(task)

    def stop(finished: int, total: int) -> None:
        if finished == 4:
            raise Stopped

    with Journal(tmp_path / "j") as journal, pytest.raises(Stopped):
        Run(TASKS, counted).collect(journal, progress=stop)
    assert done == [0, 1, 2, 3]
    with Journal(tmp_path / "j") as journal:
        Run(TASKS, counted).collect(journal)
    assert done == list(range(7))


def test_two_tasks_of_one_key_are_refused() -> None:
    with pytest.raises(ParameterError, match="1 of 3 trials repeat another"):
        Run([Draw(0), Draw(1), Draw(0)], draw).collect()


def test_results_of_other_code_are_not_reused(tmp_path: Path) -> None:
    with Journal(tmp_path / "j") as journal:
        Run(TASKS, draw, stamp="old").collect(journal)
        seen: list[tuple[int, int]] = []
        Run(TASKS, draw, stamp="new").collect(journal, progress=lambda *now: seen.append(now))
    assert seen[0] == (0, 7)


@pytest.mark.parametrize("content", [b"x,y,z\n1,2,3\n", b"{}\n", b"[1]", b'{"journal": "another"}\n'])
def test_another_file_is_not_overwritten(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "j"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match="not a journal"):
        Journal(path)
    assert path.read_bytes() == content


@pytest.mark.parametrize("written", [0, 7])
def test_a_full_disk_is_one_clear_error_and_what_was_kept_stays(tmp_path: Path, written: int) -> None:
    path = tmp_path / "journal.jsonl"
    with Journal(path) as journal:
        Run(TASKS[:2], draw).collect(journal)
        file = journal._file

        class Full:
            room = written

            def write(self, data: bytes) -> int:
                if not self.room:
                    raise OSError(errno.ENOSPC, "No space left on device")
                taken = file.write(data[: self.room])
                self.room -= taken
                return taken

        journal._file = Full()  # type: ignore[assignment]
        with pytest.raises(FileFormatError, match=r"journal.jsonl: No space left on device; run again"):
            Run(TASKS, draw).collect(journal)
        journal._file = file
    with Journal(path) as journal:
        assert len(journal.finished) == 2
        assert Run(TASKS, draw).collect(journal) == [draw(task) for task in TASKS]


def test_a_folder_in_place_of_the_journal_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="cannot use"):
        Journal(tmp_path)


def test_a_dead_worker_is_a_clear_error() -> None:
    with pytest.raises(WorkerError, match="run again"):
        Run(TASKS, die, 2).collect()


def test_workers_are_counted_from_one() -> None:
    with pytest.raises(ParameterError, match="workers"):
        Run(TASKS, draw, 0)


SLOW = """
import sys, time
from pathlib import Path
from tests.simulator.test_runner import TASKS, draw
from simulator.runner import Journal, Run

def progress(done, total):
    print(done, flush=True)
    time.sleep(0.05 if done < 3 else 60)

if __name__ == "__main__":
    with Journal(Path(sys.argv[1])) as journal:
        Run(TASKS, draw, 2).collect(journal, progress=progress)
"""


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc to find the worker processes")
def test_killed_while_running_and_resumed(tmp_path: Path) -> None:
    script = tmp_path / "slow.py"
    script.write_text(SLOW)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, script, tmp_path / "j"], stdout=subprocess.PIPE, env=environment, start_new_session=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.strip() == b"3":
                break
        children = _children(process.pid)
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    with Journal(tmp_path / "j") as journal:
        assert len(journal.finished) >= 3
        assert Run(TASKS, draw).collect(journal) == Run(TASKS, draw).collect()
    assert children
    deadline = time.monotonic() + 20
    while any(_alive(child) for child in children):
        assert time.monotonic() < deadline, "workers outlive the killed parent"
        time.sleep(0.05)


def _children(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def _alive(pid: int) -> bool:
    stat = Path(f"/proc/{pid}/stat")
    try:
        return stat.read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
