"""Test the progress display: rates and remaining times by a manual clock, bars on a terminal."""

import io
import json
import re
from datetime import UTC, datetime
from itertools import count

import pytest
from rich.console import Console
from solidcloud.server.cli.output.progress_display import (
    Bars,
    JsonLines,
    Lines,
    Listener,
    StageProgress,
    count_text,
)


class Clock:
    """Clock that changes only when it is set."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def test_a_rate_is_of_late_and_the_time_left_runs_down(clock: Clock) -> None:
    pace = StageProgress("build", 1000, "points", clock)
    assert (pace.rate, pace.left) == (None, None)
    for _ in range(10):
        clock.now += 1
        pace.advance(10)
    assert pace.rate == 10 and pace.left == 90
    clock.now += 4  # no new progress, but time passes
    assert pace.rate == 10 and pace.left == 86
    clock.now += 1000
    assert pace.left == 0
    clock.now = 110.0
    for _ in range(60):  # the disk slowed down a minute ago
        clock.now += 1
        pace.advance(1)
    assert pace.rate == 1 and pace.left == 840
    pace.end()
    assert (pace.done, pace.total, pace.left, pace.seconds) == (160, 160, 0, 70)
    assert pace.rate == pytest.approx(160 / 70)
    clock.now += 5
    assert pace.seconds == 70


def test_units_of_known_cost_give_a_measured_time_left(clock: Clock) -> None:
    """The first setting of `accuracy` compiles for minutes: 58 more of its kind would be hours."""
    costs = [1.0] * 10 + [5.0] * 10  # the later settings each build an archive
    pace = StageProgress("verdicts", 20, "settings", clock, costs)
    clock.now += 220
    pace.advance(1)
    assert pace.left is None, "one unit, which compiled, says nothing about the others"
    for _ in range(9):
        clock.now += 2
        pace.advance(1)
    assert pace.left == pytest.approx(10 * 10)
    clock.now += 4  # the next unit is at work
    assert pace.left == pytest.approx(96)
    clock.now += 60  # longer than expected
    assert pace.left == pytest.approx(90)
    pace.advance(1)
    for _ in range(4):
        clock.now += 10
        pace.advance(1)
    assert pace.left == pytest.approx(5 * 10)
    clock.now += 50
    pace.advance(5)
    assert pace.left == 0
    pace.end()
    assert pace.left == 0 and pace.done == 20


def work(listener: Listener, clock: Clock, stages: tuple[tuple[str, int, str, int], ...]) -> None:
    """Run stages of ten steps, each of 3 s."""
    for stage, total, unit, step in stages:
        listener.start(stage, total, unit)
        for _ in range(10):
            clock.now += 3
            listener.advance(step)
        listener.finish()


STAGES = (
    ("survey", 3, "files", 0),
    ("spool", 100_000_000, "points", 10_000_000),
    ("build", 123_456_789, "points", 12_345_678),
    ("verify", 0, "voxels", 7),
)


def test_json_lines_are_objects_with_the_same_names(clock: Clock) -> None:
    stream = io.StringIO()
    minutes = count()
    with JsonLines(clock, stream, lambda: datetime(2026, 11, 22, 1, next(minutes), tzinfo=UTC)) as lines:
        work(lines, clock, STAGES[1:2])
    said = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [each["event"] for each in said] == ["start", *["progress"] * 10, "end"]
    assert said[0] == {
        "time": "2026-11-22T01:00:00.000+00:00",
        "event": "start",
        "stage": "spool",
        "done": 0,
        "total": 100_000_000,
        "unit": "points",
        "rate": None,
        "eta": None,
    }
    assert all(set(each) == set(said[0]) for each in said)
    assert (said[5]["done"], said[5]["rate"], said[5]["eta"]) == (50_000_000, 3333333.333, 15.0)
    assert (said[-1]["done"], said[-1]["eta"]) == (100_000_000, 0.0)


def test_a_stage_that_fails_is_not_said_to_be_done(clock: Clock) -> None:
    for make in (Lines, JsonLines):
        stream = io.StringIO()
        with pytest.raises(ValueError, match="bad"), make(clock, stream) as lines:
            lines.start("spool", 1000, "points")
            try:
                raise ValueError("bad")
            finally:
                lines.finish()
        assert "done," not in stream.getvalue() and '"end"' not in stream.getvalue()


def drawn(width: int, clock: Clock) -> str:
    """Return everything sent to a terminal of this many columns while the stages run.

    The display is redrawn after every step.
    """
    terminal = Console(
        file=io.StringIO(), force_terminal=True, width=width, color_system=None, legacy_windows=False
    )
    with Bars(clock, terminal) as bars:
        for stage in STAGES:
            bars.start(*stage[:3])
            for _ in range(10):
                clock.now += 3
                bars.advance(stage[3])
                bars._bars.refresh()
            bars.finish()
    assert isinstance(terminal.file, io.StringIO)
    return terminal.file.getvalue()


def frames(sent: str) -> list[str]:
    """Return the drawn lines without the control sequences that move the cursor."""
    return [
        line
        for part in re.split(r"[\r\n]", sent)
        if (line := re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", part)).strip()
    ]


def test_a_bar_shows_how_much_how_fast_and_how_long(clock: Clock) -> None:
    seen = frames(drawn(100, clock))
    half = next(line for line in seen if "61.7 M of 123 M points" in line)
    assert half.split()[0] == "build"
    assert half.endswith("4.12 M/s    0:15 left")
    assert half.count("━") + half.count("╸") == 10
    assert any(re.search(r"build +━{20} +123 M points +4\.12 M/s +in 0:30$", line) for line in seen)
    assert any(re.search(r"survey .* 0 of 3 files", line) for line in seen)
    assert any(re.search(r"verify .* 70 voxels +2\.3/s +in 0:30$", line) for line in seen)


@pytest.mark.parametrize(
    ("number", "text"),
    [
        (0, "0"), (0.5, "0.5"), (12.4, "12"), (99_999, "99,999"), (99_999.5, "100 k"), (123_456, "123 k"),
        (999_499, "999 k"), (999_500, "1.00 M"), (12_345_678, "12.3 M"), (99_950_000, "100 M"), (4.56e9, "4.56 G"),
        (1e12, "1,000 G"),
    ],
)  # fmt: skip
def test_counts_are_short(number: float, text: str) -> None:
    assert count_text(number) == text
