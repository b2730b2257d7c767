"""Test `solidcloud build` from its command line: options, how to resume, and the estimated cost."""

import json
import os
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import solidcloud.builder.pipeline as pipeline
from solidcloud.builder.config import BuildConfig
from solidcloud.schemas.runtime.own_command import own_command
from solidcloud.server.cli.main import run


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    """Write a small scan."""
    path = tmp_path / "floor.xyz"
    np.savetxt(path, np.random.default_rng(1).random((300, 3)), fmt="%.4f")
    return path


def caught_config(arguments: str, scan: Path, monkeypatch: pytest.MonkeyPatch) -> BuildConfig:
    """Return the configuration that a command line produces."""
    caught: list[BuildConfig] = []

    def instead(paths: Any, target: Path, config: BuildConfig, *_: Any) -> Any:
        caught.append(config)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "build_archive", instead)
        with pytest.raises(SystemExit) as stopped:
            raise SystemExit(run(["build", str(scan), "-o", "nowhere", *arguments.split()]))
    assert stopped.value.code == 130
    return caught[0]


def test_every_option_arrives(scan: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = caught_config(
        "--fresh --thin 0.01 --outliers 0.1,5 --moving 0.2,3 --cluster local:2 --overwrite --memory 1GB "
        "--voxel 4 --resolution 0.001 --keep scan,intensity --radius mean,local --strict --skip-bad --jobs 3 "
        "--degree 4 --leaf 16 --cells balanced --spacing 0.1",
        scan,
        monkeypatch,
    )
    assert given == BuildConfig(
        fresh=True,
        thin=0.01,
        outliers=(0.1, 5),
        moving=(0.2, 3),
        cluster="local:2",
        overwrite=True,
        memory_bytes=1 << 30,
        voxel=4.0,
        resolution=0.001,
        keep=frozenset({"scan", "intensity"}),
        models=frozenset({"mean", "local"}),
        strict=True,
        skip_bad=True,
        jobs=3,
        degree=4,
        leaf=16,
        cells="balanced",
        spacing=0.1,
    )
    assert caught_config("", scan, monkeypatch) == BuildConfig()
    assert caught_config("--cell-points 300", scan, monkeypatch) == BuildConfig(cell_points=300)
    assert caught_config("--leaf-cells 4096", scan, monkeypatch) == BuildConfig(leaf_cells=4096)
    assert caught_config("--scheduler tcp://a:1", scan, monkeypatch) == BuildConfig(scheduler="tcp://a:1")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("--cell-points 300 --leaf-cells 40", "--cell-points 300 and --leaf-cells 40: expected only one"),
        ("--leaf-cells 0", "--leaf-cells 0: expected at least 1"),
        ("--cell-points 0", "--cell-points"),
    ],
)
def test_a_wrong_size_or_number_of_cells_is_refused(
    given: str, said: str, scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["build", str(scan), "-o", str(tmp_path / "x"), *given.split()]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_summary_says_what_was_asked_and_what_came_out(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = str(tmp_path / "x")
    given = ["--voxel", "0.5", "--jobs", "1", "--leaf-cells", "40"]
    assert run(["build", str(scan), "-o", target, *given]) == 0
    assert "(--leaf-cells 40)" in capsys.readouterr().out
    assert run(["info", target, "--json"]) == 0
    cells = json.loads(capsys.readouterr().out)["summary"]["cells"]
    assert cells["asked"] == 40 and abs(cells["cells"] - 40) <= 4 and cells["kind"] == "octree"
    assert run(["build", str(scan), "-o", target, *given, "--cells", "balanced", "--overwrite"]) == 0
    assert "all trees have 1 level" in " ".join(capsys.readouterr().out.split())
    assert run(["build", str(scan), "-o", target, *given, "--dry-run"]) == 0
    assert "--leaf-cells" in capsys.readouterr().out


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_who_interrupts_is_told_how_to_go_on(
    number: int,
    scan: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = signal.getsignal(signal.SIGTERM)
    build = ["build", str(scan), "-o", str(tmp_path / "hall"), "--jobs", "1"]
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "build_shards", lambda *_: os.kill(os.getpid(), number))
        with pytest.raises(SystemExit) as stopped:
            raise SystemExit(run(build))
    assert stopped.value.code == 130
    said = capsys.readouterr().err
    assert (
        f"interrupted: completed work is kept in {tmp_path}/.hall.building: the same command resumes" in said
    )
    assert said.count("interrupted") == 1
    assert signal.getsignal(signal.SIGTERM) == before
    assert run(build) == 0
    assert not (tmp_path / ".hall.building").exists()
    capsys.readouterr()
    assert run([*build, "--json"]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["already"] is True
    assert "already complete, with these scans and these options: nothing was built" in told.err
    assert f"Only its index was checked; `{own_command()} validate` reads its records" in told.err


def test_progress_is_json_where_asked_for(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["build", str(scan), "-o", str(tmp_path / "hall"), "--jobs", "1", "--log-json"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    ended = [event["stage"] for event in events if event["event"] == "end"]
    assert ended[:4] == ["survey", "spool", "build", "radius"]


def test_a_dry_run_says_what_it_would_take_and_builds_nothing(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    build = ["build", str(scan), "-o", str(tmp_path / "hall"), "--dry-run"]
    assert run(build) == 0
    assert "disk" in capsys.readouterr().out
    assert run([*build, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["points"] > 0
    assert [p.name for p in tmp_path.iterdir()] == ["floor.xyz"]
