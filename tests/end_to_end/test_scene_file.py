"""Test a server of a scene file, over zenoh, with clients that add nothing."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from solidcloud.schemas.errors import UnknownAvatarError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.cli.main import run
from solidcloud.server.client import Client
from solidcloud.server.report.walk.server_process import served

BALL, SCAN = 0.05, 0.03
HOLE = np.array([[-0.45, -0.45, -1.0], [0.45, 0.45, 1.0]])
# Pose of the second archive: rotated by a quarter turn about z, then translated.
TURN = np.array([[0.0, -1.0, 0.0, 6.0], [1.0, 0.0, 0.0, 0.5], [0.0, 0.0, 1.0, 1.25], [0.0, 0.0, 0.0, 1.0]])

SCENE = f"""
format = 1
name = "two-floors"
radius_model = "fixed:{SCAN}"
spawn = {{position = [0.0, 0.0, 1.0], heading = 90.0}}

[[archives]]
path = "lower"
[[archives]]
path = "upper"
pose = {TURN.tolist()}

[[avatars]]
name = "ball"
file = "ball.xyz"
radius = {BALL}

[[effects]]
effect = "through"
boxes = [{{name = "hole", low = {HOLE[0].tolist()}, high = {HOLE[1].tolist()}}}]
[[effects]]
effect = "sweep"
[[effects]]
effect = "stop"
skin = 0.004
[[effects]]
effect = "proximity"
"""


def floor(width: float, depth: float) -> np.ndarray:
    """Return a level floor at z = 0, points 0.1 m apart."""
    x, y = np.meshgrid(np.arange(-width, width + 0.05, 0.1), np.arange(-depth, depth + 0.05, 0.1))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]).round(4)


def truth() -> np.ndarray:
    """Return the points (n, 3) of the scene."""
    lower, upper = floor(1.0, 1.0), floor(1.0, 0.5) @ TURN[:3, :3].T + TURN[:3, 3]
    return np.concatenate([lower[~((lower >= HOLE[0]) & (lower <= HOLE[1])).all(axis=1)], upper])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("floors")
    for name, points in (("lower", floor(1.0, 1.0)), ("upper", floor(1.0, 0.5))):
        np.savetxt(folder / f"{name}.xyz", points, fmt="%.4f")
        build = [
            "build",
            str(folder / f"{name}.xyz"),
            "-o",
            str(folder / name),
            "--voxel",
            "1",
            "--jobs",
            "1",
        ]
        assert run(build) == 0
    (folder / "ball.xyz").write_text("0 0 0\n")
    (folder / "scene.toml").write_text(SCENE)
    return folder


def test_a_server_of_a_scene_file_serves_what_it_says(folder: Path) -> None:
    rng = np.random.default_rng(3)
    places = np.concatenate([rng.uniform([-1.2, -1.2, -0.1], [1.2, 1.2, 0.2], (150, 3)),
                             rng.uniform([5.3, -0.7, 1.1], [6.7, 1.7, 1.4], (150, 3))])  # fmt: skip
    nearest = np.linalg.norm(places[:, None] - truth(), axis=2).min(axis=1)
    # The lattice moves points by up to its step of 0.1 mm.
    sure = np.abs(nearest - BALL - SCAN) > 1e-3
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    with served(folder / "scene.toml", None, "--cache", "64MB") as endpoint:
        with Client(endpoint, scene="two-floors") as client:
            info = client.info()
            assert info.effects == ["through", "stop", "sweep", "proximity"]
            assert [(a.name, a.points, a.radius) for a in info.avatars] == [("ball", 1, BALL)]
            assert (
                info.spawn is not None
                and info.spawn.heading == 90.0
                and info.default_radius_model == "fixed:0.03"
            )
            found = client.collide("ball", poses).verdict == Verdict.CONTACT
            assert 40 < found.sum() < 260
            assert np.array_equal(found[sure], (nearest < BALL + SCAN)[sure])
            with pytest.raises(UnknownAvatarError, match="'cube' is not known"):
                client.collide("cube", poses)
            high, low = np.eye(4)[None], np.eye(4)[None]
            for x, y, expected in ((0.8, 0.8, BALL + SCAN), (0.0, 0.0, -1.0), (6.0, 0.5, 1.25 + BALL + SCAN)):
                high[0, :3, 3], low[0, :3, 3] = (x, y, 2.0), (x, y, -1.0)
                moved = client.move("ball", high, low)
                assert moved.simulated == ["stop", "sweep", "proximity"] and moved.verdict == Verdict.CLEAR
                least = 0.0 if expected == -1.0 else 0.004
                assert expected + least - 1e-3 <= moved.pose[0, 2, 3] <= expected + least + 2e-3
                assert len(moved.touched) == (expected != -1.0)
                assert moved.proximity is not None
        with Client(endpoint, scene="two-floors") as other:
            assert np.array_equal(other.collide("ball", poses).verdict == Verdict.CONTACT, found)


def test_a_new_scene_file_is_checked_served_and_asked(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Use the commands as a user does, in folders with spaces in their names."""
    home = tmp_path / "my scenes"
    home.mkdir()
    shutil.copytree(folder / "lower", tmp_path / "my scans/ground floor")
    np.savetxt(tmp_path / "my ball.xyz", [[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]])
    (home / "poses of a walk.csv").write_text("t,x,y,z,qw,qx,qy,qz\n0,0,0,0.5,1,0,0,0\n1,0,0,0.02,1,0,0,0\n")
    file = home / "ground.toml"
    begin = ["scene", "new", str(tmp_path / "my scans/ground floor"), "-o", str(file)]
    begin += ["--avatar", str(tmp_path / "my ball.xyz"), "--effects", "stop,sweep,proximity"]
    assert run(begin) == 0
    assert run(["scene", "check", str(file), "--json"]) == 0
    checked = json.loads(capsys.readouterr().out.partition("\n")[2])
    assert checked["order"] == ["stop", "sweep", "proximity"] and checked["notes"] == []
    with served(file, None) as endpoint:
        with Client(endpoint, scene="ground") as client:
            info = client.info()
            assert info.effects == checked["order"] and info.points == checked["archives"][0]["points"]
            assert [avatar.name for avatar in info.avatars] == ["my-ball"]
        ask = ["query", "--scene", "ground", "--connect", endpoint, "--avatar", str(tmp_path / "my ball.xyz")]
        ask += ["--poses", str(home / "poses of a walk.csv"), "--json"]
        capsys.readouterr()
        assert run(ask) == 0
        # Points 0.1 m apart have a radius of 0.05; so does the avatar.
        assert [a["verdict"] for a in json.loads(capsys.readouterr().out)["answers"]] == ["clear", "contact"]
        assert run([*ask, "--op", "move"]) == 0
        (moved,) = json.loads(capsys.readouterr().out)
        assert moved["simulated"] == checked["order"] and 0.1 < moved["pose"][0][2][3] < 0.11


def test_a_server_of_a_scene_file_that_is_wrong_ends_with_one_line(folder: Path) -> None:
    (folder / "wrong.toml").write_text(SCENE.replace('path = "upper"', 'path = "attic"'))
    command = [sys.executable, "-P", "-m", "solidcloud.server.cli.main", "serve", str(folder / "wrong.toml")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 3
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    assert f"wrong.toml: $.archives[1].path: {folder / 'attic'}: no archive here" in line
