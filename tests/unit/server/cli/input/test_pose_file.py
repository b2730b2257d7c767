"""Test pose files: written values read back, quaternions are checked, an invalid line is named."""

import os
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from solidcloud.schemas.errors import BadRequestError, ScanError
from solidcloud.server.cli.input.pose_file import (
    RAY_COLUMNS,
    parse_path,
    read_path,
    read_poses,
    read_rays,
    write_poses,
)

HEADER = "t,x,y,z,qw,qx,qy,qz\n"


def random_poses(rng: np.random.Generator, count: int) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.uniform(-5e6, 5e6, (count, 3))
    return poses


def test_written_poses_read_back(tmp_path: Path, rng: np.random.Generator) -> None:
    times, poses = np.arange(500) / 30, random_poses(rng, 500)
    # Half turns and the identity, where a component of the quaternion is zero.
    poses[:4, :3, :3] = [np.diag(d) for d in ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])]
    write_poses(tmp_path / "walk.csv", times, poses)
    found_times, found = read_poses(tmp_path / "walk.csv")
    assert np.array_equal(found_times, times)
    assert np.array_equal(found[:, :3, 3], poses[:, :3, 3])
    assert np.abs(found[:, :3, :3] - poses[:, :3, :3]).max() < 1e-14
    assert [path.name for path in tmp_path.iterdir()] == ["walk.csv"]


def test_a_failure_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "walk.csv").write_text("before")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_poses(tmp_path / "walk.csv", np.zeros(1), np.eye(4)[None])
    assert [path.read_text() for path in tmp_path.iterdir()] == ["before"]


def test_quaternions_turn_as_scipy_says(tmp_path: Path, rng: np.random.Generator) -> None:
    q = Rotation.random(200, rng=rng).as_quat(scalar_first=True)
    rows = "".join(f"0,1,2,3,{','.join(map(repr, row))}\n" for row in q.tolist())
    (tmp_path / "a.csv").write_text(HEADER + rows)
    expected = Rotation.from_quat(q, scalar_first=True).as_matrix()
    assert np.abs(read_poses(tmp_path / "a.csv")[1][:, :3, :3] - expected).max() < 1e-14


@pytest.mark.parametrize("code", ["utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize("name", ["walk.csv", "walk.tum", "rays.csv"])
def test_the_text_of_any_editor_is_read(name: str, code: str, tmp_path: Path) -> None:
    """Issue 35: of a spreadsheet, of a redirection on Windows, and with an old comment."""
    path, rows = tmp_path / name, "1,2,3,0,0,1"
    text = f"{','.join(RAY_COLUMNS)}\n{rows}\n" if name == "rays.csv" else f"{HEADER}0,1,2,3,1,0,0,0\n"
    text = "# für\n0 1 2 3 0 0 0 1\n" if name == "walk.tum" else text
    path.write_bytes(text.encode(code))
    assert (read_rays(path)[0] if name == "rays.csv" else read_path(path)[1][:, :3, 3]).tolist() == [
        [1, 2, 3]
    ]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("0,0,0,0,1.01,0,0,0", "quaternion of length 1.01"),
        ("0,0,0,0,0,0,0,0", "quaternion of length 0"),
        ("0,0,0,0,1,0,0", "7 values: expected 8"),
        ("0,0,zero,0,1,0,0,0", "'zero'"),
        ("0,0,nan,0,1,0,0,0", "finite"),
        ("0,0,1e999,0,1,0,0,0", "finite"),
    ],
)
def test_wrong_line_is_named(line: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(HEADER + "0,0,0,0,1,0,0,0\n" + line + "\n")
    with pytest.raises(BadRequestError, match=r"a\.csv, line 3: ") as found:
        read_poses(tmp_path / "a.csv")
    assert said in str(found.value)


def test_columns_may_stand_in_any_order_but_must_be_these(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("qw,qx,qy,qz,z,y,x,t\r\n1,0,0,0,3,2,1,9\r\n")
    times, poses = read_poses(tmp_path / "a.csv")
    assert times.tolist() == [9] and poses[0, :3, 3].tolist() == [1, 2, 3]
    (tmp_path / "b.csv").write_text("t,x,y,z,roll,pitch,yaw\n")
    with pytest.raises(BadRequestError, match="line 1: columns t,x,y,z,roll,pitch,yaw"):
        read_poses(tmp_path / "b.csv")
    (tmp_path / "c.csv").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ScanError, match=r"c\.csv"):
        read_poses(tmp_path / "c.csv")


def test_suffix_selects_the_format_of_a_path(tmp_path: Path) -> None:
    tum, table = "# time tx ty tz qx qy qz qw\n2.5 1 2 3 0 0 0 1\n", HEADER + "2.5,1,2,3,1,0,0,0\n"
    for name, text in (("a.tum", tum), ("a.TXT", tum), ("a.csv", table), ("a", table)):
        (tmp_path / name).write_text(text, encoding="utf-8")
        for times, poses in (read_path(tmp_path / name), parse_path(name, text)):
            assert times.tolist() == [2.5]
            assert poses[0, :3, 3].tolist() == [1, 2, 3]
    with pytest.raises(BadRequestError, match=r"walk\.tum, line 1: 1 values: expected timestamp tx ty tz"):
        parse_path("walk.tum", table)
    with pytest.raises(BadRequestError, match=r"walk\.csv, line 1: columns .*: expected t,x,y,z,qw,qx,qy,qz"):
        parse_path("walk.csv", tum)
