"""Time by effect: every frame of every user is counted once, by the effects that ran in it."""

from pathlib import Path

import archive_cases
import numpy as np
import pytest
from solidcloud.schemas.wire.stats import EffectStats
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.effects.effect_times import EffectTimes


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    """Points of a floor."""
    x, y = np.meshgrid(np.linspace(-1, 1, 60), np.linspace(-1, 1, 60))
    places = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    return archive_cases.build(tmp_path_factory.mktemp("floor"), places, voxel=1.0)


def test_effects_that_ran_are_counted() -> None:
    times = EffectTimes(["stop", "contacts"])
    times.add([("stop", 0.25), ("contacts", 0.5)], [])
    times.add([("stop", 0.5)], ["contacts"])
    assert times.stats() == [EffectStats("stop", 2, 0, 0.75), EffectStats("contacts", 1, 1, 0.5)]


@pytest.mark.parametrize("limits", ["", "[limits]\nframe_visits = 1000000\n"])
def test_statistics_have_every_frame(case: archive_cases.Case, tmp_path: Path, limits: str) -> None:
    file = tmp_path / "scene.toml"
    effects = "".join(f'[[effects]]\neffect = "{name}"\n' for name in ("stop", "sweep", "slide", "contacts"))
    file.write_text(f'format = 1\n[[archives]]\npath = "{case.archive}"\n{limits}{effects}')
    with Scene.open(file) as scene:
        scene.add_avatar("al", [[0.0, 0.0, 0.3]], 0.05)
        order = scene.info().effects
        assert [each.effect for each in scene.stats().effects] == order
        with scene.session("al") as session:
            for number in range(5):
                pose = np.eye(4)
                pose[:3, 3] = 0.1 * number, 0.0, 0.2
                session.wait(session.wish(pose))
        scene.move("al", np.eye(4), np.eye(4))
        found = scene.stats().effects
    assert [(each.effect, each.frames, each.skipped) for each in found] == [(name, 6, 0) for name in order]
    assert all(each.seconds > 0 for each in found)


def test_skipped_effects_are_counted(case: archive_cases.Case, tmp_path: Path) -> None:
    file = tmp_path / "scene.toml"
    effects = "".join(f'[[effects]]\neffect = "{name}"\n' for name in ("stop", "proximity"))
    limits = "[limits]\nframe_visits = 1\n"
    file.write_text(f'format = 1\n[[archives]]\npath = "{case.archive}"\n{limits}{effects}')
    with Scene.open(file) as scene:
        scene.add_avatar("al", [[0.0, 0.0, 0.3]], 0.05)
        skipped = 0
        for _ in range(8):
            skipped += len(scene.move("al", np.eye(4), np.eye(4)).skipped)
        stop, proximity = scene.stats().effects
    assert (stop.frames, stop.skipped) == (8, 0)
    assert proximity.skipped == skipped > 0 and proximity.frames == 8 - skipped
