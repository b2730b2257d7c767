"""The packing of an avatar's points, and their mean spacing, by brute force."""

import itertools
import math

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.builder.kernels.trees.pack_tree import pack_tree
from solidcloud.server.avatars import avatar_tree
from solidcloud.server.avatars.avatar_tree import DEGREE, bound_nodes, mean_spacing, pack_points
from solidcloud.server.kernels.core.scene_arrays import LANES
from synthetic_scans import WITH_POINTS, make_scan


def clouds(rng: np.random.Generator) -> list[NDArray[np.float64]]:
    """Points with ties, dense and sparse parts, and outliers."""
    return [
        *(make_scan(kind, 8, 3000) for kind in WITH_POINTS),
        rng.integers(0, 12, (5000, 3)) / 64,
        np.exp(-10 * rng.random((3000, 3))),
        np.concatenate([rng.random((2000, 3)) * 1e-3, 1e3 * rng.normal(size=(70, 3))]),
    ]


def test_the_tree_is_that_of_a_voxel(rng: np.random.Generator) -> None:
    for points in clouds(rng):
        tree = pack_points(points)
        steps = np.floor((points - tree.low) / tree.step).astype(np.int32)
        order, begin, end, _, levels = pack_tree(steps, LANES, DEGREE)
        for number, starts in enumerate(tree.levels):
            assert starts[:-1].tolist() == begin[levels[number] : levels[number + 1]].tolist()
        assert np.array_equal(tree.steps, steps[tree.order])
        for a, b in zip(begin[levels[-2] :], end[levels[-2] :], strict=True):
            assert sorted(tree.order[a:b]) == sorted(order[a:b])


def test_every_node_encloses_its_points(rng: np.random.Generator) -> None:
    for points in clouds(rng):
        tree = pack_points(points)
        center, radius = (column.astype(np.int64) for column in bound_nodes(tree))
        node = 0
        for starts in tree.levels:
            for a, b in itertools.pairwise(starts):
                square = ((tree.steps[a:b].astype(np.int64) - center[node]) ** 2).sum(axis=1).max()
                assert radius[node] ** 2 >= square > (radius[node] - 1) ** 2 or radius[node] == 0 == square
                node += 1
        assert node == len(radius)


@pytest.mark.parametrize("pairs", [1 << 18, 1 << 11])
def test_the_spacing_is_that_of_brute_force(
    pairs: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(avatar_tree, "_PAIRS", pairs)
    for points in clouds(rng):
        tree = pack_points(points)
        steps = np.unique(tree.steps, axis=0)
        closest = []
        for k in range(len(steps)):
            squares = ((steps - steps[k]) ** 2).sum(axis=1)
            squares[k] = np.inf
            closest.append(squares.min())
        expected = math.fsum(np.sqrt(closest) * tree.step) / len(steps) if len(steps) > 1 else 0.0
        assert mean_spacing(tree) == expected


@pytest.mark.parametrize("points", [[[1.0, 2, 3]], [[1.0, 2, 3]] * 50])
def test_one_distinct_point_has_no_spacing(points: list[list[float]]) -> None:
    assert mean_spacing(pack_points(np.array(points))) == 0


@pytest.mark.parametrize("extent", [1e-9, 1.0, 4.0, 4.1, 1e9])
def test_points_of_any_extent_fit_their_lattice(extent: float) -> None:
    points = np.array([[0.0, 0, 0], [extent, 0, 0], [0, extent / 3, 0]])
    tree = pack_points(points)
    assert 0 <= tree.steps.min() <= tree.steps.max() <= avatar_tree.MAX_STEPS
    assert math.log2(tree.step).is_integer()
    apart = points[tree.order] - (tree.low + tree.steps * tree.step)
    assert (apart >= 0).all() and (apart < 2 * tree.step).all()
