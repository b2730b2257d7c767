"""The pipeline: what is declared and nothing else, in its order."""

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
from solidcloud.server.avatars.avatar_model import make_avatar

BALL = make_avatar([[0.0, 0, 0]], 0.2)

IMPORTED = """
import sys
from solidcloud.schemas.scene.effect_table import *
from solidcloud.schemas.scene.scene_file import ArchiveItem, SceneFile
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.simulation import make_simulation
import numpy as np
file = SceneFile(format=1, archives=[ArchiveItem(path="x")], effects=[Stop(), {effects}])
with Scene.open(sys.argv[1]) as scene:
    simulation = make_simulation(scene, file)
    simulation.warm()
names = [name.rpartition(".")[2] for name in sys.modules if name.startswith("solidcloud.server.simulation.effects.")]
walks = any(name.startswith("solidcloud.server.kernels.walk") for name in sys.modules)
print(*sorted(names), "solidcloud.server.queries.surface_normals" in sys.modules, walks)
"""


@pytest.fixture(scope="module")
def floor(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    """A floor at z = 0, a metre to each side."""
    return effect_rooms.build(tmp_path_factory.mktemp("floor"), effect_rooms.plane((-1, -1, 0), (1, 1, 0)))


@pytest.mark.parametrize("effects", ["", "Sweep()"])
def test_what_is_not_declared_is_not_imported(floor: archive_cases.Case, effects: str) -> None:
    code = IMPORTED.format(effects=effects)
    run = subprocess.run(
        [sys.executable, "-c", code, str(floor.archive)],
        capture_output=True,
        text=True,
        check=True,
        timeout=200,
    )
    *names, normals, walks = run.stdout.split()
    assert names == ["motion_effects"]
    assert normals == "False", "normals are for what slides"
    assert walks == str(bool(effects)), "`stop` alone needs no kernel of kernels/walk"


@pytest.mark.interpreted
def test_effects_run_in_their_order_and_say_so(floor: archive_cases.Case) -> None:
    with play(floor.archive, Step(), Ground(), Slide(), Sweep(), Stop()) as game:
        moved = game.go(game.body(BALL, at(0, 0, 0.4)), (0.1, 0, 0))
        assert moved.simulated == ["stop", "sweep", "slide", "step", "ground"]


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

        def fails(frame: Any) -> None:
            raise RuntimeError("of the last effect")

        monkeypatch.setattr(game.pipeline, "runs", [*game.pipeline.runs[:-1], (["ground"], fails)])
        with pytest.raises(RuntimeError):
            game.go(body, (0.1, 0, 0))
        assert (body.pose.tobytes(), body.fall_speed, body.on_ground, body.clear) == before


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
