"""Test the order of coordinates cell by cell, and its inverse."""

from itertools import pairwise

import numpy as np
import pytest
from solidcloud.builder.kernels.points.octree_cells import by_axis, by_cell

pytestmark = pytest.mark.interpreted


@pytest.mark.parametrize("sizes", [[1], [3, 1, 4], [2, 7, 1, 1, 9]])
def test_a_cells_axes_stand_side_by_side(sizes: list[int]) -> None:
    starts = np.cumsum([0, *sizes])
    xyz = np.arange(3 * starts[-1], dtype=np.uint16).reshape(3, -1) + 500
    flat = by_cell(xyz, starts)
    expected = [xyz[:, a:b].ravel() for a, b in pairwise(starts)]
    assert flat.tolist() == np.concatenate(expected).tolist()
    assert np.array_equal(by_axis(flat, starts), xyz)
    # Any run of cells alone.
    some = slice(3 * int(starts[len(sizes) // 2]), None)
    rest = starts[len(sizes) // 2 :]
    assert np.array_equal(by_axis(flat[some], rest - rest[0]), xyz[:, rest[0] :])
