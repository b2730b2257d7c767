"""An avatar under one pose, by the kernels alone: where it is, what its thresholds allow for, and the definition."""

import math
from fractions import Fraction
from typing import NamedTuple

import archive_cases
import naive
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.kernels.core import node_bounds
from solidcloud.server.kernels.core import placed_avatar as kernel
from solidcloud.server.kernels.core.scene_arrays import LANES

pytestmark = pytest.mark.interpreted

U32 = 2.0**-24
STEP = 2.0**-10
UNITS_PER_STEP = STEP * naive.UNITS
VOXEL_STEPS = 1000


class Lattice(NamedTuple):
    """What placing reads of a scene: one leaf node of LANES points in each of three voxels."""

    ints: NDArray[np.int32]
    halves: NDArray[np.uint16]
    corners: NDArray[np.int64]
    origin: NDArray[np.float64]
    step: float
    units_per_step: float


def lattice(seed: int = 1) -> Lattice:
    """Random points; the block of voxel v begins at ints[3 v], its lanes at halves[3 LANES v]."""
    rng = np.random.default_rng(seed)
    return Lattice(
        rng.integers(0, 500, 9).astype(np.int32), rng.integers(0, 400, 9 * LANES).astype(np.uint16),
        np.array([[0, 0, 0], [-3, 2, 7], [40, -60, 5]]) * VOXEL_STEPS, np.array([7.0, -50.0, 300.0]), STEP,
        UNITS_PER_STEP,
    )  # fmt: skip


# --- places ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("far", [0.0, 3e6])
def test_an_avatar_is_placed_where_the_formula_says(rng: np.random.Generator, far: float) -> None:
    model, scene = make_avatar(rng.uniform(-0.4, 0.4, (100, 3)), 0.01), lattice()
    avatar = model.arrays
    turn = archive_cases.random_rotation(rng)
    pose = archive_cases.pose_of(turn, scene.origin + rng.uniform(-1, 1, 3) * far)
    placed = kernel.make_placed(avatar)
    assert (placed.stamp == -1).all() and len(placed.stamp) == len(avatar.points)
    extent, farthest = kernel.place_nodes(avatar, pose, placed, scene)
    shift = pose[:3, 3] - scene.origin
    assert placed.shift.tolist() == shift.tolist()
    exact = avatar.center @ turn.T + shift
    assert placed.frame.tolist() == np.rint(exact[0] / STEP).astype(int).tolist()
    assert extent == pytest.approx(avatar.radius[0] / STEP + 1, rel=1e-12)
    x, y, z = np.abs(turn * avatar.center[0]).T
    assert farthest == pytest.approx((x + y + z + np.abs(shift)).max() / STEP + extent, rel=1e-12)
    away = exact / STEP - placed.frame
    rounding = extent * U32 + farthest * 2.0**-49
    assert np.abs(placed.nodes[:3].T - away).max() <= rounding
    wide = placed.nodes[3] - avatar.radius / STEP
    assert (wide > 0).all() and wide.max() <= 3e-6 * extent
    root = kernel.make_placed(avatar)
    assert kernel.place_root(avatar, pose, root, scene) == (extent, farthest)
    assert root.nodes[:, 0].tolist() == placed.nodes[:, 0].tolist()
    for block in range(len(avatar.points)):
        placed.lanes[:] = np.nan
        kernel.place_block(avatar, pose, block, placed, scene)
        points = avatar.points[block].T @ turn.T + shift
        assert np.abs(placed.lanes[block].T - (points / STEP - placed.frame)).max() <= rounding
        assert np.isnan(np.delete(placed.lanes, block, axis=0)).all()


# --- the definition -------------------------------------------------------------------------------------


def scan_point(scene: Lattice, voxel: int, j: int) -> list[int]:
    """A scan point in exact units."""
    return [
        round(
            (
                int(scene.corners[voxel, r])
                + int(scene.ints[3 * voxel + r])
                + int(scene.halves[(3 * voxel + r) * LANES + j])
            )
            * UNITS_PER_STEP
        )
        for r in range(3)
    ]


