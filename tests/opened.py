"""Records opened as an archive's are, without an archive: of made scans, for kernels that read their bytes."""

import numpy as np
from numpy.typing import NDArray
from scans import make_steps
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.octree import VoxelPoints, build_voxel
from solidcloud.schemas.codec import OpenRecord, RecordShape, encode_voxel, open_record, voxel_point_dtype
from solidcloud.schemas.voxel import Links, VoxelData

ARCHIVE_ID = bytes(range(16))
KEY = 0x1234567


def open_points(points: VoxelPoints, steps: int, **options: object) -> OpenRecord:
    """The record of some points, in small cells and leaf nodes unless the options say otherwise."""
    config = BuildConfig(**{"cell_points": 40, "leaf": 8, "degree": 3, **options})
    voxel = build_voxel(KEY, points, steps, config)
    record = encode_voxel(voxel, ARCHIVE_ID)
    shape = RecordShape(record.cell_rows, record.node_rows, record.point_rows, voxel_point_dtype(voxel))
    return open_record(record.cells, record.nodes, record.points, shape, KEY, ARCHIVE_ID, steps)


def open_scan(kind: str, seed: int, count: int, steps: int, **options: object) -> OpenRecord:
    """The record of a made scan."""
    return open_points(VoxelPoints(make_steps(kind, seed, count, steps)), steps, **options)


def points_of(record: OpenRecord) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """All points of a record (p, 3) int64 [voxel steps] in stored order, and the leaf node of each (p,)."""
    return points_below(*record.decode())


def points_below(voxel: VoxelData, links: Links) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The same of a decoded voxel."""
    points, nodes = np.empty((len(voxel.points), 3), np.int64), np.empty(len(voxel.points), np.int64)
    for node in np.flatnonzero(links.is_leaf).tolist():
        run = slice(int(links.first[node]), int(links.first[node]) + int(voxel.nodes.count[node]))
        corner = voxel.cells.low[links.cell[node]].astype(np.int64) + voxel.nodes.block_low[node]
        points[run], nodes[run] = voxel.points[run] + corner, node
    return points, nodes
