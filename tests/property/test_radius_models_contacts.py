"""`contacts` with spheres of several sizes: which pairs, how deep, in which order, in which clusters, as defined."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import numpy as np
import pytest
import radius_class_archives
from contact_cases import ScanCase, compare, open_case, tight, with_model
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from point_clouds import KINDS, TREES, cloud, signed_permutations
from sample_sizes import sample
from solidcloud.schemas.archive.radius_model import RIM_BIT, local_radii
from solidcloud.server.queries import contacts as contacts_module


@settings(max_examples=sample(4, 20), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    count=st.sampled_from([2, 33, 300]),
    body=st.sampled_from(KINDS),
    model=st.sampled_from([*radius_class_archives.MODELS, "local", "local+border", "border:0"]),
    voxel=st.sampled_from([0.07, 0.5, 4.0]),
    limit=st.sampled_from([0, 1, 7, 10_000]),
    kept=st.booleans(),
    tree=TREES,
)
def test_every_pair_and_cluster_is_the_definitions(
    seed: int,
    kind: str,
    count: int,
    body: str,
    model: str | None,
    voxel: float,
    limit: int,
    kept: bool,
    tree: dict[str, Any],
) -> None:
    rng = np.random.default_rng(seed)
    points, avatar = cloud(rng, kind, count), cloud(rng, body, 30) * 0.3
    with TemporaryDirectory() as folder, radius_class_archives.any_classes():
        case = open_case(
            Path(folder), points, rng, kept=kept, voxel=voxel, models=radius_class_archives.STORED, **tree
        )
        case = with_model(case, model)
        for margin in (0.0, 0.05, 0.4):
            poses = archive_cases.near_poses(rng, points, avatar, 3, 0.05 + margin)
            distance = rng.choice([None, 0.0, 0.03, 0.5])
            compare(case, avatar, 0.01, poses, limit, margin, distance)


def rims(local: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Every other point on a rim, whatever its neighbours are."""
    return np.where(local @ np.array([1, 5, 3]) % 4 < 2, RIM_BIT, 0).astype(np.uint8)


@settings(max_examples=sample(3, 15), deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), limit=st.sampled_from([1, 5, 64, 1000]), tree=TREES)
def test_equal_gaps_of_unlike_spheres_go_by_the_rule(seed: int, limit: int, tree: dict[str, Any]) -> None:
    """Radii of two steps and of one, on a grid of one step: gaps are equal by the dozen, roots whole and not."""
    rng = np.random.default_rng(seed)
    step = archive_cases.BINARY_STEP
    points = rng.integers(-4, 5, (200, 3)) * step + 64 * step
    avatar = rng.integers(-3, 4, (25, 3)) * step
    turns = signed_permutations()
    shifts = 64 * step + step * rng.integers(-2, 3, (3, 3))
    poses = np.array([archive_cases.pose_of(turns[rng.integers(24)], shift) for shift in shifts])
    with TemporaryDirectory() as folder, radius_class_archives.any_classes(rims):
        case = open_case(
            Path(folder), points, rng, scan_count=3, resolution=step, voxel=step * 17, radius=2 * step,
            models=radius_class_archives.STORED, **tree,
        )  # fmt: skip
        case = with_model(case, "border")
        assert set((case.radii / (step * 2**26)).tolist()) == {1.0, 2.0}
        answers = compare(case, avatar, 0.0, poses, limit, step)
        assert (answers.pairs_found > 30).all()
        compare(case, avatar, 0.0, poses, limit, 0.0, step)


@pytest.fixture(scope="module")
def rich(tmp_path_factory: pytest.TempPathFactory) -> ScanCase:
    """A scene of two scans in many voxels, each point of any class."""
    rng = np.random.default_rng(5)
    points = np.concatenate([cloud(rng, "plane", 1500), cloud(rng, "noise", 1500)])
    with radius_class_archives.any_classes():
        return open_case(
            tmp_path_factory.mktemp("rich"), points, rng, voxel=0.3, resolution=1e-4, degree=3, leaf=9,
            models=radius_class_archives.STORED,
        )  # fmt: skip


def rich_question(case: ScanCase, seed: int) -> tuple[np.ndarray, float, np.ndarray, int, float]:
    """An avatar, its radius, poses, a limit and a margin."""
    rng = np.random.default_rng(seed)
    avatar = cloud(rng, "sphere", 60) * 0.4
    return avatar, 0.02, archive_cases.near_poses(rng, case.points, avatar, 4, 0.02), 50, 0.04


@pytest.mark.parametrize("model", ["local:2", "local+border:2", "border:3"])
def test_growing_cells_and_a_small_cache_say_the_same(
    rich: ScanCase, monkeypatch: pytest.MonkeyPatch, model: str
) -> None:
    monkeypatch.setattr(contacts_module, "FIRST_CELLS", 32)
    case = with_model(rich, model)
    avatar, radius, poses, limit, margin = rich_question(case, 1)
    found = compare(case, avatar, radius, poses, limit, margin, 0.05).pairs_found
    assert found.max() > 20
    small = tight(case, 3 * int(case.store.sizes.max()))
    compare(small, avatar, radius, poses, limit, margin, 0.05)
    assert small.data.residency.stats.evicted > 0


def test_spheres_that_are_large_elsewhere_cost_no_point_tests(rich: ScanCase) -> None:
    """Pruning goes by the spheres at hand: with half of them shrunk to nothing, fewer points are looked at."""
    avatar, radius, poses, limit, margin = rich_question(rich, 2)
    tests = [
        compare(with_model(rich, model), avatar, radius, poses, limit, margin).point_tests.sum()
        for model in ("fixed:0.181", "local")
    ]
    assert tests[1] < tests[0]


def test_the_larger_sphere_is_the_deeper_though_farther(tmp_path: Path, rng: np.random.Generator) -> None:
    small, large = local_radii()[[4, 15]]
    points = np.array([[2 * small, 0.0, 0.0], [-0.9 * small, 0.0, 0.0]])
    with radius_class_archives.any_classes(lambda local: np.where(local[:, 0] > 0, 15, 4).astype(np.uint8)):
        case = open_case(tmp_path, points, rng, scan_count=1, voxel=0.5, models=radius_class_archives.STORED)
    case = with_model(case, "local")
    pose = archive_cases.pose_of(np.eye(3), np.zeros(3))[None]
    answers = compare(case, np.zeros((1, 3)), 0.0, pose)
    assert np.allclose(answers.signed_distance, [2 * small - large, -0.1 * small], atol=2e-4)
    assert (answers.cloud_point[:, 0] > 0).tolist() == [True, False]
    assert compare(case, np.zeros((1, 3)), 0.0, pose, 1).cloud_point[0, 0] > 0
    assert compare(with_model(case, None), np.zeros((1, 3)), 0.0, pose).cloud_point[0, 0] < 0
