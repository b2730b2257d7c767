"""Reopens an archive and checks every invariant that FORMAT.md states."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..schemas.archive import Archive
from ..schemas.errors import BadRequestError, CorruptError
from ..schemas.radius_model import RADIUS_CLASSES
from ..schemas.voxel import Links, VoxelData
from .exact import loose_nodes, sample_nodes
from .kernels.enclosure import first_loose_node
from .progress import Progress, Silent
from .radius import search_tree


class VerifyReport(NamedTuple):
    """What was checked, and every fault found, one sentence each; none: all is well.

    exact_nodes: bounds proved in Python's integers, of `nodes` there are.
    """

    voxels: int
    points: int
    faults: tuple[str, ...]
    nodes: int = 0
    exact_nodes: int = 0


def verify_archive(
    folder: Path,
    *,
    deep: bool = False,
    exact: bool = False,
    sample: int | None = None,
    progress: Progress | None = None,
) -> VerifyReport:
    """Read every record and check it; with `deep`, also that every bound encloses all points below it, exactly.

    exact: prove the bounds once more in Python's integers, without compiled code.  sample: only so many of them,
    spread over the archive; None: all. Raises FormatError or CorruptError only when the index itself cannot be used,
    BadRequestError for a sample that is none; a broken record is a fault.
    """
    if sample is not None and (not exact or sample < 1):
        raise BadRequestError(f"--sample {sample}: expected 1 or more, and --exact with it")
    progress = progress or Silent()
    faults: list[str] = []
    points = proved = 0
    classes = np.zeros(RADIUS_CLASSES, np.int64)
    with Archive(folder) as archive:
        header = archive.header
        counts = archive.voxels["rows"][:, 1].astype(np.int64)
        asked = sample_nodes(counts, sample) if exact else None
        progress.start("verify", header.points, "points")
        for row in range(len(archive.voxels)):
            expected = int(archive.voxels["rows"][row, 2])
            try:
                voxel, links = archive.read_voxel(row)
                faults += _voxel_faults(archive, row, voxel, links, deep)
                if asked is not None:
                    loose = loose_nodes(voxel, links, asked[row].tolist())
                    faults += [_loose(archive, row, node) for node in loose]
                    proved += len(asked[row]) - len(loose)
            except (CorruptError, OSError) as error:
                faults.append(str(error))
            else:
                points += len(voxel.points)
                if voxel.radius_class is not None:
                    classes += np.bincount(voxel.radius_class, minlength=RADIUS_CLASSES)
            progress.advance(expected)
        progress.finish()
        if not faults and points != header.points:
            faults.append(
                f"{folder}: {points} points in the records, {header.points} in the index: rebuild it"
            )
        if not faults and (classes != header.radius_counts).any():
            faults.append(
                f"{folder}: radius classes counted {classes.tolist()} in the records, "
                f"{header.radius_counts.tolist()} in the index: rebuild it"
            )
        return VerifyReport(len(archive.voxels), points, tuple(faults), int(counts.sum()), proved)


def _loose(archive: Archive, row: int, node: int) -> str:
    """The fault of a bound that does not enclose."""
    return f"{archive.where(row)}: node {node} does not enclose its points: rebuild the archive"


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
            faults.append(_loose(archive, row, node))
    return faults
