"""Any scene that can be is written as TOML and read back the same, and so is what JSON makes of it."""

import math

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec import inspect
from sample_sizes import sample
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.scene.effect_table import Ground, Objects, Slide, Stop
from solidcloud.schemas.scene.scene_file import SceneFile, parse_scene
from solidcloud.schemas.scene.toml_faults import decode
from solidcloud.server.cli.scene_files.scene_text import toml_value

TURNS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.6, 0.8), (0.6, -0.8))


def values(node: object) -> st.SearchStrategy[object]:
    """Values of a type as msgspec tells of it, within its bounds."""
    match node:
        case inspect.Metadata(type=inner):
            return values(inner)
        case inspect.IntType(ge=low, gt=above, le=high):
            least = low if low is not None else above + 1
            return st.integers(least, high)
        case inspect.FloatType(ge=low, gt=above, le=high, lt=below):
            least, most = low if low is not None else above, high if high is not None else below
            return st.floats(
                -1e9 if least is None else least,
                1e9 if most is None else most,
                exclude_min=above is not None,
                exclude_max=below is not None,
            )
        case inspect.BoolType():
            return st.booleans()
        case inspect.StrType(pattern=pattern) if pattern:
            return st.from_regex(r"[A-Za-z0-9._-]{1,64}", fullmatch=True)
        case inspect.StrType(min_length=low, max_length=high):
            return st.text(st.characters(exclude_categories=["Cs"]), min_size=low or 0, max_size=high or 20)
        case inspect.LiteralType(values=names):
            return st.sampled_from(sorted(names))
        case inspect.TupleType(item_types=items):
            return st.tuples(*map(values, items))
        case inspect.ListType(item_type=item, min_length=low):
            return st.lists(values(item), min_size=low or 0, max_size=3)
        case inspect.DictType(key_type=key, value_type=value):
            return st.dictionaries(values(key), values(value), max_size=3)
        case inspect.UnionType(types=kinds):
            return st.one_of(*map(values, kinds))
        case inspect.NoneType():
            return st.none()
        case inspect.StructType(cls=kind, fields=fields):
            given = {each.name: poses() if each.name == "pose" else values(each.type) for each in fields}
            return st.builds(kind, **given)
    raise AssertionError(node)


def poses() -> st.SearchStrategy[object]:
    """Turns about z and shifts."""
    return st.builds(
        lambda turn, shift: [
            [turn[0], -turn[1], 0.0, shift[0]],
            [turn[1], turn[0], 0.0, shift[1]],
            [0.0, 0.0, 1.0, shift[2]],
            [0.0, 0.0, 0.0, 1.0],
        ],
        st.sampled_from(TURNS),
        st.tuples(*[st.floats(-1e9, 1e9)] * 3),
    )


SCENES = values(inspect.type_info(SceneFile))


def is_right(scene: SceneFile) -> bool:
    try:
        parse_scene(as_toml(scene), "made")
    except BadRequestError:
        return False
    return True


def mended(scene: SceneFile) -> SceneFile:
    """A scene with what its effects need, none twice, and objects of avatars that there are."""
    effects = {type(effect): effect for effect in [Stop(), Slide(), Ground(), Objects(), *scene.effects]}
    avatars = {item.name: item for item in scene.avatars}
    objects = {
        item.name: msgspec.structs.replace(item, avatar=name) for item in scene.objects for name in avatars
    }
    return msgspec.structs.replace(
        scene,
        radius_model=None,
        avatars=list(avatars.values()),
        objects=list(objects.values()),
        effects=list(effects.values()),
    )


def as_toml(scene: SceneFile) -> bytes:
    """Fields of the file, all inline."""
    fields = {name: value for name, value in msgspec.to_builtins(scene).items() if value is not None}
    return "".join(f"{name} = {toml_value(value)}\n" for name, value in fields.items()).encode()


@given(SCENES)
@settings(max_examples=sample(60, 200), deadline=None, derandomize=True)
def test_a_scene_comes_back_from_toml_as_it_was(scene: SceneFile) -> None:
    assert decode(as_toml(scene), SceneFile, "made") == scene
    assert msgspec.json.decode(msgspec.json.encode(scene), type=SceneFile) == scene


@given(SCENES.map(mended).filter(is_right))
@settings(
    max_examples=sample(30, 100),
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.filter_too_much],
)
def test_a_right_scene_is_read_with_its_poses_made_rigid(scene: SceneFile) -> None:
    found = parse_scene(as_toml(scene), "made")
    assert msgspec.structs.replace(found, archives=scene.archives, objects=scene.objects) == scene
    for one, other in zip(found.archives + found.objects, scene.archives + scene.objects, strict=True):
        assert all(math.dist(a, b) <= 1e-12 for a, b in zip(one.pose, other.pose, strict=True))


@given(SCENES.filter(lambda scene: not is_right(scene)))
@settings(max_examples=sample(30, 100), deadline=None, derandomize=True)
def test_a_scene_that_is_refused_is_refused_by_its_line(scene: SceneFile) -> None:
    with pytest.raises(BadRequestError, match=r"^made: line [0-9]+: \$\."):
        parse_scene(as_toml(scene), "made")
