"""Progress display of long work on standard error: bars, plain lines, or JSON for programs."""

import json
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from statistics import median
from types import TracebackType
from typing import Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID
from rich.table import Column
from rich.text import Text

from ....schemas.runtime.interrupts import check_interrupt
from ....schemas.runtime.visible_text import show_all_output
from .terminal import Terminal

# Rates average over this window: work completes in chunks of a second or two, and disk speed
# varies.
RATE_SECONDS = 30.0
# Work reported within this time of a stage's start was done earlier, by an interrupted build, and
# does not count for the rate.
HEAD_START_SECONDS = 0.05
# With units of known relative cost: least number of measured units for an estimate, and the multiple
# of the usual time that marks a unit that did more, such as compiling, and tells nothing of others.
MEASURED_UNITS, UNUSUAL = 3, 4.0
# Interval between two lines of one stage without a terminal, as text for people and as JSON for
# programs.
LINE_SECONDS, JSON_SECONDS = 10.0, 1.0


class StageProgress:
    """Progress, rate and remaining time of one stage of work.

    done, total: in `unit`.  clock: seconds since any epoch.
    costs: see `builder.run.executor.Progress`. The remaining time then follows from the costs left
    and the measured time of the units done; otherwise from the recent rate.
    """

    def __init__(
        self,
        stage: str,
        total: int,
        unit: str,
        clock: Callable[[], float],
        costs: Sequence[float] | None = None,
    ) -> None:
        self.stage, self.total, self.unit, self.done = stage, total, unit, 0
        self.ended = False
        self._costs = None if costs is None else list(costs)
        # Cost and seconds of each report so far, and the time of the last one.
        self._measured: list[tuple[float, float]] = []
        self._last = clock()
        self._clock, self._begin, self._before = clock, clock(), 0
        self._samples = deque([(self._begin, 0)])

    def advance(self, amount: int) -> None:
        """Record that `amount` more is done."""
        now = self._clock()
        if self._costs is not None and amount:
            self._measured.append((sum(self._costs[self.done : self.done + amount]), now - self._last))
            self._last = now
        self.done += amount
        if now - self._begin < HEAD_START_SECONDS:
            self._before = self.done
            self._samples = deque([(now, self.done)])
            return
        if len(self._samples) > 1 and self._samples[-1][0] - self._samples[-2][0] < 0.1:
            self._samples[-1] = (now, self.done)
        else:
            self._samples.append((now, self.done))
        while len(self._samples) > 2 and self._samples[1][0] <= now - RATE_SECONDS:
            self._samples.popleft()

    def end(self) -> None:
        """Record that the stage is complete. An estimated total becomes the amount done."""
        self.total, self.ended = self.done, True
        self._samples = deque([(self._begin, self._before), (self._clock(), self.done)])

    @property
    def seconds(self) -> float:
        """Return the duration of the stage until now, or until it ended."""
        return (self._samples[-1][0] if self.ended else self._clock()) - self._begin

    @property
    def rate(self) -> float | None:
        """Return the recent rate in `unit` per second, of the whole stage once it has ended.

        None while unknown.
        """
        (first, before), (last, done) = self._samples[0], self._samples[-1]
        return (done - before) / (last - first) if last > first and done > before else None

    @property
    def left(self) -> float | None:
        """Return the estimated remaining time [s]; None while unknown."""
        if self.ended:
            return 0.0
        if self._costs is not None:
            return self._left_by_costs(self._costs)
        rate = self.rate
        if rate is None or not self.total:
            return None
        return max(0.0, (self.total - self.done) / rate - (self._clock() - self._samples[-1][0]))

    def _left_by_costs(self, costs: list[float]) -> float | None:
        """Return the remaining time [s] by the costs of the units left; None while unknown.

        The unit at work counts for no less than nothing, however long it takes.
        """
        measured = [(cost, seconds) for cost, seconds in self._measured if cost > 0]
        if len(measured) < MEASURED_UNITS:
            return None
        usual = median(seconds / cost for cost, seconds in measured)
        kept = [(cost, seconds) for cost, seconds in measured if seconds <= UNUSUAL * usual * cost]
        pace = sum(seconds for _, seconds in kept) / sum(cost for cost, _ in kept)
        now, *later = costs[self.done :] or [0.0]
        return max(0.0, pace * now - (self._clock() - self._last)) + pace * sum(later)


