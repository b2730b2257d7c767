"""Test the kernels of radius classes: the limit of a rim, and the points that are queried."""

from fractions import Fraction

import numpy as np
import pytest
from solidcloud.builder.kernels.neighbours.nearest_neighbours import bound_boxes, box_starts
from solidcloud.builder.kernels.neighbours.point_classes import (
    RIM_SHARE,
    _is_rim,
    _local_class,
    point_classes,
)
from solidcloud.builder.kernels.points.octree_cells import voxel_codes

pytestmark = pytest.mark.interpreted


def test_a_rim_is_where_the_mean_lies_off_by_more_than_the_share() -> None:
    """Of differences of a few steps, many at the edge itself; and of millions, beyond 32 bits."""
    rng = np.random.default_rng(1)
    told = {"rim": 0, "none": 0, "edge": 0}
    for trial in range(600):
        held, wide = int(rng.integers(1, 12)), (1, 2, 1 << 21)[trial % 3]
        apart = rng.integers(-wide, wide + 1, (12, 3))
        closest = np.column_stack([(apart**2).sum(axis=1), apart])
        mean = [Fraction(int(total), held) for total in apart[:held].sum(axis=0)]
        off = sum(v * v for v in mean) - Fraction(int(closest[:held, 0].sum()), held * RIM_SHARE)
        told["rim" if off > 0 else "none" if off < 0 else "edge"] += 1
        assert _is_rim(closest, held) == (off > 0)
    assert min(told.values()) > 10


def test_a_class_is_the_first_whose_limit_holds() -> None:
    limits = np.array([4, 9, 9, 100])
    expected = {0: 0, 4: 0, 5: 1, 9: 1, 10: 3, 100: 3, 101: 4, 1 << 60: 4}
    assert {d2: int(_local_class(d2, limits)) for d2 in expected} == expected


def test_who_is_not_asked_changes_nothing_for_the_others() -> None:
    rng = np.random.default_rng(2)
    points = rng.integers(0, 12, (120, 3)).astype(np.int32)
    points = points[np.unique(voxel_codes(points), return_index=True)[1]]
    starts = box_starts(len(points))
    boxes, n = bound_boxes(points, starts), len(points)
    all_of = np.full(n, 255, np.uint8)
    limits = 30, np.array([2, 4, 8], np.int64)
    point_classes(points, boxes, starts, np.arange(n, dtype=np.int32), *limits, all_of)
    assert len(set(all_of.tolist())) > 3 and 255 not in all_of
    asked = np.flatnonzero(rng.random(n) < 0.5)
    rows = np.full(n, -1, np.int32)
    rows[asked] = rng.permutation(len(asked))
    some = np.full(len(asked) + 1, 255, np.uint8)
    point_classes(points, boxes, starts, rows, *limits, some)
    assert some[rows[asked]].tolist() == all_of[asked].tolist() and some[-1] == 255
