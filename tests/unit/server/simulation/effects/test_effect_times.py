"""Time by effect: every frame of every user is counted once, by the effects that ran in it."""

from pathlib import Path

import archive_cases
import numpy as np
import pytest
from solidcloud.server.scene import Scene


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    """Points of a floor."""
    x, y = np.meshgrid(np.linspace(-1, 1, 60), np.linspace(-1, 1, 60))
    places = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    return archive_cases.build(tmp_path_factory.mktemp("floor"), places, voxel=1.0)


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
