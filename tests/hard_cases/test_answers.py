"""Hard cases of answers: what is missing, too much, elsewhere computed; a test's number is its row in NUMERICS.md."""

import json
import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import same_answers
import synthetic_scans
from sample_sizes import sample
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import TooLargeError
from solidcloud.schemas.wire.request_limits import MAX_AVATAR_POINTS
from solidcloud.server.scene import Scene

POINT = np.zeros((1, 3))


def elsewhere(code: str, *arguments: str, **environment: str) -> str:
    """What a new Python process prints, with our test folder on its path."""
    path = os.pathsep.join([str(Path(same_answers.__file__).parent), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code, *arguments],
        env=os.environ | {"PYTHONPATH": path} | environment,
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.case(
    21,
    "an empty region is clear; outside is clear and flagged; a corrupt record and a scan left out are unknown",
)
def test_case_21_empty_outside_not_loaded_skipped(tmp_path: Path) -> None:
    good = np.array([[0.0, 0, 0], [4.0, 0, 0], [4.0, 0, 4.0]])
    scan = synthetic_scans.write_ply(tmp_path / "good.ply", good)
    synthetic_scans.write_las(
        tmp_path / "bad.las", np.array([[0, 0, 0]] * 50 + [[1000, 1000, 1000]] * 50), offset=(9, 0, 0)
    )
    os.truncate(tmp_path / "bad.las", (tmp_path / "bad.las").stat().st_size - 40)
    options = BuildConfig(skip_bad=True, jobs=1, resolution=1e-3, radius=0.01, voxel=1.0)
    build_archive([scan, tmp_path / "bad.las"], tmp_path / "archive", options)
    with Archive(tmp_path / "archive") as archive:
        row = int(np.flatnonzero((archive.coordinates == [4, 0, 0]).all(axis=1))[0])
        entry, path = archive.voxels[row], archive.shard_path(int(archive.voxels[row]["shard"]))
    with open(path, "r+b") as file:
        file.seek(int(entry["frame_offset"][0]))
        file.write(bytes(int(entry["frame_bytes"][0])))
    places = [(2.0, 0, 2.0), (-5.0, 0, 0), (4.0, 0.005, 0), (9.5, 0.5, 0.5), (4.0, 0, 4.0)]
    with Scene.open(tmp_path / "archive") as scene:
        scene.add_avatar("ball", POINT, 0.1)
        answers = scene.collide(
            "ball", np.array([archive_cases.pose_of(np.eye(3), np.array(p)) for p in places])
        )
    #                                 empty  outside  corrupt  skipped  contact
    assert answers.verdict.tolist() == [0, 0, 2, 2, 1]
    assert answers.outside.tolist() == [True, True, True, True, True]
    assert answers.voxels_missing.tolist() == [0, 0, 1, 0, 0]


@pytest.mark.case(22, "10^7 points are refused as too large; the next avatar is not")
def test_case_22_an_avatar_over_the_cap_is_refused(tmp_path: Path) -> None:
    with Scene.open(archive_cases.build(tmp_path, POINT).archive) as scene:
        with pytest.raises(TooLargeError, match=f"at most {MAX_AVATAR_POINTS}"):
            scene.add_avatar("crowd", np.broadcast_to(np.zeros(3), (10_000_000, 3)), 0.1)
        assert scene.add_avatar("one", POINT, 0.1).points == 1


@pytest.mark.case(
    23,
    "512 voxels in reach with room for 1, 7 and 200: same answers, none missing, each read once per pose",
)
def test_case_23_a_pose_that_reaches_hundreds_of_voxels(tmp_path: Path) -> None:
    grid = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), axis=-1).reshape(-1, 3)
    case = archive_cases.build(tmp_path, grid, voxel=1.0, resolution=0.5, radius=0.01)
    ball = np.array([[3.5, 3.5, 3.5], [-3.5, -3.5, -3.5], [3.5, -3.5, 3.5]])
    middle = archive_cases.pose_of(np.eye(3), np.array([3.5, 3.5, 3.5]))
    beside = archive_cases.pose_of(np.eye(3), np.array([3.5, 3.5, 3.515]))
    beyond = archive_cases.pose_of(np.eye(3), np.array([3.5, 3.5, 3.525]))
    with Scene.open(case.archive) as scene:
        one = int(scene.residency.bytes_of([0]))
    for voxels in sample((7, 200), (1, 7, 200)):
        with Scene.open(case.archive, budget_bytes=voxels * one + 64) as scene:
            scene.add_avatar("ball", ball, 0.01)
            answers = scene.collide("ball", np.array([middle, beside, beyond]))
            assert answers.verdict.tolist() == [1, 1, 0] and not answers.voxels_missing.any()
            assert answers.resident_bytes <= voxels * one + 64
            # No storm: a voxel is read at most once for each pose.
            assert answers.misses <= 3 * 512 and scene.residency.stats.evicted <= answers.misses
            scene.residency.check()


