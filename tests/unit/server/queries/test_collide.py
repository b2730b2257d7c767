"""`collide`: verdicts when something is missing, requests in pieces, and what is refused."""

import os
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import BadRequestError, BadTransformError, TooLargeError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.scene import Scene

CLEAR, CONTACT, UNKNOWN = Verdict


def at(*places: tuple[float, float, float]) -> NDArray[np.float64]:
    """Poses that move the avatar without turning it."""
    return np.array([archive_cases.pose_of(np.eye(3), np.array(place)) for place in places])


def flip_a_byte(archive: Path, voxel: tuple[int, int, int]) -> str:
    """Damage the points of one voxel's record; returns where it lies."""
    with Archive(archive) as opened:
        row = int(np.flatnonzero((opened.coordinates == voxel).all(axis=1))[0])
        entry, where = opened.voxels[row], opened.where(row)
        path = opened.shard_path(int(entry["shard"]))
    with open(path, "r+b") as file:
        offset = int(entry["frame_offset"][2]) + int(entry["frame_bytes"][2]) // 2
        byte = os.pread(file.fileno(), 1, offset)[0]
        os.pwrite(file.fileno(), bytes([byte ^ 1]), offset)
    return where


@pytest.mark.interpreted
def test_a_corrupt_record_is_unknown_where_it_matters_and_nowhere_else(tmp_path: Path) -> None:
    row = np.column_stack([np.arange(0, 4, 0.1), np.zeros(40), np.zeros(40)])
    case = archive_cases.build(tmp_path, row, voxel=1.0, resolution=1e-3)
    where = flip_a_byte(case.archive, (1, 0, 0))
    poses = at((0.5, 0.5, 0), (1.5, 0.05, 0), (1.5, 0.005, 0), (0.92, 0.0, 0), (2.5, 0.0, 0), (3.0, 9, 9))
    with Scene.open(case.archive) as scene:
        scene.add_avatar("ball", [[0.0, 0, 0]], 0.03)
        scene.add_avatar("long", [[0.0, 0, 0], [0.6, 0, 0]], 0.03)
        for _ in range(2):  # read once, remembered after
            answers = scene.collide("ball", poses)
            # 5 cm above the row is out of reach by the index; contact beside the missing voxel is one.
            assert answers.verdict.tolist() == [CLEAR, CLEAR, UNKNOWN, CONTACT, CONTACT, CLEAR]
            assert answers.voxels_missing[[0, 1, 2, 4, 5]].tolist() == [0, 0, 1, 0, 0]
            assert len(answers.faults) == 1 and answers.faults[0].startswith(where)
        assert scene.collide("long", at((1.5, 0, 0))).verdict.tolist() == [CONTACT]
        scene.residency.check()
        assert scene.residency.stats.misses == 3, "of four voxels the last is out of every reach"


