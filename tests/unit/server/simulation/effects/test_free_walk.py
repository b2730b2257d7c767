"""Test that frames finished by `FreeWalk` equal those of the effects one by one, bit for bit."""

from pathlib import Path

import archive_cases
import effect_rooms
import numpy as np
import pytest
from effect_rooms import INTERPRETED, Play
from solidcloud.schemas.scene.effect_table import AnyEffect, Contacts, Crowd, Ground, Slide, Step, Stop, Sweep
from solidcloud.schemas.scene.scene_file import SceneLimits
from solidcloud.schemas.wire.encoding import encode
from solidcloud.server.queries.resident_fast_path import ResidentQueries
from solidcloud.server.simulation.effects.effect_pipeline import make_pipeline
from solidcloud.server.simulation.world.frame import Body

FRAMES = 12 if INTERPRETED else 250


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    """Floor with a step and two walls; none to the east, where the floor ends."""
    low, apart = -0.75, effect_rooms.APART
    parts = [
        effect_rooms.plane((-2.0, -2.0, low), (2.0, 2.0, low), apart),
        effect_rooms.plane((0.6, -0.6, low + 0.15), (1.2, 0.6, low + 0.15), apart),
        effect_rooms.plane((-2.0, -2.0, low), (-2.0, 2.0, low + 1.6), apart),
        effect_rooms.plane((-2.0, 2.0, low), (2.0, 2.0, low + 1.6), apart),
    ]
    folder = tmp_path_factory.mktemp("walk")
    return effect_rooms.build(folder, np.unique(np.round(np.concatenate(parts), 6), axis=0))


@pytest.mark.interpreted
@pytest.mark.parametrize(
    ("effects", "up"),
    [
        ([Stop(), Sweep(), Slide(), Step(), Ground()], (0.0, 0.0, 1.0)),
        ([Stop(), Sweep(), Ground()], (0.0, 0.0, 1.0)),
        ([Crowd(), Stop(), Sweep(), Slide(), Ground(), Contacts()], (0.0, 0.0, 1.0)),
        ([Stop(), Sweep(), Slide(), Step(), Ground()], (0.02, 0.0, 1.0)),
    ],
)
def test_frames_equal_those_of_the_effects_one_by_one(
    case: archive_cases.Case,
    rng: np.random.Generator,
    effects: list[AnyEffect],
    up: tuple[float, float, float],
) -> None:
    person = effect_rooms.person()
    with effect_rooms.play(case.archive, *effects, up=up) as play:
        apart = Play(play.scene, play.world, make_pipeline(play.pipeline.file, play.world))
        walk, apart.pipeline._walk = play.pipeline._walk, None
        assert walk is not None
        bodies = [each.body(person, effect_rooms.at(-0.5, 0.0, -0.6)) for each in (play, apart)]
        finished, run = [], walk.run
        walk.run = lambda frame: finished.append(run(frame)) or finished[-1]  # type: ignore[method-assign]
        way, ends = np.zeros(3), []
        for number in range(FRAMES):
            if number % 25 == 0:
                angle = rng.uniform(0.0, 2.0 * np.pi)
                way = np.array([np.cos(angle), np.sin(angle), 0.0]) * rng.choice([0.0, 0.01, 0.05])
            turn = effect_rooms.at(0.0, 0.0, 0.0, 0.02 * number)[:3, :3] if number % 3 == 0 else None
            answers = [each.go(body, way, turn) for each, body in zip((play, apart), bodies, strict=True)]
            assert encode(answers[0]) == encode(answers[1])
            states = [state_of(body) for body in bodies]
            assert states[0] == states[1]
            ends.append(answers[0].left)
    done = sum(each is not None for each in finished)
    assert done > FRAMES / 5 and (INTERPRETED or done < FRAMES)


def state_of(body: Body) -> tuple[object, ...]:
    """Return all that a body keeps between frames."""
    kept = {name: [np.asarray(part).tobytes() for part in np.atleast_1d(value)] if name != "ground" else
            [part.tobytes() for part in value] for name, value in body.effect_state.items()
            if name in ("ground", "ground raised")}  # fmt: skip
    return body.pose.tobytes(), body.fall_speed, body.on_ground, body.clear, body.generations, kept


def test_a_budget_runs_the_effects_one_by_one(case: archive_cases.Case, tmp_path: Path) -> None:
    effects = [Stop(), Sweep(), Ground()]
    with effect_rooms.play(case.archive, *effects, limits=SceneLimits(frame_visits=10**6)) as play:
        assert play.pipeline._walk is None
    with effect_rooms.play(case.archive, Stop(), Sweep()) as play:
        assert play.pipeline._walk is None


def test_time_is_divided_between_sweep_and_ground(case: archive_cases.Case) -> None:
    effects = [Stop(), Sweep(), Slide(), Step(), Ground()]
    with effect_rooms.play(case.archive, *effects) as play:
        body = play.body(effect_rooms.person(), effect_rooms.at(-0.5, 0.0, -0.6))
        for _ in range(40):
            answer = play.go(body, (0.01, 0.0, 0.0))
            assert answer.simulated == ["stop", "sweep", "slide", "step", "ground"]
        stats = {each.effect: each for each in play.pipeline.times.stats()}
    assert [each.frames for each in stats.values()] == [40] * 5
    assert min(stats[name].seconds for name in ("stop", "sweep", "ground")) > 0.0


def test_the_kernel_is_called_when_a_scene_opens(
    case: archive_cases.Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = []
    walk = ResidentQueries.walk
    monkeypatch.setattr(
        ResidentQueries, "walk", lambda *arguments: answers.append(walk(*arguments)) or answers[-1]
    )
    with effect_rooms.play(case.archive, Stop(), Sweep(), Ground()):
        assert len(answers) == 1
    with effect_rooms.play(case.archive, Stop(), Sweep(), Slide()):
        assert len(answers) == 1
