"""`near`: which poses one kernel call answers, and which are left to `distance`."""

from pathlib import Path

import archive_cases
import numpy as np
import pytest
from solidcloud.schemas.wire.answers import DistanceAnswers, Verdict
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries import distance as module
from solidcloud.server.queries.distance import distance, distance_fast
from solidcloud.server.scene import Scene

BALL = make_avatar([[0.0, 0, 0]], 0.1)
ROW = np.column_stack([np.arange(0, 4, 0.1), np.zeros(40), np.zeros(40)])


class Left:
    """`distance`, counted."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.count, self._ask = 0, module.distance
        patch.setattr(module, "distance", self)

    def __call__(self, *arguments: object) -> DistanceAnswers:
        """Count and answer."""
        self.count += 1
        return self._ask(*arguments)  # type: ignore[arg-type]


def above(x: float, z: float) -> np.ndarray:
    """The ball over the row."""
    return archive_cases.pose_of(np.eye(3), np.array([x, 0, z]))


@pytest.mark.interpreted
def test_what_is_resident_is_answered_in_one_call_and_counted_as_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    left = Left(monkeypatch)
    case = archive_cases.build(tmp_path, ROW, voxel=1.0, resolution=1e-3)
    with Scene.open(case.archive) as scene:
        first = distance_fast(scene._data, BALL, above(0.5, 0.3), 0.5)
        assert left.count == 1 and first.misses > 0, "it has to be loaded"
        assert scene.residency.resident == 1, "nothing in the next voxel is as near"
        near = distance_fast(scene._data, BALL, above(0.5, 0.3), 0.5)
        assert left.count == 1 and (near.hits, near.misses) == (1, 0)
        with scene.residency.hold(range(4)):
            pass
        before = scene.residency.stats.hits
        again = distance_fast(scene._data, BALL, above(0.5, 0.3), 0.5)
        assert left.count == 1 and again.misses == 0 and again.hits == 2, "two voxels are in reach"
        assert again.signed_distance.tolist() == pytest.approx([0.19], abs=1e-6)
        assert near.signed_distance.tolist() == again.signed_distance.tolist()
        assert again.witness_cloud[0].tolist() == pytest.approx([0.5, 0, 0], abs=1e-3)
        assert scene.residency.stats.hits == before + again.hits
        scene.residency.check()


@pytest.mark.interpreted
def test_an_empty_avatar_is_near_nothing(tmp_path: Path) -> None:
    case = archive_cases.build(tmp_path, ROW, voxel=1.0, resolution=1e-3)
    with Scene.open(case.archive) as scene:
        answers = distance_fast(scene._data, make_avatar(np.empty((0, 3))), np.eye(4), 0.5)
    assert answers.verdict.tolist() == [Verdict.CLEAR] and answers.signed_distance.tolist() == [np.inf]
    assert answers.lower.tolist() == [0.5] and np.isnan(answers.normal).all()


@pytest.mark.interpreted
@pytest.mark.parametrize("radius", [0.0, 0.1])
def test_centres_that_coincide_are_as_distance_says(tmp_path: Path, radius: float) -> None:
    case = archive_cases.build(tmp_path, ROW, voxel=1.0, resolution=1e-3, radius=radius)
    ball = make_avatar([[0.0, 0, 0]], radius)
    with Scene.open(case.archive) as scene:
        data, pose = scene._data, above(0.5, 0.0)
        expected = distance(data, ball, pose[None], 0.5)
        found = distance_fast(data, ball, pose, 0.5)
    assert found.hits == expected.misses > 0
    assert found.signed_distance.tolist() == expected.signed_distance.tolist()
    assert found.signed_distance[0] == pytest.approx(-2 * radius, abs=1e-7)
    assert found.normal.tolist() == expected.normal.tolist() == [[0.0, 0.0, 0.0]]
    assert found.verdict.tolist() == [Verdict.CONTACT]
