"""Test frames that do not wait for voxels: they return at once, cross nothing, and arrive in the end."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import effect_rooms
import numpy as np
import pytest
from facade_scene import scene_text
from late_frames import PATIENCE, Floats, assert_crosses_nothing, blocked_loads
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.motion_messages import State
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.replay import recorded, replay
from solidcloud.server.simulation.replay_log import read_log

pytestmark = pytest.mark.interpreted

EFFECTS = ("stop", "sweep")
WALKING = ("stop", "sweep", "slide", "step", "ground")
SIZE = 6.0 if not effect_rooms.INTERPRETED else 3.0
BODY = effect_rooms.body_box()
PERSON = effect_rooms.person()


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the archive of a room, in many voxels."""
    folder = tmp_path_factory.mktemp("room")
    archive = effect_rooms.build(folder, effect_rooms.room(SIZE), voxel=1.0).archive
    # Compile before the tests, whose waits have limits.
    with (
        opened(archive, folder, WALKING) as scene,
        blocked_loads(scene),
        scene.session("person", late="bounds") as user,
    ):
        wishes(user, [effect_rooms.at(0, 0, 0), effect_rooms.at(SIZE, 0, 0)])
    return archive


@contextmanager
def opened(
    archive: Path, folder: Path, effects: tuple[str, ...] = EFFECTS, **options: int
) -> Iterator[Scene]:
    """Open the scene of an archive with effects, and the avatars."""
    path = folder / f"{len(list(folder.iterdir()))}.toml"
    path.write_text(scene_text(archive, effects))
    with Scene.open(path, "room", **options) as scene:
        scene.add_avatar("body", BODY.points, BODY.radius)
        scene.add_avatar("person", PERSON.points, PERSON.radius)
        yield scene


def wishes(session: object, poses: list[Floats]) -> list[State]:
    """Return the states of motion commands to these poses."""
    states = []
    for number, pose in enumerate(poses):
        session.wish(pose=pose, time=number / 30)  # type: ignore[attr-defined]
        states.append(session.latest())  # type: ignore[attr-defined]
    return states


def until(walk: Callable[[], State], done: Callable[[State], bool]) -> list[State]:
    """Repeat frames until one is done."""
    states, deadline = [], time.monotonic() + PATIENCE
    while not states or not done(states[-1]):
        assert time.monotonic() < deadline, f"never came true: {states[-1]!r}"
        states.append(walk())
        threading.Event().wait(0.001)  # lets the prefetcher's thread load
    return states


