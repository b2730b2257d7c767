"""Every node of a BSH encloses all points below it, exactly."""

import numpy as np
import pytest
from solidcloud.builder.voxel.point_hierarchy import Hierarchy, build_hierarchy
from synthetic_scans import WITH_POINTS, make_steps

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


def test_a_shrunk_radius_is_seen_by_this_judge() -> None:
    hierarchy = build_hierarchy(make_steps("noise", 3, 100, 1000), leaf=16, degree=4)
    hierarchy.bounds.radius[3] -= 1
    assert loose_nodes(hierarchy) == [3]


def test_the_hierarchy_keeps_columns_apart_by_order() -> None:
    points = make_steps("duplicates", 3, 100, 1000)
    hierarchy = build_hierarchy(points, leaf=16, degree=4)
    assert sorted(hierarchy.tree.order.tolist()) == list(range(100))
