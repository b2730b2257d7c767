"""Test the floor of an archive, on which made users walk, and walks of the user's own."""

from pathlib import Path

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.errors import BadDataError, BadRequestError
from solidcloud.server.report.load.users import user_traces
from solidcloud.server.report.load.users.archive_floor import ArchiveFloor, make_floor, read_floor
from solidcloud.server.report.load.users.own_walks import read_walk, repeat_walks
from solidcloud.server.report.load.users.user_traces import KINDS
from solidcloud.server.report.load.users.walking_motion import SOLE_HEIGHT


def slope() -> ArchiveFloor:
    """Return a floor of 20 m by 10 m that rises by 0.1 m a metre along x."""
    x, y = np.meshgrid(np.arange(0.5, 20), np.arange(0.5, 10))
    xy = np.column_stack([x.ravel(), y.ravel()])
    return make_floor(xy, 0.1 * xy[:, 0])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [1, 200], ids=["one place", "a hall"])
def test_users_of_every_kind_walk_on_any_floor(kind: str, size: int) -> None:
    floor = slope()
    floor = floor._replace(places=floor.places[:size])
    made = user_traces.traces(kind, floor, 3, 4.0, seed=1)
    again = user_traces.traces(kind, floor, 3, 4.0, seed=1)
    assert len(made.user) == 3 * 120 and np.array_equal(made.pose, again.pose)
    assert np.isfinite(made.pose).all()
    place = made.pose[:, :3, 3]
    assert np.abs(place[:, 2] - floor.floor(place[:, :2]) - SOLE_HEIGHT).max() < 0.2
    assert (place[:, :2] > -3).all() and (place[:, :2] < 23).all()


def test_the_floor_of_an_archive_is_found_under_its_ceiling(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.arange(0, 12, 0.1), np.arange(0, 8, 0.1))
    level = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 1.02)])
    scan = tmp_path / "hall.xyz"
    np.savetxt(scan, np.concatenate([level, level + (0, 0, 3.0)]), fmt="%.4f")  # noqa: RUF005
    build_archive([scan], tmp_path / "hall", BuildConfig(jobs=1, voxel=4.0))
    floor = read_floor(tmp_path / "hall", 0.5)
    assert len(floor.places) > 60
    assert np.abs(floor.floor(floor.places) - 1.52).max() < 0.06
    sparse = tmp_path / "sparse.xyz"
    np.savetxt(sparse, level[::97], fmt="%.4f")
    build_archive([sparse], tmp_path / "sparse", BuildConfig(jobs=1))
    with pytest.raises(BadDataError, match=r"no square metre of a floor.*--walk"):
        read_floor(tmp_path / "sparse", 0.5)


CSV = "t,x,y,z,qw,qx,qy,qz\n" + "".join(f"{10 + 0.1 * k},{k},0,0,1,0,0,0\n" for k in range(11))
TUM = "# timestamp tx ty tz qx qy qz qw\n" + "".join(
    f"{1e9 + 0.1 * k:.1f} {k} 0 0 0 0 0.7071 0.7071\n" for k in range(11)
)


def test_own_walks_are_followed_there_and_back(tmp_path: Path) -> None:
    (tmp_path / "walk.csv").write_text(CSV)
    (tmp_path / "walk.txt").write_text(TUM)
    csv, tum = read_walk(tmp_path / "walk.csv"), read_walk(tmp_path / "walk.txt")
    assert csv.time == pytest.approx(np.arange(11) * 0.1) and tum.time == pytest.approx(csv.time, abs=1e-6)
    assert np.array_equal(csv.pose[:, 0, 3], np.arange(11)) and np.array_equal(
        tum.pose[:, 0, 3], np.arange(11)
    )
    assert tum.pose[3, :3, :3] == pytest.approx(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), abs=1e-3)
    trace = repeat_walks([csv, tum], 3, 2.4)
    assert (np.diff(trace.time) >= 0).all() and trace.time[-1] < 2.4
    first = user_traces.of_users(trace, [0])
    assert first.pose[:, 0, 3].tolist() == [*range(11), *range(9, -1, -1), 1, 2, 3]
    assert user_traces.of_users(trace, [2]).pose[0, 0, 3] == 5, (
        "the second user of a walk starts in its middle"
    )


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.csv", CSV.splitlines()[0] + "\n0,0,0,0,1,0,0,0\n", "1 poses, expected a walk of at least two"),
        ("a.tum", "1 2 3\n", "line 1: 3 values"),
        ("a.tum", "0 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 2\n", "line 2: quaternion of length 2"),
    ],
)
def test_a_file_that_is_no_walk_is_named(tmp_path: Path, name: str, text: str, said: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(BadRequestError, match=said):
        read_walk(tmp_path / name)
