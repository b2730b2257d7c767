"""Test `add`, `remove` and `reload` while a server serves the archive."""

import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import archive_cases
import naive
import numpy as np
import pytest
import synthetic_scans
from solidcloud.builder.edit.edit_archive import add_scans, remove_scans
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.cli.main import run
from solidcloud.server.client import Client
from solidcloud.server.scene import Scene
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig
from test_reload import endpoint as endpoint  # the fixture

BODY = np.array([[0.0, 0, 0], [0.1, 0, 0.1]])
HALL = np.vstack([[[0.0, 0, 0], [2, 2, 2]], synthetic_scans.make_scan("plane", 1, 400)]).round(3)
CHAIR = synthetic_scans.make_scan("pillar", 2, 200).round(3)


@pytest.fixture
def hall(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """Build an archive of one scan, and write another scan beside it."""
    synthetic_scans.write_ply(tmp_path / "hall.ply", HALL)
    synthetic_scans.write_ply(tmp_path / "chair.ply", CHAIR)
    options = ["--voxel", "0.5", "--resolution", "0.001", "--keep", "scan", "--jobs", "1", "--radius", "0.02"]
    assert run(["build", str(tmp_path / "hall.ply"), "-o", str(tmp_path / "hall"), *options]) == 0
    capsys.readouterr()
    return tmp_path / "hall"


def told(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> dict:
    """Return the JSON output of a command."""
    capsys.readouterr()
    assert run([*arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_scans_are_added_and_removed(hall: Path, capsys: pytest.CaptureFixture[str]) -> None:
    chair = str(hall.parent / "chair.ply")
    found = told(["add", str(hall), chair], capsys)
    assert (found["generation"], found["points_before"], found["points"]) == (1, 402, 602)
    assert run(["add", str(hall), chair]) == 2
    assert "is already in the archive" in capsys.readouterr().err
    assert run(["add", str(hall), chair, "--again"]) == 0
    assert "802, before 602" in capsys.readouterr().out
    info = told(["info", str(hall)], capsys)
    assert (info["format_version"], info["generation"], info["points"]) == (3, 2, 802)
    assert run(["info", str(hall)]) == 0
    assert "generation 2" in (shown := capsys.readouterr().out) and "scan 2" in shown
    assert run(["validate", str(hall), "--deep"]) == 0
    assert run(["remove", str(hall), chair]) == 0
    assert "402, before 802" in capsys.readouterr().out
    assert run(["remove", str(hall), "0"]) == 2
    assert "nothing would be left" in capsys.readouterr().err
    assert run(["add", str(hall), str(hall.parent / "none.ply")]) == 3
    assert run(["add", str(hall.parent), chair]) == 3
    assert "no archive here" in capsys.readouterr().err


def test_points_that_are_left_out_are_said_or_refused(hall: Path, capsys: pytest.CaptureFixture[str]) -> None:
    points = CHAIR.copy()
    points[[3, 5, 8]] = np.nan
    holes = str(synthetic_scans.write_ply(hall.parent / "holes.ply", points))
    assert run(["add", str(hall), holes, "--strict"]) == 3
    assert "holes.ply: 3 points that are not finite, expected none with --strict" in capsys.readouterr().err
    assert told(["add", str(hall), holes], capsys)["skipped"] == {"not finite": 3}
    assert run(["add", str(hall), holes, "--again", "--new"]) == 2
    assert "--new and --again together" in capsys.readouterr().err
    assert run(["add", str(hall), holes, "--again"]) == 0
    assert "3 points: not finite" in capsys.readouterr().out
    assert told(["remove", str(hall), holes], capsys)["skipped"] == {}


def start_adding(hall: Path) -> subprocess.Popen[str]:
    """Start `solidcloud add` with workers in a separate process, and wait until it has begun."""
    command = ["add", str(hall), str(hall.parent / "chair.ply"), "--jobs", "2"]
    process = subprocess.Popen(
        [sys.executable, "-m", "solidcloud.server.cli.main", *command], stderr=subprocess.PIPE, text=True
    )
    deadline = time.monotonic() + 120
    while not (hall.parent / ".hall.changing" / "spool").exists():
        assert process.poll() is None and time.monotonic() < deadline, "it did not begin"
        time.sleep(0.001)
    return process


def test_nothing_is_left_of_a_change_that_is_told_to_end(hall: Path) -> None:
    before = sorted(hall.parent.iterdir())
    with start_adding(hall) as process:
        process.terminate()
        _, said = process.communicate(timeout=120)
    assert process.returncode == 130 and f"interrupted: {hall} is complete, at generation 0" in said
    assert sorted(hall.parent.iterdir()) == before
    assert run(["validate", str(hall), "--deep"]) == 0


@pytest.mark.parametrize("following", ["add", "remove", "build"])
def test_a_change_that_was_killed_keeps_nobody_off(
    hall: Path, following: str, capsys: pytest.CaptureFixture[str]
) -> None:
    scan, chair = (str(hall.parent / name) for name in ("hall.ply", "chair.ply"))
    if following == "remove":
        assert run(["add", str(hall), chair]) == 0
        (hall.parent / "chair.ply").rename(hall.parent / "old.ply")
        synthetic_scans.write_ply(hall.parent / "chair.ply", CHAIR[:100])
    with start_adding(hall) as process:
        process.kill()
    assert (hall.parent / ".hall.changing").is_dir(), "nobody could tidy up"
    capsys.readouterr()
    assert run(["validate", str(hall), "--deep"]) == 0
    if following == "build":
        options = ["--voxel", "0.5", "--resolution", "0.001", "--keep", "scan", "--radius", "0.02"]
        found = told(["build", scan, "-o", str(hall), "--jobs", "1", "--overwrite", *options], capsys)
        assert found["points"] == len(HALL)
    elif following == "add":
        assert told(["add", str(hall), chair], capsys)["points"] == len(HALL) + len(CHAIR)
    else:
        assert told(["remove", str(hall), "1"], capsys)["points"] == len(HALL)
    assert run(["validate", str(hall), "--deep"]) == 0
    if following != "build":  # which leaves the folder as it is: the next change removes it
        assert not (hall.parent / ".hall.changing").exists()
    assert told(["add", str(hall), chair, "--again"], capsys)["generation"] >= 1
    assert not list(hall.parent.glob(".hall*"))


def test_the_stored_figure_stays_and_info_says_how_far_it_is_off(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    synthetic_scans.write_ply(tmp_path / "one.ply", HALL)
    synthetic_scans.write_ply(tmp_path / "two.ply", HALL + 0.011)
    target = str(tmp_path / "x")
    assert run(["build", str(tmp_path / "one.ply"), "-o", target, "--voxel", "0.5", "--jobs", "1"]) == 0
    capsys.readouterr()
    before = told(["info", target], capsys)
    assert (before["generation"], before["radius_now"]) == (0, None)
    added = told(["add", target, str(tmp_path / "two.ply")], capsys)
    info = told(["info", target], capsys)
    assert info["radius"] == before["radius"] == added["radius"]
    assert info["radius_now"] == added["radius_now"] < info["radius"]
    assert run(["info", target]) == 0
    shown = capsys.readouterr().out
    off = 100 * (info["radius_now"] / info["radius"] - 1)
    assert "radius now" in shown and f"({off:+.1f} %)" in shown


def test_an_archive_grows_and_shrinks_while_it_is_served(hall: Path, endpoint: str) -> None:
    """Test that no request is lost and that each answer is true of some generation of the archive."""
    rng = np.random.default_rng(6)
    poses = archive_cases.near_poses(rng, np.vstack([HALL, CHAIR]), BODY, 150, 0.1)
    place = (np.zeros(3), 0.001, 0.02)
    truths = [
        naive.collide(points, *place, BODY, 0.01, poses).astype(np.uint8)
        for points in (HALL, np.vstack([HALL, CHAIR]))
    ]
    assert (truths[0] != truths[1]).sum() > 20
    stop, found = threading.Event(), []

    def ask() -> None:
        with Client(endpoint, scene="hall", timeout=60.0) as client:
            client.add_avatar("al", BODY, 0.01)
            while not stop.is_set():
                found.append(client.collide("al", poses).verdict)

    chair = hall.parent / "chair.ply"
    with (
        Scene.open(hall) as scene,
        serving([scene], ServerConfig(listen=endpoint, max_request_seconds=60.0)),
        Client(endpoint, scene="hall", timeout=60.0) as client,
    ):
        client.add_avatar("al", BODY, 0.01)
        thread = threading.Thread(target=ask)
        thread.start()
        try:
            for number in range(3):
                add_scans(hall, [chair], jobs=1)
                assert np.array_equal(client.collide("al", poses).verdict, truths[0]), "until it is told"
                answer = client.reload()
                assert (answer.generation_before, answer.generation_after) == (2 * number, 2 * number + 1)
                assert np.array_equal(client.collide("al", poses).verdict, truths[1])
                remove_scans(hall, [str(chair)], jobs=1)
                assert np.array_equal(client.collide("al", poses).verdict, truths[1])
                assert client.reload().points == len(HALL)
                assert np.array_equal(client.collide("al", poses).verdict, truths[0])
        finally:
            stop.set()
            thread.join(60.0)
    assert len(found) > 20
    for verdicts in found:
        assert not (verdicts == Verdict.UNKNOWN).any()
        assert any(np.array_equal(verdicts, truth) for truth in truths)
