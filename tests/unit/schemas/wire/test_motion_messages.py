"""Motion commands as their senders give them."""

import numpy as np
import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.wire.motion_messages import motion_fields


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
