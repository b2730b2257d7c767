"""The mean closest-point distance of avatars equals brute force; sums make a mean and its error; points of a voxel."""

import math

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.passes.point_spacing import SUM_UNITS, mean_of_squares
from solidcloud.builder.voxel import point_hierarchy as radius
from solidcloud.builder.voxel.point_hierarchy import build_local, mean_closest_distance
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.builder.voxel.voxel_octree import VoxelPoints, build_voxel
from solidcloud.schemas.archive.voxel import check_voxel
from synthetic_scans import make_scan, make_steps


def test_sums_give_mean_and_standard_error() -> None:
    values = [0.25, 0.5, 1.0, 4.0]
    units = [int(v * SUM_UNITS) for v in values]
    found = mean_of_squares(sum(units), sum(u * u for u in units), 4, everything=False)
    assert found.mean == np.mean(values)
    assert found.error == pytest.approx(np.std(values, ddof=1) / 2)
    assert mean_of_squares(sum(units), 0, 4, everything=True).error == 0
    assert mean_of_squares(0, 0, 0, everything=True) == (0, 0, 0)
    assert mean_of_squares(units[0], units[0] ** 2, 1, everything=False).error == 0


@pytest.mark.interpreted
def test_points_of_a_voxel_come_back_in_stored_order() -> None:
    points = make_steps("corner", 2, 200, 1000)
    voxel = build_voxel(
        1, VoxelPoints(points, points[:, 2].astype(np.uint16)), 1000, BuildConfig(cell_points=20)
    )
    found = voxel_points(voxel, check_voxel(voxel, 1000))
    assert sorted(found.tolist()) == sorted(points.tolist())
    assert np.array_equal(found[:, 2], voxel.scan_index)


@pytest.mark.interpreted
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


@pytest.mark.interpreted
@pytest.mark.parametrize("points", [[[1.0, 2, 3]], [[1.0, 2, 3]] * 50])
def test_an_avatar_of_one_distinct_point_has_no_mean(points: list[list[float]]) -> None:
    assert mean_closest_distance(build_local(np.array(points), leaf=32, degree=8)) == 0


@pytest.mark.parametrize("extent", [1e-9, 1.0, 4.0, 4.1, 1e9])
def test_an_avatar_of_any_extent_fits_its_lattice(extent: float) -> None:
    points = np.array([[0.0, 0, 0], [extent, 0, 0], [0, extent / 3, 0]])
    local = build_local(points, leaf=2, degree=2)
    assert 0 <= local.hierarchy.points.min() <= local.hierarchy.points.max() <= 1 << 23
    assert math.log2(local.step).is_integer()


@pytest.mark.parametrize("count", [1, 2, 5000])
def test_distinct_points_are_those_of_numpy(count: int) -> None:
    points = np.random.default_rng(count).integers(-8, 8, (count, 3))
    assert np.array_equal(radius._distinct(points), np.unique(points, axis=0))