def test_the_square_of_a_pair_is_that_of_the_definition(rng: np.random.Generator) -> None:
    scene, points = lattice(), rng.uniform(-1, 1, (40, 3))
    model = make_avatar(points, 0.0)
    placed = kernel.make_placed(model.arrays)
    for voxel in range(3):
        for _ in range(20):
            block, lane, j = (
                int(rng.integers(len(model.rows))),
                int(rng.integers(LANES)),
                int(rng.integers(LANES)),
            )
            at = np.array(scan_point(scene, voxel, j)) / naive.UNITS + scene.origin
            pose = archive_cases.pose_of(
                archive_cases.random_rotation(rng), at + rng.uniform(-1, 1, 3) * rng.choice([0.01, 8])
            )
            kernel.place_root(model.arrays, pose, placed, scene)
            own = naive.placed_units(points[model.rows[block, lane]][None], pose, scene.origin)[0].tolist()
            apart = [a - b for a, b in zip(own, scan_point(scene, voxel, j), strict=True)]
            square = sum(d * d for d in apart)
            pair = (model.arrays, pose, block, lane, placed, scene, voxel, 3 * LANES * voxel, 3 * voxel, j)
            assert kernel.pair_square(*pair) == square
            least = math.isqrt(square - 1) + 1
            assert kernel.pair_in_reach(*pair, least) and not kernel.pair_in_reach(*pair, least - 1)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [1, -1])
def test_a_pair_beyond_any_reach_has_no_square(axis: int, sign: int) -> None:
    scene = lattice()._replace(ints=np.zeros(9, np.int32), halves=np.zeros(9 * LANES, np.uint16))
    model = make_avatar([[0.0, 0, 0]], 0.0)
    placed = kernel.make_placed(model.arrays)
    for units, square in ((1 << 30, 1 << 60), ((1 << 30) + 1, None), (1 << 33, None)):
        shift = np.zeros(3)
        shift[axis] = sign * units / naive.UNITS
        pose = archive_cases.pose_of(np.eye(3), scene.origin + shift)
        assert Fraction(pose[axis, 3]) - Fraction(scene.origin[axis]) == sign * Fraction(units, 1 << 26)
        kernel.place_root(model.arrays, pose, placed, scene)
        pair = (model.arrays, pose, 0, 0, placed, scene, 0, 0, 0, 0)
        if square is None:
            assert kernel.pair_square(*pair) < 0 and not kernel.pair_in_reach(*pair, 1 << 30)
        else:
            assert kernel.pair_square(*pair) == square and kernel.pair_in_reach(*pair, 1 << 30)


@pytest.mark.parametrize("voxel_steps", [1000, 500_000])
@pytest.mark.parametrize(
    ("reach", "extent", "farthest"),
    [(300.0, 900.0, 3e3), (3.0, 50_000.0, 3e9), (16_000.0, 1.0, 1e12), (2.0, 5.0, 8e14)],
)
def test_thresholds_are_outside_the_errors_documented_and_not_far(
    reach: float, extent: float, farthest: float, voxel_steps: int
) -> None:
    """Each term of the docstring weighs in one of the cases; thresholds lie beyond it by less than float32 tells."""
    units = round(reach * UNITS_PER_STEP)
    found = node_bounds.make_thresholds(units, UNITS_PER_STEP, extent, farthest, voxel_steps)
    error = 1.1 / UNITS_PER_STEP
    error += U32 * (extent + 2 * (max(65_536, voxel_steps) + reach)) + farthest * 2.0**-49
    around = math.sqrt(3) * error
    below, above = reach * (1 - 2 * U32) - around, reach * (1 + 2 * U32) + around
    assert found.units == units
    for limit, least in ((found.reach, reach), (found.error, around)):
        assert least < float(limit) <= least * (1 + 4 * U32)
    assert above**2 * (1 + 8 * U32) < float(found.far) <= above**2 * (1 + 14 * U32)
    if below > 0:
        assert below**2 * (1 - 14 * U32) <= float(found.near) < below**2 * (1 - 8 * U32)
    else:
        assert found.near < 0


@pytest.mark.parametrize(
    ("radius", "steps", "extent"), [(0.0, 1024.0, 9.0), (0.3, 1024.0, 400.0), (2.0, 1e4, 9e5)]
)
def test_a_placed_radius_is_wider_than_its_rounding(radius: float, steps: float, extent: float) -> None:
    found = float(kernel.node_reach(radius, steps, extent))
    assert found >= radius * steps * (1 + U32) + extent * U32 * math.sqrt(3)
    assert found <= radius * steps * (1 + 2e-6) + extent * 2e-6
