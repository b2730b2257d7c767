"""The pipeline: what is declared and nothing else, in its order, within a frame's budget."""

import subprocess
import sys
from typing import Any

import archive_cases
import effect_rooms
import numpy as np
import pytest
from effect_rooms import at, play
from solidcloud.schemas.errors import BadTransformError
from solidcloud.schemas.scene.effect_table import Ground, Proximity, Slide, Step, Stop, Sweep
from solidcloud.schemas.scene.scene_file import SceneLimits
from solidcloud.schemas.wire.motion_messages import Moved
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.simulation.world.collision_world import World
from solidcloud.server.simulation.world.frame import Frame, Runner

BALL = make_avatar([[0.0, 0, 0]], 0.2)

IMPORTED = """
import sys
from solidcloud.schemas.scene.effect_table import *
from solidcloud.schemas.scene.scene_file import ArchiveItem, SceneFile
from solidcloud.server.simulation.effects.effect_pipeline import make_pipeline
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.world.collision_world import World
import numpy as np
file = SceneFile(format=1, archives=[ArchiveItem(path="x")], effects=[Stop(), {effects}])
with Scene.open(sys.argv[1]) as scene:
    pipeline = make_pipeline(file, World(scene, file))
names = [name.rpartition(".")[2] for name in sys.modules if name.startswith("solidcloud.server.simulation.effects.")]
print(*sorted(names), "solidcloud.server.queries.surface_normals" in sys.modules)
"""


class Counted:
    """An effect that takes some node visits more."""

    def __init__(self, world: World, runner: Runner) -> None:
        self.name, self.visits, self._world, self._runner = runner.name, 0, world, runner

    def run(self, frame: Frame) -> None:
        """As the effect."""
        self._runner.run(frame)
        self._world.count(self.visits)


