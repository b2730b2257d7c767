"""The store: sizes before loading, and records that are not what the index says."""

import os
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from solidcloud.schemas.archive import voxel as voxel_module
from solidcloud.schemas.archive.codec import encode_voxel
from solidcloud.schemas.errors import CorruptError, FormatError, MisleadingIndexError
from solidcloud.server.residency.arena import ArenaBuffer
from solidcloud.server.residency.voxel_store import VoxelStore


@pytest.fixture
def store(tmp_path: Path) -> VoxelStore:
    """A store of a few voxels."""
    return VoxelStore(archive_cases.build(tmp_path, synthetic_scans.make_scan("noise", 3, 300)).archive)


def test_a_folder_without_an_archive_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no archive here"):
        VoxelStore(tmp_path)


def test_a_flipped_byte_is_corrupt_and_named(store: VoxelStore) -> None:
    row = 2
    entry = store.archive.voxels[row]
    path = store.archive.shard_path(int(entry["shard"]))
    with open(path, "r+b") as file:
        offset = int(entry["frame_offset"][2]) + int(entry["frame_bytes"][2]) // 2
        byte = os.pread(file.fileno(), 1, offset)[0]
        os.pwrite(file.fileno(), bytes([byte ^ 0x10]), offset)
    arena = ArenaBuffer(int(store.sizes.max())).arena
    with pytest.raises(CorruptError) as caught:
        store.load(row, arena, 0)
    x, y, z = store.archive.coordinates[row]
    assert f"{path}: voxel ({x}, {y}, {z})" in str(caught.value)
    assert store.load(row + 1, arena, 0)[0] == 0


def test_a_point_outside_its_cell_is_corrupt_and_named(
    store: VoxelStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    voxel, _ = store.archive.read_voxel(1)
    points = voxel.points.copy()
    points[-1] = 65535
    record = encode_voxel(voxel._replace(points=points), store.archive.header.archive_id)
    monkeypatch.setattr(store.archive, "read_frames", lambda row: (record.cells, record.nodes, record.points))
    x, y, z = store.archive.coordinates[1]
    with pytest.raises(CorruptError, match=rf"voxel \({x}, {y}, {z}\): .*a point outside its cell"):
        store.load(1, ArenaBuffer(1 << 20).arena, 0)


def test_leaf_nodes_that_the_index_does_not_count_are_corrupt(store: VoxelStore) -> None:
    store.archive.voxels["leaves"][1] += 1
    with pytest.raises(CorruptError, match=r"leaf nodes, the index says \d+"):
        store.load(1, ArenaBuffer(1 << 20).arena, 0)


def test_a_tree_too_high_for_the_stack_is_corrupt(store: VoxelStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(voxel_module, "MAX_LEVELS", 0)
    with pytest.raises(CorruptError, match="levels of nodes, expected at most 0"):
        store.load(int(np.argmax(store.sizes)), ArenaBuffer(1 << 20).arena, 0)


def test_a_radius_class_that_there_is_none_of_is_corrupt_and_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    models = frozenset({"mean", "local"})
    store = VoxelStore(
        archive_cases.build(tmp_path, synthetic_scans.make_scan("noise", 3, 300), models=models).archive
    )
    voxel, _ = store.archive.read_voxel(1)
    classes = voxel.radius_class.copy()
    for greatest in (31, 32):
        classes[-1] = greatest
        record = encode_voxel(voxel._replace(radius_class=classes), store.archive.header.archive_id)
        frames = (record.cells, record.nodes, record.points)
        monkeypatch.setattr(store.archive, "read_frames", lambda row, frames=frames: frames)
        x, y, z = store.archive.coordinates[1]
        kind = MisleadingIndexError if greatest < 32 else CorruptError
        with pytest.raises(kind, match=rf"voxel \({x}, {y}, {z}\): .*radius class {greatest}"):
            store.load(1, ArenaBuffer(1 << 20).arena, 0)
