"""Voxels of an archive rebuilt without some of their points, as a build of the rest stores them.

A server uses them for the effect `through` (server/archives/masked_archive.py). The remaining
points keep their stored columns. A radius class in particular remains that of the whole scan,
because the classes of the rest alone would be larger at its border.
"""

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ...schemas.archive.codec import OPTIONAL_COLUMNS, encode_voxel
from ...schemas.archive.index import Header
from ..config import BuildConfig
from .record_points import voxel_points
from .voxel_octree import BuiltVoxel, VoxelPoints, build_voxel

__all__ = ["BuiltVoxel", "build_masked_voxel", "read_points"]


def read_points(archive: Archive, row: int) -> VoxelPoints:
    """Return all points of a voxel with all stored columns. row: of the index.

    Raise CorruptError, OSError.
    """
    voxel, links = archive.read_voxel(row)
    local = voxel_points(voxel, links).astype(np.int32)
    return VoxelPoints(local, **{name: getattr(voxel, name) for name in OPTIONAL_COLUMNS})


def build_masked_voxel(header: Header, key: int, points: VoxelPoints, stays: NDArray[np.bool_]) -> BuiltVoxel:
    """Build the voxel of the points that stay, with the options of the archive's build.

    stays: (n,) mask, at least one set. The voxel is built as a whole. If a build would make it part
    by part (dense_voxel.py), the result is the same, row for row.
    """
    left = VoxelPoints._make(None if column is None else column[stays] for column in points)
    voxel = build_voxel(key, left, header.lattice.voxel_steps, _config(header))
    low, high = left.local.min(axis=0).astype(np.int64), left.local.max(axis=0).astype(np.int64)
    return BuiltVoxel(voxel, encode_voxel(voxel, header.archive_id), low, high)


def _config(header: Header) -> BuildConfig:
    """Return the build options that affect how a voxel is built from its points."""
    names = ("cell_points", "cells", "with_slab")
    stored = {name: header.options[name] for name in names if name in header.options}
    return BuildConfig(degree=header.degree, leaf=header.leaf, **stored)
