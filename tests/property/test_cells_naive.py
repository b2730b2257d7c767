"""Cells of one height change no answer: the verdicts are the octree's, and the judge's."""

from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from solidcloud.builder.passes.cell_summary import summarize_cells
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.schemas.archive.archive import Archive


@pytest.mark.parametrize(("kind", "degree"), [("noise", 8), ("plane", 3), ("corner", 2), ("duplicates", 4)])
@pytest.mark.parametrize("resolution", [1e-4, 5e-6])
def test_contacts_are_those_of_the_plain_octree(
    tmp_path: Path, kind: str, degree: int, resolution: float
) -> None:
    rng = np.random.default_rng([degree, 31])
    points = synthetic_scans.make_scan(kind, 11, 250)
    avatar = rng.uniform(-0.15, 0.15, (12, 3))
    options = {"voxel": 0.7, "leaf": 4, "degree": degree, "cell_points": 4 * degree, "resolution": resolution}
    plain = archive_cases.build(tmp_path, points, **options)
    merged = archive_cases.build(tmp_path, points, cells="balanced", **options)
    assert verify_archive(merged.archive, deep=True).faults == ()
    with Archive(merged.archive) as archive:
        cells = summarize_cells(archive)
    # A largest cube of 2^16 steps is an eighth of a voxel of 140,000 steps and may hold few points.
    assert set(cells.heights) == {2} and (cells.small > 0 or resolution > 1e-5 or kind == "duplicates")
    poses = archive_cases.near_poses(rng, points, avatar, 30, 0.06)
    expected = plain.judge(avatar, 0.01, poses)
    assert expected.any() and not expected.all()
    found = archive_cases.ask(merged, avatar, 0.01, poses)
    assert np.array_equal(found, archive_cases.ask(plain, avatar, 0.01, poses))
    assert np.array_equal(found == 1, expected)
