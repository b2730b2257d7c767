"""Poses: what is admitted, what is refused and why, and where a pose puts a point."""

from fractions import Fraction

import archive_cases
import naive
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.server.kernels.core import placed_avatar as placing
from solidcloud.server.kernels.core import reach as pose_checks
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


def check(pose: NDArray[np.float64], node_radius: float = 1.0, radius: float = 0.01) -> tuple[int, int]:
    """The fault of one pose and its reach in units; other radii and margin are 5 units."""
    units = np.zeros(1, np.int64)
    fault, index, _ = pose_checks.check_poses(
        pose[None].copy(), np.array([node_radius]), radius, 5, SCENE, units
    )
    assert index == 0
    return int(fault), int(units[0])


def test_a_rotation_is_rigid_whatever_its_rounding(rng: np.random.Generator) -> None:
    for _ in range(50):
        pose = archive_cases.pose_of(archive_cases.random_rotation(rng), rng.uniform(-1e6, 1e6, 3))
        assert check(pose) == (pose_checks.VALID, naive.reach_units(0.01, 0.0, 0.0) + 5)


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
