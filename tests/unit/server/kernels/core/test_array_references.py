"""Test references to arrays: reused while the arrays are the same, and safe for arrays of any memory order."""

from itertools import pairwise
from pathlib import Path

import archive_cases
import numpy as np
import pytest
from solidcloud.server.queries.request import EXACT
from solidcloud.server.queries.resident_fast_path import ResidentQueries, distance_fast
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
            data, queries = generation.data, ResidentQueries(model)
            for first, last in pairwise(poses):
                other_first, other_last = np.asfortranarray(first), np.repeat(last, 2, axis=1)[:, ::2]
                assert not other_first.flags.c_contiguous and not other_last.flags.c_contiguous
                plain = queries.sweep(data, first, last, 1e-6, EXACT)
                other_swept = queries.sweep(data, other_first, other_last, 1e-6, EXACT)
                for one, same in zip(other_swept, plain, strict=True):
                    np.testing.assert_array_equal(one, same)
                assert queries.collide(data, other_last, EXACT) == queries.collide(data, last, EXACT)
                between, _ = queries.between(data.arrays.origin, first, last, 0.5)
                other, _ = queries.between(data.arrays.origin, other_first, other_last, 0.5)
                assert between.tobytes() == other.tobytes()
                near = distance_fast(data, model, last, 0.5)
                assert distance_fast(data, model, other_last, 0.5).signed_distance == near.signed_distance
