"""Cells of one height change no answer: the verdicts are the octree's, and the judge's."""

from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from solidcloud.builder.passes.verify import verify_archive


@pytest.mark.interpreted
@pytest.mark.parametrize(("kind", "degree"), [("noise", 8), ("plane", 3), ("corner", 2), ("duplicates", 4)])
def test_contacts_are_those_of_the_plain_octree(tmp_path: Path, kind: str, degree: int) -> None:
    rng = np.random.default_rng([degree, 31])
    points = synthetic_scans.make_scan(kind, 11, 250)
    avatar = rng.uniform(-0.15, 0.15, (12, 3))
    options = {"voxel": 0.7, "leaf": 4, "degree": degree, "cell_points": 4 * degree}
    plain = archive_cases.build(tmp_path, points, **options)
    merged = archive_cases.build(tmp_path, points, cells="balanced", **options)
    assert verify_archive(merged.archive, deep=True).faults == ()
    poses = archive_cases.near_poses(rng, points, avatar, 30, 0.06)
    expected = plain.judge(avatar, 0.01, poses)
    assert expected.any() and not expected.all()
    found = archive_cases.ask(merged, avatar, 0.01, poses)
    assert np.array_equal(found, archive_cases.ask(plain, avatar, 0.01, poses))
    assert np.array_equal(found == 1, expected)
