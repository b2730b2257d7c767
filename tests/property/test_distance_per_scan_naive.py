"""The least gap of each scan is that of the definition, by every pair of points, whatever the trees and the radii."""

from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import contact_cases
import naive
import naive_contacts
import numpy as np
import pytest
import radius_class_archives
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from point_clouds import KINDS, TREES, cloud
from sample_sizes import sample
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.queries.contacts import contacts, separation_per_scan

SCANS = 4


def judge(
    case: contact_cases.ScanCase, model: AvatarModel, pose: NDArray[np.float64], margin: float
) -> dict[int, float]:
    """The least gap of each scan within the margin, of all pairs."""
    lattice = case.store.archive.header.lattice
    origin = np.array(lattice.origin)
    whole = naive.lattice_of(case.points, origin, lattice.step)
    reach = case.radii + naive.reach_units(model.radius, 0.0, margin)
    pairs = naive_contacts.pairs_of(whole, case.numbers, lattice.step, origin, model.points, pose, reach)
    margin_units = round(margin * naive.UNITS)
    found: dict[int, float] = {}
    for pair in pairs:  # deepest first
        found.setdefault(pair.scan, naive_contacts.signed_distance(pair.square, pair.reach - margin_units))
    return found


@settings(max_examples=sample(4, 20), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    body=st.sampled_from(KINDS),
    model=st.sampled_from(radius_class_archives.MODELS),
    voxel=st.sampled_from([0.07, 0.5, 4.0]),
    step=st.sampled_from([1e-4, archive_cases.BINARY_STEP, 1e-2]),
    far=st.sampled_from([0.0, 5e5, 6.4e6]),
    margin=st.sampled_from([0.0, 0.02, 0.4]),
    tree=TREES,
)
def test_the_least_gap_of_each_scan_is_that_of_the_definition(
    seed: int, kind: str, body: str, model: str | None, voxel: float, step: float, far: float, margin: float,
    tree: dict[str, Any],
) -> None:  # fmt: skip
    rng = np.random.default_rng(seed)
    points = cloud(rng, kind, 250) + far * rng.uniform(-1, 1, 3)
    avatar = make_avatar(cloud(rng, body, 30) * 0.3, float(rng.choice([0.0, 0.01])))
    poses = archive_cases.near_poses(rng, points, avatar.points, 8, 0.1)
    voxel = np.ceil(voxel / step) * step
    with TemporaryDirectory() as folder, radius_class_archives.any_classes():
        case = contact_cases.open_case(
            Path(folder), points, rng, scan_count=SCANS, voxel=voxel, resolution=step,
            models=radius_class_archives.STORED, **tree
        )  # fmt: skip
        case = contact_cases.with_model(case, model)
        with closing(case.store):
            for pose in poses:
                expected = judge(case, avatar, pose, margin)
                found = separation_per_scan(case.data, avatar, pose, margin, SCANS)
                assert found.exact and list(found.separations) == sorted(expected)
                for number, gap in found.separations.items():
                    assert gap == pytest.approx(expected[number], rel=1e-14, abs=1e-15)


def test_a_cache_too_small_for_all_at_once_changes_no_gap(tmp_path: Path, rng: np.random.Generator) -> None:
    points = cloud(rng, "noise", 2000)
    case = contact_cases.open_case(tmp_path, points, rng, scan_count=3, voxel=0.5)
    avatar = make_avatar(rng.uniform(-0.5, 0.5, (60, 3)), 0.02)
    with closing(case.store):
        largest = max(case.data.residency.bytes_of([row]) for row in range(len(case.data.keys)))
        small = contact_cases.tight(case, 2 * largest)
        for pose in archive_cases.near_poses(rng, points, avatar.points, 5, 0.1):
            whole = separation_per_scan(case.data, avatar, pose, 0.1, 3)
            assert separation_per_scan(small.data, avatar, pose, 0.1, 3)[:2] == whole[:2]
            assert whole.exact and len(whole.separations) == 3
            answers = contacts(case.data, avatar, pose[None], 1, 0.1)
            assert min(whole.separations.values()) == pytest.approx(answers.signed_distance[0], rel=1e-14)
            small.data.residency.check()


def test_a_wall_that_one_scan_saw_costs_few_tests_of_points(tmp_path: Path, rng: np.random.Generator) -> None:
    wall = np.column_stack([rng.uniform(0, 1, (20_000, 2)), rng.normal(0, 1e-4, 20_000)])
    avatar = make_avatar(np.column_stack([rng.uniform(-0.3, 0.3, (500, 2)), np.zeros(500)]), 0.01)
    # Tilted by 3 degrees: all of it is within the margin of 4 cm, and the nearest pair is at an edge.
    c, s = np.cos(0.05), np.sin(0.05)
    pose = archive_cases.pose_of(np.array([[1, 0, 0], [0, c, -s], [0, s, c]]), np.array([0.5, 0.5, 0.04]))
    case = contact_cases.open_case(tmp_path, wall, rng, scan_count=1, voxel=2.0)
    with closing(case.store):
        found = separation_per_scan(case.data, avatar, pose, 0.04, 1)
        all_pairs = contacts(case.data, avatar, pose[None], 0, 0.04)
    assert found.exact and found.point_tests < all_pairs.point_tests[0] / 3
