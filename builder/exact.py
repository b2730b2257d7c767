"""Enclosure proved node by node in Python's integers: the judge of the bounds that kernels measured.

Slow, and on purpose: no compiled code, no number of a fixed width, and of the archive's rules only what FORMAT.md says.
"""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ..schemas.voxel import Links, VoxelData
from .radius import voxel_points

# The same nodes of the same archive every time, so that a fault found once is found again.
SAMPLE_SEED = 2012


def sample_nodes(counts: NDArray[np.int64], sample: int | None) -> list[NDArray[np.int64]]:
    """Which nodes are asked: an array of node numbers for each voxel; all where sample is None or as many.

    counts: (v,) nodes of each voxel. Every node of the archive is as likely as any other; none is drawn twice.
    """
    ends = np.cumsum(counts)
    total = int(ends[-1]) if len(ends) else 0
    if sample is None or sample >= total:
        return [np.arange(count) for count in counts]
    drawn = np.sort(np.random.default_rng(SAMPLE_SEED).choice(total, sample, replace=False, shuffle=False))
    return [part - start for part, start in zip(np.split(drawn, np.searchsorted(drawn, ends[:-1])),
                                                ends - counts, strict=True)]  # fmt: skip


def loose_nodes(voxel: VoxelData, links: Links, nodes: Iterable[int]) -> list[int]:
    """Those of `nodes` whose sphere or slab does not enclose every point below them.

    A node's numbers are whole lattice steps, or whole multiples of the top unit (schemas/FORMAT.md), so that both
    tests are of integers: |p - c|^2 <= r^2, and least <= normal . (p - c) <= greatest.
    """
    points = voxel_points(voxel, links)
    return [int(node) for node in nodes if not _encloses(voxel, links, int(node), points)]


def _encloses(voxel: VoxelData, links: Links, node: int, points: NDArray[np.int64]) -> bool:
    """Whether one node's bound holds; points: all of the voxel (p, 3) [steps], in stored order."""
    cell = int(links.cell[node])
    low = [0, 0, 0] if cell < 0 else voxel.cells.low[cell].tolist()
    unit = 1 << voxel.top_shift if cell < 0 else 1
    center = voxel.nodes.center[node].tolist()
    cx, cy, cz = (corner + coordinate * unit for corner, coordinate in zip(low, center, strict=True))
    square = (int(voxel.nodes.radius[node]) * unit) ** 2
    nx, ny, nz = voxel.nodes.normal[node].tolist()
    least, greatest = voxel.nodes.slab[node].tolist()
    has_slab = bool(nx or ny or nz)
    begin, end = _run(voxel, links, node)
    for x, y, z in points[begin:end].tolist():
        dx, dy, dz = x - cx, y - cy, z - cz
        if dx * dx + dy * dy + dz * dz > square:
            return False
        if has_slab and not least <= nx * dx + ny * dy + nz * dz <= greatest:
            return False
    return True


def _run(voxel: VoxelData, links: Links, node: int) -> tuple[int, int]:
    """The points below a node, as a run of the stored order: from its first leaf node's to its last one's."""
    first = last = node
    while not links.is_leaf[first]:
        first = int(links.first[first])
    while not links.is_leaf[last]:
        last = int(links.first[last]) + int(voxel.nodes.count[last]) - 1
    return int(links.first[first]), int(links.first[last]) + int(voxel.nodes.count[last])
