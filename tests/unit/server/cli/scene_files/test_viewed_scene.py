"""Test the scene file with which the viewer serves an archive."""

from pathlib import Path

import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.scene.effect_table import effect_name
from solidcloud.schemas.scene.scene_file import parse_scene
from solidcloud.server.cli.scene_files.viewed_scene import VIEWER_EFFECTS, archive_scene, viewed_scene


@pytest.mark.parametrize(
    ("folder", "name"), [("hall", "hall"), ("Große Halle", "Gro-e-Halle"), ("x" * 100, "x" * 64)]
)
def test_archive_is_served_under_its_name_with_users_who_walk(tmp_path: Path, folder: str, name: str) -> None:
    archive = tmp_path / folder
    parsed = parse_scene(archive_scene(archive).encode(), "viewer.toml")
    assert parsed.name == name
    assert [Path(each.path) for each in parsed.archives] == [archive.resolve()]
    assert {effect_name(effect) for effect in parsed.effects} == set(VIEWER_EFFECTS)


def test_file_is_temporary_and_a_given_one_is_used_as_it_is(tmp_path: Path) -> None:
    with viewed_scene(tmp_path / "hall") as file:
        assert file.read_text() == archive_scene(tmp_path / "hall")
    assert not file.exists()
    given = tmp_path / "scene.toml"
    with viewed_scene(given) as file:
        assert file == given


def test_archive_that_stands_on_another_axis_is_served_with_it_up(tmp_path: Path) -> None:
    with viewed_scene(tmp_path / "hall", "y") as file:
        assert parse_scene(file.read_bytes(), "viewer.toml").up == (0.0, 1.0, 0.0)
    with pytest.raises(BadRequestError, match=r"--up 'north': expected one of x, y, z"):
        viewed_scene(tmp_path / "hall", "north").__enter__()
    with pytest.raises(BadRequestError, match=r"write `up = \[0.0, 1.0, 0.0\]` in scene.toml"):
        viewed_scene(tmp_path / "scene.toml", "y").__enter__()
