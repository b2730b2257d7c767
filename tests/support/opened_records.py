"""Records of synthetic scans, opened like those of an archive, for kernels that read their bytes."""

import numpy as np
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.voxel.voxel_octree import VoxelPoints, build_voxel
from solidcloud.schemas.archive.codec import (
    OPTIONAL_COLUMNS,
    DecompressedRecord,
    Record,
    RecordShape,
    decode_voxel,
    decompress_record,
    encode_voxel,
    voxel_point_dtype,
)
from solidcloud.schemas.archive.radius_model import RADIUS_CLASSES
from solidcloud.schemas.archive.voxel import Links, VoxelData
from synthetic_scans import make_steps

ARCHIVE_ID = bytes(range(16))
KEY = 0x1234567


def shape_of(voxel: VoxelData) -> RecordShape:
    """Return the entry of this voxel's record in an index."""
    counts = len(voxel.cells.nodes), len(voxel.nodes.count), len(voxel.points)
    return RecordShape(*counts, voxel_point_dtype(voxel))


def decode(record: Record, voxel: VoxelData, steps: int, **other: object) -> tuple[VoxelData, Links]:
    """Decode a record with correct arguments, except for those in `other`."""
    arguments = {
        "cells": record.cells,
        "nodes": record.nodes,
        "points": record.points,
        "shape": shape_of(voxel),
        "key": voxel.key,
        "archive_id": ARCHIVE_ID,
        "voxel_steps": steps,
        **other,
    }
    return decode_voxel(**arguments)


def assert_same_bits(found: VoxelData, expected: VoxelData) -> None:
    """Assert that every column has the same type, shape and bytes."""
    assert found.key == expected.key
    assert found.top_shift == expected.top_shift
    columns = [
        *zip(found.cells, expected.cells, strict=True),
        *zip(found.nodes, expected.nodes, strict=True),
        *((getattr(found, f), getattr(expected, f)) for f in ("points", *OPTIONAL_COLUMNS)),
    ]
    for a, b in columns:
        assert (a is None) == (b is None)
        if a is not None:
            assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())


def kept(n: int, seed: int) -> dict[str, np.ndarray]:
    """Return optional columns with any bits, including NaN."""
    rng = np.random.default_rng(seed)
    bits = rng.integers(0, 2**32, n, np.uint32)
    return {
        "scan_index": rng.integers(0, 2**16, n).astype(np.uint16),
        "intensity": bits.view(np.float32),
        "radius_class": rng.integers(0, RADIUS_CLASSES, n).astype(np.uint8),
        "rgb": rng.integers(0, 256, (n, 3)).astype(np.uint8),
        "classification": rng.integers(0, 256, n).astype(np.uint8),
    }


def open_points(points: VoxelPoints, steps: int, **options: object) -> DecompressedRecord:
    """Return the record of some points, by default in small cells and leaf nodes."""
    config = BuildConfig(**{"cell_points": 40, "leaf": 8, "degree": 3, **options})
    voxel = build_voxel(KEY, points, steps, config)
    record = encode_voxel(voxel, ARCHIVE_ID)
    return decompress_record(*record[:3], shape_of(voxel), KEY, ARCHIVE_ID, steps)


def open_scan(kind: str, seed: int, count: int, steps: int, **options: object) -> DecompressedRecord:
    """Return the record of a synthetic scan."""
    return open_points(VoxelPoints(make_steps(kind, seed, count, steps)), steps, **options)


def points_of(record: DecompressedRecord) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return all points of a record (p, 3) int64 [voxel steps], and the leaf node of each (p,).

    Points are in stored order.
    """
    return points_below(*record.decode())


def points_below(voxel: VoxelData, links: Links) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the points and leaf nodes of a decoded voxel, as `points_of` does."""
    points, nodes = np.empty((len(voxel.points), 3), np.int64), np.empty(len(voxel.points), np.int64)
    for node in np.flatnonzero(links.is_leaf).tolist():
        run = slice(int(links.first[node]), int(links.first[node]) + int(voxel.nodes.count[node]))
        corner = voxel.cells.low[links.cell[node]].astype(np.int64) + voxel.nodes.block_low[node]
        points[run], nodes[run] = voxel.points[run] + corner, node
    return points, nodes
