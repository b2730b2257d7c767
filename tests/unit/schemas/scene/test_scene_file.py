"""Scene files: what is read of one, and that SCENE.md says the same."""

import re
import tomllib
from pathlib import Path

import msgspec
import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.scene import scene_file as scene_module
from solidcloud.schemas.scene.effect_table import Ground, Slide, Step, Stop, Through, ThroughBox, effect_name
from solidcloud.schemas.scene.scene_file import (
    ArchiveItem,
    SceneFile,
    Spawn,
    parse_scene,
    read_scene,
    scene_name,
    scene_of,
    up_of,
)

SCHEMAS = Path(scene_module.__file__).parents[1]
TOP = 'format = 1\n[[archives]]\npath = "hall"\n'


def parse(text: str) -> SceneFile:
    return parse_scene(text.encode(), "hall.toml")


def test_a_file_that_is_not_there_is_named_with_what_makes_one(tmp_path: Path) -> None:
    with pytest.raises(BadRequestError, match=r"nowhere.toml: No such file.*solidcloud scene new"):
        read_scene(tmp_path / "nowhere.toml")
    (tmp_path / "folder.toml").mkdir()
    with pytest.raises(BadRequestError, match=r"folder.toml: Is a directory"):
        read_scene(tmp_path / "folder.toml")


def test_a_small_file_has_defaults() -> None:
    assert parse(TOP) == scene_of("hall") == SceneFile(format=1, archives=[ArchiveItem(path="hall")])
    found = parse(TOP)
    assert found.effects == [Stop()] and found.up == (0.0, 0.0, 1.0) and found.limits.users == 64
    assert parse("format = 1\neffects = []\n" + TOP[11:]).effects == []


def test_what_is_written_is_what_is_read() -> None:
    text = TOP + (
        "[spawn]\nposition = [1, 2, 3]\n[[effects]]\neffect = 'step'\nheight = 0.3\n[[effects]]\neffect = 'stop'\n"
        "[[effects]]\neffect = 'slide'\n[[effects]]\neffect = 'ground'\n[[effects]]\neffect = 'through'\n"
        "boxes = [{name = 'door', low = [0, 0, 0], high = [1, 0, 2]}]\n"
    )
    found = parse(text)
    box = ThroughBox("door", (0.0, 0.0, 0.0), (1.0, 0.0, 2.0))
    assert found.effects == [Step(height=0.3), Stop(), Slide(), Ground(), Through(boxes=[box])]
    assert [effect_name(effect) for effect in found.effects] == ["step", "stop", "slide", "ground", "through"]
    assert found.spawn == Spawn(position=(1.0, 2.0, 3.0), heading=0.0)


def test_a_pose_written_with_seven_digits_is_made_rigid() -> None:
    rows = "[[0.7071068, -0.7071068, 0, 5], [0.7071068, 0.7071068, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]"
    pose = parse(TOP + f"pose = {rows}\n").archives[0].pose
    half = 0.5**0.5
    expected = [[half, -half, 0, 5], [half, half, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]
    for row, wanted in zip(pose, expected, strict=True):
        assert row == pytest.approx(wanted, abs=1e-12)


def test_a_rigid_pose_stays_as_it_is_to_the_last_digit() -> None:
    rows = [[0.6, -0.8, 0.0, 1e6 + 0.1], [0.8, 0.6, 0.0, -3.0], [0.0, 0.0, 1.0, 0.25], [0.0, 0.0, 0.0, 1.0]]
    assert parse(TOP + f"pose = {rows}\n").archives[0].pose == rows


def test_a_scene_is_called_as_the_file_says_or_the_file_is() -> None:
    assert scene_name(parse('format = 1\nname = "hall"\n' + TOP[11:]), Path("x/tower.toml")) == "hall"
    assert scene_name(parse(TOP), Path("x/tower.toml")) == "tower"
    with pytest.raises(
        BadRequestError, match=r"my tower.toml: the file's name 'my tower': expected 1 to 64.*`name`"
    ):
        scene_name(parse(TOP), Path("my tower.toml"))


@pytest.mark.parametrize("up", [(0, 0, 2), (1e-90, 0, 0), (3.0, -4.0, 12.0), (0.0, 1e90, 1e90)])
def test_up_is_a_unit_vector(up: tuple[float, float, float]) -> None:
    found = up_of(msgspec.structs.replace(scene_of("hall"), up=up))
    length = max(map(abs, up))
    assert sum(value * value for value in found) == pytest.approx(1.0, abs=1e-15)
    cross = [found[i] * up[j] / length - found[j] * up[i] / length for i, j in ((0, 1), (1, 2), (2, 0))]
    assert cross == pytest.approx([0, 0, 0], abs=1e-15)


def documented() -> str:
    return (SCHEMAS / "SCENE.md").read_text()


def test_the_documents_example_is_a_scene() -> None:
    text = re.findall(r"```toml\n([^`]*)```", documented())[0]
    found = parse(text)
    assert len(found.effects) >= 5 and found.avatars and found.objects and found.spawn


def test_the_document_has_every_field_with_its_default() -> None:
    rows = dict(re.findall(r"^\| `([\w.]+)` \| [^|]*\| ([^|]*) \|", documented(), re.M))
    kinds = {name: kind for name, kind in vars(scene_module).items() if isinstance(kind, type)}
    parts = {"": "SceneFile", "archives": "ArchiveItem", "avatars": "AvatarItem", "objects": "ObjectItem"}
    parts |= {"spawn": "Spawn", "limits": "SceneLimits"}
    expected = {}
    for table, kind in parts.items():
        for field in msgspec.structs.fields(kinds[kind]):
            expected[f"{table}.{field.name}".removeprefix(".")] = field
    for kind in msgspec.inspect.type_info(SceneFile).fields[-1].type.item_type.types:
        for field in msgspec.structs.fields(kind.cls):
            expected[f"{kind.tag}.{field.name}"] = field
    assert set(rows) == set(expected)
    for name, field in expected.items():
        if isinstance(field.default, float | int):
            assert tomllib.loads(f"x = {rows[name]}")["x"] == field.default, name
        elif field.required:
            assert rows[name] == "required", name


def test_the_documents_errors_are_those_that_are_told() -> None:
    pairs = re.findall(r"```toml\n([^`]*)```\n```text\n(.*?)\n```\n", documented(), re.S)
    assert len(pairs) >= 5
    for text, said in pairs:
        with pytest.raises(BadRequestError) as found:
            parse(text)
        assert str(found.value) == said
