"""Points or bounding spheres of one voxel, as a viewer draws them.

The hierarchy itself is the picture, as in QSplat (Rusinkiewicz and Levoy 2000): far voxels are drawn
by the spheres of one level, near ones by their points. Points are in the order of the hierarchy, so
that every 4^k-th of them is spread evenly, and a finer detail adds to a coarser one.
"""

import numpy as np
from numpy.typing import NDArray

from ...builder.voxel.record_points import voxel_points
from ...schemas.archive.archive import Archive
from ...schemas.archive.voxel import Links, VoxelData, top_shift
from ...schemas.archive.voxel_grid import voxel_keys
from ...schemas.errors import BadRequestError
from ...schemas.wire.tile_messages import TileAnswer, TileRequest
from ..archives.placed_archive import PlacedArchive

Steps = NDArray[np.int64]
# Coordinates of a tile have this many bits.
_BITS = 16


def read_tile(request: TileRequest, placed: PlacedArchive, archive: Archive) -> TileAnswer:
    """Read a tile of an archive. placed: its place in the scene.

    Raise BadRequestError if there is no such voxel, CorruptError if it cannot be read.
    """
    row = _row_of(archive, request.voxel)
    voxel, links = archive.read_voxel(row)
    header = archive.header
    lattice = header.lattice
    shift = max(0, int(lattice.voxel_steps - 1).bit_length() - _BITS)
    low = lattice.to_world(np.array(request.voxel, np.int64) * lattice.voxel_steps)
    pose = np.eye(4)
    pose[:3, 3] = low
    if placed.pose is not None:
        pose = placed.pose @ pose
    kept = slice(0, 0)
    if request.level is None:
        kept = slice(None, None, 4**request.detail)
        places, radii = voxel_points(voxel, links)[kept], np.empty(0, np.int64)
    else:
        places, radii = _spheres(voxel, links, request.level, top_shift(lattice.voxel_steps))
    # Half a unit is what rounding a centre may move it.
    spheres = -(-radii >> shift) + (shift > 0)
    return TileAnswer(
        pose[None],
        lattice.step * 2**shift,
        len(voxel.points),
        header.radius,
        np.clip((places + (1 << shift >> 1)) >> shift, 0, (1 << _BITS) - 1).astype(np.uint16),
        np.clip(spheres, 0, (1 << _BITS) - 1).astype(np.uint16),
        _column(voxel.rgb, np.dtype(("u1", 3)), kept),
        _column(voxel.intensity, np.dtype("f4"), kept),
        _column(voxel.classification, np.dtype("u1"), kept),
        _column(voxel.scan_index, np.dtype("u2"), kept),
    )


def _row_of(archive: Archive, voxel: tuple[int, int, int]) -> int:
    """Return the index row of a voxel. Raise BadRequestError."""
    key = voxel_keys(np.array([voxel], np.int64))[0]
    keys = archive.voxels["key"]
    row = int(np.searchsorted(keys, key))
    if row == len(keys) or keys[row] != key:
        raise BadRequestError(f"voxel {voxel}: it holds no points: take voxels from a list of voxels")
    return row


def _spheres(voxel: VoxelData, links: Links, level: int, shift: int) -> tuple[Steps, Steps]:
    """Return centres (n, 3) and radii (n,) of the spheres of a level [steps from the voxel's corner].

    shift: binary logarithm of the unit of the top hierarchy.
    """
    nodes = np.zeros(1, np.int64)
    for _ in range(level):
        inner = ~links.is_leaf[nodes]
        if not inner.any():
            break
        parents = nodes[inner]
        counts = voxel.nodes.count[parents].astype(np.int64)
        starts = np.repeat(links.first[parents] - np.cumsum(counts) + counts, counts)
        nodes = np.concatenate([nodes[~inner], starts + np.arange(counts.sum())])
    nodes = np.sort(nodes)
    cell = links.cell[nodes]
    top = cell < 0
    centers, radii = voxel.nodes.center[nodes].astype(np.int64), voxel.nodes.radius[nodes].astype(np.int64)
    centers[top] <<= shift
    radii[top] <<= shift
    centers[~top] += voxel.cells.low[cell[~top]]
    return centers, radii


def _column(values: NDArray | None, kind: np.dtype, kept: slice) -> NDArray:
    """Return the kept values of a column, none if the archive does not keep it."""
    if values is None:
        return np.empty((0, *kind.shape), kind.base)
    return np.ascontiguousarray(values[kept])
