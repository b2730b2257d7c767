"""What `check_poses` says of a fault, its figure included, at the borders of what is admitted; the terms of a place."""

from typing import NamedTuple

import archive_cases
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.server.kernels.core import reach as pose_checks
from solidcloud.server.runtime.stop_flag import NO_STOP

pytestmark = pytest.mark.interpreted

UNITS = 2.0**26


class Lattice(NamedTuple):
    """What `check_poses` reads of a scene."""

    step: float
    voxel_steps: int
    stop: NDArray[np.int64]


LATTICE = Lattice(2.0**-13, 65_536, NO_STOP.flag)


def check(
    poses: NDArray[np.float64], node_radius: float = 1.0, radius: float = 0.0, others: int = 0
) -> tuple[int, int, float]:
    """The fault, the pose that has it, and the figure found."""
    units = np.zeros(len(poses), np.int64)
    return pose_checks.check_poses(poses, np.array([node_radius]), radius, others, LATTICE, units)


def entry(row: int, column: int, value: float) -> NDArray[np.float64]:
    """The identity with one entry changed, behind a pose that is good."""
    poses = np.stack([np.eye(4)] * 2)
    poses[1, row, column] = value
    return poses


def test_a_mirrored_pose_is_told_whatever_its_axes(rng: np.random.Generator) -> None:
    for _ in range(60):
        pose = archive_cases.pose_of(archive_cases.random_rotation(rng), rng.uniform(-1, 1, 3))
        assert check(pose[None])[0] == pose_checks.VALID
        pose[:3, rng.integers(3)] *= -1
        fault, index, volume = check(pose[None])
        assert (fault, index) == (pose_checks.MIRRORED, 0)
        assert volume == pytest.approx(np.linalg.det(pose[:3, :3]), rel=1e-12)


@pytest.mark.parametrize(("row", "column"), [(r, c) for r in range(4) for c in range(4)])
def test_every_entry_is_looked_at_and_the_figure_is_what_was_found(row: int, column: int) -> None:
    for value in (np.nan, np.inf, -np.inf):
        fault, index, found = check(entry(row, column, value))
        assert (fault, index) == (pose_checks.NOT_FINITE, 1) and str(found) == str(value)
    if row == 3:
        given = 1.0 + 2.0**-52 if column == 3 else 5e-324
        assert check(entry(row, column, given)) == (
            pose_checks.BAD_LAST_ROW,
            1,
            given if column == 3 else 1.0,
        )
    elif column == 3:
        for sign in (1.0, -1.0):
            assert check(entry(row, column, sign * 1e9))[0] == pose_checks.VALID
            beyond = sign * np.nextafter(1e9, np.inf)
            assert check(entry(row, column, beyond)) == (pose_checks.TOO_FAR, 1, beyond)
    else:
        for value in (1999.0, -1e200):  # the square of the second is infinite
            fault, index, _ = check(entry(row, column, value))
            assert fault in (pose_checks.SHEARED, pose_checks.MIRRORED, pose_checks.SCALED) and index == 1


def test_a_scale_is_told_by_its_size_from_a_thousand_millionth_on(rng: np.random.Generator) -> None:
    turn = archive_cases.random_rotation(rng)
    for scale in (0.0, 1e-3, 0.5, 1 - 1.05e-9, 1 + 1.05e-9, 1.02, 1e3):
        fault, index, found = check(archive_cases.pose_of(turn * scale, np.zeros(3))[None])
        assert (fault, index) == (pose_checks.SCALED, 0) and found == pytest.approx(scale, rel=1e-15)
        mirrored = np.diag([-scale, scale, scale, 1.0])[None]
        assert check(mirrored)[0] == (pose_checks.MIRRORED if scale else pose_checks.SCALED)
    for scale in (1 - 0.95e-9, 1 + 0.95e-9):
        assert check(archive_cases.pose_of(turn * scale, np.zeros(3))[None])[0] == pose_checks.VALID


@pytest.mark.parametrize(("row", "column"), [(r, c) for r in range(3) for c in range(3)])
def test_a_shear_is_told_by_its_size(row: int, column: int) -> None:
    value = 1.0 if row == column else 0.0
    for by in (1e-8, -1e-8):
        pose = entry(row, column, value + by)
        gram = pose[1, :3, :3].T @ pose[1, :3, :3]
        square = np.trace(gram) / 3
        for scale in (1.0, 0.25):
            pose[1, :3, :3] *= scale
            fault, index, found = check(pose)
            assert (fault, index) == (pose_checks.SHEARED, 1)
            assert found == pytest.approx(np.abs(gram - np.eye(3) * square).max() / square, rel=1e-6)
    least, most = 0.95e-9 * (1.5 if row == column else 2), 1.05e-9 * (1.5 if row == column else 2)
    assert check(entry(row, column, value + least))[0] == pose_checks.VALID
    assert check(entry(row, column, value + most))[0] == pose_checks.SHEARED


def test_the_reach_ends_at_sixteen_metres_to_the_unit() -> None:
    assert check(np.eye(4)[None], radius=15.0, others=1 << 26)[0] == pose_checks.VALID
    said = check(np.eye(4)[None], radius=15.0, others=(1 << 26) + 1)
    assert said == (pose_checks.LONG_REACH, 0, 16 + 1 / UNITS)


def test_an_avatar_ends_where_float32_does_to_the_step() -> None:
    """2^23 steps of 2^-13 m, less a voxel of 8 m, less a reach of 1 m: 1,015 m."""
    assert check(np.eye(4)[None], 1015.0, 1.0)[0] == pose_checks.VALID
    said = check(np.eye(4)[None], 1015.0 + 2.0**-13, 1.0)
    assert said == (pose_checks.LARGE_AVATAR, 0, 1016.0 + 2.0**-13)
    said = pose_checks.check_poses(np.eye(4)[None], np.empty(0), 1.0, 0, LATTICE, np.empty(1, np.int64))
    assert said == (pose_checks.VALID, 0, 0.0), "an avatar without nodes has no extent but its reach"
