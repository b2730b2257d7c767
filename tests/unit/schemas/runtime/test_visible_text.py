"""Test that texts of others reach a terminal as texts: without control characters and without markup."""

import contextlib
import io
import sys

import pytest
from rich.live import Live
from rich.table import Table
from solidcloud.schemas.runtime.visible_text import VisibleStream, show_all_output, visible
from solidcloud.server.cli.output.terminal import Terminal

HOSTILE = "\x1b[31m[scan] [/data/hall] :smile: \x00\r\x07\x7f\x9b2J\u202e\u2066\udcff\tend"
SHOWN = (
    r"\x1b[31m[scan] [/data/hall] :smile: \x00\x0d\x07\x7f\x9b2J\u202e\u2066\udcff"
    "\tend"
)


def test_hidden_characters_become_escapes_and_others_stay() -> None:
    assert visible(HOSTILE) == SHOWN
    assert visible(visible(HOSTILE)) == SHOWN
    plain = "two lines\n\tHalle für Öl, 大聖堂, قاعة, é \U0001f600 C:\\scans"
    assert visible(plain) == plain


def test_every_print_of_the_process_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    raw = io.BytesIO()
    for name in ("stdout", "stderr"):
        monkeypatch.setattr(sys, name, io.TextIOWrapper(raw, "ascii", write_through=True))
    show_all_output()
    once = sys.stdout
    show_all_output()
    assert sys.stdout is once
    print(HOSTILE)
    print("Öl", file=sys.stderr, flush=True)
    sys.stderr.writelines(["\x1bA", "\n"])
    assert raw.getvalue().decode() == f"{SHOWN}\n\\xd6l\n\\x1bA\n"
    assert not sys.stdout.isatty()


@pytest.mark.parametrize("live", [False, True])
def test_tables_show_texts_and_keep_their_own_colours(live: bool) -> None:
    """Issue 35: `[scan]` was lost, and `[/data/hall]` ended a load test with an error of rich."""
    out = io.StringIO()
    terminal = Terminal(file=VisibleStream(out), force_terminal=True, width=200, color_system="standard")
    table = Table("head [/x]", title="title [/x] \x1b[2J")
    table.add_row(HOSTILE, style="red")
    with Live(console=terminal) if live else contextlib.nullcontext():
        terminal.print(table)
        terminal.print("[/data/hall] \x1b[2J", style="bold")
    text = out.getvalue()
    for part in ("head [/x]", r"title [/x] \x1b[2J", SHOWN.split("\t")[0], r"[/data/hall] \x1b[2J"):
        assert part in text
    assert f"\x1b[31m{SHOWN.split(chr(9))[0]}" in text
    assert "\x1b[2J" not in text
    assert not {*"\x00\x07\x7f\x9b\u202e\u2066\udcff"} & {*text}
