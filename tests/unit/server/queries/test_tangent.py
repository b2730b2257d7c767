"""Contact begins at the unit that the definition says, in every query, on the scenes of query_scenes.py.

Margins are set to the least reach that is contact, and to a unit less: what float32 cannot tell, integers decide.
"""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import archive_cases
import naive
import numpy as np
import pytest
import query_scenes
from numpy.typing import NDArray
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.scene import Scene

pytestmark = pytest.mark.interpreted

UNIT = 2.0**-26


@pytest.fixture(scope="module")
def archive_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The archive of a kind, built when first asked for."""
    return cache(lambda kind: query_scenes.build(tmp_path_factory.mktemp(kind), kind))


def margins(case: archive_cases.Case, scene: Scene, name: str) -> list[tuple[int, float]]:
    """Numbers of poses that have the margin at which contact begins, and that margin [m]."""
    info, found = scene.info(), []
    points, radius = query_scenes.AVATARS[name]
    for i, pose in enumerate(query_scenes.poses()):
        least, _ = archive_cases.least_reach(case, points, pose, info.origin, info.lattice_step)
        margin = least - naive.reach_units(radius, info.radius, 0.0)
        if 0 < margin < 2**28:
            found.append((i, margin * UNIT))
    return found


def verdict(scene: Scene, question: str, name: str, pose: NDArray[np.float64], margin: float) -> int:
    """What a question says of one pose (1, 4, 4)."""
    if question == "collide":
        return int(scene.collide(name, pose, margin).verdict[0])
    answers = scene.contacts(name, pose, 5, margin)
    assert (answers.pairs_found[0] > 0) == (answers.verdict[0] == Verdict.CONTACT)
    return int(answers.verdict[0])


@pytest.mark.parametrize("kind", ["fine", "flat"])
@pytest.mark.parametrize("name", ["small", "deep"])
@pytest.mark.parametrize("question", ["collide", "contacts"])
def test_contact_begins_at_the_unit_of_the_definition(
    archive_of: Callable[[str], Path], question: str, name: str, kind: str
) -> None:
    case = archive_cases.Case(archive_of(kind), query_scenes.scene_points(kind))
    with query_scenes.opened(case.archive, question) as scene:
        at = margins(case, scene, name)
        assert len(at) >= 3
        for i, margin in at:
            pose = query_scenes.poses()[i : i + 1]
            assert verdict(scene, question, name, pose, margin) == Verdict.CONTACT
            assert verdict(scene, question, name, pose, margin - UNIT) == Verdict.CLEAR
