"""Surface normals of bodies."""

import numpy as np
import pytest
import trimesh
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.avatars.avatar_shape import avatar_shape
from solidcloud.server.simulation.world.bodies import Bodies


def test_points_inside_take_no_part_in_a_bodys_normal_issue_35() -> None:
    shape = avatar_shape(trimesh.creation.box((1, 1, 1)), 0.02)
    found = Bodies(np.zeros(3), np.array([0.0, 0, 1])).shape_of(make_avatar(*shape[:3]))
    side = int(np.linalg.norm(shape.surface - [0.5, 0.0, 0.0], axis=1).argmin())
    normal = found.normal_at(side)
    assert normal is not None and abs(normal[0]) == pytest.approx(1.0, abs=1e-6)
