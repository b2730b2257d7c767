"""A voxel spooled as runs, built in parts, and read back from its record."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from solidcloud.builder.spool.spool import Spool
from solidcloud.builder.voxel.voxel_octree import BuiltVoxel
from solidcloud.schemas.archive.codec import RecordShape, decode_voxel, voxel_point_dtype
from solidcloud.schemas.archive.voxel import VoxelData
from solidcloud.schemas.archive.voxel_grid import Lattice
from written_runs import write_run

KEY = 0x1C0000000000000  # voxel (0, 0, 0)
COLUMNS = {"scan_index": ("<u2",), "intensity": ("<f4",), "rgb": ("u1", (3,)), "classification": ("u1",)}


def spooled(folder: Path, rows: NDArray, steps: int, cuts: list[int]) -> Spool:
    """Return a spool of one voxel, with one run of rows between each two cuts."""
    folder.mkdir()
    for number, part in enumerate(np.split(rows, cuts)):
        if len(part):
            write_run(folder / f"{number:06d}.run", np.full(len(part), KEY, np.uint64), part)
    return Spool(folder, rows.dtype, Lattice((0.0, 0.0, 0.0), 0.001, steps))


def rows_of(points: NDArray[np.int32], *names: str) -> NDArray:
    """Return rows of the spool with some of the columns, with few different values in each."""
    rng = np.random.default_rng(5)
    rows = np.zeros(len(points), [("local", "<i4", (3,)), *((name, *COLUMNS[name]) for name in names)])
    rows["local"] = points
    for name in names:
        rows[name] = rng.integers(0, 3, rows[name].shape)
    return rows


def hashed(local: NDArray[np.int32], _: range, times: int = 1) -> NDArray[np.uint8]:
    """Return a radius class for each position."""
    return (local.astype(np.int64) @ np.array([7919, 104729, 1299709]) % 32).astype(np.uint8)


def decoded(built: BuiltVoxel, steps: int) -> VoxelData:
    """Return the voxel of a record, after all checks of a reader."""
    record = built.record
    shape = RecordShape(record.cell_rows, record.node_rows, record.point_rows, voxel_point_dtype(built.voxel))
    frames = (bytes(record.cells), bytes(record.nodes), bytes(record.points))
    voxel, links = decode_voxel(*frames, shape, KEY, bytes(16), steps)
    assert record.leaf_rows == links.is_leaf.sum()
    return voxel


def assert_same(a: VoxelData, b: VoxelData) -> None:
    """Assert that two voxels are equal, row by row."""
    assert a.top_shift == b.top_shift
    for x, y in zip((*a.cells, *a.nodes, *a[4:]), (*b.cells, *b.nodes, *b[4:]), strict=True):
        assert (x is None) == (y is None)
        assert x is None or np.array_equal(x, y)
