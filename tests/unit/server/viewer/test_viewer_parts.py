"""Test where the users of a viewer are: others see them, numbers are used again."""

import numpy as np
from solidcloud.server.viewer.viewer_parts import Users

POSE = np.eye(4).tolist()


def test_others_see_a_user_from_its_first_state_until_it_leaves() -> None:
    users = Users()
    one, other = users.enter(), users.enter()
    assert users.others(one) == []
    users.moved(other, np.array([1.0, 2.0, 3.0]), POSE, 0)
    assert users.others(one) == [{"number": other, "pose": POSE, "verdict": 0}]
    assert users.others(other) == []
    assert [place.tolist() for place in users.places(one)] == [[1.0, 2.0, 3.0]]
    users.leave(other)
    assert users.others(one) == []