def test_a_pose_over_the_budget_is_looked_at_in_pieces(tmp_path: Path, rng: np.random.Generator) -> None:
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan("noise", 2, 1000), voxel=0.5, radius=0.01)
    avatar = rng.uniform(
        0, synthetic_scans.SIZE, (8, 3)
    )  # as large as the scan: poses reach nearly every voxel
    poses = np.concatenate(
        [archive_cases.near_poses(rng, case.points, avatar, 12, 0.05), at((0, 0, 0), (99, 0, 0))]
    )
    expected = case.judge(avatar, 0.02, poses)
    with Scene.open(case.archive) as scene:
        everything, largest = scene.info().resident_bytes, 64 + int(scene.residency.bytes_of([0])) * 3
        scene.add_avatar("avatar", avatar, 0.02)
        whole = scene.collide("avatar", poses)
    assert whole.verdict.tolist() == expected.tolist() and 2 < expected.sum() < 13
    for budget in (everything // 2, everything // 7, largest):
        with Scene.open(case.archive, budget_bytes=budget) as scene:
            scene.add_avatar("avatar", avatar, 0.02)
            answers = scene.collide("avatar", poses)
            assert answers.verdict.tolist() == whole.verdict.tolist()
            assert (answers.voxels_missing == 0).all() and scene.residency.stats.evicted > 0
            assert answers.resident_bytes <= budget
            scene.residency.check()


def broken_las(path: Path, corner: float) -> None:
    """A LAS whose header promises points in [corner, corner + 1]^3, and which ends half way."""
    raw = np.random.default_rng(1).integers(0, 1001, (500, 3))
    raw[:2] = [[0, 0, 0], [1000, 1000, 1000]]
    synthetic_scans.write_las(path, raw, offset=(corner, corner, corner))
    os.truncate(path, path.stat().st_size // 2)


def test_the_region_of_a_scan_left_out_is_unknown(tmp_path: Path) -> None:
    good = synthetic_scans.write_ply(tmp_path / "good.ply", synthetic_scans.make_scan("plane", 1, 200))
    broken_las(tmp_path / "broken.las", 10.0)
    options = BuildConfig(skip_bad=True, jobs=1, resolution=1e-3, radius=0.01)
    build_archive([good, tmp_path / "broken.las"], tmp_path / "archive", options)
    places = [(5.0, 5, 5), (10.5, 10.5, 10.5), (9.95, 10.5, 10.5), (9.8, 10.5, 10.5), (11.2, 10.5, 10.5)]
    with Scene.open(tmp_path / "archive") as scene:
        scene.add_avatar("ball", [[0.0, 0, 0]], 0.1)
        answers = scene.collide("ball", at(*places))
        assert answers.verdict.tolist() == [CLEAR, UNKNOWN, UNKNOWN, CLEAR, CLEAR]
        assert answers.outside.all(), "no stored point lies as far out"
        assert "broken.las" in scene.info().skipped[0]
        # A contact found wins over anything missing: a bar from a point of the scan into the region.
        point = synthetic_scans.make_scan("plane", 1, 200)[0]
        scene.add_avatar("bar", np.linspace(point, [10.5, 10.5, 10.5], 50), 0.1)
        assert scene.collide("bar", at((0, 0, 0))).verdict.tolist() == [CONTACT]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A scene of one plane, with a ball."""
    case = archive_cases.build(tmp_path_factory.mktemp("scene"), synthetic_scans.make_scan("plane", 1, 100))
    opened = Scene.open(case.archive)
    opened.add_avatar("ball", [[0.0, 0, 0]], 0.1)
    # The engine answers an avatar without points, `add_avatar` refuses it.
    opened._avatars.provide("nobody", make_avatar(np.empty((0, 3))))
    return opened


def changed(row: int, column: int, value: float) -> NDArray[np.float64]:
    """Two poses, the second with one entry changed."""
    poses = np.stack([np.eye(4), np.eye(4)])
    poses[1, row, column] = value
    return poses


@pytest.mark.interpreted
@pytest.mark.parametrize("avatar", ["ball", "nobody"])
@pytest.mark.parametrize(
    ("poses", "error", "message"),
    [
        (changed(0, 0, np.nan), BadRequestError, "pose 1 holds nan"),
        (changed(2, 3, -np.inf), BadRequestError, "pose 1 holds -inf"),
        (changed(0, 1, 1.0), BadTransformError, "pose 1 shears"),
        (changed(0, 0, 1.1), BadTransformError, "pose 1 shears"),
        (changed(2, 2, -1.0), BadTransformError, "pose 1 mirrors"),
        (changed(3, 0, 0.5), BadTransformError, "pose 1 has a last row that is not 0 0 0 1"),
        (changed(0, 3, 2e9), BadTransformError, "pose 1 translates by 2e"),
        (
            np.diag([1.02, 1.02, 1.02, 1.0])[None],
            BadTransformError,
            r"pose 0 scales by 1\.02: expected a rigid pose, .*: add a scaled avatar, add_avatar\(.*scale=1\.02\)",
        ),
        (np.eye(3), BadRequestError, "shape"),
        (np.zeros((2, 4, 3)), BadRequestError, "shape"),
        ([[["a"] * 4] * 4], BadRequestError, "expected an array of numbers"),
    ],
)
def test_a_bad_pose_is_refused_by_number_and_reason(
    scene: Scene, avatar: str, poses: object, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message) as caught:
        scene.collide(avatar, poses)  # type: ignore[arg-type]
    assert caught.type is error
    assert scene.collide("ball", np.eye(4)[None]).verdict.shape == (1,), "and the scene goes on"


@pytest.mark.interpreted
@pytest.mark.parametrize("avatar", ["ball", "nobody"])
@pytest.mark.parametrize("margin", [-1e-12, np.nan, np.inf, -np.inf, 16.1, 1e12, 1e300])
def test_a_margin_that_is_no_reach_is_refused(scene: Scene, avatar: str, margin: float) -> None:
    with pytest.raises(BadRequestError):
        scene.collide(avatar, np.eye(4)[None], margin)


def test_an_avatar_larger_than_the_frame_is_refused(scene: Scene) -> None:
    scene.add_avatar("two far apart", [[0.0, 0, 0], [2e3, 0, 0]], 0.1)
    with pytest.raises(TooLargeError, match="split it"):
        scene.collide("two far apart", np.eye(4)[None])


@pytest.mark.interpreted
def test_no_poses_and_no_avatar_are_answered(scene: Scene) -> None:
    assert len(scene.collide("ball", np.empty((0, 4, 4)))) == 0
    assert len(scene.collide("nobody", np.empty((0, 4, 4)))) == 0
    inside = at(tuple(synthetic_scans.make_scan("plane", 1, 100)[0]), (50.0, 0, 0))
    answers = scene.collide("nobody", inside, 0.5)
    assert answers.verdict.tolist() == [CLEAR, CLEAR] and not answers.outside.any()
    assert [answer.verdict for answer in scene.collide("ball", inside)] == [CONTACT, CLEAR]


def test_a_tolerance_makes_contact_early_by_no_more_and_gives_bounds(tmp_path: Path) -> None:
    # One point, one ball of 0.25 m, a margin of 0.125 m: contact begins at 0.375 m.
    case = archive_cases.build(tmp_path, np.zeros((1, 3)), radius=0.0, resolution=archive_cases.BINARY_STEP)
    away = np.array([0.0, 0.375, 0.375 + 2.0**-26, 0.4, 5.0])
    poses = np.array([archive_cases.pose_of(np.eye(3), np.array([0.0, 0.0, z])) for z in away])
    with Scene.open(case.archive) as scene:
        scene.add_avatar("ball", np.zeros((1, 3)), 0.25)
        scene._avatars.provide("nothing", make_avatar(np.zeros((0, 3)), 0.25))
        for asked in (poses, *poses[:, None]):
            exact = scene.collide("ball", asked, 0.125)
            answers = scene.collide("ball", asked, 0.125, tolerance=0.5)
            assert (answers.verdict >= exact.verdict).all() and (
                answers.node_visits <= exact.node_visits
            ).all()
            assert answers.exact.tolist() == (answers.verdict == exact.verdict).tolist()
            distance = asked[:, 2, 3] - 0.25
            assert (answers.lower <= distance).all() and (distance <= answers.upper).all()
        assert scene.collide("ball", poses, 0.125, tolerance=0.5).verdict.tolist() == [1, 1, 1, 0, 0]
        assert scene.collide("nothing", poses, 0.125, tolerance=0.5).lower.tolist() == [0.125] * 5
        # Margins are rounded to whole units, up or down: bounds go by what verdicts go by.
        apart = np.array([0.25 + 2.0**-26, 0.25 + 2 * 2.0**-26])
        poses = np.array([archive_cases.pose_of(np.eye(3), np.array([0.0, 0.0, z])) for z in apart])
        for margin, right in ((0.6, [1, 0]), (1.4, [1, 0]), (1.6, [1, 1])):
            answers = scene.collide("ball", poses, margin * 2.0**-26, tolerance=1e-9)
            assert answers.verdict.tolist() == right
            assert (answers.lower <= apart - 0.25).all() and (apart - 0.25 <= answers.upper).all()
