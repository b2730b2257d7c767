"""Top hierarchy of a voxel: packed over its cells, and bounded around points as they are added."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.voxel import CELL_BITS, Nodes, top_shift
from ..config import BuildConfig
from ..kernels.trees.bounding_sphere import ceil_sqrt
from ..kernels.trees.build_tree import enlarge_bounds, initial_bounds
from ..kernels.trees.pack_tree import pack_tree

# Greatest coordinate of a centre in a cell.
HIGHEST = (1 << CELL_BITS) - 1


class Top(NamedTuple):
    """Top hierarchy over c cells, with t nodes.

    Its bounds grow as points are added, see kernels/trees/build_tree.py.

    order: (c,) int64, cells in the order of its leaf nodes.  count: (t,) uint8.
    above: (h, c) int64, the node of each level above each cell in that order.
    boxes: (c, 2, 3) int64, of the cells' points in that order.
    center: (t, 3), normal: (t, 3), reach2: (t,), slab: (t, 2): int64.  unit: of stored lengths
    [steps].
    """

    order: NDArray[np.int64]
    count: NDArray[np.uint8]  # type: ignore[assignment]  # hides tuple.count, which nobody calls
    above: NDArray[np.int64]
    boxes: NDArray[np.int64]
    center: NDArray[np.int64]
    normal: NDArray[np.int64]
    reach2: NDArray[np.int64]
    slab: NDArray[np.int64]
    unit: int

    def grow(
        self, xyz: NDArray[np.uint16], starts: NDArray[np.int64], low: NDArray[np.int64], first: int
    ) -> None:
        """Enlarge the bounds to enclose the points of consecutive cells, from `first` of the order.

        xyz: (3, n) from their cell's corner; starts: (k + 1,), first point of each cell; low: (k,
        3) int64 corners.
        """
        of = slice(first, first + len(low))
        above, boxes = np.ascontiguousarray(self.above[:, of]), self.boxes[of]
        enlarge_bounds(
            xyz, starts, low, boxes, above, self.center, self.normal, self.unit, self.reach2, self.slab
        )

    def rows(self) -> Nodes:
        """Return the nodes in their stored form; call it after all points are added."""
        t = len(self.count)
        radius = [-(-int(ceil_sqrt(reach2)) // self.unit) for reach2 in self.reach2]
        return Nodes(
            self.center.astype(np.uint16),
            np.array(radius, np.uint16),
            self.normal.astype(np.int8),
            self.slab.astype(np.int32),
            self.count,
            np.zeros(t, np.uint8),
            np.zeros((t, 3), np.uint16),
        )


def pack_top(
    low: NDArray[np.int64],
    log2_size: NDArray[np.uint8],
    spreads: NDArray[np.float64],
    extremes: NDArray[np.int32],
    voxel_steps: int,
    config: BuildConfig,
) -> Top:
    """Pack the top hierarchy over the cells of a voxel, c > 1, in octree order.

    The columns are as in `CellTrees`.
    """
    middle = (low + (np.int64(1) << log2_size.astype(np.int64))[:, None] // 2).astype(np.int32)
    order, begin, end, count, levels = pack_tree(middle, config.degree, config.degree)
    t, unit = len(begin), 1 << top_shift(voxel_steps)
    center, normal, slab = (np.empty((t, k), np.int64) for k in (3, 3, 2))
    reach2 = np.empty(t, np.int64)
    tree = (begin, count, levels)
    extremes = extremes[order]
    initial_bounds(
        tree, spreads[order], extremes, unit, HIGHEST, config.with_slab, center, normal, reach2, slab
    )
    # The points least along x, y and z are 1st, 3rd and 5th, each followed by the greatest
    # (kernels/trees/build_tree.py DIRECTIONS).
    sides = [[extremes[:, 2 * k + side, k] for k in range(3)] for side in range(2)]
    boxes = np.ascontiguousarray(np.moveaxis(np.array(sides, np.int64), 2, 0))
    held = end - begin
    above = np.stack([np.repeat(np.arange(a, b), held[a:b]) for a, b in pairwise(levels.tolist())])
    return Top(order, count, above, boxes, center, normal, reach2, slab, unit)
