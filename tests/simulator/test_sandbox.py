"""Whatever a call does, the caller gets an answer or a failure of the right kind, in order and in time."""

from __future__ import annotations

import pytest

from common.errors import ParameterError
from simulator.codecs.sandbox import Failure, Sandbox
from simulator.runner import WorkerError
from tests.simulator.decoders import answer, leave, misbehave


@pytest.mark.parametrize("workers", [1, 2])
def test_every_way_to_fail_is_counted_and_the_others_answer(workers: int) -> None:
    calls = ["crash", "fine", "refuse", "hang", "also fine", "leave", "gorge", "last"]
    with Sandbox(workers=workers, seconds=2.0, memory=1 << 28) as box:
        results = list(box.map(misbehave, [(call,) for call in calls]))
    kinds = [result.kind if isinstance(result, Failure) else result for result in results]
    assert kinds == ["crash", "fine", "error", "timeout", "also fine", "crash", "memory", "last"]
    details = {call: result.detail for call, result in zip(calls, results, strict=True) if isinstance(result, Failure)}
    assert details["crash"] == "SIGSEGV"
    assert details["refuse"] == "ValueError: damaged"
    assert "status 3" in details["leave"]


def test_a_child_that_does_not_start_is_our_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simulator.codecs.sandbox._serve", leave)
    with Sandbox() as box, pytest.raises(WorkerError, match="did not start"):
        box.run(answer, 1)


def test_children_serve_many_calls_and_are_gone_afterwards() -> None:
    with Sandbox(workers=2) as box:
        assert list(box.map(answer, [(i,) for i in range(50)])) == [2 * i for i in range(50)]
        processes = [child.process for child in box._children]
        assert len(processes) == 2
        assert all(process.is_alive() for process in processes)
        assert box.run(answer, 4) == 8
    assert not any(process.is_alive() for process in processes)


def test_a_run_that_is_given_up_leaves_nothing_behind() -> None:
    """What a half-read row of calls left running does not answer the next one."""
    with Sandbox(workers=2, seconds=5) as box:
        first = box.map(answer, [(i,) for i in range(10)])
        assert next(first) == 0
        del first
        assert list(box.map(answer, [(i,) for i in range(100, 110)])) == [2 * i for i in range(100, 110)]


def test_decoders_chatter_stays_in_the_child(capfd: pytest.CaptureFixture[str]) -> None:
    with Sandbox() as box:
        assert box.run(answer, 1) == 2
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("wrong", [{"workers": 0}, {"seconds": 0.0}, {"memory": 0}])
def test_limits_are_positive(wrong: dict[str, int]) -> None:
    with pytest.raises(ParameterError, match="must be positive"):
        Sandbox(**wrong)
