"""The check that every bound encloses: a bound just wide enough passes, one a step tighter is named."""

import numpy as np
import pytest
from solidcloud.builder.kernels.enclosure import first_loose_node

pytestmark = pytest.mark.interpreted

# Row 0 holds rows 1 and 2, row 2 holds rows 3 and 4; leaf nodes 1, 3, 4 have 3, 1 and 4 points.
FIRST, COUNT = np.array([1, 0, 3, 3, 4], np.int32), np.array([2, 3, 2, 1, 4], np.uint8)
LEAF = np.array([False, True, False, True, True])
BELOW = ([0, 8], [0, 3], [3, 8], [3, 4], [4, 8])
ORDER = np.array([1, 4, 3, 2, 0])


class Tree:
    """The tree above over random points, each bound as tight as integers let it be, about a centre of its own."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.points = rng.integers(-50, 50, (8, 3))
        # Off the origin of the frame, and with three components that are not 0 where the slab is to be looked at.
        self.center = rng.integers(-60, 60, (5, 3))
        self.normal = rng.choice([-7, -3, 2, 5], (5, 3))
        self.radius, self.slab = np.zeros(5, np.int64), np.zeros((5, 2), np.int64)
        for node, (a, b) in enumerate(BELOW):
            apart = self.points[a:b] - self.center[node]
            self.radius[node] = np.ceil(np.sqrt((apart**2).sum(axis=1).max()))
            along = apart @ self.normal[node]
            self.slab[node] = along.min(), along.max()

    def loose(self) -> int:
        """What the kernel says."""
        return int(
            first_loose_node(
                self.center, self.radius, self.normal, self.slab, FIRST, COUNT, LEAF, ORDER, self.points
            )
        )


@pytest.mark.parametrize("seed", range(6))
def test_a_bound_one_step_too_tight_is_named(seed: int) -> None:
    tree = Tree(seed)
    assert tree.loose() == -1
    for node in range(5):
        for column, by in ((tree.radius, -1), (tree.slab[:, 0], 1), (tree.slab[:, 1], -1)):
            column[node] += by
            assert tree.loose() == node
            column[node] -= by
    tree.radius[[0, 3]] -= 1
    tree.slab[4, 1] -= 1
    assert tree.loose() == 4  # the first in the order asked for


@pytest.mark.parametrize("axis", range(3))
def test_a_sphere_that_touches_its_farthest_point_encloses_it(axis: int) -> None:
    tree = Tree(0)
    tree.points[:] = tree.center[:] = tree.slab[:] = 0
    tree.points[6, axis] = 9
    tree.radius[:] = 9
    tree.slab[:] = -99, 99
    assert tree.loose() == -1
    tree.radius[2] = 8
    assert tree.loose() == 2


@pytest.mark.parametrize("axis", range(3))
def test_no_slab_is_looked_at_where_there_is_no_direction(axis: int) -> None:
    tree = Tree(1)
    tree.normal[:] = 0
    tree.slab[:] = 1, -1
    assert tree.loose() == -1
    tree.normal[1, axis] = 1
    assert tree.loose() == 1
