"""Test commands interrupted while they read scans: no reader reports a fault of the file."""

import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_scans
from solidcloud.builder.plan import stray_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.server.cli.main import run

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.fixture(autouse=True)
def usual_handler() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


class Interrupting(io.BufferedReader):
    """File that interrupts its reader at the `left`-th read or seek, counted over all such files."""

    left = 0

    @classmethod
    def _count(cls) -> None:
        cls.left -= 1
        if cls.left == 0:
            os.kill(os.getpid(), signal.SIGINT)

    def read(self, *size: Any) -> bytes:
        self._count()
        return super().read(*size)

    def readinto(self, buffer: Any) -> int:
        self._count()
        return super().readinto(buffer)

    def seek(self, *to: Any) -> int:
        self._count()
        return super().seek(*to)


@pytest.fixture(scope="module")
def laz(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a LAZ file of several chunks and a small scan that is always readable."""
    folder = tmp_path_factory.mktemp("laz")
    rng = np.random.default_rng(3)
    synthetic_scans.write_las(folder / "hall.laz", rng.integers(0, 8000, (120_000, 3)))
    synthetic_scans.write_xyz(folder / "few.xyz", rng.uniform(0, 8, (40, 3)).round(3))
    return folder


@pytest.mark.parametrize("number", [1, 20, 30])
def test_an_interrupt_in_a_callback_of_lazrs_loses_no_scan(
    number: int,
    laz: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    command = ["build", str(laz), "-o", str(tmp_path / "hall"), "--jobs", "1", "--skip-bad"]
    opened = Path.open

    def interrupting(path: Path, *mode: Any, **options: Any) -> Any:
        file = opened(path, *mode, **options)
        return Interrupting(file.detach()) if path.suffix == ".laz" and not options else file

    Interrupting.left = number
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", interrupting)
        code = run(command)
    said = capsys.readouterr().err
    assert Interrupting.left <= 0, "there were fewer reads"
    assert code == 130, said
    assert said.count("interrupted") == 1 and "LazrsError" not in said and "left out" not in said
    assert run(command) == 0
    with Archive(tmp_path / "hall") as archive:
        assert archive.header.points == 120_040
        assert not any(source.fault for source in archive.header.sources)


def interrupt_readers(folder: Path, *arguments: str) -> dict[str, Any]:
    """Run the script; return its figures."""
    done = subprocess.run(
        [sys.executable, SCRIPTS / "interrupt_readers", *arguments, "--scratch", folder],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode in (0, 1), done.stderr
    found = json.loads(done.stdout)
    bad = [fault for part in found["formats"].values() for fault in part["bad"]]
    assert found["bad"] == 0 and done.returncode == 0, json.dumps(bad, indent=1)
    return found


def test_an_interrupt_of_each_kind_of_reader_loses_nothing(tmp_path: Path) -> None:
    names = ["laz", "e57", "ptx", "stl sampled"]
    # Few voxels, so that most of a build is reading.
    sizes = ("--count", "1", "--points", "2000", "--voxel", "20")
    found = interrupt_readers(tmp_path, *sizes, "--formats", ",".join(names))["formats"]
    assert list(found) == names
    counts = [part["counts"] for part in found.values()]
    assert all(count["finished"] == 1 for count in counts)
    # A build may end before its interrupt comes.
    assert any(count.get("interrupted") for count in counts)


@pytest.mark.slow
def test_workers_end_quietly_when_the_terminal_interrupts_all(tmp_path: Path) -> None:
    sizes = ("--count", "1", "--points", "4000", "--voxel", "20")
    # This seed's interrupt comes at 0.44 of the build.
    options = ("--formats", "laz", "--real=--jobs 2", "--seed", "4")
    counts = interrupt_readers(tmp_path, *sizes, *options)["formats"]["laz"]["counts"]
    assert counts["finished"] == counts["interrupted"] == 1


@pytest.mark.parametrize("verb", ["inspect", "plan", "add", "validate", "export"])
def test_every_verb_that_reads_can_be_interrupted(
    verb: str, laz: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    hall = tmp_path / "hall"
    assert run(["build", str(laz / "few.xyz"), "-o", str(hall), "--jobs", "1"]) == 0
    before = sorted(path.name for path in tmp_path.iterdir())
    capsys.readouterr()
    words = {
        "inspect": [str(laz), "-o", str(tmp_path / "scans.toml")],
        "plan": [str(laz)],
        "add": [str(hall), str(laz / "hall.laz"), "--jobs", "1"],
        "validate": [str(hall)],
        "export": [str(hall), "-o", str(tmp_path / "out.laz")],
    }[verb]
    read = os.pread if verb in ("validate", "export") else Path.open

    def interrupting(*arguments: Any, **options: Any) -> Any:
        if verb in ("validate", "export") or arguments[0].suffix == ".laz":
            os.kill(os.getpid(), signal.SIGINT)
        return read(*arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(*((os, "pread") if verb in ("validate", "export") else (Path, "open")), interrupting)
        assert run([verb, *words]) == 130
    said = capsys.readouterr().err
    assert said.count("interrupted") == 1 and "error" not in said, said
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_counting_stray_points_can_be_interrupted(
    laz: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    count = stray_points.count_points

    def interrupting(*arguments: Any) -> int:
        os.kill(os.getpid(), signal.SIGINT)
        return count(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(stray_points, "count_points", interrupting)
        assert run(["inspect", str(laz), "--stray", "-o", str(tmp_path / "scans.toml")]) == 130
    said = capsys.readouterr()
    assert said.err.count("interrupted") == 1 and "error" not in said.err and said.out == ""
    assert not (tmp_path / "scans.toml").exists()
