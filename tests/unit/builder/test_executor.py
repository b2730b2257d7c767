"""Work units run in order, in this process or in others; a failure stops what waits."""

import os
from functools import partial

import pytest
import solidcloud.builder.executor as executor_module
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.executor import POINTS_WORTH_A_PROCESS, ProcessExecutor, make_executor, worker_count


class Counted:
    """Progress that adds up."""

    def __init__(self) -> None:
        self.done = 0

    def start(self, stage: str, total: int, unit: str) -> None:
        """Nothing."""

    def advance(self, amount: int) -> None:
        """Add."""
        self.done += amount

    def finish(self) -> None:
        """Nothing."""


def test_results_come_in_the_order_of_the_units() -> None:
    progress = Counted()
    with ProcessExecutor(1) as executor:
        results = executor.map(divmod_by_7, range(20), progress, lambda unit: unit)
        assert next(results) == (0, 0)
        assert progress.done == 0  # advances when a result is taken
        assert list(results) == [divmod(i, 7) for i in range(1, 20)]
    assert progress.done == sum(range(20))


def divmod_by_7(value: int) -> tuple[int, int]:
    """A picklable unit of work."""
    return divmod(value, 7)


def test_processes_give_the_same_in_the_same_order() -> None:
    progress = Counted()
    # A builtin, because spawned processes cannot import a test module by its name.
    with ProcessExecutor(2) as executor:
        results = list(executor.map(partial(divmod, 100), range(1, 21), progress, lambda unit: 1))
        processes = set(executor.map(eval, ["__import__('os').getpid()"] * 8, progress, lambda unit: 0))
        with pytest.raises(ZeroDivisionError):
            list(executor.map(partial(divmod, 1), [1, 0, 1], progress, lambda unit: 1))
    assert results == [divmod(100, i) for i in range(1, 21)]
    assert os.getpid() not in processes
    assert progress.done == 20 + 1


def test_a_failure_here_stops_at_its_unit() -> None:
    with ProcessExecutor(1) as executor:
        results = executor.map(partial(divmod, 1), [1, 0, 1], Counted(), lambda unit: 1)
        assert next(results) == (1, 0)
        with pytest.raises(ZeroDivisionError):
            next(results)


def test_processes_are_started_only_where_they_pay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executor_module.os, "cpu_count", lambda: 4)
    assert worker_count(0, 0) == 1
    assert worker_count(0, POINTS_WORTH_A_PROCESS * 2) == 2
    assert worker_count(0, POINTS_WORTH_A_PROCESS * 100) == 4
    assert worker_count(3, 0) == 3
    monkeypatch.setattr(executor_module.os, "cpu_count", lambda: None)
    assert worker_count(0, POINTS_WORTH_A_PROCESS * 100) == 1


def test_processes_do_the_work_where_no_cluster_is_named() -> None:
    with make_executor(BuildConfig(), 1) as executor:
        assert isinstance(executor, ProcessExecutor)
        assert executor.jobs == 1
