"""`rigid_pose` and `check_rigid`: what they refuse, with one message for all poses that place something."""

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.schemas.archive.rigid_pose import check_rigid, rigid_fault, rigid_pose
from solidcloud.schemas.errors import BadRequestError, BadTransformError


def changed(row: int, column: int, value: float) -> NDArray[np.float64]:
    """Return the identity with one number changed."""
    pose = np.eye(4)
    pose[row, column] = value
    return pose


@pytest.mark.parametrize(
    ("pose", "fault"),
    [
        (changed(0, 1, 1e-8), "off by 1e-08:"),
        (changed(2, 2, 1.1), "off by 0.21:"),
        (changed(2, 2, -1.0), "it mirrors:"),
        (changed(3, 0, 0.5), r"its last row is \[0.5, 0.0, 0.0, 1.0\]:"),
        (np.diag([0.0, 0, 0, 1]), "off by 1:"),
    ],
)
def test_a_pose_that_is_not_rigid_is_refused_with_the_reason(pose: NDArray[np.float64], fault: str) -> None:
    expected = (
        "expected a row-major 4x4 pose of a rotation, within 1e-09, and a translation, last row 0 0 0 1"
    )
    rounded = ": solidcloud.poses.renormalise returns the nearest rotation" if "e-" in fault else ""
    for check in (check_rigid, rigid_pose):
        with pytest.raises(BadTransformError, match=f"^door: not rigid, {fault} {expected}{rounded}$"):
            check(pose, "door")


def test_a_rigid_pose_is_copied_and_a_looser_tolerance_accepts_more(rng: np.random.Generator) -> None:
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn * np.sign(np.linalg.det(turn)), (1.0, -2.0, 1e9)
    for given in (pose.tolist(), pose, pose[None]):
        assert np.array_equal(rigid_pose(given, "door"), pose)
    found = rigid_pose(pose.tolist(), "door")
    assert np.array_equal(found, pose) and found.flags.c_contiguous
    assert check_rigid(pose, "door") is pose
    loose = changed(0, 1, 1e-8).tolist()
    assert rigid_fault(loose) is not None and rigid_fault(loose, 1e-6) is None


@pytest.mark.parametrize(
    ("pose", "fault"),
    [
        (np.eye(3), r"of shape \(3, 3\): expected one pose, \(4, 4\) or \(1, 4, 4\)"),
        (np.tile(np.eye(4), (2, 1, 1)), r"of shape \(2, 4, 4\): expected one pose"),
        (changed(1, 1, np.nan), "expected finite numbers"),
        (changed(0, 3, 1.1e9), "a translation within 1e9 m"),
    ],
)
def test_what_is_no_pose_is_refused(pose: NDArray[np.float64], fault: str) -> None:
    with pytest.raises(BadRequestError, match=f"^door:? .*{fault}"):
        rigid_pose(pose, "door")


def test_rotations_of_float32_numbers_are_refused_with_the_way_out(rng: np.random.Generator) -> None:
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3] = turn * np.sign(np.linalg.det(turn))
    with pytest.raises(BadTransformError, match=r"off by .*e-0[78]: .*solidcloud.poses.renormalise"):
        rigid_pose(pose.astype(np.float32), "door")
