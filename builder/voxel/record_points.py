"""Points of a voxel's record, in blocks (all, those in a box, or a sample) or all at once."""

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.codec import DecompressedRecord
from ...schemas.archive.index import Header
from ...schemas.archive.voxel import Links, VoxelData, top_shift
from ..kernels.neighbours.nearest_points import NodeSpheres
from ..kernels.points.voxel_records import Leaves, copy_points

BLOCK_POINTS = 1 << 16
# Name in `--keep` -> field of a record, and its type.
_COLUMNS: dict[str, tuple[str, np.dtype]] = {
    "scan": ("scan_index", np.dtype("<u2")),
    "intensity": ("intensity", np.dtype("<f4")),
    "rgb": ("rgb", np.dtype(("u1", (3,)))),
    "classification": ("classification", np.dtype("u1")),
}
# Larger than every lattice coordinate.
_EVERYWHERE = np.array([[-(1 << 62)] * 3, [1 << 62] * 3], np.int64)


class PointBlock(NamedTuple):
    """Points of a record.

    xyz: (m, 3) int32 [voxel steps].  rows: (m,) int64, index of each point in the record.  nodes:
    (m,) int32, its leaf node.
    """

    xyz: NDArray[np.int32]
    rows: NDArray[np.int64]
    nodes: NDArray[np.int32]


def leaves_of(record: DecompressedRecord) -> Leaves:
    """Return a record in the form that kernels take."""
    first, is_leaf, cell = record.tree
    nodes, cells = record.nodes, record.cells
    return Leaves(
        record.planes,
        first,
        is_leaf,
        cell,
        nodes.count,
        nodes.axis,
        nodes.block_low,
        cells.low,
        cells.log2_size,
    )


def spheres_of(record: DecompressedRecord) -> NodeSpheres:
    """Return the bounds of a record in the form that kernels take."""
    return NodeSpheres(record.nodes.center, record.nodes.radius, np.int64(1 << top_shift(record.voxel_steps)))


def stored_columns(header: Header) -> dict[str, np.dtype]:
    """Return the stored columns of an archive that can be exported, by their name in `--keep`."""
    kept = header.point_dtype.names or ()
    return {name: kind for name, (field, kind) in _COLUMNS.items() if field in kept}


def record_columns(columns: Iterable[str]) -> list[str]:
    """Return the names of these columns in a record (schemas/archive/codec.py OPTIONAL_COLUMNS)."""
    return [_COLUMNS[name][0] for name in columns]


def read_columns(
    record: DecompressedRecord, columns: Iterable[str], rows: NDArray[np.int64]
) -> dict[str, NDArray]:
    """Return columns (m,) or (m, 3) of some points of a record, by name. rows: (m,), see `PointBlock`.

    The record must have these columns.
    """
    found = {}
    for name in columns:
        field, kind = _COLUMNS[name]
        at = record.dtype.fields[field][1]  # type: ignore[index]  # its dtype has fields
        raw = np.stack([record.planes[at + i][rows] for i in range(kind.itemsize)], axis=1)
        found[name] = np.ascontiguousarray(raw).view(kind.base).reshape(-1, *kind.shape)
    return found


def hash_limit(share: float) -> np.uint64:
    """Return the limit below which a point's hash must lie to select about `share` of all points.

    The result for a share of 1 or more is 0, which selects all. The lattice coordinates alone
    decide whether a point is selected, whatever the order of scans, the voxel size or the number of
    jobs.
    """
    return np.uint64(0 if share >= 1.0 else max(1, int(share * 2.0**64)))


def iter_points(
    record: DecompressedRecord,
    base: NDArray[np.int64],
    *,
    box: NDArray[np.int64] | None = None,
    limit: np.uint64 = np.uint64(0),  # noqa: B008  a number
    block: int = BLOCK_POINTS,
) -> Iterator[PointBlock]:
    """Yield blocks of at most `block` points of a record, in the order of the leaf nodes' rows.

    No block is empty. base: (3,) lattice coordinates of the voxel's corner.
    box: (2, 3) lattice coordinates, both corners inclusive.
    limit: see `hash_limit`; if set, only the first of equal points in one leaf node is yielded.
    """
    leaves = leaves_of(record)
    low, high = _EVERYWHERE if box is None else box
    at, nodes = 0, len(leaves.first)
    xyz, rows, node = np.empty((block, 3), np.int32), np.empty(block, np.int64), np.empty(block, np.int32)
    while at < nodes:
        at, held = copy_points(leaves, at, base, low, high, limit, xyz, rows, node)
        if held:
            yield PointBlock(xyz[:held].copy(), rows[:held].copy(), node[:held].copy())


def voxel_points(voxel: VoxelData, links: Links) -> NDArray[np.int64]:
    """Return the points of a voxel (p, 3) int64 [voxel steps], in stored order."""
    leaf = np.flatnonzero(links.is_leaf)
    # Sort by first point: a cell that is a single leaf node stands among the roots, before the leaf
    # nodes of other cells.
    leaf = leaf[np.argsort(links.first[leaf], kind="stable")]
    low = voxel.cells.low[links.cell[leaf]].astype(np.int64) + voxel.nodes.block_low[leaf]
    return np.repeat(low, voxel.nodes.count[leaf].astype(np.int64), axis=0) + voxel.points.astype(np.int64)
