"""Test what the command `solidcloud` offers as a whole: help, version, completion, common options."""

import os
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from solidcloud.server.cli.main import app, run
from typer.main import get_command

pytestmark = pytest.mark.interpreted


def leaves(command: Any = None, name: str = "") -> dict[str, Any]:
    """Return every command that runs, by its words."""
    command = get_command(app) if command is None else command
    inner = getattr(command, "commands", None)
    if inner is None:
        return {name.strip(): command}
    return {
        words: leaf for verb, each in inner.items() for words, leaf in leaves(each, f"{name} {verb}").items()
    }


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--version"]) == 0
    assert capsys.readouterr().out == f"solidcloud {metadata.version('solidcloud')}\n"


@pytest.mark.parametrize("group", [[], ["make"], ["scene"]])
@pytest.mark.parametrize("columns", ["60", "80", "200"])
def test_no_line_of_the_list_of_commands_is_cut(
    group: list[str], columns: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", columns)
    assert run([*group, "--help"]) == 0
    listed = capsys.readouterr().out.split("Commands:")[1].split("\n\n")[0].strip().splitlines()
    assert len(listed) >= 2
    for line in listed:
        assert re.match(r" *[a-z]+ +[A-Z].*\.$", line) and "..." not in line, line


def test_no_description_is_cut_where_a_shell_shows_it() -> None:
    for words, command in leaves().items():
        assert not command.get_short_help_str().endswith("..."), words


def test_output_and_overwrite_have_one_spelling() -> None:
    found = leaves()
    assert "scene new" in found and "build" in found
    for words, command in found.items():
        names = {name for option in command.params for name in (*option.opts, *option.secondary_opts)}
        assert not names & {"--out", "--force", "-f", "--replace"}, words
        assert ("-o" in names) == ("--output" in names), words
    replacing = {words for words, each in found.items() if any("--overwrite" in p.opts for p in each.params)}
    made = {f"make {what}" for what in ("facade", "town", "office", "figure", "walk")}
    assert replacing == {"build", "export", "inspect", "scene new", *made}


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("solidcloud scene ", ["new", "check"]),
        ("solidcloud serve hall --policy lru", ["lru", "lru+prefetch"]),
    ],
)
def test_a_shell_completes(typed: str, offered: list[str]) -> None:
    said = {
        "_SOLIDCLOUD_COMPLETE": "complete_bash",
        "COMP_WORDS": typed,
        "COMP_CWORD": str(typed.count(" ")),
    }
    done = subprocess.run(
        [sys.executable, "-P", "-m", "solidcloud.server.cli.main"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **said},
    )
    assert done.stdout.split() == offered and done.stderr == ""


def test_an_error_names_a_command_as_it_can_be_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    monkeypatch.chdir(tmp_path)
    assert run(["info", "nowhere"]) == 3
    command = re.search(r"build one with `(.+) build`", capsys.readouterr().err)
    assert (
        command
        and subprocess.run([command[1], "--version"], capture_output=True, check=False).returncode == 0
    )


def test_what_make_finds_is_replaced_only_with_overwrite(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "figure.obj"
    path.write_text("mine")
    command = ["make", "figure", "-o", str(path), "--points", "20"]
    assert run(command) == 2
    assert path.read_text() == "mine"
    assert (
        f"{path}: exists, expected no such file: give another -o, or --overwrite" in capsys.readouterr().err
    )
    assert run([*command, "--overwrite"]) == 0
    assert path.read_text().count("v ") == 20