class Listener:
    """Receiver of progress reports and context manager. Subclasses display the reports.

    Implements the protocol `builder.run.executor.Progress` and the callback of `builder.synthetic`.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._pace: StageProgress | None = None
        # The stage in which an error occurred, with its progress at that time.
        self._broken: StageProgress | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def start(self, stage: str, total: int, unit: str, costs: Sequence[float] | None = None) -> None:
        """Begin a stage. Raises Interrupted if a signal has arrived."""
        check_interrupt()
        self._pace = StageProgress(stage, total, unit, self._clock, costs)
        self._began(self._pace)

    def advance(self, amount: int) -> None:
        """Add to the amount done of the stage. Raises Interrupted if a signal has arrived."""
        check_interrupt()
        if self._pace is not None:
            self._pace.advance(amount)
            self._moved(self._pace)

    def finish(self) -> None:
        """End the stage. An estimated total becomes the amount done."""
        if self._pace is None:
            return
        if sys.exception() is None:
            self._pace.end()
            self._ended(self._pace)
        else:
            self._broken = self._pace
        self._pace = None

    def made(self, done: int, total: int) -> None:
        """Report the points written so far and in total, as `builder.synthetic` calls it."""
        if self._pace is None and done < total:
            self.start("scan", total, "points")
        if self._pace is not None:
            self.advance(done - self._pace.done)
            if done >= total:
                self.finish()

    def _began(self, pace: StageProgress) -> None:
        """Display that a stage begins."""

    def _moved(self, pace: StageProgress) -> None:
        """Display progress of the stage."""

    def _ended(self, pace: StageProgress) -> None:
        """Display that the stage is complete."""


class Bars(Listener):
    """Progress bars for a terminal, one per stage, with amount done, rate and remaining time.

    Only the line of the current stage is redrawn, four times a second. Completed stages and other
    output are printed above it. The columns have fixed widths, 79 characters in all.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, console: Console | None = None) -> None:
        super().__init__(clock)
        self._bars = Progress(
            _Cell(lambda pace: f"{pace.stage:<8.8}", 8),
            BarColumn(bar_width=20, table_column=Column(width=20, no_wrap=True)),
            _Cell(_amount_text, 26),
            _Cell(lambda pace: _rate_text(pace, ""), 9),
            _Cell(_left_text, 12),
            console=console or Terminal(stderr=True),
            refresh_per_second=4,
        )
        self._task: TaskID | None = None

    def __enter__(self) -> Self:
        self._bars.start()
        show_all_output()  # the bars have replaced standard error, to print other output above them
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def _began(self, pace: StageProgress) -> None:
        self._task = self._bars.add_task(pace.stage, total=pace.total, pace=pace)

    def _moved(self, pace: StageProgress) -> None:
        if self._task is not None:
            self._bars.update(self._task, completed=pace.done)

    def _ended(self, pace: StageProgress) -> None:
        if self._task is None:
            return
        # A stage with a total of 0 also ends with a full bar.
        self._bars.update(self._task, completed=max(pace.done, 1), total=max(pace.done, 1))
        over = next(task for task in self._bars.tasks if task.id == self._task)
        self._bars.remove_task(self._task)
        self._bars.refresh()  # otherwise the old line would be drawn again below the next output
        self._bars.console.print(self._bars.make_tasks_table([over]))
        self._task = None


class _Cell(ProgressColumn):
    """Column of fixed width with a text about the pace of a task."""

    def __init__(self, say: Callable[[StageProgress], str], width: int) -> None:
        super().__init__(Column(width=width, no_wrap=True, justify="left" if width == 8 else "right"))
        self._say = say

    def render(self, task: Task) -> Text:
        """Return the text. rich calls this several times a second, in its own thread."""
        return Text(self._say(task.fields["pace"]))


