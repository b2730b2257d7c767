"""Voxels near a place, of all archives of a scene, nearest first."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError
from ...schemas.wire.tile_messages import VoxelsAnswer, VoxelsRequest
from ..archives.placed_archive import ArchiveGeneration, PlacedArchive
from ..archives.rigid_transform import transform_points

Floats = NDArray[np.float64]

# Voxels whose boxes are computed at a time, so that a large index takes little memory.
_BLOCK = 1 << 16


def list_voxels(
    request: VoxelsRequest, placed: Sequence[PlacedArchive], opened: Sequence[ArchiveGeneration]
) -> VoxelsAnswer:
    """Return the voxels near a place. placed, opened: the archives, and their generations in use."""
    if len(placed) > np.iinfo(np.uint16).max:
        raise BadRequestError(f"{len(placed)} archives: expected at most {np.iinfo(np.uint16).max}")
    place = np.array(request.place, np.float64)
    reach = np.inf if request.reach is None else request.reach
    near = [
        _distances(
            generation, place if each.inverse is None else transform_points(each.inverse, place[None])[0]
        )
        for each, generation in zip(placed, opened, strict=True)
    ]
    within = [np.flatnonzero(distances <= reach) for distances in near]
    total = sum(map(len, within))
    archive = np.repeat(np.arange(len(placed), dtype=np.uint16), [len(rows) for rows in within])
    rows = np.concatenate(within)
    distance = np.concatenate([distances[chosen] for distances, chosen in zip(near, within, strict=True)])
    # Rows of an index are in the order of voxels, so a stable sort orders equal distances.
    order = np.argsort(distance, kind="stable")[: request.limit]
    archive, rows = archive[order], rows[order]
    columns = [_columns(generation, rows[archive == number]) for number, generation in enumerate(opened)]
    back = np.argsort(np.argsort(archive, kind="stable"), kind="stable")
    voxel, low, high, points, size, resident = (
        np.concatenate([column[k] for column in columns])[back] for k in range(6)
    )
    return VoxelsAnswer(
        total,
        archive,
        voxel,
        low,
        high,
        points,
        size,
        resident,
        np.stack([np.eye(4) if each.pose is None else each.pose for each in placed]),
        np.array([generation.store.archive.header.lattice.voxel_size for generation in opened]),
    )


def _boxes(opened: ArchiveGeneration, rows: NDArray[np.int64] | slice) -> tuple[Floats, Floats]:
    """Return the corners (v, 3) of the boxes around the points of voxels, archive frame [m]."""
    archive = opened.store.archive
    lattice, corner = archive.header.lattice, archive.coordinates[rows].astype(np.int64)
    corner = corner * lattice.voxel_steps
    low, high = (lattice.to_world(corner + archive.voxels[name][rows]) for name in ("low", "high"))
    return low, high


def _distances(opened: ArchiveGeneration, place: Floats) -> Floats:
    """Return the distance (v,) of each voxel's box from a place (3,), archive frame [m]."""
    count = len(opened.store.archive.voxels)
    found = np.empty(count)
    for begin in range(0, count, _BLOCK):
        rows = slice(begin, begin + _BLOCK)
        low, high = _boxes(opened, rows)
        apart = np.maximum(np.maximum(low - place, place - high), 0.0)
        found[rows] = np.sqrt((apart * apart).sum(axis=1))
    return found


def _columns(opened: ArchiveGeneration, rows: NDArray[np.int64]) -> tuple[NDArray, ...]:
    """Return voxel, low, high, points, bytes and resident of `VoxelsAnswer` for rows of an index."""
    archive = opened.store.archive
    voxels = archive.voxels
    return (
        archive.coordinates[rows].astype(np.int32),
        *_boxes(opened, rows),
        voxels["rows"][rows, 2].astype(np.uint64),
        voxels["frame_bytes"][rows].reshape(len(rows), -1).sum(axis=1, dtype=np.uint64),
        opened.data.arrays.where[rows, 0] >= 0,
    )