@pytest.fixture(scope="module")
def floor(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    """A floor at z = 0, a metre to each side."""
    return effect_rooms.build(tmp_path_factory.mktemp("floor"), effect_rooms.plane((-1, -1, 0), (1, 1, 0)))


@pytest.mark.parametrize(
    ("effects", "imported"),
    [
        ("", "stop_effect"),
        ("Sweep()", "stop_effect sweep_effect"),
        ("Sweep(), Slide()", "slide_effect stop_effect sweep_effect"),
    ],
)
def test_what_is_not_declared_is_not_imported(floor: archive_cases.Case, effects: str, imported: str) -> None:
    code = IMPORTED.format(effects=effects)
    run = subprocess.run(
        [sys.executable, "-c", code, str(floor.archive)],
        capture_output=True,
        text=True,
        check=True,
        timeout=200,
    )
    shared = {"effect_pipeline", "effect_times"}
    names = run.stdout.split()
    assert [name for name in names[:-1] if name not in shared] == imported.split()
    assert names[-1] == str("slide" in imported), "normals are for what slides"


@pytest.mark.interpreted
def test_effects_run_in_their_order_and_say_so(floor: archive_cases.Case) -> None:
    with play(floor.archive, Step(), Ground(), Slide(), Sweep(), Stop()) as game:
        moved = game.go(game.body(BALL, at(0, 0, 0.4)), (0.1, 0, 0))
        assert moved.simulated == ["stop", "sweep", "slide", "step", "ground"] and moved.skipped == []


@pytest.mark.interpreted
def test_an_effect_more_adds_nothing_to_answers_and_counts_of_those_there(floor: archive_cases.Case) -> None:
    sent, visits = [], []
    for effects in ((Stop(), Sweep()), (Stop(), Sweep(), Slide())):
        with play(floor.archive, *effects) as game:
            body = game.body(BALL, at(0, 0, 0.6))
            game.go(body, (0.1, 0, 0))
            before = game.world.visits
            moved = game.go(body, (0.1, 0, 0.1))
            visits.append(game.world.visits - before)
            plain = Moved(pose=moved.pose)
            fields = (name for name in Moved.__struct_fields__ if name != "pose")
            sent.append({name for name in fields if getattr(moved, name) != getattr(plain, name)})
    assert sent[0] == sent[1] == {"simulated"} and visits[0] == visits[1]


@pytest.mark.interpreted
def test_a_frame_without_room_skips_what_may_be_skipped_and_says_which(floor: archive_cases.Case) -> None:
    effects = (Stop(), Sweep(), Slide(), Ground(), Proximity())
    with play(floor.archive, *effects, limits=SceneLimits(frame_visits=1)) as game:
        body = game.body(BALL, at(0, 0, 0.5))
        for _ in range(4):
            moved = game.go(body, (0.05, 0, 0))
        assert moved.simulated[:2] == ["stop", "sweep"]
        assert "ground" in moved.skipped and "stop" not in moved.skipped
        assert moved.ground is None and (moved.proximity is None) == ("proximity" in moved.skipped)
    with play(floor.archive, *effects, limits=SceneLimits(frame_ms=1e-6)) as game:
        body = game.body(BALL, at(0, 0, 0.5))
        moved = game.go(body, (0.05, 0, 0))
        assert moved.simulated == ["stop", "sweep"] and moved.skipped == ["slide", "ground", "proximity"]
        assert body.pose[0, 3] == 0.05


@pytest.mark.interpreted
def test_an_effect_that_once_took_long_is_tried_again(floor: archive_cases.Case) -> None:
    with play(floor.archive, Stop(), Proximity(), limits=SceneLimits(frame_visits=10_000)) as game:
        body = game.body(BALL, at(0, 0, 0.5))
        runner, long = Counted(game.world, game.pipeline.runners[-1]), 1_000_000
        game.pipeline.runners = [*game.pipeline.runners[:-1], runner]

        def frames(count: int) -> list[bool]:
            moves = [game.go(body, (0.001 * (-1) ** number, 0, 0)) for number in range(count)]
            return [bool(moved.skipped) for moved in moves]

        assert not any(frames(4))
        runner.visits = long
        assert not any(frames(1))
        runner.visits = 0
        # 100 times the budget, fading by 2 % a frame, from the share of it that the mean took up.
        after = frames(200)
        assert 50 < after.count(True) < 180 and after == sorted(after, reverse=True)
        runner.visits = long
        always = frames(1000)
        assert 2 <= always.count(False) <= 6, "what always takes too long is hardly ever tried"


@pytest.mark.interpreted
def test_a_frame_that_is_replayed_skips_what_it_is_told_to(floor: archive_cases.Case) -> None:
    with play(floor.archive, Stop(), Sweep(), Slide(), Ground(), limits=SceneLimits(frame_ms=1e-6)) as game:
        body = game.body(BALL, at(0, 0, 0.5))
        moved = game.pipeline.run(body, at(0.1, 0, 0.5), 1 / 30, skip=["slide", "stop"])
        assert moved.skipped == ["slide"] and moved.simulated == ["stop", "sweep", "ground"]
        moved = game.pipeline.run(body, at(0.1, 0, 0.5), 1 / 30, skip=())
        assert moved.skipped == []


@pytest.mark.interpreted
def test_without_stop_an_avatar_is_a_ghost_and_its_verdict_true(floor: archive_cases.Case) -> None:
    with play(floor.archive, Proximity(reach=0.5)) as game:
        body = game.body(BALL, at(0, 0, 1))
        for height, verdict in ((0.1, 1), (0.5, 0)):
            moved = game.pipeline.run(body, at(0, 0, height))
            np.testing.assert_array_equal(body.pose, at(0, 0, height))
            assert moved.verdict == verdict and moved.proximity is not None


@pytest.mark.interpreted
def test_a_frame_that_fails_leaves_the_body_as_it_was(
    floor: archive_cases.Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    with play(floor.archive, Stop(), Sweep(), Slide(), Ground()) as game:
        body = game.body(BALL, at(0, 0, 0.5))
        game.go(body, (0.1, 0, 0))
        before = (body.pose.tobytes(), body.fall_speed, body.on_ground, body.clear)
        sheared = body.pose.copy()
        sheared[0, 1] = 0.1
        with pytest.raises(BadTransformError):
            game.pipeline.run(body, sheared)

        def fails(frame: Any, parts: int) -> None:
            raise RuntimeError("of the last effect")

        monkeypatch.setattr(game.world.walker, "run", fails)
        with pytest.raises(RuntimeError):
            game.go(body, (0.1, 0, 0))
        assert (body.pose.tobytes(), body.fall_speed, body.on_ground, body.clear) == before


@pytest.mark.interpreted
def test_users_are_seen_where_they_are_once_a_frame(
    floor: archive_cases.Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    with play(floor.archive, Stop(), Sweep(), Slide()) as game:
        seen: list[Any] = []
        with game.world as held:
            opened = held[0].opened
        monkeypatch.setattr(
            opened, "record_user", lambda user, avatar, pose, other: seen.append((user, pose.copy()))
        )
        body = game.body(BALL, at(0, 0, 0.5))
        game.go(body, (0, 0, -1.0))
        assert [user for user, _ in seen] == [("client", "avatar")]
        np.testing.assert_array_equal(seen[0][1], body.pose)


@pytest.mark.interpreted
def test_after_a_reload_it_is_asked_anew_whether_a_body_is_free(floor: archive_cases.Case) -> None:
    with play(floor.archive, Stop(), Sweep()) as game:
        body = game.body(BALL, at(0, 0, 0.5))
        game.go(body, (0.1, 0, 0))
        assert body.clear
        first = body.generations
        game.scene.reload()
        moved = game.go(body, (0.1, 0, 0))
        assert body.generations != first and moved.verdict == 0 and body.pose[0, 3] == 0.2