def corners(count: int, seed: int, height: float | None = None) -> list[Floats]:
    """Return targets (4, 4) of motion commands all over the room, some beyond its walls."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.7 * SIZE, 0.7 * SIZE, (count, 3))
    if height is not None:
        places[:, 2] = height
    return [effect_rooms.at(*place) for place in places.tolist()]


def test_a_frame_returns_while_every_load_is_blocked(room: Path, tmp_path: Path) -> None:
    with opened(room, tmp_path) as scene, blocked_loads(scene) as gate:  # noqa: SIM117
        with scene.session("body", late="bounds") as session:
            session.wish(pose=effect_rooms.at(0, 0, 0), time=0.0)
            session.wish(pose=effect_rooms.at(SIZE, 0, 0), time=1 / 30)
            state = session.latest()
            assert not gate.is_set() and state is not None
            assert state.touched[-1].unloaded and state.touched[-1].unknown and state.unknown
            assert 0 < state.unloaded <= state.left and state.verdict == Verdict.UNKNOWN
            x = state.pose[0, 0, 3]
            assert x < SIZE / 2
            gate.set()
            target = effect_rooms.at(SIZE, 0, 0)
            last = until(lambda: wishes(session, [target])[0], lambda state: not state.unknown)[-1]
    assert last.unloaded == 0 and not last.touched[-1].unloaded and last.touched[-1].place[0] == SIZE / 2
    assert last.pose[0, 0, 3] > x
    with opened(room, tmp_path) as scene, scene.session("body") as session:
        states = wishes(session, [effect_rooms.at(0, 0, 0), target])
    assert np.allclose(states[-1].pose, last.pose, atol=1e-3)


@pytest.mark.parametrize("effects", [EFFECTS, ("stop",), WALKING])
def test_no_path_crosses_the_scan_with_a_tiny_cache(
    room: Path, tmp_path: Path, effects: tuple[str, ...]
) -> None:
    """Only a few voxels fit, so most frames lack some."""
    with Scene.open(room) as scene:
        largest = int(scene.archives[0].take().store.sizes.max())
    lacked = 0
    with (
        opened(room, tmp_path) as judge,
        opened(room, tmp_path, effects, budget_bytes=3 * largest + (1 << 14)) as scene,
    ):
        name = "person" if "ground" in effects else "body"
        for seed in range(1 if effect_rooms.INTERPRETED else 2):
            start = effect_rooms.at(0, 0, -0.4 if "ground" in effects else 0.0)
            with scene.session(name, late="bounds") as session:
                states = wishes(session, [start, *corners(12, seed, -0.4 if "ground" in effects else None)])
            lacked += sum(state.unknown for state in states)
            poses = [state.pose[0] for state in states]
            if effects == ("stop",):  # such a motion is not continuous
                assert (judge.collide(name, np.array(poses)).verdict == Verdict.CLEAR).all()
            elif effects == EFFECTS:
                assert_crosses_nothing(judge, name, poses)
            else:
                assert (judge.collide(name, np.array(poses)).verdict == Verdict.CLEAR).all()
                assert (np.abs(np.array(poses)[:, :3, 3]) < SIZE / 2).all(), "it is still in the room"
        scene.residency.check()
    assert lacked > 0


@pytest.mark.parametrize("policy", ["lru", "lru+prefetch"])
def test_it_arrives_where_a_frame_that_waits_does(room: Path, tmp_path: Path, policy: str) -> None:
    with opened(room, tmp_path) as judge, opened(room, tmp_path, policy=policy) as scene:  # type: ignore[arg-type]
        for target in corners(6, 5):
            with judge.session("body") as session:
                expected = wishes(session, [effect_rooms.at(0, 0, 0), target])[-1].pose
            with scene.session("body", late="bounds") as session:
                wishes(session, [effect_rooms.at(0, 0, 0)])
                states = until(lambda: wishes(session, [target])[0], lambda state: not state.unknown)  # noqa: B023
            assert_crosses_nothing(judge, "body", [state.pose[0] for state in states])
            assert np.allclose(states[-1].pose, expected, atol=0.02)


def test_nobody_falls_through_a_floor_that_is_not_loaded(room: Path, tmp_path: Path) -> None:
    above = -SIZE / 2 + effect_rooms.RADIUS + 0.3
    with opened(room, tmp_path, WALKING) as scene, blocked_loads(scene) as gate:  # noqa: SIM117
        with scene.session("person", late="bounds") as session:
            states = wishes(session, [effect_rooms.at(0, 0, above)] * 20)
            assert all(state.pose[0, 2, 3] == states[0].pose[0, 2, 3] for state in states[1:])
            assert states[-1].ground is not None and not states[-1].ground.on_ground
            assert any(touched.unloaded for touched in states[-1].touched)
            gate.set()
            pose = effect_rooms.at(0, 0, above)
            found = until(
                lambda: wishes(session, [pose, pose, pose])[-1],
                lambda state: state.ground is not None and state.ground.on_ground,
            )
    assert found[-1].pose[0, 2, 3] == pytest.approx(-SIZE / 2 + effect_rooms.RADIUS + 0.03, abs=0.02)


def test_with_all_in_memory_frames_are_those_that_wait(room: Path, tmp_path: Path) -> None:
    for effects, name in ((WALKING, "person"), (EFFECTS, "body")):
        with opened(room, tmp_path, effects) as scene:
            scene.collide("body", np.array(corners(40, 3)))
            count = 5 if effect_rooms.INTERPRETED else 20
            found = []
            for late in ("wait", "bounds"):
                with scene.session(name, late=late) as session:
                    found.append(wishes(session, [effect_rooms.at(0, 0, -0.4), *corners(count, 8)]))
        for one, other in zip(*found, strict=True):
            assert one.pose.tobytes() == other.pose.tobytes()
            assert one.touched == other.touched and one.unknown == other.unknown


def test_a_replay_takes_what_was_not_in_memory_from_the_log(room: Path, tmp_path: Path) -> None:
    path, log = tmp_path / "room.toml", tmp_path / "frames.log"
    path.write_text(scene_text(room, WALKING))
    with Scene.open(path, "room") as scene:
        scene.add_avatar("person", PERSON.points, PERSON.radius)
        with recorded(scene, path, log), scene.session("person", late="bounds") as session:
            states = wishes(session, [effect_rooms.at(0, 0, -0.4)] * 3)
            until(lambda: wishes(session, corners(1, len(states), -0.4))[0], lambda state: not state.unknown)
            wishes(session, corners(6 if effect_rooms.INTERPRETED else 30, 2, -0.4))
    frames = list(read_log(log)[1])
    taken = [frame.turns[0].body is not None for frame in frames]
    assert taken[0] and not all(taken)
    with Scene.open(path, "room") as scene:
        found = replay(scene.simulation, frames)
    assert (found.turns, found.different, found.taken) == (len(frames), 0, sum(taken))
