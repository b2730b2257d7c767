"""How long work looks while it goes on, on standard error: bars, plain lines, or JSON for programs."""

import json
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from types import TracebackType
from typing import Self, TextIO

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID
from rich.table import Column
from rich.text import Text

from ..schemas.interrupts import check

# A rate is that of the last so many seconds: work comes in lumps of a second or two, and a disk's mood changes.
RATE_SECONDS = 30.0
# What is done so soon after a stage began was done before it began, by a build that was interrupted.
HEAD_START_SECONDS = 0.05
# Between two lines of one stage, where no terminal shows bars; JSON is for programs, which do not tire.
LINE_SECONDS, JSON_SECONDS = 10.0, 1.0


class Pace:
    """How far one stage of work is, how fast it goes and how long it has still to go.

    done, total: in `unit`.  clock: seconds, from anywhere.
    """

    def __init__(self, stage: str, total: int, unit: str, clock: Callable[[], float]) -> None:
        self.stage, self.total, self.unit, self.done = stage, total, unit, 0
        self.ended = False
        self._clock, self._begin, self._before = clock, clock(), 0
        self._samples = deque([(self._begin, 0)])

    def advance(self, amount: int) -> None:
        """So much more is done."""
        now = self._clock()
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
        """All is done; a total that was an estimate becomes what was done."""
        self.total, self.ended = self.done, True
        self._samples = deque([(self._begin, self._before), (self._clock(), self.done)])

    @property
    def seconds(self) -> float:
        """Since it began, until now or until it ended."""
        return (self._samples[-1][0] if self.ended else self._clock()) - self._begin

    @property
    def rate(self) -> float | None:
        """`unit` a second, of late; of all of it when it has ended. None while nothing is known."""
        (first, before), (last, done) = self._samples[0], self._samples[-1]
        return (done - before) / (last - first) if last > first and done > before else None

    @property
    def left(self) -> float | None:
        """Seconds still to go; None while nothing is known."""
        rate = self.rate
        if self.ended:
            return 0.0
        if rate is None or not self.total:
            return None
        return max(0.0, (self.total - self.done) / rate - (self._clock() - self._samples[-1][0]))


class Listener:
    """What `builder.progress.Progress` asks for, and `builder.made`; a context manager. A subclass shows it."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._pace: Pace | None = None
        # The stage that something went wrong in: it is left as it stood.
        self._broken: Pace | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def start(self, stage: str, total: int, unit: str) -> None:
        """Begin a stage. Raises Interrupted where a signal has come."""
        check()
        self._pace = Pace(stage, total, unit, self._clock)
        self._began(self._pace)

    def advance(self, amount: int) -> None:
        """Add to what is done of the stage. Raises Interrupted where a signal has come."""
        check()
        if self._pace is not None:
            self._pace.advance(amount)
            self._moved(self._pace)

    def finish(self) -> None:
        """The stage is over; a total that was an estimate becomes what was done."""
        if self._pace is None:
            return
        if sys.exception() is None:
            self._pace.end()
            self._ended(self._pace)
        else:
            self._broken = self._pace
        self._pace = None

    def made(self, done: int, total: int) -> None:
        """What `builder.made` calls: points written so far, of all."""
        if self._pace is None and done < total:
            self.start("scan", total, "points")
        if self._pace is not None:
            self.advance(done - self._pace.done)
            if done >= total:
                self.finish()

    def _began(self, pace: Pace) -> None:
        """A stage begins."""

    def _moved(self, pace: Pace) -> None:
        """Some of it is done."""

    def _ended(self, pace: Pace) -> None:
        """All of it is done."""


class Bars(Listener):
    """A bar for each stage, on a terminal: how much is done, how fast, and how long it will take.

    One line is drawn anew, four times a second: that of the stage at work. One that is over is printed above it, once,
    and so is what others print meanwhile. Its columns have fixed places, 79 in all: what moves is the figures alone.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic, console: Console | None = None) -> None:
        super().__init__(clock)
        self._bars = Progress(
            _Cell(lambda pace: f"{pace.stage:<8.8}", 8),
            BarColumn(bar_width=20, table_column=Column(width=20, no_wrap=True)),
            _Cell(_amount_text, 26),
            _Cell(lambda pace: _rate_text(pace, ""), 9),
            _Cell(_left_text, 12),
            console=console or Console(stderr=True),
            refresh_per_second=4,
        )
        self._task: TaskID | None = None

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bars.stop()

    def _began(self, pace: Pace) -> None:
        self._task = self._bars.add_task(pace.stage, total=pace.total, pace=pace)

    def _moved(self, pace: Pace) -> None:
        if self._task is not None:
            self._bars.update(self._task, completed=pace.done)

    def _ended(self, pace: Pace) -> None:
        if self._task is None:
            return
        # A stage of nothing has a full bar too.
        self._bars.update(self._task, completed=max(pace.done, 1), total=max(pace.done, 1))
        over = next(task for task in self._bars.tasks if task.id == self._task)
        self._bars.remove_task(self._task)
        self._bars.refresh()  # what is printed next would else be followed by the line as it was drawn last
        self._bars.console.print(self._bars.make_tasks_table([over]))
        self._task = None


