"""Motion commands as their senders give them."""

import numpy as np
import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.wire.motion_messages import motion_fields, object_poses


@pytest.mark.parametrize(
    "pose", [np.eye(4), np.eye(4)[None], np.eye(4).tolist(), np.asfortranarray(np.eye(4))]
)
def test_a_pose_is_one_row_of_a_contiguous_array(pose):
    poses, velocity = motion_fields(pose, None)
    assert poses.shape == (1, 4, 4) and poses.flags.c_contiguous and velocity is None
    assert np.array_equal(poses[0], np.eye(4))


def test_a_velocity_is_three_numbers_and_no_pose():
    poses, velocity = motion_fields(None, np.array([1, 2, 3]))
    assert poses.shape == (0, 4, 4) and velocity == (1.0, 2.0, 3.0)


@pytest.mark.parametrize("velocity", [(1.0, 2.0), (1.0, 2.0, 3.0, 4.0), ()])
def test_a_velocity_of_another_length_is_refused(velocity):
    with pytest.raises(BadRequestError, match=f"velocity of {len(velocity)} numbers: expected 3"):
        motion_fields(None, velocity)


@pytest.mark.parametrize("pose", [np.eye(3), np.zeros(16), np.tile(np.eye(4), (2, 1, 1)), "text"])
def test_what_is_not_one_pose_is_refused(pose):
    with pytest.raises(BadRequestError, match=r"^pose"):
        motion_fields(pose, None)
    with pytest.raises(BadRequestError, match=r"^pose of object 'door'"):
        object_poses({"door": pose})


def test_poses_of_objects_are_lists_of_numbers():
    given = {"door": np.eye(4), "cart": np.eye(4, dtype=np.float32)[None], "box": np.eye(4).tolist()}
    assert object_poses(given) == dict.fromkeys(given, np.eye(4).tolist())
    assert object_poses(None) == {}
