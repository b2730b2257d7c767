"""Work units run in order, in this process or in others; a failure stops what waits. Ranges hold every row once."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import solidcloud.builder.run.executor as executor_module
from solidcloud.builder.run.executor import (
    POINTS_WORTH_A_PROCESS,
    ProcessExecutor,
    voxel_ranges,
    worker_count,
)
from solidcloud.schemas.errors import SolidcloudError


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
    progress, failing = Counted(), Counted()
    # A builtin, because spawned processes cannot import a test module by its name.
    with ProcessExecutor(2) as executor:
        results = list(executor.map(partial(divmod, 100), range(1, 21), progress, lambda unit: 1))
        processes = set(executor.map(eval, ["__import__('os').getpid()"] * 8, progress, lambda unit: 0))
        with pytest.raises(ZeroDivisionError):  # the unit after it may have been done before
            list(executor.map(partial(divmod, 1), [1, 0, 1], failing, lambda unit: 1))
    assert results == [divmod(100, i) for i in range(1, 21)]
    assert os.getpid() not in processes
    assert progress.done == 20
    assert 0 <= failing.done <= 2


def slow_first(number: int, folder: str) -> str:
    """Python text of a unit that says it ran; number 0 waits for all others."""
    waits = f"while len(os.listdir({folder!r})) < 30: time.sleep(0.01)" if number == 0 else ""
    says = f"open({folder!r} + '/{number}', 'w').close()"
    return f"import os, time\n{waits}\n{says}"


def test_a_long_unit_keeps_nobody_waiting(tmp_path: Path) -> None:
    progress = Counted()
    with ProcessExecutor(2) as executor:
        results = executor.map(
            exec, [slow_first(i, str(tmp_path)) for i in range(31)], progress, lambda unit: 1
        )
        assert list(results) == [None] * 31
    assert progress.done == 31


def test_an_interrupted_builder_does_not_wait_for_its_workers(tmp_path: Path) -> None:
    begin = time.monotonic()
    code = f"import time; open({str(tmp_path / 'runs')!r}, 'w').close(); time.sleep(600)"
    with pytest.raises(KeyboardInterrupt), ProcessExecutor(2) as executor:
        executor._pool.submit(exec, code)  # type: ignore[union-attr]
        while not (tmp_path / "runs").exists():
            time.sleep(0.01)
        raise KeyboardInterrupt
    assert time.monotonic() - begin < 300


def test_a_worker_that_died_while_it_had_nothing_to_do_is_said(tmp_path: Path) -> None:
    with (
        ProcessExecutor(2) as executor,
        pytest.raises(SolidcloudError, match="ended abruptly: out of memory"),
    ):
        for worker in set(executor.map(eval, ["__import__('os').getpid()"] * 4, Counted(), lambda unit: 0)):
            os.kill(worker, signal.SIGKILL)
        until(lambda: executor._pool._broken)  # type: ignore[union-attr]
        list(executor.map(eval, ["1"], Counted(), lambda unit: 0))


BUILDER = """
import os, sys, time
from solidcloud.builder.run.executor import ProcessExecutor
if __name__ == "__main__":
    with ProcessExecutor(2) as executor:
        code = "import os, time; open(%r + '/' + str(os.getpid()), 'w').close(); time.sleep(600)" % sys.argv[1]
        for _ in range(2):
            executor._pool.submit(exec, code)
        time.sleep(600)
"""


def test_workers_end_with_a_builder_that_is_killed(tmp_path: Path) -> None:
    said = tmp_path / "said"
    said.mkdir()
    (tmp_path / "builder.py").write_text(BUILDER)
    with subprocess.Popen([sys.executable, "-P", str(tmp_path / "builder.py"), str(said)]) as builder:
        workers = until(
            lambda: [int(p.name) for p in said.iterdir()] if len(list(said.iterdir())) == 2 else []
        )
        builder.kill()
    assert until(lambda: not any(alive(worker) for worker in workers))


def until(found: Callable[[], Any]) -> Any:
    """What is found within a minute."""
    deadline = time.monotonic() + 60
    while not (result := found()):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return result


def alive(process: int) -> bool:
    """Whether a process runs; one that has ended and waits to be asked how does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_processes_are_started_only_where_they_pay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executor_module.os, "cpu_count", lambda: 4)
    assert worker_count(0, 0) == 1
    assert worker_count(0, POINTS_WORTH_A_PROCESS * 2) == 2
    assert worker_count(0, POINTS_WORTH_A_PROCESS * 100) == 4
    assert worker_count(3, 0) == 3
    monkeypatch.setattr(executor_module.os, "cpu_count", lambda: None)
    assert worker_count(0, POINTS_WORTH_A_PROCESS * 100) == 1


M = 1 << 20


@pytest.mark.parametrize("jobs", [1, 2, 7])
@pytest.mark.parametrize("counts", [[5], [M] * 100, [1, 40 * M, 2, 3], [0, 0, 9 * M, 0], list(range(1000))])
def test_every_row_is_in_one_portion_and_the_largest_come_first(counts: list[int], jobs: int) -> None:
    points = np.array(counts)
    runs = voxel_ranges(points, jobs)
    assert sorted(row for run in runs for row in run) == list(range(len(points)))
    held = [int(points[list(run)].sum()) for run in runs]
    assert held == sorted(held, reverse=True)
    planned = max(M, int(points.sum()) // (8 * jobs))
    assert all(h - points[run.stop - 1] <= planned for h, run in zip(held, runs, strict=True))
    assert len(runs) <= points.sum() // planned + 1
