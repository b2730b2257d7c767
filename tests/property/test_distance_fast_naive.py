"""`near` answers one pose with the bits of `distance`: fields, counters of work and what is held in memory."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import numpy as np
import pytest
import radius_class_archives
import synthetic_scans
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from point_clouds import KINDS, TREES, cloud
from sample_sizes import sample
from solidcloud.schemas.errors import SolidcloudError
from solidcloud.schemas.wire.answers import DistanceAnswers
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.queries.distance import MAX_FAST_REACH, distance, distance_fast
from solidcloud.server.queries.query_inputs import SceneData
from solidcloud.server.scene import Scene

COLUMNS = (
    "verdict", "signed_distance", "lower", "upper", "exact", "witness_avatar", "witness_cloud", "normal", "outside",
    "voxels_missing", "node_visits", "point_tests",
)  # fmt: skip


@dataclass
class Counted:
    """How many poses a kernel call of its own answered, and how many found nothing."""

    nothing: int = 0
    touching: int = 0


def assert_same(found: DistanceAnswers, expected: DistanceAnswers) -> None:
    """Every column of the same type, shape and bytes."""
    for name in COLUMNS:
        a, b = getattr(found, name), getattr(expected, name)
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes()), (name, a, b)
    for name in ("misses", "resident", "resident_bytes", "faults", "late"):
        assert getattr(found, name) == getattr(expected, name), name
    assert found.hits <= expected.hits  # it counts the voxels that it examined, not all that are in reach


def both_ways(
    data: SceneData, avatar: AvatarModel, poses: NDArray[np.float64], reach: float, counted: Counted
) -> None:
    """Ask both, all resident, and compare."""
    distance(data, avatar, poses, reach)
    for pose in poses:
        expected = distance(data, avatar, pose[None], reach)
        assert_same(distance_fast(data, avatar, pose, reach), expected)
        counted.nothing += bool(np.isinf(expected.signed_distance[0]))
        counted.touching += bool(expected.signed_distance[0] <= 0)


@settings(max_examples=sample(6, 40), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    body=st.sampled_from(KINDS),
    far=st.sampled_from([0.0, 5e5, 6.4e6]),
    step=st.sampled_from([archive_cases.BINARY_STEP, 1e-4, 1e-2]),
    reach=st.sampled_from([0.0, 1e-3, 0.1, 0.5, MAX_FAST_REACH, 3.0]),
    tree=TREES,
)
def test_one_pose_has_the_bits_of_distance(
    seed: int, kind: str, body: str, far: float, step: float, reach: float, tree: dict[str, Any]
) -> None:
    rng = np.random.default_rng(seed)
    points = cloud(rng, kind, 400) + far * rng.uniform(-1, 1, 3)
    avatar = make_avatar(cloud(rng, body, 30) * 0.2, float(rng.choice([0.0, 0.01])))
    poses = archive_cases.near_poses(rng, points, avatar.points, 12, 1.0)
    with TemporaryDirectory() as folder:
        case = archive_cases.build(Path(folder), points, voxel=1.0, resolution=step, radius=step, **tree)
        with Scene.open(case.archive) as scene:
            both_ways(scene._data, avatar, poses, reach, Counted())


def test_near_and_distance_agree_under_every_radius_model(tmp_path: Path, rng: np.random.Generator) -> None:
    points = synthetic_scans.make_scan("corner", 3, 600)
    with radius_class_archives.any_classes():
        case = archive_cases.build(tmp_path, points, voxel=0.5, models=radius_class_archives.STORED)
    avatar = make_avatar(rng.uniform(-0.2, 0.2, (40, 3)), 0.01)
    poses = archive_cases.near_poses(rng, case.points, avatar.points, 60, 0.5)
    counted = Counted()
    with Scene.open(case.archive) as scene:
        for model in radius_class_archives.MODELS:
            both_ways(scene.archives[0]._opened.radius_model(model), avatar, poses, 0.1, counted)
    assert counted.nothing > 20 and counted.touching > 20


def test_what_is_refused_is_refused_in_the_same_words(tmp_path: Path) -> None:
    case = archive_cases.build(tmp_path, np.zeros((1, 3)))
    avatar = make_avatar([[0.0, 0, 0]], 0.1)
    shear, mirror, gone = np.eye(4), np.diag([1.0, 1, -1, 1]), np.eye(4)
    shear[0, 1], gone[0, 3] = 0.1, np.nan
    with Scene.open(case.archive) as scene:
        for pose, reach in ((shear, 0.1), (mirror, 0.1), (gone, 0.1), (np.eye(4), -1.0), (np.eye(4), np.nan),
                            (np.eye(4), 1e3), (np.eye(3), 0.1), (np.diag([1.0, 1, 1, 2]), 0.1)):  # fmt: skip
            said = []
            for ask in (lambda p, r: distance_fast(scene._data, avatar, p, r),
                        lambda p, r: distance(scene._data, avatar, p, r)):  # fmt: skip
                with pytest.raises(SolidcloudError) as refused:
                    ask(pose, reach)
                said.append((type(refused.value), str(refused.value)))
            assert said[0] == said[1]