class Lines(Listener):
    """Plain text lines, without a terminal: at a stage's start, every 10 s, and at its end."""

    def __init__(self, clock: Callable[[], float] = time.monotonic, stream: TextIO | None = None) -> None:
        super().__init__(clock)
        self._stream = stream
        self._said = 0.0

    def _began(self, pace: StageProgress) -> None:
        self._said = self._clock()
        self._say(f"{pace.stage}: {pace.total:,} {pace.unit}")

    def _moved(self, pace: StageProgress) -> None:
        if self._clock() - self._said < LINE_SECONDS:
            return
        self._said = self._clock()
        done = f"{pace.done:,} {pace.unit}"
        if pace.total:
            done = f"{pace.done / pace.total:.0%}, {pace.done:,} of {pace.total:,} {pace.unit}"
        facts = [f"{pace.stage}: {done}", _rate_text(pace, pace.unit)]
        if pace.left is not None:
            facts.append(f"{clock_text(pace.left)} left")
        self._say(", ".join(filter(None, facts)))

    def _ended(self, pace: StageProgress) -> None:
        rate = _rate_text(pace, pace.unit)
        self._say(
            f"{pace.stage}: done, {pace.done:,} {pace.unit} in {clock_text(pace.seconds)}{rate and ', '}{rate}"
        )

    def _say(self, line: str) -> None:
        print(line, file=self._stream or sys.stderr, flush=True)


class JsonLines(Listener):
    """JSON lines for programs: at a stage's start, every second, at its end, and on failure.

    time: ISO 8601, UTC.  event: "start", "progress", "end" or "failed".
    stage: its name; null outside any stage.
    done, total: amount so far and in all, in `unit`; total may be an estimate until the end.
    rate: recent `unit` per second, at the end that of the whole stage; null while unknown.
    eta: estimated remaining time [s]; null while unknown.
    message: error message; only in "failed".
    """

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        stream: TextIO | None = None,
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        super().__init__(clock)
        self._stream, self._now = stream, now
        self._said = 0.0

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is not None:
            self._say("failed", self._pace or self._broken, message=str(error) or type(error).__name__)

    def _began(self, pace: StageProgress) -> None:
        self._said = self._clock()
        self._say("start", pace)

    def _moved(self, pace: StageProgress) -> None:
        if self._clock() - self._said >= JSON_SECONDS:
            self._said = self._clock()
            self._say("progress", pace)

    def _ended(self, pace: StageProgress) -> None:
        self._say("end", pace)

    def _say(self, event: str, pace: StageProgress | None, **more: str) -> None:
        facts = {
            "time": self._now().isoformat(timespec="milliseconds"),
            "event": event,
            "stage": pace and pace.stage,
            "done": pace and pace.done,
            "total": pace and pace.total,
            "unit": pace and pace.unit,
            "rate": pace and _rounded(pace.rate),
            "eta": pace and _rounded(pace.left),
        }
        print(json.dumps(facts | more, allow_nan=False), file=self._stream or sys.stderr, flush=True)


@contextmanager
def progress_listener(log_json: bool = False) -> Iterator[Listener]:
    """Yield a progress display: JSON if `log_json`, bars on a terminal, else plain lines."""
    console = Terminal(stderr=True)
    listener: Listener
    if log_json:
        listener = JsonLines()
    elif console.is_terminal and not console.is_dumb_terminal:
        listener = Bars(console=console)
    else:
        listener = Lines()
    with listener:
        yield listener


def count_text(count: float) -> str:
    """Format a count in at most seven characters: 99,999, then 100 k, 12.3 M, 4.56 G."""
    if count < 99_999.5:
        return f"{count:,.0f}" if count >= 10 or count == int(count) else f"{count:.1f}"
    power = min(3, (len(str(round(count))) - 1) // 3)
    count /= 1000.0**power
    if round(count, 2 if count < 10 else 1 if count < 100 else 0) >= 1000 and power < 3:
        count, power = count / 1000, power + 1
    digits = 2 if count < 9.995 else 1 if count < 99.95 else 0
    return f"{count:,.{digits}f} {' kMG'[power]}"


def clock_text(seconds: float) -> str:
    """Format a duration as on a clock: 0:07, 12:34, 1:02:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def _amount_text(pace: StageProgress) -> str:
    if pace.ended or not pace.total:
        return f"{count_text(pace.done)} {pace.unit}"
    return f"{count_text(pace.done)} of {count_text(pace.total)} {pace.unit}"


def _rate_text(pace: StageProgress, unit: str) -> str:
    rate = pace.rate
    return "" if rate is None else f"{count_text(rate)}{unit and ' '}{unit}/s"


def _left_text(pace: StageProgress) -> str:
    if pace.ended:
        return f"in {clock_text(pace.seconds)}"
    left = pace.left
    return "" if left is None else f"{clock_text(left)} left"


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)
