"""Test that a frame is the same bit for bit, whoever answers its queries and in however many calls."""

from functools import partial

import archive_cases
import effect_rooms
import numpy as np
import pytest
from effect_rooms import INTERPRETED, Play
from solidcloud.schemas.scene.effect_table import AnyEffect, Contacts, Crowd, Ground, Slide, Step, Stop, Sweep
from solidcloud.schemas.wire.encoding import encode
from solidcloud.server.simulation.simulation import make_pipeline
from solidcloud.server.simulation.world import walker
from solidcloud.server.simulation.world.collision_world import World
from solidcloud.server.simulation.world.frame import Body
from solidcloud.server.simulation.world.walker import FOLLOW, GROUND, SLIDE, STEP

FRAMES = 12 if INTERPRETED else 130


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
        ([Crowd(), Stop(), Sweep(), Slide(), Ground(), Contacts()], (0.0, 0.0, 1.0)),
        ([Stop(), Sweep(), Slide(), Step(), Ground()], (0.02, 0.0, 1.0)),
    ],
)
def test_frames_are_the_same_whoever_answers_their_queries(
    case: archive_cases.Case,
    rng: np.random.Generator,
    monkeypatch: pytest.MonkeyPatch,
    effects: list[AnyEffect],
    up: tuple[float, float, float],
) -> None:
    """In compiled code, by Python, and by Python with a call for each effect and a short tape."""
    person = effect_rooms.person()
    with effect_rooms.play(case.archive, *effects, up=up) as play:
        plays = [play]
        monkeypatch.setattr(walker, "_ROWS", 2)
        for _ in range(2):
            world = World(play.scene, play.world.file)
            plays.append(Play(play.scene, world, make_pipeline(play.world.file, world)))
            world.walker.native = False
        parts = {"sweep": FOLLOW, "slide": SLIDE, "step": STEP, "ground": GROUND}
        plays[2].pipeline.runs = [
            ([name], partial(plays[2].world.walker.run, parts=parts[name]) if name in parts else run)
            for names, run in plays[2].pipeline.runs
            for name in names
        ]
        bodies = [each.body(person, effect_rooms.at(-0.5, 0.0, -0.6)) for each in plays]
        way, touched, stepped = np.zeros(3), 0, 0
        for number in range(FRAMES):
            if number == 0:
                way = np.array([0.03, 0.0, 0.0])  # to the step
            elif number % 25 == 0 and number > 50:
                angle = rng.uniform(0.0, 2.0 * np.pi)
                way = np.array([np.cos(angle), np.sin(angle), 0.0]) * rng.choice([0.0, 0.01, 0.05, 0.1])
            turn = effect_rooms.at(0.0, 0.0, 0.0, 0.02 * number)[:3, :3] if number % 3 == 0 else None
            answers = [each.go(body, way, turn) for each, body in zip(plays, bodies, strict=True)]
            assert encode(answers[0]) == encode(answers[1]) == encode(answers[2])
            states = [state_of(body) for body in bodies]
            assert states[0] == states[1] == states[2]
            touched += bool(answers[0].touched)
            stepped += bool(answers[0].stepped)
    assert INTERPRETED or touched > 0
    if not INTERPRETED and len(effects) == 5 and up == (0.0, 0.0, 1.0) and isinstance(effects[3], Step):
        assert stepped > 0


def state_of(body: Body) -> tuple[object, ...]:
    """Return all that a body keeps between frames."""
    kept = {name: body.effect_state[name].tobytes() for name in body.effect_state if "ground" in name}
    return body.pose.tobytes(), body.fall_speed, body.on_ground, body.clear, body.generations, kept
