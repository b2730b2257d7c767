"""Every node of a BSH encloses all points below it, exactly."""

import math

import numpy as np
import pytest
from solidcloud.builder.voxel.point_hierarchy import (
    Hierarchy,
    build_hierarchy,
    build_local,
    mean_closest_distance,
)
from synthetic_scans import WITH_POINTS, make_scan, make_steps

pytestmark = pytest.mark.interpreted


def loose_nodes(hierarchy: Hierarchy) -> list[int]:
    """Nodes that do not enclose their points, judged with Python integers."""
    tree, bounds, loose = hierarchy.tree, hierarchy.bounds, []
    for node in range(len(tree.begin)):
        points = hierarchy.points[tree.begin[node] : tree.end[node]].astype(object)
        apart = points - bounds.center[node].astype(object)
        normal = bounds.normal[node].astype(object)
        along = (apart * normal).sum(axis=1)
        if (
            max((apart * apart).sum(axis=1)) > int(bounds.radius[node]) ** 2
            or int(bounds.slab[node, 0]) > min(along)
            or max(along) > int(bounds.slab[node, 1])
        ):
            loose.append(node)
    return loose


@pytest.mark.parametrize("kind", WITH_POINTS)
@pytest.mark.parametrize(("leaf", "degree", "with_slab"), [(32, 8, True), (4, 2, True), (8, 3, False)])
def test_every_node_encloses_its_points(kind: str, leaf: int, degree: int, with_slab: bool) -> None:
    points = make_steps(kind, 3, 300, 1 << 16)
    hierarchy = build_hierarchy(points, leaf=leaf, degree=degree, with_slab=with_slab)
    assert np.array_equal(hierarchy.points, points[hierarchy.tree.order])
    assert not loose_nodes(hierarchy)
    assert hierarchy.bounds.normal.any() == (with_slab and len(points) > 2)


def test_coordinates_of_an_avatars_lattice_are_enclosed() -> None:
    points = make_steps("noise", 3, 200, 1 << 23)
    assert not loose_nodes(build_hierarchy(points, leaf=16, degree=4, highest=1 << 23))


@pytest.mark.parametrize("kind", ["plane", "pillar", "noise", "duplicates"])
def test_an_avatars_mean_equals_brute_force(kind: str) -> None:
    points = make_scan(kind, 8, 200) - 1.0
    local = build_local(points, leaf=8, degree=4)
    distinct = np.unique(points, axis=0)
    apart = np.sqrt(((distinct[:, None] - distinct) ** 2).sum(axis=2)) + np.where(
        np.eye(len(distinct)), np.inf, 0
    )
    # A point and its neighbour are each less than sqrt(3) steps from their lattice points.
    assert abs(mean_closest_distance(local) - apart.min(axis=1).mean()) <= 2 * math.sqrt(3) * local.step
    world = local.low + local.hierarchy.points * local.step
    assert (world <= points[local.hierarchy.tree.order]).all()
    assert (points[local.hierarchy.tree.order] - world < 2 * local.step).all()


@pytest.mark.parametrize("points", [[[1.0, 2, 3]], [[1.0, 2, 3]] * 50])
def test_an_avatar_of_one_distinct_point_has_no_mean(points: list[list[float]]) -> None:
    assert mean_closest_distance(build_local(np.array(points), leaf=32, degree=8)) == 0


@pytest.mark.parametrize("extent", [1e-9, 1.0, 4.0, 4.1, 1e9])
def test_an_avatar_of_any_extent_fits_its_lattice(extent: float) -> None:
    points = np.array([[0.0, 0, 0], [extent, 0, 0], [0, extent / 3, 0]])
    local = build_local(points, leaf=2, degree=2)
    assert 0 <= local.hierarchy.points.min() <= local.hierarchy.points.max() <= 1 << 23
    assert math.log2(local.step).is_integer()
