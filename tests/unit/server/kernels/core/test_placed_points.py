"""Poses: what is admitted, what is refused and why, and where a pose puts a point."""

from fractions import Fraction

import archive_cases
import naive
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.server.kernels.core import placed_avatar as placing
from solidcloud.server.kernels.core import voxels_in_reach as pose_checks
from solidcloud.server.kernels.core.scene_arrays import BLOCK_WORDS, SceneArrays

pytestmark = pytest.mark.interpreted

SCENE = SceneArrays(
    np.empty(0, np.float32),
    np.empty(0, np.int32),
    np.empty(0, np.uint16),
    np.empty((0, 3), np.int64),
    np.empty((0, 3), np.int64),
    np.zeros(3),
    1e-4,
    1e-4 * naive.UNITS,
    80_000,
    BLOCK_WORDS,
    np.zeros(1, np.int64),
    np.zeros(1, np.int64),
)


def check(
    pose: NDArray[np.float64], node_radius: float = 1.0, radius: float = 0.01
) -> tuple[int, float, int]:
    """The fault of one pose, its scale and its reach in units; other radii and margin are 5 units."""
    scales, units = np.full(1, np.nan), np.zeros(1, np.int64)
    fault, index, _ = pose_checks.check_poses(
        pose[None].copy(), np.array([node_radius]), radius, 5, SCENE, scales, units
    )
    assert index == 0
    return int(fault), float(scales[0]), int(units[0])


def test_a_rotation_is_rigid_whatever_its_rounding(rng: np.random.Generator) -> None:
    for _ in range(50):
        pose = archive_cases.pose_of(archive_cases.random_rotation(rng), rng.uniform(-1e6, 1e6, 3))
        fault, scale, units = check(pose)
        assert (fault, scale) == (pose_checks.VALID, 1.0)
        assert units == naive.reach_units(pose, 0.01, 0.0, 0.0) + 5


@pytest.mark.parametrize("factor", [1e-3, 0.02, 0.999, 1 + 1e-8, 7.5, 1e3])
def test_a_uniform_scale_scales_the_radius(rng: np.random.Generator, factor: float) -> None:
    pose = archive_cases.pose_of(factor * archive_cases.random_rotation(rng), np.zeros(3))
    fault, scale, units = check(pose, node_radius=0.01, radius=0.003)
    assert fault == pose_checks.VALID and scale == pytest.approx(factor, rel=1e-12)
    assert units == naive.reach_units(pose, 0.003, 0.0, 0.0) + 5


def entry(row: int, column: int, value: float) -> NDArray[np.float64]:
    """The identity with one entry changed."""
    pose = np.eye(4)
    pose[row, column] = value
    return pose


@pytest.mark.parametrize(
    ("pose", "fault"),
    [
        (entry(0, 0, np.nan), pose_checks.NOT_FINITE),
        (entry(3, 3, np.nan), pose_checks.NOT_FINITE),
        (entry(1, 3, np.inf), pose_checks.NOT_FINITE),
        (entry(3, 0, 1e-300), pose_checks.BAD_LAST_ROW),
        (entry(3, 3, 1.0 + 2.0**-52), pose_checks.BAD_LAST_ROW),
        (entry(2, 2, -1.0), pose_checks.MIRRORED),
        (np.diag([-1.0, -1.0, -1.0, 1.0]), pose_checks.MIRRORED),
        (entry(0, 1, 1.0), pose_checks.SHEARED),
        (entry(0, 1, 3e-9), pose_checks.SHEARED),
        (entry(1, 1, 1.0 + 4e-9), pose_checks.SHEARED),
        (np.diag([0.0, 0.0, 0.0, 1.0]), pose_checks.BAD_SCALE),
        (np.diag([1001.0, 1001.0, 1001.0, 1.0]), pose_checks.BAD_SCALE),
        (np.diag([9e-4, 9e-4, 9e-4, 1.0]), pose_checks.BAD_SCALE),
        (entry(0, 0, 1e300), pose_checks.BAD_SCALE),
        (entry(0, 3, 1.0000001e9), pose_checks.TOO_FAR),
    ],
)
def test_what_is_no_similarity_is_refused(pose: NDArray[np.float64], fault: int) -> None:
    assert check(pose)[0] == fault


def test_a_departure_within_the_tolerance_is_admitted() -> None:
    assert check(entry(0, 1, 0.9e-9))[:2] == (pose_checks.VALID, 1.0)
    assert check(np.diag([1 + 0.9e-9] * 3 + [1.0]))[:2] == (pose_checks.VALID, 1.0)
    # Beyond it a scale is a scale.
    assert check(np.diag([1 + 2e-9] * 3 + [1.0]))[1] == pytest.approx(1 + 2e-9, abs=1e-12)


def test_reach_and_extent_are_bounded() -> None:
    assert check(np.eye(4), radius=15.99)[0] == pose_checks.VALID
    assert check(np.eye(4), radius=16.01)[0] == pose_checks.LONG_REACH
    assert check(np.eye(4), radius=1e300)[0] == pose_checks.LONG_REACH
    # 2^23 steps of 0.1 mm are 838.9 m, of which the voxel takes 8.
    assert check(np.eye(4), node_radius=830.0)[0] == pose_checks.VALID
    assert check(np.eye(4), node_radius=831.0)[0] == pose_checks.LARGE_AVATAR


def test_the_first_bad_pose_is_named() -> None:
    poses = np.stack([np.eye(4), entry(0, 1, 1.0), entry(0, 0, np.nan)])
    scales, units = np.empty(3), np.empty(3, np.int64)
    fault, index, _ = pose_checks.check_poses(poses, np.empty(0), 0.0, 0, SCENE, scales, units)
    assert (fault, index) == (pose_checks.SHEARED, 1)


def test_placing_is_the_formula_of_the_definition(rng: np.random.Generator) -> None:
    origin = np.array([5e5, 5.6e6, -3.25])
    for _ in range(200):
        pose = archive_cases.pose_of(
            archive_cases.random_rotation(rng) * rng.uniform(0.5, 2), rng.uniform(-10, 10, 3) + origin
        )
        point = rng.uniform(-1, 1, 3) * 10.0 ** rng.integers(-6, 4)
        shift = pose[:3, 3] - origin
        placed = [placing.to_units(placing.place(pose, shift, r, *point)) for r in range(3)]
        assert placed == naive.placed_units(point[None], pose, origin)[0].tolist()


def test_units_are_rounded_half_to_even() -> None:
    halves = np.arange(-3.5, 4.0)
    assert [placing.to_units(h / naive.UNITS) for h in halves] == [-4, -2, -2, 0, 0, 2, 2, 4]
    assert [placing.lattice_to_units(k, 0.5) for k in (-3, -1, 1, 3)] == [-2, 0, 0, 2]


def test_largest_term_bounds_the_rounding_of_place(rng: np.random.Generator) -> None:
    # Terms that cancel, up to 1e9 m: the placed coordinate is small and its rounding is not.
    for _ in range(300):
        point = rng.uniform(-1, 1, 3) * 10.0 ** rng.integers(0, 9)
        turn = archive_cases.random_rotation(rng)
        pose = archive_cases.pose_of(turn, -turn @ point + rng.uniform(-1, 1, 3))
        shift = pose[:3, 3].copy()
        bound = Fraction(placing.largest_term(pose, shift, *point)) / 2**50
        for r in range(3):
            ideal = sum(
                (Fraction(pose[r, c]) * Fraction(point[c]) for c in range(3)), start=Fraction(shift[r])
            )
            assert abs(Fraction(placing.place(pose, shift, r, *point)) - ideal) <= bound
