"""A scene that is reloaded: which generation answers, when the old one goes, what happens where none can be opened."""

import gc
import os
import shutil
import time
import weakref
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from solidcloud.schemas.archive.index import INDEX_NAME
from solidcloud.schemas.errors import BadRequestError, FormatError, SolidcloudError
from solidcloud.server.scene import Scene

BODY = np.array([[0.0, 0, 0], [0.1, 0, 0]])
POINTS = synthetic_scans.make_scan("corner", 4, 300)
# A point that the second generation alone has, far from all others.
ALONE = np.array([1.5, 1.5, 1.5])
AT_ALONE = archive_cases.pose_of(np.eye(3), ALONE)[None]
ELSEWHERE = archive_cases.pose_of(np.eye(3), POINTS[0])[None]


@pytest.fixture(scope="module")
def generations(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two archives of one lattice: without the point and with it."""
    folder = tmp_path_factory.mktemp("generations")
    return archive_cases.build(folder, POINTS).archive, archive_cases.build(
        folder, np.vstack([POINTS, ALONE])
    ).archive


@pytest.fixture
def place(generations: tuple[Path, Path], tmp_path: Path) -> Path:
    """A folder with the first of them."""
    shutil.copytree(generations[0], tmp_path / "place")
    return tmp_path / "place"


@pytest.fixture
def replace(generations: tuple[Path, Path], place: Path) -> Callable[[int], None]:
    """Puts a generation there."""

    def put(number: int) -> None:
        shutil.rmtree(place)
        shutil.copytree(generations[number], place)

    return put


Replace = Callable[[int], None]


def test_what_is_opened_stays_until_reload(place: Path, replace: Replace) -> None:
    with Scene.open(place) as scene:
        scene.add_avatar("al", BODY, 0.01)
        replace(1)
        assert scene.collide("al", AT_ALONE).verdict.tolist() == [0]
        assert scene.info().points == 300
        answer = scene.reload()
        assert (answer.scene, answer.points) == ("place", 301) and answer.seconds > 0
        assert scene.collide("al", AT_ALONE).verdict.tolist() == [1]
        assert scene.info().points == 301
        replace(0)
        scene.reload()
        assert scene.collide("al", AT_ALONE).verdict.tolist() == [0]


def test_every_question_is_asked_of_the_new_one(place: Path, replace: Replace) -> None:
    with Scene.open(place) as scene:
        scene.add_avatar("al", BODY, 0.01)
        replace(1)
        scene.reload()
        assert scene.distance("al", AT_ALONE, 0.05).verdict.tolist() == [1]
        assert scene.contacts("al", AT_ALONE).pairs_found.tolist() == [1]
        assert scene.sweep("al", AT_ALONE, AT_ALONE).verdict.tolist() == [1]
        assert scene.raycast(ALONE[None] + [0, 0, 0.02], [[0, 0, -1.0]], 0.05).verdict.tolist() == [1]
        assert scene.within(ALONE[None], 0.01).verdict.tolist() == [1]
        assert scene.objects([("al", AT_ALONE[0])]).verdict.tolist() == [1]
        assert [p.verdict.tolist() for p in scene.path("al", AT_ALONE)] == [[1]]
        assert scene.collide("al", AT_ALONE, radius_model="fixed:0.01").verdict.tolist() == [1]


def files_open(folder: Path) -> int:
    """Files below a folder that this process has open, replaced ones included."""
    held = 0
    for number in os.listdir("/proc/self/fd"):
        with suppress(OSError):  # closed meanwhile
            held += os.readlink(f"/proc/self/fd/{number}").startswith(f"{folder}/")
    return held


def test_the_old_one_goes_with_its_last_reader(place: Path, replace: Replace, tmp_path: Path) -> None:
    with Scene.open(place) as scene:
        scene.add_avatar("al", BODY, 0.01)
        scene.collide("al", ELSEWHERE)
        gc.collect()  # closes what earlier tests left open
        before = files_open(tmp_path)
        memory = weakref.ref(scene.residency.buffer)
        path = scene.path("al", np.repeat(AT_ALONE, 3000, axis=0))
        first = next(path)
        replace(1)
        scene.reload()
        assert memory() is not None and files_open(tmp_path) > before, "the path still reads it"
        rest = list(path)
        verdicts = np.concatenate([part.verdict for part in (first, *rest)])
        assert len(verdicts) == 3000 and not verdicts.any(), "one answer, of one generation"
        # A thread of its own waits for the prefetcher to end.
        until = time.monotonic() + 20.0
        while (memory() is not None or files_open(tmp_path) > before) and time.monotonic() < until:
            time.sleep(0.001)
        assert memory() is None and files_open(tmp_path) <= before
        assert scene.collide("al", AT_ALONE).verdict.tolist() == [1]


@pytest.mark.parametrize("begun", [False, True])
def test_a_path_that_nobody_wants_any_more_holds_nothing(place: Path, begun: bool) -> None:
    with Scene.open(place) as scene:
        scene.add_avatar("al", BODY, 0.01)
        path = scene.path("al", np.repeat(AT_ALONE, 5000, axis=0))
        if begun:
            next(path)
        scene.reload()
        before = scene.archives[0]._before
        assert before is not None and not before.ended.is_set()
        del path
        assert before.ended.wait(20.0), "parts that were being computed have ended too"
        assert not before.take()
        assert before.level is None, "nor the memory of its level"


def truncate(place: Path) -> None:
    shard = next((place / "shards").iterdir())
    shard.write_bytes(shard.read_bytes()[:-1])


def garble(place: Path) -> None:
    (place / INDEX_NAME).write_bytes(b"no index")


@pytest.mark.parametrize("damage", [truncate, garble, shutil.rmtree])
def test_what_cannot_be_opened_is_refused_and_the_old_one_served_on(
    place: Path, tmp_path: Path, replace: Replace, damage: Callable[[Path], None]
) -> None:
    with Scene.open(place) as scene:
        scene.add_avatar("al", BODY, 0.01)
        replace(1)
        damage(place)
        before = files_open(tmp_path)
        with pytest.raises(FormatError, match=str(place)):
            scene.reload()
        assert files_open(tmp_path) == before
        assert scene.collide("al", AT_ALONE).verdict.tolist() == [0]
        assert scene.collide("al", ELSEWHERE).verdict.tolist() == [1]
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        replace(1)
        assert scene.reload().points == 301
        assert scene.collide("al", AT_ALONE).verdict.tolist() == [1]


def test_a_budget_too_small_for_the_new_one_is_refused(tmp_path: Path) -> None:
    few, many = (
        archive_cases.build(tmp_path, synthetic_scans.make_scan("corner", 4, n)).archive for n in (30, 3000)
    )
    with Scene.open(few) as scene:
        largest = max(scene.residency._sizes)
    with Scene.open(few, budget_bytes=largest) as scene:
        shutil.rmtree(few)
        shutil.copytree(many, few)
        before = files_open(tmp_path)
        with pytest.raises(BadRequestError, match="larger --cache"):
            scene.reload()
        assert scene.info().points == 30 and files_open(tmp_path) == before


def test_voxels_in_memory_are_there_after(place: Path, replace: Replace) -> None:
    with Scene.open(place) as scene:
        scene.add_avatar("al", BODY, 0.01)
        everywhere = np.array([archive_cases.pose_of(np.eye(3), point) for point in POINTS])
        scene.collide("al", everywhere)
        resident = scene.residency.resident
        assert resident > 5
        replace(1)
        scene.reload()
        assert scene.residency.resident >= resident
        assert scene.collide("al", everywhere).misses == 0
        scene.residency.check()


def test_a_closed_scene_says_so(place: Path) -> None:
    scene = Scene.open(place)
    scene.add_avatar("al", BODY, 0.01)
    scene.close()
    scene.close()
    for ask in (
        lambda: scene.collide("al", AT_ALONE),
        lambda: scene.path("al", AT_ALONE),
        scene.reload,
    ):
        with pytest.raises(SolidcloudError, match="closed"):
            ask()
