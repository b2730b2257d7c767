"""Test that a voxel built in parts is the voxel built at once."""

from pathlib import Path

import numpy as np
import pytest
import solidcloud.builder.build_limits as build_limits
from dense_voxels import COLUMNS, KEY, assert_same, decoded, hashed, rows_of, spooled
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.voxel import dense_record
from solidcloud.builder.voxel.dense_voxel import build_dense
from solidcloud.builder.voxel.voxel_octree import VoxelPoints, build_voxel
from synthetic_scans import make_steps

PART = 200


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parts of a few hundred points, passed on in windows of a few cells."""
    monkeypatch.setattr(build_limits, "DENSE_POINTS", PART)
    monkeypatch.setattr(dense_record, "WINDOW_POINTS", 70)


@pytest.mark.parametrize("kind", ["corner", "duplicates"])
def test_a_voxel_built_in_parts_is_the_voxel(kind: str, tmp_path: Path) -> None:
    steps = 1000
    points = make_steps(kind, 3, 1500, steps)
    names = {
        "corner": ("scan_index", "intensity"), "duplicates": tuple(COLUMNS), "noise": ("classification",)
    }.get(kind, ())  # fmt: skip
    rows = rows_of(points, *names)
    config = BuildConfig(cell_points=40, leaf=8, degree=3, with_slab=kind != "pillar")
    classify = hashed if kind == "corner" else None
    whole = VoxelPoints(
        points, radius_class=hashed(points, range(0)) if classify else None, **{n: rows[n] for n in names}
    )
    spool = spooled(tmp_path / "spool", rows, steps, [400, 900])
    built = build_dense(KEY, spool, config, bytes(16), tmp_path, classify)
    assert_same(decoded(built, steps), build_voxel(KEY, whole, steps, config))
    assert [built.low.tolist(), built.high.tolist()] == [
        points.min(axis=0).tolist(),
        points.max(axis=0).tolist(),
    ]
    assert [path.name for path in tmp_path.iterdir()] == ["spool"]


@pytest.mark.parametrize(
    ("points", "config"),
    [
        (np.full((3000, 3), 77), BuildConfig(leaf=8, degree=3)),
        (make_steps("plane", 1, 900, 1000), BuildConfig(cell_points=700)),
    ],
    ids=["one place", "large cells"],
)
def test_cells_of_more_points_than_a_part_are_one_part(
    points: NDArray[np.int32], config: BuildConfig, tmp_path: Path
) -> None:
    spool = spooled(tmp_path / "spool", rows_of(points), 1000, [100])
    found = decoded(build_dense(KEY, spool, config, bytes(16), tmp_path), 1000)
    assert_same(found, build_voxel(KEY, VoxelPoints(points.astype(np.int32)), 1000, config))
