"""Test how messages name the command `solidcloud`: as a shell in the working directory can run it."""

import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from solidcloud.schemas.runtime.own_command import VERBS, own_command, path_advice

pytestmark = pytest.mark.interpreted


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the script of an installation in a folder .venv; this process seems to be its Python."""
    path = tmp_path / "my place/.venv/bin/solidcloud"
    path.parent.mkdir(parents=True)
    path.write_text("#!/bin/sh\necho ran $1\n")
    path.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(path.with_name("python")))
    monkeypatch.setattr(sys, "argv", ["-m"])
    monkeypatch.setenv("PATH", "/usr/bin:/bin")
    return path


def runs(command: str) -> bool:
    done = subprocess.run(f"{command} info", shell=True, capture_output=True, text=True, check=False)
    return done.stdout == "ran info\n"


@pytest.mark.parametrize(
    ("folder", "expected"), [("..", ".venv/bin/solidcloud"), (".", "bin/solidcloud"), ("bin", "./solidcloud")]
)
def test_it_is_the_shortest_path_below_the_working_directory(
    script: Path, folder: str, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(script.parents[1] / folder)
    assert own_command() == expected and runs(own_command())


def test_elsewhere_it_is_the_whole_path_quoted(
    script: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert own_command() == shlex.quote(str(script)) and runs(own_command())


def test_on_the_search_path_it_is_its_name(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", f"{script.parent}:/usr/bin:/bin")
    assert own_command() == "solidcloud" and path_advice() == ""


def test_without_a_script_it_is_a_call_of_python(script: Path) -> None:
    script.unlink()
    assert own_command().endswith("python' -m solidcloud.server.cli.main")


def test_the_advice_makes_the_name_work(script: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/")
    export = path_advice().splitlines()[-1].strip()
    assert export.startswith("export PATH=") and runs(f"{export}; solidcloud")


def test_every_subcommand_is_known() -> None:
    from solidcloud.server.cli.main import app
    from typer.main import get_command

    command = get_command(app)
    assert sorted(command.commands) == sorted(VERBS)  # type: ignore[attr-defined]
