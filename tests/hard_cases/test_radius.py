"""Hard case of the radius that is measured; a test's number is its row in NUMERICS.md."""

import math
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from solidcloud.schemas.archive.archive import Archive


@pytest.mark.case(
    28,
    "half the mean closest-point distance, with duplicates and voxel borders everywhere: brute force to 2^-33 m",
)
@pytest.mark.parametrize("kind", ["plane", "noise", "duplicates"])
@pytest.mark.parametrize("voxel", [0.0625, 8.0])
def test_case_28_the_mean_distance_is_that_of_brute_force(tmp_path: Path, kind: str, voxel: float) -> None:
    step = archive_cases.BINARY_STEP
    steps = synthetic_scans.make_steps(kind, 6, 200, 1024).astype(np.int64)
    steps -= steps.min(axis=0)
    # Every third point again, and pairs one step apart on either side of borders of the grid of voxels.
    edge = round(voxel / step) * np.arange(1, 4)[:, None] * [1, 1, 1]
    steps = np.concatenate([steps, steps[::3], edge[edge[:, 0] < 1024], edge[edge[:, 0] < 1024] - [1, 0, 0]])
    case = archive_cases.build(
        tmp_path, steps * step, voxel=voxel, resolution=step, radius=None, cell_points=9, leaf=4
    )
    distinct = np.unique(steps, axis=0)
    apart = ((distinct[:, None] - distinct) ** 2).sum(axis=2)
    np.fill_diagonal(apart, 1 << 40)
    expected = math.fsum(np.sqrt(apart.min(axis=1).astype(float))) / len(distinct) * step / 2
    with Archive(case.archive) as archive:
        header = archive.header
    # Distances are added as integers of 2^-32 m: half of that at most each, and half of it in a radius.
    assert abs(header.radius - expected) <= 2.0**-34 + 1e-16
    assert (header.radius_model, header.radius_sample, header.radius_error) == ("mean", len(distinct), 0)
