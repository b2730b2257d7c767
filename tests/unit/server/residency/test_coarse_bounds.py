"""Coarse tops: what a slot holds, who gets one, and that what cannot be read, or was read before, changes nothing."""

import os
import shutil
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from coarse_tops import Made, build_scattered, open_made
from numpy.typing import NDArray
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.errors import CorruptError
from solidcloud.server.kernels.collide.coarse_clearance import MAX_SLOT_NODES
from solidcloud.server.kernels.core.scene_arrays import COUNT, COUNTED, FIRST
from solidcloud.server.residency.coarse_bounds import SLOT_BYTES, CoarseBounds
from solidcloud.server.residency.voxel_store import VoxelStore

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"


@pytest.fixture(scope="module")
def scattered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build an archive of eight voxels."""
    return build_scattered(tmp_path_factory.mktemp("scattered"))


@pytest.fixture
def made(scattered: Path, tmp_path: Path) -> Made:
    """Open a copy of the archive, which the test may damage. Loaded and filled slots are the same."""
    return open_made(shutil.copytree(scattered, tmp_path / "archive"), boxes=False)


def enclosing(top: NDArray[np.int32], points: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which nodes (n,) of a top hold which points (p, 3) [voxel steps], both bounds: (p, n). Exact in float64."""
    words = top.view(np.float32).astype(np.float64)
    apart = points[:, None, :] - words[:, :3]
    along = (apart * words[:, 4:7]).sum(axis=2)
    in_slab = (along >= words[:, 8]) & (along <= words[:, 9])
    in_box = (np.abs(apart) <= words[:, 4:7]).all(axis=2)
    return ((apart**2).sum(axis=2) <= words[:, 3] ** 2) & np.where(words[:, 7] < 0, in_box, in_slab)


def damage(store: VoxelStore, row: int, dataset: int) -> None:
    """Turn a bit of a frame over, in the middle of it."""
    entry = store.archive.voxels[row]
    offset = int(entry["frame_offset"][dataset]) + int(entry["frame_bytes"][dataset]) // 2
    with open(store.archive.shard_path(int(entry["shard"])), "r+b") as file:
        byte = os.pread(file.fileno(), 1, offset)[0]
        os.pwrite(file.fileno(), bytes([byte ^ 0x10]), offset)


# --- what a slot holds ----------------------------------------------------------------------------------


@pytest.mark.interpreted
@pytest.mark.parametrize(
    ("kind", "voxel", "options"),
    [
        ("noise", 4.0, {"leaf": 2, "degree": 2, "cell_points": 16}),
        ("noise", 4.0, {"leaf": 1, "degree": 16, "cell_points": 4096}),
        ("plane", 2.0, {"resolution": 1e-6, "leaf": 3, "cell_points": 64}),
        ("one point", 0.5, {}),
        ("duplicates", 0.5, {"with_slab": False, "leaf": 1}),
    ],
)
def test_the_nodes_of_a_top_enclose_all_points(
    tmp_path: Path, kind: str, voxel: float, options: dict
) -> None:
    scan = synthetic_scans.make_scan(kind, 7, 300 if INTERPRETED else 700)
    made = open_made(archive_cases.build(tmp_path, scan, voxel=voxel, **options).archive)
    degree, leaves = options.get("degree", 16), made.store.archive.voxels["leaves"]
    for row in range(made.voxels):
        made.coarse.store_from_archive(made.store, row)
        top = made.top(row)
        points = voxel_points(*made.store.archive.read_voxel(row)).astype(np.int64)
        held = enclosing(top, points)
        assert held.any(axis=1).all()
        assert held.any(axis=0).all()  # no node is there in vain
        # All leaf nodes, or so many nodes that no inner one could be opened further, were it of the least degree.
        assert len(top) == leaves[row] or MAX_SLOT_NODES - degree + 1 < len(top) <= MAX_SLOT_NODES
        assert len(top) <= leaves[row]
        assert (top[:, FIRST] == -1).all() and not (top[:, COUNT] & COUNTED).any()


# --- what cannot be read --------------------------------------------------------------------------------


@pytest.mark.interpreted
@pytest.mark.parametrize("dataset", [0, 1])
def test_a_damaged_record_has_no_slot_and_takes_no_room(made: Made, dataset: int) -> None:
    coarse = CoarseBounds(made.voxels, 4 * made.voxels + SLOT_BYTES)
    damage(made.store, 1, dataset)
    for _ in range(2):
        with pytest.raises(CorruptError, match=("voxel .*, cells", "voxel .*, nodes")[dataset]) as caught:
            coarse.store_from_archive(made.store, 1)
    assert made.store.archive.where(1) in str(caught.value)
    assert coarse.stored == 0 and (coarse.arrays.slot == -1).all()
    damage(made.store, 1, dataset)  # the bit as it was
    coarse.store_from_archive(made.store, 1)
    assert made.top(1, coarse).tolist() == _remembered(made, 1)


def _remembered(made: Made, row: int) -> list:
    made.remember(row)
    return made.top(row).tolist()
