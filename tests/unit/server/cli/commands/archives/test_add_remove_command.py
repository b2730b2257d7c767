"""Test interrupted `add` and `remove`: nothing is left behind, and the archive's state is printed."""

import os
import signal
from pathlib import Path

import numpy as np
import pytest
import synthetic_scans
from solidcloud.builder.edit import rebuild_voxels as rebuild
from solidcloud.server.cli.main import run


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(("stage", "now"), [("verify_new", 0), ("_dead_bytes", 1)])
def test_who_interrupts_a_change_is_told_what_the_archive_is(
    number: int,
    stage: str,
    now: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (folder := tmp_path / "there").mkdir()
    points = np.random.default_rng(1).uniform(0, 2, (300, 3)).round(3)
    for name, part in (("a", points[:200]), ("b", points[200:])):
        synthetic_scans.write_xyz(tmp_path / f"{name}.xyz", part)
    hall = str(folder / "hall")
    assert run(["build", str(tmp_path / "a.xyz"), "-o", hall, "--jobs", "1", "--keep", "scan"]) == 0
    before = signal.getsignal(signal.SIGTERM)
    capsys.readouterr()
    with monkeypatch.context() as patch:
        patch.setattr(rebuild, stage, lambda *_: os.kill(os.getpid(), number))
        assert run(["add", hall, str(tmp_path / "b.xyz"), "--jobs", "1"]) == 130
    said = capsys.readouterr().err
    assert f"interrupted: {hall} is complete, at generation {now}" in said and said.count("interrupted") == 1
    assert signal.getsignal(signal.SIGTERM) == before
    assert [path.name for path in folder.iterdir()] == ["hall"]
    assert run(["add", hall, str(tmp_path / "b.xyz"), "--jobs", "1", "--new"]) == 2 * now