class _Cell(ProgressColumn):
    """A text of fixed width about the pace of a task."""

    def __init__(self, say: Callable[[Pace], str], width: int) -> None:
        super().__init__(Column(width=width, no_wrap=True, justify="left" if width == 8 else "right"))
        self._say = say

    def render(self, task: Task) -> Text:
        """Called by rich some times a second, in a thread of its own."""
        return Text(self._say(task.fields["pace"]))


class Lines(Listener):
    """Plain lines, where no terminal is: one as a stage begins, one every 10 s, one as it ends."""

    def __init__(self, clock: Callable[[], float] = time.monotonic, stream: TextIO | None = None) -> None:
        super().__init__(clock)
        self._stream = stream
        self._said = 0.0

    def _began(self, pace: Pace) -> None:
        self._said = self._clock()
        self._say(f"{pace.stage}: {pace.total:,} {pace.unit}")

    def _moved(self, pace: Pace) -> None:
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

    def _ended(self, pace: Pace) -> None:
        rate = _rate_text(pace, pace.unit)
        self._say(
            f"{pace.stage}: done, {pace.done:,} {pace.unit} in {clock_text(pace.seconds)}{rate and ', '}{rate}"
        )

    def _say(self, line: str) -> None:
        print(line, file=self._stream or sys.stderr, flush=True)


class JsonLines(Listener):
    """One JSON object a line, for programs: as a stage begins, every second, as it ends, and when something fails.

    time: ISO 8601, UTC.  event: "start", "progress", "end" or "failed".  stage: its name, null outside any.
    done, total: so far and of all, in `unit`; total may be an estimate until the end.  rate: `unit` a second, of late,
    at the end of all of it; eta: seconds to go; both null while unknown.  message: of what failed, there alone.
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

    def _began(self, pace: Pace) -> None:
        self._said = self._clock()
        self._say("start", pace)

    def _moved(self, pace: Pace) -> None:
        if self._clock() - self._said >= JSON_SECONDS:
            self._said = self._clock()
            self._say("progress", pace)

    def _ended(self, pace: Pace) -> None:
        self._say("end", pace)

    def _say(self, event: str, pace: Pace | None, **more: str) -> None:
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
    """What listens to this command's work, on standard error: JSON if asked for, bars on a terminal, else lines."""
    console = Console(stderr=True)
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
    """A count in at most seven characters: 99,999 as it is, then 100 k, 12.3 M, 4.56 G."""
    if count < 99_999.5:
        return f"{count:,.0f}" if count >= 10 or count == int(count) else f"{count:.1f}"
    power = min(3, (len(str(round(count))) - 1) // 3)
    count /= 1000.0**power
    if round(count, 2 if count < 10 else 1 if count < 100 else 0) >= 1000 and power < 3:
        count, power = count / 1000, power + 1
    digits = 2 if count < 9.995 else 1 if count < 99.95 else 0
    return f"{count:,.{digits}f} {' kMG'[power]}"


def clock_text(seconds: float) -> str:
    """A time in seconds as on a clock: 0:07, 12:34, 1:02:03."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def _amount_text(pace: Pace) -> str:
    if pace.ended or not pace.total:
        return f"{count_text(pace.done)} {pace.unit}"
    return f"{count_text(pace.done)} of {count_text(pace.total)} {pace.unit}"


def _rate_text(pace: Pace, unit: str) -> str:
    rate = pace.rate
    return "" if rate is None else f"{count_text(rate)}{unit and ' '}{unit}/s"


def _left_text(pace: Pace) -> str:
    if pace.ended:
        return f"in {clock_text(pace.seconds)}"
    left = pace.left
    return "" if left is None else f"{clock_text(left)} left"


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)
