"""A voxel of an archive without some of its points: what a build of the points that are left would have stored.

A server asks for it where a scene says that contact is ignored (server/left_out.py). Columns of the points that are
left stay what they are stored as: a radius class is that of the whole scan, or what is left would grow. But normals are
those of what is left, as they are where a server estimates them.
"""

import numpy as np
from numpy.typing import NDArray

from ..schemas.archive import Archive
from ..schemas.codec import OPTIONAL_COLUMNS, encode_voxel
from ..schemas.index import Header
from ..schemas.normals import normal_reach
from .config import BuildConfig
from .dense import BuiltVoxel
from .octree import VoxelPoints, build_voxel
from .radius import voxel_points

__all__ = ["BuiltVoxel", "build_rest", "read_points"]


def read_points(archive: Archive, row: int) -> VoxelPoints:
    """All points of the voxel of index row `row`, with all columns stored. Raises CorruptError, OSError."""
    voxel, links = archive.read_voxel(row)
    local = voxel_points(voxel, links).astype(np.int32)
    return VoxelPoints(local, **{name: getattr(voxel, name) for name in OPTIONAL_COLUMNS})


def build_rest(header: Header, key: int, points: VoxelPoints, stays: NDArray[np.bool_]) -> BuiltVoxel:
    """The voxel of those points, at least one, that stay (n,), built with the options of the archive's build.

    It is built whole: of a voxel that a build would take part by part (dense.py), row for row the same.
    """
    left = VoxelPoints._make(None if column is None else column[stays] for column in points)
    if header.normals:
        from .normals import voxel_normals  # most archives have none

        square = normal_reach(header.normal_reach, header.lattice.step, len(left.local))
        left = left._replace(normal=voxel_normals(left.local, square))
    voxel = build_voxel(key, left, header.lattice.voxel_steps, _config(header))
    low, high = left.local.min(axis=0).astype(np.int64), left.local.max(axis=0).astype(np.int64)
    return BuiltVoxel(voxel, encode_voxel(voxel, header.archive_id), low, high)


def _config(header: Header) -> BuildConfig:
    """The options that what a voxel is built of its points depends on."""
    names = ("cell_points", "cells", "with_slab")
    stored = {name: header.options[name] for name in names if name in header.options}
    return BuildConfig(degree=header.degree, leaf=header.leaf, **stored)
