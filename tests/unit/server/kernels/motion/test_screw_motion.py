"""Screw motions: the formula bit for bit, its distance from the ideal, and the rates that bounds are taken from."""

import archive_cases
import naive_sweep
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.schemas.archive.rigid_pose import RIGID_TOLERANCE
from solidcloud.server.kernels.motion.screw_motion import make_motion, pose_at, sine_cosine

FRACTIONS = np.array([0.0, 1e-18, 1e-9, 0.1, 0.25, 0.5, 0.7, 1 - 1e-9, 1 - 2.0**-53, 1.0])
ORIGIN = np.zeros(3)


def turn_about(axis: NDArray[np.float64], angle: float) -> NDArray[np.float64]:
    """A rotation (3, 3), well rounded for angles down to 1e-300."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + 2 * np.sin(angle / 2) ** 2 * cross @ cross


def motions(rng: np.random.Generator) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Motions of all sorts: still, straight, turns small, large and by nearly half a turn, far away."""
    found = []
    for angle in (0.0, 1e-300, 1e-20, 1e-9, 1e-3, 0.7, 2.0, 3.1, np.pi - 1e-9, np.pi - 1e-15):
        for far, way in ((0.0, 1.0), (5e6, 1e4), (1e8, 0.0), (10.0, 1e-9)):
            start = archive_cases.random_rotation(rng)
            end = turn_about(rng.normal(size=3), angle) @ start if angle else start
            at = rng.normal(size=3) * far
            found.append(
                (
                    archive_cases.pose_of(start, at),
                    archive_cases.pose_of(end, at + rng.normal(size=3) * way),
                )
            )
    return found


def along(first: NDArray[np.float64], last: NDArray[np.float64]) -> NDArray[np.float64]:
    """The kernel's poses at FRACTIONS."""
    poses = np.empty((len(FRACTIONS), 4, 4))
    motion = make_motion(first, last, np.zeros((2, 3)), ORIGIN)
    for fraction, pose in zip(FRACTIONS, poses, strict=True):
        pose_at(motion, fraction, pose)
    return poses


@pytest.mark.interpreted
def test_poses_are_the_formula_bit_for_bit(rng: np.random.Generator) -> None:
    for first, last in motions(rng):
        for pose, t in zip(along(first, last), FRACTIONS, strict=True):
            assert pose.tolist() == naive_sweep.pose_at(first, last, t).tolist(), (first, last, t)


@pytest.mark.interpreted
def test_the_ends_are_the_bits_given(rng: np.random.Generator) -> None:
    for first, last in motions(rng):
        poses = along(first, last)
        assert poses[0].tobytes() == first.tobytes() and poses[-1].tobytes() == last.tobytes()
        # And the formula runs into them.
        assert np.abs(poses[1] - first).max() <= 1e-15 * max(1.0, np.abs(first).max(), np.abs(last).max())
        assert np.abs(poses[-2] - last).max() <= 1e-14 * max(1.0, np.abs(first).max(), np.abs(last).max())


def test_computed_points_lie_within_slip_of_the_ideal_motion(rng: np.random.Generator) -> None:
    """What the proof of sweep_interval.py takes for granted, against 60 digits; by how much is kept below a quarter."""
    worst = 0.0
    for first, last in motions(rng):
        box = np.array([[-3.0, -1, 0], [1, 2, 20]])
        motion = make_motion(first, last, box, ORIGIN)
        corner = np.array([-3.0, 2, 20])
        for pose, t in zip(along(first, last), FRACTIONS, strict=True):
            ideal = naive_sweep.ideal_pose(first, last, t)
            # Not summed with the translation, whose rounding there belongs to this test.
            off = (pose[:3, :3] - ideal[:3, :3]) @ corner + (pose[:3, 3] - ideal[:3, 3])
            worst = max(worst, float(np.linalg.norm(off)) / motion.slip)
    assert 0 < worst < 0.25


@pytest.mark.interpreted
def test_speed_and_bend_bound_what_points_do(rng: np.random.Generator) -> None:
    tight = 0.0
    for first, last in motions(rng):
        box = np.sort(rng.normal(size=(2, 3)), axis=0)
        motion = make_motion(first, last, box, ORIGIN)
        points = rng.uniform(box[0], box[1], (5, 3))
        for t in (0.0, 0.3, 0.9):
            step = 2.0**-4
            a, b, c = (
                np.array(naive_sweep.ideal_pose(first, last, at)) for at in (t, t + step / 2, t + step)
            )
            paths = [points @ m[:3, :3].T + m[:3, 3] for m in (a, b, c)]
            noise = 2.0**-50 * (np.abs(first).max() + np.abs(last).max()) * 20
            moved = np.linalg.norm(paths[2] - paths[0], axis=1).max()
            assert moved <= motion.speed * step + noise
            strayed = np.linalg.norm(paths[1] - (paths[0] + paths[2]) / 2, axis=1).max()
            assert strayed <= motion.bend * step**2 / 8 + noise
            if motion.bend > 1e-3:
                tight = max(tight, strayed / (motion.bend * step**2 / 8))
    assert tight > 0.3  # a bound that is never come near to would bound nothing worth having


@pytest.mark.interpreted
def test_a_pose_on_the_way_is_rigid_where_the_ends_are(rng: np.random.Generator) -> None:
    for first, last in motions(rng):
        first, last = first.copy(), last.copy()
        for pose in (first, last):  # nearly as far from one as is let in
            pose[:3, :3] *= 1 + rng.uniform(-0.5, 0.5, (3, 3)) * RIGID_TOLERANCE
        for pose in along(first, last):
            gram = pose[:3, :3].T @ pose[:3, :3]
            assert np.abs(gram - np.eye(3)).max() <= 2 * RIGID_TOLERANCE


@pytest.mark.interpreted
def test_half_a_turn_goes_about_the_axis_documented() -> None:
    quarter_z = turn_about(np.array([0.0, 0, 1]), np.pi / 2)
    for axis, signs in ((0, [1, -1, -1]), (1, [-1, 1, -1]), (2, [-1, -1, 1])):
        first, last = np.eye(4), np.diag([*map(float, signs), 1.0])
        middle = along(first, last)[5]
        expected = turn_about(np.eye(3)[axis], np.pi / 2)
        assert np.abs(middle[:3, :3] - expected).max() < 1e-15
        back = along(last, first)[5]  # about the same axis, in the same sense: not the way back
        assert np.abs(back[:3, :3] - expected @ last[:3, :3]).max() < 1e-15
    assert (
        np.abs(along(np.eye(4), archive_cases.pose_of(quarter_z, np.ones(3)))[-1][:3, :3] - quarter_z).max()
        == 0
    )


@pytest.mark.interpreted
def test_sines_are_right_to_the_last_bits() -> None:
    for x in [*np.linspace(0, np.pi / 2, 200), 1e-300, 1e-8]:
        s, c = sine_cosine(float(x))
        assert abs(s - np.sin(x)) <= 2.5e-16 * max(abs(np.sin(x)), 1e-300) + 0.0
        assert abs(c - np.cos(x)) <= 3e-16
