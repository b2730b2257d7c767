"""Arrays of poses: the shapes that are one pose or many, and what is said of others."""

import numpy as np
import pytest
from solidcloud.schemas.archive.pose_arrays import make_poses, one_pose
from solidcloud.schemas.errors import BadRequestError


def test_one_pose_is_a_batch_of_one() -> None:
    pose = np.eye(4)
    pose[0, 3] = 2.0
    for given in (pose, pose.tolist(), pose.astype(np.float32), np.asfortranarray(pose), pose[None]):
        poses, one = make_poses(given), one_pose(given)
        assert (poses.shape, one.shape) == ((1, 4, 4), (4, 4))
        assert np.array_equal(poses[0], pose) and np.array_equal(one, pose)
        assert poses.dtype == one.dtype == np.float64 and poses.flags.c_contiguous and one.flags.c_contiguous
    assert make_poses(pose[None]).base is pose or np.shares_memory(make_poses(pose), pose)
    assert make_poses(np.empty((0, 4, 4))).shape == (0, 4, 4)


def test_what_has_a_method_as_matrix_is_told_the_way() -> None:
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation.identity()
    for convert in (make_poses, one_pose):
        with pytest.raises(BadRequestError, match=r"solidcloud.poses.from_rotation"):
            convert(rotation)


@pytest.mark.parametrize("shape", [(3, 3), (4,), (7,), (16,), (5, 4), (2, 3, 4), (1, 1, 4, 4)])
def test_another_shape_is_told_what_makes_poses(shape: tuple[int, ...]) -> None:
    for convert in (make_poses, one_pose):
        with pytest.raises(BadRequestError, match=r"solidcloud.poses makes poses from quaternions"):
            convert(np.zeros(shape))