@pytest.mark.case(
    24,
    "placed integers, verdicts and counters of 60 poses equal the interpreter's",
)
def test_case_24_compiled_equals_interpreted(tmp_path: Path) -> None:
    case = archive_cases.build(
        tmp_path, synthetic_scans.make_scan(*same_answers.SCAN), leaf=8, cell_points=30
    )
    here = json.loads(same_answers.answers(case.archive))
    code = "import same_answers, sys, pathlib; print(same_answers.answers(pathlib.Path(sys.argv[1])))"
    there = json.loads(elsewhere(code, str(case.archive), NUMBA_DISABLE_JIT="1"))
    assert here["placed"] == there["placed"] and here["radius"] == there["radius"]
    assert here["columns"] == there["columns"], "even the costs"
    assert {0, 1} == set(here["columns"][0])


@pytest.mark.case(24, "an archive built interpreted has the same bytes")
def test_case_24_an_archive_built_interpreted_has_the_same_bytes(tmp_path: Path) -> None:
    case = archive_cases.build(
        tmp_path, synthetic_scans.make_scan(*same_answers.SCAN), leaf=8, cell_points=30, radius=None
    )
    code = (
        "import archive_cases, synthetic_scans, same_answers, sys, pathlib\n"
        "folder = pathlib.Path(sys.argv[1])\n"
        "scan = synthetic_scans.make_scan(*same_answers.SCAN)\n"
        "archive_cases.build(folder, scan, leaf=8, cell_points=30, radius=None)"
    )
    other = tmp_path / "other"
    other.mkdir()
    elsewhere(code, str(other), NUMBA_DISABLE_JIT="1")
    names = ["shards/0-000000.h5"]
    assert [(case.archive / n).read_bytes() for n in names] == [
        (other / "archive0" / n).read_bytes() for n in names
    ]
    with Archive(case.archive) as one, Archive(other / "archive0") as two:
        assert one.header.radius == two.header.radius and one.header.archive_id == two.header.archive_id


@pytest.mark.case(25, "500 poses, 7 times, on 1, 2 and 4 threads: the judge's verdict every time")
def test_case_25_any_number_of_threads_gives_the_same_answers(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan("corner", 5, 600), voxel=0.3)
    avatar = rng.uniform(-0.2, 0.2, (30, 3))
    count = sample(100, 500)
    poses = archive_cases.near_poses(rng, case.points, avatar, count, 0.15)
    expected = case.judge(avatar, 0.01, poses).astype(np.uint8)
    for threads in (1, 2, 4):
        with Scene.open(case.archive, budget_bytes=1 << 20) as scene, ThreadPoolExecutor(threads) as pool:
            scene.add_avatar("avatar", avatar, 0.01)

            def ask(pose: np.ndarray, scene: Scene = scene) -> tuple[int, bool, int]:
                answers = scene.collide("avatar", pose[None])
                return int(answers.verdict[0]), bool(answers.outside[0]), int(answers.voxels_missing[0])

            replies = list(pool.map(ask, np.tile(poses, (7, 1, 1))))
        for i in range(count):
            assert set(replies[i::count]) == {replies[i]} and replies[i][0] == expected[i]


@pytest.mark.case(
    29, "collide(A, B, M) = collide(B, A, M⁻¹) for a small and a tall tree and quarter turns, and the judge's"
)
def test_case_29_either_tree_may_be_the_taller(tmp_path: Path, rng: np.random.Generator) -> None:
    """collide(A, B, M) == collide(B, A, M^-1), for a small and a tall tree and quarter turns."""
    step = archive_cases.BINARY_STEP
    small = np.rint(synthetic_scans.make_scan("noise", 1, 3) / step) * step
    tall = np.rint(synthetic_scans.make_scan("plane", 2, 150) / step) * step
    options = {"resolution": step, "radius": 4 * step, "leaf": 1, "degree": 2}
    first, second = (
        archive_cases.build(tmp_path, small, **options),
        archive_cases.build(tmp_path, tall, **options),
    )
    turn = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    poses, back = [], []
    for _ in range(200):
        a, b = small[rng.integers(3)], tall[rng.integers(150)]
        poses.append(archive_cases.pose_of(turn, a - turn @ b + rng.integers(-7, 8, 3) * step))
        back.append(archive_cases.pose_of(turn.T, -turn.T @ poses[-1][:3, 3]))
    one = archive_cases.ask(first, tall, 4 * step, np.array(poses))
    other = archive_cases.ask(second, small, 4 * step, np.array(back))
    assert one.tolist() == other.tolist()
    assert one.tolist() == first.judge(tall, 4 * step, np.array(poses)).astype(int).tolist()
    assert 0 < one.sum() < len(one)
