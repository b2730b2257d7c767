"""Test that `scene new` proposes a spawn where the avatars stand on a floor near the middle."""

from pathlib import Path

import numpy as np
import pytest
from small_builds import build
from solidcloud.schemas.scene.scene_file import read_scene
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars.avatar_shape import read_avatar
from solidcloud.server.cli.main import run
from solidcloud.server.scene import Scene

STEP = 0.06
Box = tuple[tuple[float, float, float], tuple[float, float, float]]
# A hall of 6 x 5 x 3 m, with a table in the middle, far from the origin.
ORIGIN = np.array([2600.0, -1200.0, 400.0])
FLOOR: Box = ((0, 0, 0), (6, 5, 0))
ROOF: Box = ((0, 0, 3), (6, 5, 3))
WALLS: list[Box] = [
    ((0, 0, 0), (0, 5, 3)),
    ((6, 0, 0), (6, 5, 3)),
    ((0, 0, 0), (6, 0, 3)),
    ((0, 5, 0), (6, 5, 3)),
]
TABLE: Box = ((2.5, 2, 0.75), (3.5, 3, 0.75))


def sheet(box: Box) -> np.ndarray:
    """Return points of a flat sheet that spans a box, one side of which is 0."""
    axes = [np.arange(a, b + STEP / 2, STEP) for a, b in zip(*box, strict=True)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)


def archive(folder: Path, boxes: list[Box]) -> Path:
    scan = folder / "hall.xyz"
    np.savetxt(scan, np.vstack([sheet(box) for box in boxes]) + ORIGIN, fmt="%.4f")
    build([scan], folder / "hall", voxel=2.0, leaf=32)
    return folder / "hall"


def propose(folder: Path, boxes: list[Box], *options: str) -> np.ndarray | None:
    """Return the spawn of a new scene file, from ORIGIN [m]; None if it has none."""
    path = folder / "hall.toml"
    assert run(["scene", "new", str(archive(folder, boxes)), "-o", str(path), *options]) == 0
    spawn = read_scene(path).spawn
    return None if spawn is None else np.array(spawn.position) - ORIGIN


def write_box(path: Path, low: tuple[float, float, float], high: tuple[float, float, float]) -> Path:
    """Write the points of a box's surface, 5 cm apart."""
    axes = [np.arange(a, b + 0.02, 0.05) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    rim = ((grid < np.array(low) + 1e-9) | (grid > np.array(high) - 0.03)).any(axis=1)
    np.savetxt(path, grid[rim], fmt="%.4f")
    return path


def test_it_stands_on_the_floor_beside_the_table_and_not_on_the_roof(tmp_path: Path) -> None:
    at = propose(tmp_path, [FLOOR, ROOF, *WALLS, TABLE])
    assert at is not None
    assert 0.03 <= at[2] < 0.2, "on the floor"
    assert np.hypot(at[0] - 3, at[1] - 2.5) < 1.6, "near the middle"
    said = (tmp_path / "hall.toml").read_text().replace("\n# ", " ")
    assert "a figure of 1.75 m clear, 0.03 m above a floor" in said


def test_the_proposed_place_is_clear_and_a_little_lower_it_is_not(tmp_path: Path) -> None:
    body = write_box(tmp_path / "robot.xyz", (-0.3, -0.2, 0.1), (0.3, 0.2, 0.8))
    at = propose(tmp_path, [FLOOR, *WALLS], "--avatar", str(body))
    assert at is not None
    with Scene.open(tmp_path / "hall") as scene:
        scene.add_avatar("robot", read_avatar(body).points)
        poses = np.tile(np.eye(4), (2, 1, 1))
        poses[:, :3, 3] = at + ORIGIN
        poses[1, 2, 3] -= 0.04
        assert scene.collide("robot", poses).verdict.tolist() == [Verdict.CLEAR, Verdict.CONTACT]
    assert "robot clear" in (tmp_path / "hall.toml").read_text().replace("\n# ", " ")


def test_every_avatar_is_clear(tmp_path: Path) -> None:
    low = write_box(tmp_path / "low.xyz", (-0.3, -0.2, -0.6), (0.3, 0.2, 0.0))
    high = write_box(tmp_path / "high.xyz", (-0.2, -0.2, 0.0), (0.2, 0.2, 1.2))
    at = propose(tmp_path, [FLOOR, *WALLS], "--avatar", str(low), "--avatar", str(high))
    assert at is not None and 0.6 < at[2] < 0.8


def test_where_nobody_can_stand_the_file_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert propose(tmp_path, [WALLS[0]]) is None
    said = (tmp_path / "hall.toml").read_text().replace("\n# ", " ")
    assert "No place near the middle was found where a figure of 1.75 m would stand clear on a floor" in said
    assert "#[spawn]" in said
    assert "no place to stand was found" in capsys.readouterr().err
    assert run(["scene", "check", str(tmp_path / "hall.toml")]) == 0
