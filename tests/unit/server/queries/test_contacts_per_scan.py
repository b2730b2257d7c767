"""`separation_per_scan`: one wall that two scans saw, and what is missing."""

from contextlib import closing
from pathlib import Path

import archive_cases
import contact_cases
import numpy as np
import pytest
from effect_frames import flip_a_byte
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries.contacts import ScanSeparations, separation_per_scan
from solidcloud.server.queries.query_inputs import make_budget

BALL = make_avatar([[0.0, 0, 0], [0.02, 0, 0]], 0.1)
POSE = archive_cases.pose_of(np.eye(3), np.array([0.5, 0.0, 0.13]))


def row(folder: Path) -> contact_cases.ScanCase:
    """Twelve points in a row, by turns of two scans; spheres of 1 cm."""
    points = np.column_stack([np.arange(12) * 0.1, np.zeros(12), np.zeros(12)])
    return contact_cases.open_case(folder, points, np.random.default_rng(3), leaf=2, voxel=4.0)


@pytest.mark.interpreted
def test_each_scan_has_its_nearest_pair(tmp_path: Path) -> None:
    case = row(tmp_path)
    spheres = (BALL.points + POSE[:3, 3])[:, None] - case.points
    gaps = np.linalg.norm(spheres, axis=2).min(axis=0) - 0.11
    with closing(case.store):
        found = separation_per_scan(case.data, BALL, POSE, 0.15, 2)
    assert found.exact and found.point_tests > 0
    for scan in (0, 1):
        assert found.separations[scan] == pytest.approx(gaps[case.numbers == scan].min(), abs=1e-7)
    assert found.separations[0] != found.separations[1]


@pytest.mark.interpreted
def test_beyond_the_margin_a_scan_is_not_there(tmp_path: Path) -> None:
    case = row(tmp_path)
    with closing(case.store):
        both = separation_per_scan(case.data, BALL, POSE, 0.15, 2).separations
        less = float(np.mean(list(both.values())))
        first = min(both, key=both.__getitem__)
        assert separation_per_scan(case.data, BALL, POSE, less, 2).separations == {first: both[first]}
        assert separation_per_scan(case.data, BALL, POSE, 0.0, 2).separations == {}


@pytest.mark.interpreted
def test_what_is_missing_or_not_looked_at_is_not_exact(tmp_path: Path) -> None:
    case = row(tmp_path)
    with closing(case.store):
        assert separation_per_scan(case.data, make_avatar(np.empty((0, 3))), POSE, 0.1, 2) == ScanSeparations(
            {}, True
        )
        late = separation_per_scan(case.data, BALL, POSE, 0.1, 2, make_budget(budget_ms=0))
        assert late == ScanSeparations({}, False)
        lost = case.data._replace(unknown_everywhere=True)
        assert not separation_per_scan(lost, BALL, POSE, 0.1, 2).exact


@pytest.mark.interpreted
def test_trees_of_several_levels_give_the_gaps_of_all_pairs(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform(0, 1, (120, 3)) * [1, 1, 0.05]
    avatar = make_avatar(rng.uniform(-0.3, 0.3, (90, 3)) * [1, 1, 0.1], 0.02)
    case = contact_cases.open_case(
        tmp_path, points, rng, scan_count=3, voxel=0.5, leaf=8, cell_points=20, degree=3
    )
    with closing(case.store):
        for height in (0.02, 0.13, 0.3):
            pose = archive_cases.pose_of(archive_cases.random_rotation(rng), np.array([0.5, 0.5, height]))
            placed = avatar.points @ pose[:3, :3].T + pose[:3, 3]
            gaps = np.linalg.norm(placed[:, None] - points, axis=2).min(axis=0) - 0.03
            expected = {s: gaps[case.numbers == s].min() for s in range(3)}
            found = separation_per_scan(case.data, avatar, pose, 0.05, 3)
            assert found.separations == pytest.approx(
                {s: g for s, g in expected.items() if g <= 0.05}, abs=2e-4
            )


@pytest.mark.interpreted
def test_a_voxel_that_cannot_be_read_is_missing_and_the_rest_is_found(tmp_path: Path) -> None:
    points = np.column_stack([np.arange(12) * 0.1, np.zeros(12), np.zeros(12)])
    case = contact_cases.open_case(tmp_path, points, np.random.default_rng(3), voxel=0.5)
    flip_a_byte(case.store.archive.folder, (0, 0, 0))
    with closing(case.store):
        found = separation_per_scan(case.data, BALL, POSE, 0.15, 2)
        assert not found.exact and set(found.separations) == {0, 1}
        away = archive_cases.pose_of(np.eye(3), np.array([0.9, 0.0, 0.13]))
        assert separation_per_scan(case.data, BALL, away, 0.02, 2).exact
