"""Codes of the normals of all points of a voxel; schemas/kernels/normal_codes.py defines them."""

import numpy as np
from numpy.typing import NDArray

from ..kernels.neighbours.estimate_normals import box_sums, point_normals
from ..kernels.neighbours.nearest_neighbours import bound_boxes, box_starts
from ..kernels.points.octree_cells import voxel_codes


def voxel_normals(local: NDArray[np.int32], square: int) -> NDArray[np.uint16]:
    """Return the codes (n,) of the normals at all points (n, 3) of a voxel [voxel steps], n >= 1.

    The points may be in any order. square: squared radius of the neighbourhood [steps^2], as
    `squared_reach` returns it. Each of several points at one position counts.
    """
    _, first, back, times = np.unique(
        voxel_codes(local), return_index=True, return_inverse=True, return_counts=True
    )
    points = np.ascontiguousarray(local[first])
    starts = box_starts(len(points))
    boxes = bound_boxes(points, starts)
    sums = box_sums(points, times, boxes, starts, square)
    codes = np.empty(len(points), np.uint16)
    point_normals(points, times, boxes, starts, sums, square, codes)
    return codes[back]
