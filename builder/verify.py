"""Reopens an archive and checks every invariant that FORMAT.md states."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..schemas.archive import Archive
from ..schemas.errors import CorruptError
from ..schemas.voxel import Links, VoxelData
from .kernels.enclosure import first_loose_node
from .progress import Progress, Silent
from .radius import search_tree


class VerifyReport(NamedTuple):
    """What was checked, and every fault found, one sentence each; none: all is well."""

    voxels: int
    points: int
    faults: tuple[str, ...]


def verify_archive(folder: Path, *, deep: bool = False, progress: Progress | None = None) -> VerifyReport:
    """Read every record and check it; with `deep`, also that every bound encloses all points below it, exactly.

    Raises FormatError or CorruptError only when the index itself cannot be used; a broken record is a fault.
    """
    progress = progress or Silent()
    faults: list[str] = []
    points = 0
    with Archive(folder) as archive:
        header = archive.header
        progress.start("verify", header.points, "points")
        for row in range(len(archive.voxels)):
            expected = int(archive.voxels["rows"][row, 2])
            try:
                voxel, links = archive.read_voxel(row)
                faults += _voxel_faults(archive, row, voxel, links, deep)
            except (CorruptError, OSError) as error:
                faults.append(str(error))
            else:
                points += len(voxel.points)
            progress.advance(expected)
        progress.finish()
        if not faults and points != header.points:
            faults.append(
                f"{folder}: {points} points in the records, {header.points} in the index: rebuild it"
            )
        return VerifyReport(len(archive.voxels), points, tuple(faults))


def _voxel_faults(archive: Archive, row: int, voxel: VoxelData, links: Links, deep: bool) -> list[str]:
    """Faults of one voxel that `check_voxel` does not look for."""
    faults = []
    tree = search_tree(voxel, links)
    entry = archive.voxels[row]
    if (tree.points.min(axis=0) != entry["low"]).any() or (tree.points.max(axis=0) != entry["high"]).any():
        faults.append(f"{archive.where(row)}: points are not where the index says: rebuild the archive")
    if deep:
        # Children stand behind their parents everywhere but for the cells' roots, which stand behind the top BSH.
        order = np.arange(len(tree.first))[::-1].copy()
        normal, slab = voxel.nodes.normal.astype(np.int64), voxel.nodes.slab.astype(np.int64)
        node = first_loose_node(
            tree.center, tree.radius, normal, slab, tree.first, tree.count, tree.is_leaf, order, tree.points
        )
        if node >= 0:
            faults.append(
                f"{archive.where(row)}: node {node} does not enclose its points: rebuild the archive"
            )
    return faults
