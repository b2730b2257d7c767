"""Points or bounding spheres of one voxel, as a viewer draws them.

The hierarchy itself is the picture, as in QSplat (Rusinkiewicz and Levoy 2000): far voxels are drawn
by the spheres of one level, near ones by their points. Points are in the order of the hierarchy, so
that every 4^k-th of them is spread evenly, and a finer detail adds to a coarser one. Coarse details
are read from the archive's level of detail, if it has one: a thirtieth of the points.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ...schemas.archive.level import halvings_between
from ...schemas.archive.voxel import LeafCells, Links, Nodes, VoxelData, top_shift, transpose_columns
from ...schemas.archive.voxel_grid import voxel_keys
from ...schemas.errors import BadRequestError, BusyError, TooLargeError
from ...schemas.wire.request_limits import MAX_MESSAGE_BYTES
from ...schemas.wire.tile_messages import LEVEL_DETAIL, TileAnswer, TileRequest
from ..archives.placed_archive import PlacedArchive
from ..residency.voxel_store import VoxelStore

Steps = NDArray[np.int64]
# Coordinates of a tile have this many bits.
_BITS = 16
# From this detail on, a tile shows the points of the level of detail, if the archive has one: one of
# LEVEL_EVERY of them, because a level has a thirtieth of the points, and the tile one of 64.
_LEVEL_EVERY = 2
# Types of rgb, intensity, classification and scan.
_KINDS: tuple[np.dtype, ...] = (np.dtype(("u1", 3)), np.dtype("f4"), np.dtype("u1"), np.dtype("u2"))
# Largest voxel whose points, or whose spheres, are read for a tile. A record takes 50 bytes a point
# while it is decoded: 4 million points 0.2 GB and 0.5 s.
_MAX_POINTS, _MAX_NODES = 1 << 22, 1 << 21
# The same for its points in the level of detail, which are read record by record: 40 MB.
_MAX_LEVEL_POINTS = 1 << 20
# Records of more points are decoded one at a time, so that many requests take no more memory than
# one. A request waits for its turn for at most this long [s].
_LARGE_POINTS, _TURN_SECONDS = 1 << 18, 1.0
_large = threading.Lock()


def read_tile(
    request: TileRequest, placed: PlacedArchive, store: VoxelStore, level: Archive | None = None
) -> TileAnswer:
    """Read a tile of an archive. placed: its place in the scene.  level: its level of detail.

    What the store hides is left out: points, and spheres as a whole.

    Raise BadRequestError if there is no such voxel, TooLargeError for a voxel or an answer over the
    limits, BusyError if other large voxels are being read, CorruptError if it cannot be read.
    """
    archive = store.archive
    row = _row_of(archive, request.voxel)
    header = archive.header
    lattice = header.lattice
    shift = max(0, int(lattice.voxel_steps - 1).bit_length() - _BITS)
    low = lattice.to_world(np.array(request.voxel, np.int64) * lattice.voxel_steps)
    pose = np.eye(4)
    pose[:3, 3] = low
    if placed.pose is not None:
        pose = placed.pose @ pose
    total = int(archive.voxels["rows"][row, 2])
    columns: tuple[NDArray | None, ...] = (None, None, None, None)
    kept = slice(0, 0)
    coarse = _level_of(request, archive, level)
    with _turn(archive, row, request) if coarse is None else nullcontext():
        if coarse is not None:
            places, columns, kept = _representatives(request, archive, coarse)
            radii = np.empty(0, np.int64)
        elif request.level is None:
            kept = slice(None, None, 4**request.detail)
            voxel, links = archive.read_voxel(row)
            places, radii = _points(voxel, links, 4**request.detail), np.empty(0, np.int64)
            columns = voxel.rgb, voxel.intensity, voxel.classification, voxel.scan_index
        else:
            tree = archive.open_tree(row)
            nodes = transpose_columns(tree.nodes)
            cells, unit = transpose_columns(tree.cells), top_shift(lattice.voxel_steps)
            places, radii = _spheres(nodes, cells, tree.links, request.level, unit)
        corner = np.array(request.voxel, np.int64) * lattice.voxel_steps
        reach = np.float64(lattice.step) * radii if len(radii) else 0.0
        shown = ~store.hides(lattice.to_world(places + corner), reach)
        places, radii = places[shown], radii[shown[: len(radii)]]
        # Half a unit is what rounding a centre may move it.
        spheres = -(-radii >> shift) + (shift > 0)
        return TileAnswer(
            pose[None],
            lattice.step * 2**shift,
            total,
            header.radius,
            np.clip((places + (1 << shift >> 1)) >> shift, 0, (1 << _BITS) - 1).astype(np.uint16),
            np.clip(spheres, 0, (1 << _BITS) - 1).astype(np.uint16),
            *(_column(values, kind, kept, shown) for values, kind in zip(columns, _KINDS, strict=True)),
        )


@contextmanager
def _turn(archive: Archive, row: int, request: TileRequest) -> Iterator[None]:
    """Check the limits before anything is read, and wait for a turn if the voxel is large.

    Raise TooLargeError or BusyError.
    """
    _, nodes, points = archive.voxels["rows"][row].tolist()
    if request.level is None:
        shown = -(-points // 4**request.detail)
        if points > _MAX_POINTS:
            raise TooLargeError(
                f"voxel {request.voxel} of {points} points: at most {_MAX_POINTS} in a tile: ask for its spheres"
            )
        if shown * 6 > MAX_MESSAGE_BYTES:
            raise TooLargeError(
                f"tile of {shown} points: a message holds {MAX_MESSAGE_BYTES} bytes: ask for less detail"
            )
    elif nodes > _MAX_NODES:
        raise TooLargeError(f"voxel {request.voxel} of {nodes} nodes: at most {_MAX_NODES} in a tile")
    if points <= _LARGE_POINTS:
        yield
        return
    if not _large.acquire(timeout=_TURN_SECONDS):
        raise BusyError(f"voxel {request.voxel} of {points} points: others are being read: ask again")
    try:
        yield
    finally:
        _large.release()


def _level_of(request: TileRequest, archive: Archive, level: Archive | None) -> Archive | None:
    """Return the level of detail if a tile is read from it; it does not distinguish scans."""
    is_coarse = request.level is None and request.detail >= LEVEL_DETAIL
    return level if is_coarse and not archive.header.scan_index else None


def _representatives(
    request: TileRequest, archive: Archive, level: Archive
) -> tuple[Steps, tuple[NDArray | None, ...], slice]:
    """Return points (p, 3) of a level in a voxel of its archive [steps from the voxel's corner].

    Also return rgb, intensity, classification and scan of all points of the level in the voxel, and
    which of them are the points. Raise TooLargeError if they are too many.
    """
    halvings = halvings_between(level.header.lattice, archive.header.lattice)
    base = np.array([request.voxel], np.int64) << halvings
    # The voxels of a level in one of the archive's are contiguous in Morton order.
    first, last = voxel_keys(np.concatenate([base, base + ((1 << halvings) - 1)]))
    keys = level.voxels["key"]
    rows = range(int(np.searchsorted(keys, first)), int(np.searchsorted(keys, last, side="right")))
    count = int(level.voxels["rows"][rows.start : rows.stop, 2].sum())
    if count > _MAX_LEVEL_POINTS:
        raise TooLargeError(
            f"voxel {request.voxel} with {count} points in its level of detail: at most {_MAX_LEVEL_POINTS} in a tile: "
            "ask for its spheres"
        )
    steps = level.header.lattice.voxel_steps
    places, columns = [np.empty((0, 3), np.int64)], []
    for row in rows:
        voxel, links = level.read_voxel(row)
        places.append(_points(voxel, links, 1) + (level.coordinates[row] - base[0]) * steps)
        columns.append((voxel.rgb, voxel.intensity, voxel.classification))
    joined = (
        None if not columns or columns[0][k] is None else np.concatenate([each[k] for each in columns])
        for k in range(3)
    )
    kept = slice(None, None, _LEVEL_EVERY * 4 ** (request.detail - LEVEL_DETAIL))
    return np.concatenate(places)[kept], (*joined, None), kept


def _row_of(archive: Archive, voxel: tuple[int, int, int]) -> int:
    """Return the index row of a voxel. Raise BadRequestError."""
    key = voxel_keys(np.array([voxel], np.int64))[0]
    keys = archive.voxels["key"]
    row = int(np.searchsorted(keys, key))
    if row == len(keys) or keys[row] != key:
        raise BadRequestError(f"voxel {voxel}: it holds no points: take voxels from a list of voxels")
    return row


def _points(voxel: VoxelData, links: Links, every: int) -> Steps:
    """Return one of `every` points (p, 3) in the order of the record [steps from the voxel's corner]."""
    leaves = np.flatnonzero(links.is_leaf)
    first = links.first[leaves]
    order = np.argsort(first, kind="stable")
    chosen = np.arange(0, len(voxel.points), every)
    leaf = leaves[order[np.searchsorted(first[order], chosen, side="right") - 1]]
    low = voxel.nodes.block_low[leaf].astype(np.int64) + voxel.cells.low[links.cell[leaf]]
    places: Steps = voxel.points[chosen] + low
    return places


def _spheres(tree: Nodes, cells: LeafCells, links: Links, level: int, shift: int) -> tuple[Steps, Steps]:
    """Return centres (n, 3) and radii (n,) of the spheres of a level [steps from the voxel's corner].

    shift: binary logarithm of the unit of the top hierarchy.
    """
    nodes = np.zeros(1, np.int64)
    for _ in range(level):
        inner = ~links.is_leaf[nodes]
        if not inner.any():
            break
        parents = nodes[inner]
        counts = tree.count[parents].astype(np.int64)
        starts = np.repeat(links.first[parents] - np.cumsum(counts) + counts, counts)
        nodes = np.concatenate([nodes[~inner], starts + np.arange(counts.sum())])
    nodes = np.sort(nodes)
    cell = links.cell[nodes]
    top = cell < 0
    centers, radii = tree.center[nodes].astype(np.int64), tree.radius[nodes].astype(np.int64)
    centers[top] <<= shift
    radii[top] <<= shift
    centers[~top] += cells.low[cell[~top]]
    return centers, radii


def _column(values: NDArray | None, kind: np.dtype, kept: slice, shown: NDArray[np.bool_]) -> NDArray:
    """Return the shown ones of the kept values of a column, none if the archive does not keep it."""
    if values is None:
        return np.empty((0, *kind.shape), kind.base)
    return np.ascontiguousarray(values[kept][shown])
