"""Test that decode(encode(v)) == v bit for bit."""

import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from opened_records import ARCHIVE_ID, KEY, assert_same_bits, decode, kept, shape_of
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.voxel.voxel_octree import VoxelPoints, build_voxel
from solidcloud.schemas.archive.codec import OPTIONAL_COLUMNS, encode_voxel
from solidcloud.schemas.archive.voxel import VoxelData
from synthetic_scans import WITH_POINTS, make_steps

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"


@st.composite
def voxels(draw: st.DrawFn) -> tuple[VoxelData, int]:
    """A voxel of random points, many of them equal or in line, of any size and tree, and its steps."""
    steps = draw(st.sampled_from([1, 2, 1000, 65535, 65536, 65537, 200_000, 1 << 21]))
    coordinate = st.integers(0, steps - 1) | st.sampled_from([0, steps - 1, min(65535, steps - 1)])
    rows = draw(st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=60))
    rows = rows * draw(st.integers(1, 3))
    if draw(st.booleans()):  # in line along an axis
        rows = [(x, rows[0][1], rows[0][2]) for x, _, _ in rows]
    config = BuildConfig(
        leaf=draw(st.integers(1, 32)),
        degree=draw(st.integers(2, 16)),
        cell_points=draw(st.sampled_from([1, 5, 4096])),
        with_slab=draw(st.booleans()),
    )
    columns = draw(st.sets(st.sampled_from(OPTIONAL_COLUMNS)))
    columns_of = {name: column for name, column in kept(len(rows), 7).items() if name in columns}
    return build_voxel(KEY, VoxelPoints(np.array(rows, np.int32), **columns_of), steps, config), steps


@pytest.mark.interpreted
@settings(max_examples=15 if INTERPRETED else 150, deadline=None)
@given(voxels())
def test_decoding_gives_back_what_was_encoded(case: tuple[VoxelData, int]) -> None:
    voxel, steps = case
    record = encode_voxel(voxel, ARCHIVE_ID)
    found, links = decode(record, voxel, steps)
    assert_same_bits(found, voxel)
    assert record.leaf_rows == int(links.is_leaf.sum())
    assert (record.cell_rows, record.node_rows, record.point_rows) == shape_of(voxel)[:3]


@pytest.mark.interpreted
@pytest.mark.parametrize("kind", WITH_POINTS)
@pytest.mark.parametrize("steps", [1000, 65536, 1 << 21])
def test_synthetic_scans_come_back(kind: str, steps: int) -> None:
    points = make_steps(kind, 3, 200, steps)
    config = BuildConfig(cell_points=50, leaf=16)
    voxel = build_voxel(KEY, VoxelPoints(points, **kept(len(points), 1)), steps, config)
    found, _ = decode(encode_voxel(voxel, ARCHIVE_ID), voxel, steps)
    assert_same_bits(found, voxel)
