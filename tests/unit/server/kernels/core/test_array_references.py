"""Test references to arrays: reused while the arrays are the same, and safe for arrays of any memory order."""

from pathlib import Path

import archive_cases
import numpy as np
import pytest
from solidcloud.server.queries.collide import collide_fast
from solidcloud.server.queries.distance import distance_fast
from solidcloud.server.scene import Scene

pytestmark = pytest.mark.interpreted


def test_poses_of_any_memory_order_are_the_same_poses(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    case = archive_cases.build(tmp_path, rng.uniform(0, 1, (200, 3)))
    with Scene.open(case.archive) as scene:
        scene.add_avatar("body", rng.uniform(-0.2, 0.2, (30, 3)), 0.01)
        scene.collide("body", np.eye(4))
        model = scene.avatar("body", "")
        poses = archive_cases.near_poses(rng, case.points, model.points, 20, 0.5)
        with scene.archives[0].take() as generation:
            data = generation.data
            for pose in poses:
                for other in (np.asfortranarray(pose), np.repeat(pose, 2, axis=1)[:, ::2]):
                    assert not other.flags.c_contiguous
                    verdict = collide_fast(data, model, pose).verdict
                    assert collide_fast(data, model, other).verdict == verdict
                    near = distance_fast(data, model, pose, 0.5)
                    assert distance_fast(data, model, other, 0.5).signed_distance == near.signed_distance
