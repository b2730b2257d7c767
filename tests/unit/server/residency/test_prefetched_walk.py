"""A walk through a scene larger than its cache: voxels are loaded early, and every answer is the same."""

import time
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.residency.voxel_cache import POLICIES
from solidcloud.server.scene import Scene

SCAN = synthetic_scans.make_scan("noise", 9, 30_000)


def walk(points: np.ndarray, frames: int) -> np.ndarray:
    """Poses (frames, 4, 4) from one end of the points to the other and back."""
    low, high = points.min(axis=0), points.max(axis=0)
    at = 1 - np.abs(np.linspace(-1, 1, frames))
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, 3] = low + at[:, None] * (high - low)
    return poses


def needed(archive: Path, avatar: np.ndarray, poses: np.ndarray) -> int:
    """Bytes of all voxels that the poses reach."""
    with Scene.open(archive) as scene:
        scene.add_avatar("al", avatar, 0.005)
        scene.collide("al", poses)
        return scene.stats().resident_bytes


@pytest.mark.parametrize("policy", POLICIES)
def test_a_walk_is_answered_as_with_everything_in_memory(
    tmp_path: Path, rng: np.random.Generator, policy: str
) -> None:
    case = archive_cases.build(tmp_path, SCAN, voxel=0.2)
    avatar = rng.uniform(-0.05, 0.05, (20, 3))
    poses = walk(case.points, 120)
    expected = case.judge(avatar, 0.002, poses).astype(int)
    assert 0 < expected.sum() < len(poses)
    budget = needed(case.archive, avatar, poses) // 2
    with Scene.open(case.archive, budget_bytes=budget, policy=policy) as scene:
        scene.add_avatar("al", avatar, 0.002)
        for pose, verdict in zip(poses, expected, strict=True):
            answers = scene.collide("al", pose[None])
            assert answers.verdict[0] == verdict and answers.verdict[0] != Verdict.UNKNOWN
        scene.residency.check()
        stats = scene.stats()
        assert stats.evicted > 0 and stats.resident_bytes + stats.level_bytes <= budget
        assert stats.requests == len(poses) and len(stats.users) == 1


def test_a_path_washes_out_no_more_than_its_share(tmp_path: Path, rng: np.random.Generator) -> None:
    """What a user stands in is there after somebody has swept over the whole archive."""
    case = archive_cases.build(tmp_path, SCAN, voxel=0.2)
    avatar = rng.uniform(-0.05, 0.05, (20, 3))
    sweep = walk(case.points, 400)
    here = sweep[150:151]
    with Scene.open(case.archive, budget_bytes=needed(case.archive, avatar, sweep) // 2) as scene:
        scene.add_avatar("al", avatar, 0.005)
        assert scene.collide("al", here).misses > 0
        until = time.monotonic() + 20.0
        while not scene.residency.kept and time.monotonic() < until:
            time.sleep(0.001)
        assert scene.residency.kept
        for part in scene.path("al", sweep, threads=1):
            assert not (part.verdict == Verdict.UNKNOWN).any()
        assert scene.stats().evicted > 0
        again = scene.collide("al", here)
        assert (again.misses, again.wait_seconds) == (0, 0.0) and again.hits > 0
