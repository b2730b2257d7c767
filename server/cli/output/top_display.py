"""Tables of `solidcloud top`: the statistics of a server, with rates between two samples."""

import time
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, Protocol

from rich.columns import Columns
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from ....schemas.runtime.visible_text import visible
from ....schemas.wire.stats import StatsAnswer, UserStats
from .console import bytes_text
from .terminal import Terminal

# Maximum number of users shown, the most recently active.
MAX_USERS_SHOWN = 16
BAR = 30
# Maximum delay of Ctrl-C: a signal delivered to one of zenoh's threads does not wake the main
# thread.
POLL_SECONDS = 0.2

# Label of each counter, and its field of `StatsAnswer`.
_COUNTS = (
    ("requests", "requests"),
    ("requests that waited", "waited"),
    ("answers", "answers"),
    ("unknown", "unknown"),
    ("voxel hits", "hits"),
    ("hits that waited", "waits"),
    ("misses", "misses"),
    ("deadlines missed", "late"),
    ("prefetched", "prefetched"),
    ("prefetched, used", "used"),
    ("prefetched, wasted", "wasted"),
    ("evicted", "evicted"),
    ("evicted too early", "too_soon"),
    ("failed loads", "failed"),
)
_BYTES = (("prefetched", "prefetched_bytes"), ("wasted", "wasted_bytes"), ("moved", "moved_bytes"))
_TIMES = (("load", "load_seconds"), ("stall", "stall_seconds"), ("engine", "engine_seconds"))


class Watched(Protocol):
    """A client whose statistics are shown."""

    def stats(self) -> StatsAnswer: ...


class Sample(NamedTuple):
    """A sample of a scene's statistics. at: time of the sample [s]."""

    at: float
    stats: StatsAnswer


def rate(before: Sample | None, now: Sample, field: str) -> float | None:
    """Return the increase per second of a counter of StatsAnswer between two samples.

    Returns None if the counter fell: another server answers, or another generation is served.
    """
    if before is None:
        return None
    return _rise(getattr(now.stats, field) - getattr(before.stats, field), now.at - before.at)


def _rise(more: int, seconds: float) -> float | None:
    return more / seconds if more >= 0 and seconds > 0 else None


def seconds_text(seconds: float) -> str:
    """Format a duration: 0.00123 -> "1.2 ms"."""
    for unit, name in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")):
        if seconds >= unit:
            value = seconds / unit
            return f"{value:.0f} {name}" if value >= 99.5 else f"{value:.2g} {name}"
    return "0"


def rate_text(value: float | None) -> str:
    """Format a number per second."""
    return "" if value is None else f"{value:,.0f}" if value >= 10 else f"{value:.2g}"


def scene_view(before: Sample | None, now: Sample) -> RenderableType:
    """Return all tables of one scene. before: the previous sample, for rates."""
    stats = now.stats
    generation = f", generation {stats.generation}" if stats.generation else ""
    facts = Text(f"{visible(stats.scene)}{generation}, policy {visible(stats.policy) or '?'}", style="bold")
    voxels = f"{stats.resident:,} of {stats.voxels:,} voxels resident, {stats.kept:,} with users in them"
    right = Group(_bytes_table(before, now), Text(), _times_table(stats))
    tables = Columns([_counts_table(before, now), right], padding=(1, 3))
    return Group(facts, Text(budget_line(stats)), Text(voxels), tables, _users_table(before, now))


def budget_line(stats: StatsAnswer) -> str:
    """Format the memory in use against the budget, with a bar."""
    used = stats.resident_bytes + stats.level_bytes
    share = used / stats.budget_bytes if stats.budget_bytes else 0.0
    full = min(BAR, round(BAR * share))
    level = f", {bytes_text(stats.level_bytes)} for levels of detail" if stats.level_bytes else ""
    bar = "█" * full + "░" * (BAR - full)
    return f"{bar} {share:.0%}  {bytes_text(used)} of {bytes_text(stats.budget_bytes)}{level}"


def _table(first: str, *numbers: str) -> Table:
    """Return an empty table: names to the left, numbers to the right."""
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False, header_style="dim")
    table.add_column(first, no_wrap=True)
    for name in numbers:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _counts_table(before: Sample | None, now: Sample) -> Table:
    table = _table("", "total", "per second")
    for name, field in _COUNTS:
        table.add_row(name, f"{getattr(now.stats, field):,}", rate_text(rate(before, now, field)))
    return table


def _bytes_table(before: Sample | None, now: Sample) -> Table:
    table = _table("bytes", "total", "per second")
    for name, field in _BYTES:
        a_second = rate(before, now, field)
        table.add_row(
            name, bytes_text(getattr(now.stats, field)), "" if a_second is None else bytes_text(a_second)
        )
    return table


def _times_table(stats: StatsAnswer) -> Table:
    table = _table("seconds", "p50", "p90", "p99", "max")
    for name, field in _TIMES:
        times = getattr(stats, field)
        table.add_row(name, *map(seconds_text, (times.p50, times.p90, times.p99, times.max)))
    return table


def _users_table(before: Sample | None, now: Sample) -> Table:
    """Return a table of the most recently active users, with the number of the others."""
    table = _table("user", "requests", "/s", "misses", "late", "unknown", "waited", "p99", "max", "silent")
    known = {} if before is None else {(user.client, user.avatar): user for user in before.stats.users}
    for user in now.stats.users[:MAX_USERS_SHOWN]:
        last = known.get((user.client, user.avatar))
        more = (
            None
            if last is None or before is None
            else _rise(user.requests - last.requests, now.at - before.at)
        )
        table.add_row(*_user_row(user, more))
    left = len(now.stats.users) - MAX_USERS_SHOWN
    if left > 0:
        table.add_row(f"and {left:,} more")
    return table


def _user_row(user: UserStats, a_second: float | None) -> Iterable[RenderableType]:
    """Yield the cells of one user. A client is shown by the first characters of its random name."""
    yield Text(f"{visible(user.client[:6]) or '-'} {visible(user.avatar)[:10] or '-'}")
    yield f"{user.requests:,}"
    yield rate_text(a_second)
    for count in (user.misses, user.late, user.unknown, user.waited):
        yield f"{count:,}"
    for seconds in (user.stall_p99, user.stall_max, user.silent_seconds):
        yield seconds_text(seconds)


def watch(
    scenes: Sequence[Watched],
    interval: float,
    *,
    once: bool = False,
    console: Console | None = None,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> None:
    """Show the statistics of scenes every `interval` [s] until interrupted, or only once.

    Raises the errors of `stats`.
    """
    console = console or Terminal()
    before: list[Sample | None] = [None] * len(scenes)

    def look() -> RenderableType:
        now = [Sample(clock(), scene.stats()) for scene in scenes]
        views = [scene_view(*looks) for looks in zip(before, now, strict=True)]
        before[:] = now
        return Group(*views)

    if once:
        console.print(look())
        return
    # Without a terminal, a live display would be printed only once, at the end.
    with Live(console=console, auto_refresh=False, vertical_overflow="crop") as live:
        while True:
            view = look()
            if console.is_terminal:
                live.update(view, refresh=True)
            else:
                console.print(view)
            wake = clock() + interval
            while (left := wake - clock()) > 0:
                sleep(min(left, POLL_SECONDS))
