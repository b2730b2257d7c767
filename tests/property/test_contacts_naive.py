"""`contacts` equals the definition, pair by pair and cluster by cluster, bit for bit."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import numpy as np
import pytest
from contact_cases import ScanCase, compare, open_case, tight
from hypothesis import given, settings
from hypothesis import strategies as st
from point_clouds import COUNTS, FAR, KINDS, STEPS, TREES, VOXEL_STEPS, cloud, signed_permutations
from sample_sizes import sample
from solidcloud.schemas.wire.answers import ContactsAnswers
from solidcloud.server.queries import contacts as contacts_module


@settings(max_examples=sample(6, 35), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    count=COUNTS,
    body=st.sampled_from(KINDS),
    step=STEPS,
    voxel_steps=VOXEL_STEPS,
    far=FAR,
    limit=st.sampled_from([0, 1, 7, 100, 10_000]),
    scan_count=st.sampled_from([0, 1, 3]),
    tree=TREES,
)
def test_every_pair_and_cluster_is_the_definitions(
    seed: int,
    kind: str,
    count: int,
    body: str,
    step: float,
    voxel_steps: int,
    far: float,
    limit: int,
    scan_count: int,
    tree: dict[str, Any],
) -> None:
    rng = np.random.default_rng(seed)
    extent = step * min(voxel_steps * rng.uniform(0.1, 3), 1 << 21)
    if step <= far * 1e-14:  # float64 holds no such lattice there
        far = 0.0
    points = cloud(rng, kind, count) * extent + far * rng.uniform(-1, 1, 3)
    avatar = cloud(rng, body, 40) * (extent * rng.uniform(0.01, 0.5))
    radius, scan_radius = step * rng.choice([0, 0.7, 9]), step * rng.choice([0, 0.5, 9])
    with TemporaryDirectory() as folder:
        case = open_case(
            Path(folder), points, rng, scan_count=max(1, scan_count), kept=scan_count > 0,
            voxel=step * voxel_steps, resolution=step, radius=float(scan_radius), **tree,
        )  # fmt: skip
        for share in (0.0, 0.02, 0.2, 1.0):
            margin = min(extent * share * rng.uniform(0.5, 1), 10.0)
            distance = rng.choice([None, 0.0, 3 * step, 0.05 * extent, extent])
            poses = archive_cases.near_poses(rng, points, avatar, 3, margin + radius)
            if np.abs(poses[:, :3, 3]).max() <= 1e9:
                compare(case, avatar, float(radius), poses, limit, float(margin), distance)


@settings(max_examples=sample(4, 20), deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), limit=st.sampled_from([1, 5, 64, 1000]), tree=TREES)
def test_ties_go_by_point_then_centre_then_row_then_scan(seed: int, limit: int, tree: dict[str, Any]) -> None:
    """Points and avatar on one coarse grid, many of them several times, under poses that keep the grid."""
    rng = np.random.default_rng(seed)
    step = archive_cases.BINARY_STEP
    points = rng.integers(-3, 4, (150, 3)) * (4 * step) + 64 * step
    avatar = rng.integers(-2, 3, (40, 3)) * (4 * step)
    turns = signed_permutations()
    poses = np.array(
        [
            archive_cases.pose_of(turns[rng.integers(24)], 64 * step + 4 * step * rng.integers(-2, 3, 3))
            for _ in range(4)
        ]
    )
    with TemporaryDirectory() as folder:
        case = open_case(
            Path(folder), points, rng, scan_count=3, resolution=step, voxel=step * 17, radius=4 * step, **tree
        )
        # At 4 steps the pairs one grid cell apart are tangent.
        answers = compare(case, avatar, 0.0, poses, limit)
        assert (answers.pairs_found > 30).all()
        compare(case, avatar, 0.0, poses, limit, 0.0, step)
        compare(case, avatar, 0.0, poses, limit, 0.0, 4 * step)


@pytest.fixture(scope="module")
def rich(tmp_path_factory: pytest.TempPathFactory) -> ScanCase:
    """A scene of two scans in many voxels."""
    rng = np.random.default_rng(5)
    points = np.concatenate([cloud(rng, "plane", 1500), cloud(rng, "noise", 1500)])
    return open_case(
        tmp_path_factory.mktemp("rich"), points, rng, voxel=0.3, resolution=1e-3, degree=3, leaf=9
    )


def rich_question(case: ScanCase, seed: int) -> tuple[np.ndarray, float, np.ndarray, int, float]:
    """An avatar, its radius, poses, a limit and a margin, with some hundred pairs a pose in several clusters."""
    rng = np.random.default_rng(seed)
    avatar = cloud(rng, "sphere", 60) * 0.4
    poses = archive_cases.near_poses(rng, case.points, avatar, 5, 0.02)
    return avatar, 0.02, poses, 50, 0.03


def test_many_pairs_in_several_clusters_over_many_voxels(rich: ScanCase) -> None:
    for seed in range(6):
        answers = compare(rich, *rich_question(rich, seed))
    assert answers.pairs_found.max() > 50 and np.diff(answers.cluster_starts).max() > 5
    assert set(answers.scan_index.tolist()) == {0, 1}


def test_cells_that_grow_and_voxels_that_do_not_fit_together_say_the_same(
    rich: ScanCase, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A small cache cuts a pose's voxels into runs, and its search goes on in another call."""
    monkeypatch.setattr(contacts_module, "FIRST_CELLS", 32)
    largest = int(rich.store.sizes.max())
    for seed in (1, 7, 300):
        compare(rich, *rich_question(rich, seed), 0.05)
        rng = np.random.default_rng(seed)
        avatar, radius, poses, limit, margin = rich_question(rich, seed)
        small = tight(rich, 3 * largest)
        answers = compare(small, avatar, radius, rng.permutation(poses), limit, margin)
        assert small.data.residency.stats.evicted > 0 and answers.misses > 3


def listed(answers: ContactsAnswers, pose: int) -> list[tuple[float, ...]]:
    """What is listed of one pose."""
    own = slice(answers.pair_starts[pose], answers.pair_starts[pose + 1])
    places = np.column_stack([answers.avatar_point[own], answers.cloud_point[own]])
    return list(zip(answers.avatar_index[own], answers.signed_distance[own], *places.T, strict=True))
