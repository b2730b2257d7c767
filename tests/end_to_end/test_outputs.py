"""Test outputs that cannot be written: one line of error; and SIGTERM: nothing left behind.

The line says where, what and what to do.
"""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from solidcloud.server.cli.main import run

NOBODY = 65534
DEADLINE = 300.0


def floor(z: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-1, 1, 0.1), np.arange(-1, 1, 0.1))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])


@pytest.fixture(scope="module")
def place() -> Iterator[Path]:
    """Return a folder that every user may enter, with scans, an archive and a walk's ground truth."""
    folder = Path(tempfile.mkdtemp(prefix="solidcloud-outputs-"))
    folder.chmod(0o755)
    try:
        np.savetxt(folder / "floor.xyz", floor(0.0), fmt="%.4f")
        np.savetxt(folder / "more.xyz", floor(0.5), fmt="%.4f")
        build = ["build", str(folder / "floor.xyz"), "-o", str(folder / "hall"), "--keep", "scan"]
        assert run([*build, "--jobs", "1"]) == 0
        assert run(["add", str(folder / "hall"), str(folder / "more.xyz"), "--jobs", "1"]) == 0
        assert run(["make", "facade", "-o", str(folder / "facade.laz"), "--points", "2000"]) == 0
        (folder / "file").write_text("a file, and no folder\n")
        yield folder
    finally:
        shutil.rmtree(folder)


def verbs(place: Path, out: Path) -> dict[str, list[str]]:
    """Return the arguments of each verb that writes, with `out` as its folder."""
    floor_scan, hall, truth = (str(place / name) for name in ("floor.xyz", "hall", "facade.truth.json"))
    return {
        "build": ["build", floor_scan, "-o", str(out / "new"), "--jobs", "1"],
        "inspect": ["inspect", floor_scan, "-o", str(out / "scans.toml")],
        "export laz": ["export", hall, "-o", str(out / "door.laz")],
        "export ply": ["export", hall, "-o", str(out / "door.ply")],
        "export vtkhdf": ["export", hall, "-o", str(out / "door.vtkhdf")],
        "make facade": ["make", "facade", "-o", str(out / "f.laz"), "--points", "2000"],
        "make town": ["make", "town", "-o", str(out / "town"), "--points", "2000"],
        "make office": ["make", "office", "-o", str(out / "office")],
        "make figure": ["make", "figure", "-o", str(out / "f.obj"), "--points", "50"],
        "make walk": ["make", "walk", truth, "-o", str(out / "walk.csv"), "--frames", "5"],
        "scene new": ["scene", "new", hall, "-o", str(out / "hall.toml")],
        "accuracy": ["accuracy", hall, "-o", str(out / "report")],
        "serve --log": ["serve", hall, "--listen", "tcp/127.0.0.1:1", "--log", str(out / "walk.log")],
    }


VERBS = list(verbs(Path(), Path()))


def check_line(capsys: pytest.CaptureFixture[str], path: Path) -> str:
    """Check the one line of an error: it names the output, or the folder in the way."""
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    assert "Errno" not in line and ".tmp" not in line and ".lock" not in line, line
    assert line.startswith(f"error: {path}"), line
    # Location, what was found, what to do.
    assert len(line.removeprefix(f"error: {path}").split(": ")) >= 3, line
    return line


@pytest.mark.parametrize("verb", VERBS)
def test_below_a_file_nothing_can_be_written(
    verb: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(place.rglob("*"))
    assert run(verbs(place, place / "file")[verb]) in (1, 2)
    assert "expected a folder" in check_line(capsys, place / "file")
    assert sorted(place.rglob("*")) == before


@contextmanager
def not_root() -> Iterator[None]:
    """Drop the rights of root, to which permissions do not apply."""
    if os.geteuid() != 0:
        yield
        return
    os.seteuid(NOBODY)
    try:
        yield
    finally:
        os.seteuid(0)


@pytest.mark.parametrize("verb", [*VERBS, "add", "remove"])
def test_without_permission_the_output_is_named(
    verb: str, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    closed = place / "closed"
    closed.mkdir(exist_ok=True)
    closed.chmod(0o555)
    hall = str(place / "hall")
    changes = {
        "add": ["add", hall, str(place / "floor.xyz"), "--again", "--jobs", "1"],
        "remove": ["remove", hall, str(place / "more.xyz"), "--jobs", "1"],
    }
    place.chmod(0o555)
    try:
        with not_root():
            code = run((verbs(place, closed) | changes)[verb])
    finally:
        place.chmod(0o755)
    assert code in (1, 2)
    assert "permission denied" in check_line(capsys, place / "hall" if verb in changes else closed)
    assert not list(closed.iterdir())


def test_a_name_that_is_too_long_is_said(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command in (["make", "figure", "--points", "50"], ["build", str(place / "floor.xyz"), "--jobs", "1"]):
        output = place / "parents" / ("n" * 300 + ".obj")
        assert run([*command, "-o", str(output)]) == 1
        assert "the name is too long: choose a shorter one" in check_line(capsys, output)


def test_accuracy_leaves_nothing_when_it_is_terminated(place: Path, tmp_path: Path) -> None:
    scratch, report = tmp_path / "scratch", tmp_path / "report"
    scratch.mkdir()
    command = [sys.executable, "-P", "-m", "solidcloud.server.cli.main", "accuracy", str(place / "hall")]
    with subprocess.Popen(
        [*command, "-o", str(report)], env={**os.environ, "TMPDIR": str(scratch)}, stderr=subprocess.PIPE
    ) as process:
        deadline = time.monotonic() + DEADLINE
        while not report.is_dir() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        assert list(scratch.glob("solidcloud-accuracy-*"))
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=DEADLINE)
    assert process.returncode == 130 and b"interrupted" in said
    assert not list(scratch.iterdir())
