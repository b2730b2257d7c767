"""`objects`: budgets, groups, and what is refused."""

from collections.abc import Iterator

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.schemas.errors import BadRequestError, BadTransformError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries.objects import SCENE_GROUP, objects
from solidcloud.server.queries.query_inputs import SceneData, make_budget, make_scene_data
from solidcloud.server.residency.voxel_cache import VoxelCache
from solidcloud.server.residency.voxel_store import VoxelStore

CLEAR, CONTACT, UNKNOWN = Verdict
BALL = make_avatar([[0.0, 0, 0]], 0.5)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SceneData]:
    """A plane of 50 points."""
    case = archive_cases.build(tmp_path_factory.mktemp("objects"), synthetic_scans.make_scan("plane", 1, 50))
    store = VoxelStore(case.archive)
    yield make_scene_data(store.archive, VoxelCache(store, 64 << 20))
    store.close()


def at(*places: float) -> NDArray[np.float64]:
    """Poses along x, above the plane."""
    return np.array([archive_cases.pose_of(np.eye(3), np.array([x, 0.0, 30.0])) for x in places])


def test_a_pair_needs_each_group_in_the_other_mask(data: SceneData) -> None:
    for groups, masks, touch in [
        ((1, 1), (1, 1), True),
        ((1, 2), (2, 1), True),
        ((1, 2), (2, 2), False),
        ((1, 2), (1, 1), False),
        ((0, 1), (1, 1), False),
        ((6, 1), (3, 4), True),
        ((SCENE_GROUP, SCENE_GROUP), (SCENE_GROUP, SCENE_GROUP), True),
    ]:
        answers = objects(data, [BALL, BALL], at(0, 0.5), groups, masks)
        assert answers.pairs.tolist() == ([[0, 1]] if touch else [])
        assert (answers.pairs_tested, answers.pairs_filtered) == ((1, 0) if touch else (0, 1))
    assert objects(data, [BALL, BALL], at(0, 1.5), [1, 1], [1, 1]).pairs_tested == 0


def test_a_deadline_that_has_passed_leaves_all_unknown(data: SceneData) -> None:
    late = make_budget(budget_ms=0)
    poses = at(0, 0.5, 9)
    poses[2, :3, 3] = synthetic_scans.make_scan("plane", 1, 50)[0]
    answers = objects(data, [BALL] * 3, poses, [1] * 3, [1, 1 | SCENE_GROUP, SCENE_GROUP], budget=late)
    assert answers.verdict.tolist() == [CLEAR, CLEAR, UNKNOWN], "the second is out of all reach"
    assert answers.pairs.tolist() == [[0, 1]] and answers.pair_verdict.tolist() == [UNKNOWN]
    assert answers.pairs_tested == 0 and answers.misses == 0
    soon = make_budget(budget_ms=600_000)
    answers = objects(data, [BALL] * 300, np.repeat(at(0), 300, axis=0), [1] * 300, [1] * 300, budget=soon)
    assert len(answers.pairs) == 300 * 299 // 2 and (answers.pair_verdict == CONTACT).all()


def test_objects_at_the_farthest_place_are_exact(data: SceneData) -> None:
    """Two points 2 mm apart, 1.9e9 m from the origin, which takes 57 bits of exact units."""
    far, poses = make_avatar([[9e8, 0, 0]], 0.0), at(1e9 - 0.002, 1e9)
    assert objects(data, [far] * 2, poses, [1] * 2, [1] * 2, 0.0021).pairs.tolist() == [[0, 1]]
    assert objects(data, [far] * 2, poses, [1] * 2, [1] * 2, 0.0019).pairs.tolist() == []


def test_what_is_refused(data: SceneData) -> None:
    for arguments, error, text in [
        (([BALL], at(0, 1), [1, 1], [1, 1]), BadRequestError, "1 avatars, 2 poses"),
        (([BALL], at(0), [1, 1], [1]), BadRequestError, "2 groups"),
        (([BALL], np.eye(3), [1], [1]), BadRequestError, "shape"),
        (([BALL] * 2, at(0, 1), [1, 1], [1, 1], -1.0), BadRequestError, "margin"),
        (([BALL] * 2, at(0, 1), [1, 1], [1, 1], 15.5), BadRequestError, "add up to 16.5 m"),
        (([BALL] * 2, at(0, np.nan), [1, 1], [1, 1]), BadRequestError, "pose 1 holds nan"),
        (
            (
                [BALL, make_avatar([[0, 0, 1.0]], 1), BALL],
                at(0, 1, 2) * [[[1], [1], [-1], [1]]],
                [1] * 3,
                [1] * 3,
            ),
            BadTransformError,
            "pose 0 mirrors",
        ),
    ]:
        with pytest.raises(error, match=text):
            objects(data, *arguments)
    assert len(objects(data, [], np.empty((0, 4, 4)), [], [])) == 0
    assert objects(data, [BALL], at(0), [1], [1], 15.5).verdict.tolist() == [CLEAR]
