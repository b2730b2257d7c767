"""Exact verification, node by node in Python integers, of the bounds that the kernels measured.

It is slow on purpose: it uses no compiled code and no fixed-width numbers, and it knows only the
rules of FORMAT.md.
"""

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.voxel import Links, VoxelData

# A fixed seed selects the same nodes of an archive every time. A fault can thus be reproduced.
SAMPLE_SEED = 2012
# Leaf nodes whose points are converted to Python integers at a time; a node may have all points of
# a voxel below it.
_LEAVES = 1 << 10


def sample_nodes(counts: NDArray[np.int64], sample: int | None) -> list[NDArray[np.int64]]:
    """Select the nodes to verify: an array of node numbers for each voxel.

    counts: (v,) nodes of each voxel.  sample: number of nodes to draw; None, or at least the total:
    all nodes. Every node of the archive is equally likely; none is drawn twice.
    """
    ends = np.cumsum(counts)
    total = int(ends[-1]) if len(ends) else 0
    if sample is None or sample >= total:
        return [np.arange(count) for count in counts]
    drawn = np.sort(np.random.default_rng(SAMPLE_SEED).choice(total, sample, replace=False, shuffle=False))
    return [part - start for part, start in zip(np.split(drawn, np.searchsorted(drawn, ends[:-1])),
                                                ends - counts, strict=True)]  # fmt: skip


def loose_nodes(voxel: VoxelData, links: Links, nodes: Iterable[int]) -> list[int]:
    """Return those of `nodes` whose sphere or slab does not enclose every point below them.

    The numbers of a node are whole lattice steps, or whole multiples of the top unit
    (schemas/FORMAT.md). Both tests are therefore integer tests: |p - c|^2 <= r^2, and least <=
    normal . (p - c) <= greatest.
    """
    leaves = np.flatnonzero(links.is_leaf)
    # Sort by first point: a cell that is a single leaf node stands among the roots, before the leaf
    # nodes of other cells.
    leaves = leaves[np.argsort(links.first[leaves], kind="stable")]
    return [int(node) for node in nodes if not _encloses(voxel, links, int(node), leaves)]


def _encloses(voxel: VoxelData, links: Links, node: int, leaves: NDArray[np.int64]) -> bool:
    """Return whether the bounds of one node hold.

    leaves: the leaf nodes in the order of their points.
    """
    cell = int(links.cell[node])
    low = [0, 0, 0] if cell < 0 else voxel.cells.low[cell].tolist()
    unit = 1 << voxel.top_shift if cell < 0 else 1
    center = voxel.nodes.center[node].tolist()
    cx, cy, cz = (corner + coordinate * unit for corner, coordinate in zip(low, center, strict=True))
    square = (int(voxel.nodes.radius[node]) * unit) ** 2
    nx, ny, nz = voxel.nodes.normal[node].tolist()
    least, greatest = voxel.nodes.slab[node].tolist()
    has_slab = bool(nx or ny or nz)
    for x, y, z in _points(voxel, links, leaves, *_run(voxel, links, node)):
        dx, dy, dz = x - cx, y - cy, z - cz
        if dx * dx + dy * dy + dz * dz > square:
            return False
        if has_slab and not least <= nx * dx + ny * dy + nz * dz <= greatest:
            return False
    return True


def _points(
    voxel: VoxelData, links: Links, leaves: NDArray[np.int64], begin: int, end: int
) -> Iterator[list[int]]:
    """Yield the points [begin, end) of the stored order [voxel steps].

    `begin` is the first point of a leaf node, `end` follows the last point of one.
    """
    a, b = np.searchsorted(links.first[leaves], [begin, end]).tolist()
    for at in range(a, b, _LEAVES):
        some = leaves[at : min(at + _LEAVES, b)]
        count = voxel.nodes.count[some].astype(np.int64)
        low = voxel.cells.low[links.cell[some]].astype(np.int64) + voxel.nodes.block_low[some]
        first = int(links.first[some[0]])
        points = voxel.points[first : first + int(count.sum())].astype(np.int64)
        yield from (points + np.repeat(low, count, axis=0)).tolist()


def _run(voxel: VoxelData, links: Links, node: int) -> tuple[int, int]:
    """Return the range of points below a node in the stored order."""
    first = last = node
    while not links.is_leaf[first]:
        first = int(links.first[first])
    while not links.is_leaf[last]:
        last = int(links.first[last]) + int(voxel.nodes.count[last]) - 1
    return int(links.first[first]), int(links.first[last]) + int(voxel.nodes.count[last])
