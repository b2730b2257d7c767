"""Test the tables of `top`: rates between two samples, the bar of bytes, names from clients."""

import io
from collections.abc import Sequence
from typing import Any, get_type_hints

import pytest
from rich.console import Console
from solidcloud.schemas.errors import BusyError
from solidcloud.schemas.wire.stats import StatsAnswer, Times, UserStats
from solidcloud.server.cli.output import top_display as top
from solidcloud.server.cli.output.top_display import (
    MAX_USERS_SHOWN,
    Sample,
    rate,
    seconds_text,
    watch,
)


class Told:
    """Scene that returns one sample after another, and then fails as without a server."""

    def __init__(self, *said: StatsAnswer) -> None:
        self.said = list(said)

    def stats(self) -> StatsAnswer:
        if not self.said:
            raise BusyError("no server of scene 'hall' answered")
        return self.said.pop(0)


class Clock:
    """Clock that advances during a sleep."""

    now = 50.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert 0 < seconds <= top.POLL_SECONDS
        self.now += seconds


def hall(**fields: Any) -> StatsAnswer:
    return StatsAnswer(scene="hall", **fields)


def shown(said: Sequence[StatsAnswer], width: int = 80, terminal: bool = False, **more: Any) -> str:
    """Return what is printed for these samples, until no server answers."""
    out, clock = io.StringIO(), Clock()
    console = Console(file=out, width=width, height=60, force_terminal=terminal)
    watching: dict[str, Any] = {"console": console, "clock": clock, "sleep": clock.sleep, **more}
    if more.get("once"):
        watch([Told(*said)], 1.0, **watching)
    else:
        with pytest.raises(BusyError, match="no server"):
            watch([Told(*said)], 1.0, **watching)
    return out.getvalue()


def line(text: str, name: str, which: int = -1) -> list[str]:
    """Return the words after a name in a line that begins with it and a number, or in one of several."""
    found = [each.removeprefix(name).split() for each in text.splitlines() if each.startswith(name)]
    return [words for words in found if words[0][0].isdigit()][which]


def test_a_rate_is_what_a_count_rose_a_second() -> None:
    before, now = Sample(10.0, hall(hits=100)), Sample(12.0, hall(hits=150))
    assert rate(before, now, "hits") == 25.0
    assert rate(before, now, "misses") == 0.0
    assert rate(None, now, "hits") is None
    assert rate(now, Sample(14.0, hall(hits=3)), "hits") is None, "another generation"
    assert rate(now, now, "hits") is None


def test_every_count_is_shown() -> None:
    counted = {
        name: 1001 + number
        for number, (name, kind) in enumerate(get_type_hints(StatsAnswer).items())
        if kind is int and "bytes" not in name and name != "generation"
    }
    text = shown([hall(**counted)], once=True)
    assert [name for name, value in counted.items() if f"{value:,}" not in text] == []


@pytest.mark.parametrize("width", [80, 100, 200])
def test_it_fits_a_terminal_without_losing_a_number(width: int) -> None:
    user = UserStats("c" * 32, "a" * 64, 123456, 1, 1, 12345, 1234, 123, 123, 0.1, 0.123, 1.25, 1000.0)
    times = Times(9, 1.0, 0.00012, 0.0123, 0.123, 120.0)
    counts = {"requests": 123_456_789, "answers": 123_456_789, "hits": 123_456_789}
    said = hall(users=[user], load_seconds=times, stall_seconds=times, prefetched_bytes=123 << 30, **counts)
    text = shown([said], width, once=True)
    assert "…" not in text and max(map(len, text.splitlines())) <= width
    numbers = ["123,456", "12,345", "1,234", "123", "123"]
    assert line(text, "cccccc aaaaaaaaaa") == [*numbers, "123", "ms", "1.2", "s", "1000", "s"]
    assert "120 µs" in text and "12 ms" in text and "123 ms" in text and "123.0 GB" in text


def test_users_have_rates_of_their_own_and_the_last_are_counted() -> None:
    many = [UserStats(f"{number:06}", "al", requests=100 + number) for number in range(MAX_USERS_SHOWN + 3)]
    later = [UserStats("000001", "al", requests=161), UserStats("new", "al", requests=5)]
    text = shown([hall(users=many), hall(users=later)], 120)
    assert (
        "and 3 more" in text
        and f"{MAX_USERS_SHOWN - 1:06} al" in text
        and f"{MAX_USERS_SHOWN:06} al" not in text
    )
    assert line(text, "000001 al")[:2] == ["161", "60"]
    assert line(text, "new al")[:2] == ["5", "0"], "no rate yet: the next is the misses"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.0, "0"),
        (5e-7, "0"),
        (1e-6, "1 µs"),
        (0.000123, "123 µs"),
        (0.00123, "1.2 ms"),
        (0.0996, "100 ms"),
        (0.25, "250 ms"),
        (1.25, "1.2 s"),
        (300.0, "300 s"),
    ],
)
def test_times_for_a_reader(seconds: float, text: str) -> None:
    assert seconds_text(seconds) == text


def test_names_cannot_move_the_cursor() -> None:
    text = shown([hall(users=[UserStats("c\x1b[2J", "[red]x\x1b")])], once=True)
    assert "\x1b" not in text and r"c\x1b[2J [red]x\x1b" in text
