"""Test the parts of a load test: the clock of frames, adversaries, processes. Nothing is timed."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from solidcloud.server.report.load.runs import load_run, load_server
from solidcloud.server.report.load.users import frame_clock
from solidcloud.server.report.load.users.frame_outcomes import ANSWERED
from solidcloud.server.report.load.users.user_traces import Trace


class Clock:
    """Simulated clock that advances during a sleep and during an act. early: by which a sleep is short [s]."""

    def __init__(self, early: float = 0.0) -> None:
        self.now, self.early = 0.0, early
        self.acted: list[tuple[int, float]] = []

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now += max(seconds - self.early, 1e-6)

    def act(self, takes: Callable[[int], float]) -> Callable[[int], None]:
        def act(number: int) -> None:
            self.acted.append((number, self.now))
            self.now += takes(number)

        return act

    def run(self, due: list[float], takes: Callable[[int], float]) -> list[tuple[int, float]]:
        frame_clock.pace(due, self.act(takes), lambda: self.now, self.sleep)
        return self.acted


def test_each_frame_is_asked_when_it_is_due() -> None:
    due = [0.5, 1.0, 1.25, 7.0]
    assert Clock().run(due, lambda _: 0.0) == list(enumerate(due))


def test_a_late_frame_delays_no_other_but_those_due_meanwhile() -> None:
    due = [0.0, 1.0, 2.0, 3.0, 4.0]
    # The second frame takes until 3.5: two follow at once, the last is on time again.
    acted = Clock().run(due, lambda number: 2.5 if number == 1 else 0.0)
    assert acted == [(0, 0.0), (1, 1.0), (2, 3.5), (3, 3.5), (4, 4.0)]


def test_a_frame_stalls_when_its_answer_is_later_than_the_next_frame_or_never() -> None:
    due = np.array([1.0, 2.0, 3.0, 4.0])
    done = np.array([1.033, 2.034, np.nan, 4.0])
    assert frame_clock.stalled(due, done).tolist() == [False, True, True, False]
    assert frame_clock.stalled(due, done, 0.1).tolist() == [False, False, True, False]


def test_a_process_that_ends_before_it_is_ready_says_why(tmp_path: Path) -> None:
    code = "import sys; print('no room', file=sys.stderr); sys.exit(3)"
    with (
        pytest.raises(load_server.ServerError, match="no room"),
        load_server.running([sys.executable, "-c", code], tmp_path / "log", "ready"),
    ):
        pass


def test_users_in_processes_ask_every_frame_of_a_trace_and_hear_of_each(tmp_path: Path) -> None:
    user = np.array([0, 1, 2] * 10)
    asked = Trace(user, np.arange(30) / 90, np.tile(np.eye(4), (30, 1, 1)))
    setup = load_run.Setup(tmp_path / "none", tmp_path, processes=2)
    found = load_run.run_echo(setup, asked, request_bytes=226, reply_bytes=180)
    made = found.frames
    assert made.user.tolist() == user.tolist() and (made.status == ANSWERED).all() and not found.faults
    assert np.allclose(made.due - made.due[0], asked.time) and (made.due <= made.sent).all()
    assert (made.sent <= made.done).all() and (np.diff(made.due) >= 0).all()
