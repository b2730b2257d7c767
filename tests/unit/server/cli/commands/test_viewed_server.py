"""Test the scene files of a viewed server with other effects."""

from pathlib import Path

import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.scene.effect_table import Stop, Through
from solidcloud.schemas.scene.scene_file import parse_scene
from solidcloud.server.cli.commands.viewed_server import ViewedServer, scene_with_effects

SCENE = """
format = 1
name = "hall"
up = [0, 0, 1]

[[archives]]
path = "hall"
pose = [
  [1, 0, 0, 2.5],
  [0, 1, 0, 0],
  [0, 0, 1, 0],
  [0, 0, 0, 1],
]

[[archives]]
path = "/scans/yard"

[[avatars]]
name = "visitor"
file = "shapes/visitor.obj"

[limits]
users = 3

[[effects]]
effect = "stop"
skin = 0.01

[[effects]]
effect = "slide"

[[effects]]
effect = "through"
[[effects.boxes]]
name = "door \\"one\\""
low = [0, 0, 0]
high = [1, 1, 1]
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    file = tmp_path / "scene.toml"
    file.write_text(SCENE)
    return file


def test_other_effects_leave_the_rest_of_the_scene(file: Path) -> None:
    whole = parse_scene(SCENE.encode(), "whole")
    scene = parse_scene(scene_with_effects(file, ["through", "stop"]).encode(), "made")
    assert [type(effect) for effect in scene.effects] == [Stop, Through]
    assert scene.effects == [whole.effects[0], whole.effects[2]]
    assert [each.path for each in scene.archives] == [str(file.parent / "hall"), "/scans/yard"]
    assert [each.pose for each in scene.archives] == [each.pose for each in whole.archives]
    assert scene.avatars[0].file == str(file.parent / "shapes" / "visitor.obj")
    assert (scene.name, scene.up, scene.limits) == (whole.name, whole.up, whole.limits)


def test_all_effects_can_be_switched_off(file: Path) -> None:
    assert parse_scene(scene_with_effects(file, []).encode(), "made").effects == []
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert parse_scene(scene_with_effects(file, []).encode(), "made").effects == []


def test_effects_that_the_file_does_not_declare_are_refused(file: Path) -> None:
    with pytest.raises(BadRequestError, match=r"'ground': the scene file declares slide, stop, through"):
        scene_with_effects(file, ["ground"])


def test_effects_that_do_not_belong_together_leave_the_server(file: Path) -> None:
    server = ViewedServer(file)
    assert list(server.declared) == ["stop", "slide", "through"]
    with pytest.raises(BadRequestError, match="`slide` requires `stop`"):
        server.change(["slide"])
    server.change(["through", "slide", "stop"])  # the same: nothing is started
