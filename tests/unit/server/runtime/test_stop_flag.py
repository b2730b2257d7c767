"""The stop flag: work ends soon after it is set, what was not looked at is unknown, and nothing is lost."""

import os
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.queries import path
from solidcloud.server.runtime.stop_flag import NO_STOP, StopFlag
from solidcloud.server.scene import Scene

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
CLEAR, CONTACT, UNKNOWN = Verdict
WHY = "the test has seen enough"
# A sheet of points above another one, with less than a tenth of a millimetre between their spheres: nothing touches,
# and hardly a node can be pruned.
SPACING, RADIUS = 0.01, 0.02
GAP = 2 * RADIUS + 1e-4
SIDE = 12 if INTERPRETED else 100


def sheet(side: int) -> np.ndarray:
    """Points (side^2, 3) of a square sheet at z = 0 [m]."""
    at = np.arange(side) * SPACING
    x, y = np.meshgrid(at, at)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(side * side)])


def poses_above(count: int, gap: float = GAP) -> np.ndarray:
    """Poses (count, 4, 4) of a sheet above the scan, each moved sideways by a little."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    moved = np.random.default_rng(7).uniform(-SPACING, SPACING, (count, 2))
    poses[:, :2, 3], poses[:, 2, 3] = moved, gap
    return poses


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """A scan of one sheet, resident, and an avatar that is the same sheet."""
    folder = tmp_path_factory.mktemp("sheet")
    np.savetxt(folder / "sheet.xyz", sheet(SIDE), fmt="%.4f")
    build_archive([folder / "sheet.xyz"], folder / "sheet", BuildConfig(jobs=1))
    with Scene.open(folder / "sheet") as scene:
        scene.add_avatar("sheet", sheet(SIDE), RADIUS)
        scene.add_avatar("corner", sheet(SIDE // 4), RADIUS)
        yield scene


def ask(scene: Scene, op: str, count: int, **options: Any) -> Any:
    """Ask one question of `count` poses, motions, rays, points or objects; each alone is answered in a moment."""
    options.setdefault("radius_model", f"fixed:{RADIUS}")
    poses = poses_above(count)
    points = poses[:, :3, 3] + [SIDE * SPACING / 2, SIDE * SPACING / 2, 0.0]
    if op == "raycast":
        ways = np.tile([1.0, 0.7, 0.0], (count, 1))
        return scene.raycast(points - [3.0, 2.1, 0.0], ways, 50.0, **options)
    if op == "within":
        return scene.within(points + np.array([0.0, 0.0, 7.0]), 10.0, **options)
    if op == "objects":
        poses[:, 2, 3] = GAP * np.arange(1, count + 1)
        return scene.objects([("sheet", pose) for pose in poses], **options)
    if op == "sweep":
        ends = poses.copy()
        ends[:, 0, 3] += 0.5
        return scene.sweep("sheet", poses, ends, **options)
    if op == "distance":
        return scene.distance("sheet", poses, 1.0, **options)
    if op == "contacts":
        return scene.contacts("sheet", poses_above(count, GAP / 2), 1000, 0.1, 0.001, **options)
    return scene.collide("sheet", poses, **options)


OPS = ("collide", "distance", "contacts", "sweep", "raycast", "within", "objects")
# So many that each question would take far longer than a test may.
MANY = {
    "collide": 20_000, "distance": 20_000, "contacts": 2_000, "sweep": 2_000, "raycast": 400_000, "within": 400_000,
    "objects": 1_500,
}  # fmt: skip


@pytest.mark.parametrize("op", OPS)
def test_stopped_at_work_it_ends_soon_and_says_nothing_wrong(scene: Scene, op: str) -> None:
    ask(scene, op, 2)  # compiled
    stop = StopFlag()
    timer = threading.Timer(0.05, stop.set, [WHY])
    timer.start()
    begin = time.monotonic()
    answers = ask(scene, op, MANY[op], stop=stop)
    took = time.monotonic() - begin
    timer.join()
    assert answers.stopped == WHY, f"{op} was done before it was stopped, after {took:.1f} s: give it more"
    assert took < 20, "far more than any kernel may take; scripts/bench_stop has the figures"
    verdict = np.asarray(answers.verdict)
    pairs = op == "objects"  # the scan is done with first
    assert ((answers.pair_verdict if pairs else verdict) == UNKNOWN).any()
    # What was said is what is true: the sheets do not touch, and every ray and point meets the scan.
    truth = CONTACT if op in ("contacts", "raycast", "within") else CLEAR
    assert set(verdict.tolist()) <= {truth, UNKNOWN}
    scene.residency.check()


@pytest.mark.interpreted
@pytest.mark.parametrize("op", ["collide", "distance", "contacts", "sweep"])
def test_a_path_that_is_stopped_is_unknown_to_its_end(scene: Scene, op: str) -> None:
    stop = StopFlag()
    given: dict[str, Any] = {"reach": 1.0} if op == "distance" else {}
    poses = poses_above(200)
    parts = []
    for part in scene.path("sheet", poses, op, stop=stop, threads=1, **given):
        parts.append(part)
        stop.set(WHY)
    assert parts[-1].stopped == WHY
    assert sum(len(part) for part in parts) == 200 - (op == "sweep")
    assert all((np.asarray(part.verdict) == UNKNOWN).all() for part in parts[1:])
    scene.residency.check()


@pytest.mark.interpreted
def test_a_stopped_frame_leaves_the_avatar_where_it_was(scene: Scene) -> None:
    stop = StopFlag()
    stop.set(WHY)
    begin, end = poses_above(2, 1.0)
    end[0, 3] += 0.2
    moved = scene.move("corner", begin[None], end[None], stop=stop)
    assert moved.verdict == UNKNOWN
    assert np.array_equal(moved.pose[0], begin)
    assert moved.left == pytest.approx(np.linalg.norm(end[:3, 3] - begin[:3, 3]))


@pytest.mark.parametrize("threads", [1, 2])
def test_a_part_of_a_path_that_takes_too_long_ends_alone(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, threads: int
) -> None:
    poses = poses_above(300)
    truth = [part.verdict for part in scene.path("corner", poses, "collide")]
    late: list[str] = []

    def at_once(stop: StopFlag, when: float, reason: str) -> None:
        assert when <= time.perf_counter() + 30.0
        late.append(reason)
        if len(late) == 1:
            stop.set(reason)

    monkeypatch.setattr(path, "stop_at", at_once)
    stop = StopFlag(part_seconds=30.0)
    parts = list(scene.path("corner", poses, "collide", threads=threads, stop=stop))
    assert [part.stopped for part in parts].count(late[0]) == 1 and "30 s" in late[0]
    for part in parts:
        if part.stopped:
            assert (part.verdict == UNKNOWN).all()
        else:
            assert (part.verdict != UNKNOWN).all()
    assert len(late) == len(parts) > 1 and not stop
    assert sum(len(part.verdict) for part in parts) == sum(map(len, truth)) == 300


@pytest.mark.interpreted
def test_a_flag_sets_those_of_its_parts() -> None:
    stop = StopFlag()
    parts = [stop.part(), stop.part()]
    parts[0].set("of one part")
    assert not stop and not parts[1]
    stop.set(WHY)
    assert [part.reason for part in [*parts, stop.part()]] == ["of one part", WHY, WHY]
    assert not NO_STOP.part()
