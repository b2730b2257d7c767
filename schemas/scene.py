"""The scene file, `scene.toml`: what a scene is made of, and which effects it calls for.

Read by `solidcloud serve` and `solidcloud scene check`; SCENE.md says it in prose. Paths are relative to the file.
"""

import inspect
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import structs

from .effects import AnyEffect, Stop, Through, Vector
from .errors import BadRequestError
from .keys import check_name
from .radius_model import parse_radius_model
from .toml_faults import MOST_BYTES, decode, fault, nearest, shown
from .voxel_grid import MAX_COORDINATE

SUFFIX = ".toml"
FORMAT = 1
# A pose may be written with seven digits: one that is so near to a rigid one is made rigid (NUMERICS.md case 4).
_ALMOST_RIGID = 1e-6
# A pose that is rigid to its last digits stays as it is; the server asks for 1e-9 (NUMERICS.md N6).
_RIGID = 1e-12

Matrix = Annotated[list[Annotated[list[float], msgspec.Meta(min_length=4, max_length=4)]], msgspec.Meta(min_length=4, max_length=4)]  # fmt: skip  # noqa: E501
# `$` of Python's is before a line end, too.
SceneName = Annotated[
    str,
    msgspec.Meta(
        pattern=r"^[A-Za-z0-9._-]{1,64}$(?!\n)", description="1 to 64 of A-Z, a-z, 0-9, '.', '_' and '-'"
    ),
]
PathText = Annotated[str, msgspec.Meta(min_length=1)]
ItemName = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]


def identity() -> list[list[float]]:
    """The pose of what stays where it is."""
    return [[float(row == column) for column in range(4)] for row in range(4)]


class _Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A part of the file: what it does not know it refuses."""


class ArchiveItem(_Part, frozen=True):
    """An archive. path: its folder.  pose: archive to world, rigid, row-major."""

    path: PathText
    pose: Matrix = msgspec.field(default_factory=identity)


class AvatarItem(_Part, frozen=True):
    """An avatar that every user finds there. file: a scan or mesh of it.  radius: of its points [m]; left out: half
    the mean closest-point distance."""

    name: SceneName
    file: PathText
    radius: Annotated[float, msgspec.Meta(ge=0, le=8)] | None = None


class ObjectItem(_Part, frozen=True):
    """A dynamic object. avatar: its shape, of `avatars`.  pose: where it begins.  kind: `kinematic`: where it is told
    to be; `pushed`: users push it."""

    name: ItemName
    avatar: ItemName
    pose: Matrix = msgspec.field(default_factory=identity)
    kind: Literal["kinematic", "pushed"] = "kinematic"


class Spawn(_Part, frozen=True):
    """Where users begin: position of the avatar's origin, world [m]; heading: turned about up so far [degrees]."""

    position: Vector
    heading: float = 0.0


class Limits(_Part, frozen=True):
    """What a scene may cost. users: at a time.  frame_ms: of one user's frame; effects it has no room for are skipped,
    `stop`, `sweep`, `objects` and `crowd` never.  frame_visits: its twin that needs no clock, node visits.
    longest_move: of a frame [m]."""

    users: Annotated[int, msgspec.Meta(ge=1, le=1024)] = 64
    frame_ms: Annotated[float, msgspec.Meta(gt=0, le=10_000)] | None = None
    frame_visits: Annotated[int, msgspec.Meta(gt=0, le=1 << 62)] | None = None
    longest_move: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 100.0


class SceneFile(_Part, frozen=True):
    """A scene. format: 1.  up: against gravity; any length but zero.  radius_model: of the scan's spheres, one the
    archives hold; left out: each archive's one figure.  effects: in any order: they run in one of their own."""

    format: Literal[1]
    archives: Annotated[list[ArchiveItem], msgspec.Meta(min_length=1)]
    name: SceneName | None = None
    up: Vector = (0.0, 0.0, 1.0)
    radius_model: str | None = None
    avatars: list[AvatarItem] = []
    objects: list[ObjectItem] = []
    spawn: Spawn | None = None
    limits: Limits = Limits()
    effects: list[AnyEffect] = msgspec.field(default_factory=lambda: [Stop()])


def scene_of(archive: str) -> SceneFile:
    """The scene of an archive without a file: the archive and `stop`."""
    return SceneFile(format=1, archives=[ArchiveItem(path=archive)])


def effect_name(effect: AnyEffect) -> str:
    """What an effect is called in the file and in answers."""
    return str(type(effect).__struct_config__.tag)


def up_of(scene: SceneFile) -> Vector:
    """Unit vector against gravity."""
    length = math.hypot(*scene.up)
    x, y, z = (value / length for value in scene.up)
    return x, y, z


def scene_name(scene: SceneFile, path: Path) -> str:
    """What clients call the scene of a file: its `name`, else the file's, without suffix. BadRequestError."""
    if scene.name is not None:
        return scene.name
    try:
        return check_name(path.stem, "the file's name")
    except BadRequestError as error:
        raise BadRequestError(f"{path}: {error}: give the scene a `name`") from None


def read_scene(path: Path) -> SceneFile:
    """The scene of a file, all that can be said without opening an archive checked. BadRequestError: what is wrong,
    with file, place and what is allowed."""
    if path.suffix != SUFFIX:
        raise BadRequestError(
            f"{path}: expected a scene file, by a name that ends in {SUFFIX}: `serve` knows it by that"
        )
    try:
        with open(path, "rb") as file:
            text = file.read(MOST_BYTES + 1)  # no more of a scan that was given by mistake
    except OSError as error:
        raise BadRequestError(
            f"{path}: {error.strerror}: expected a scene file: make one with: solidcloud scene new"
        ) from None
    return parse_scene(text, str(path))


def parse_scene(text: bytes, where: str) -> SceneFile:
    """The scene of a file's bytes, its poses made rigid to the last digits; where: its name, for errors."""
    scene = decode(text, SceneFile, where)
    for place, said in _faults(scene):
        raise fault(where, place, said, text)
    return structs.replace(scene, archives=_rigid(scene.archives), objects=_rigid(scene.objects))


def check_scene(scene: SceneFile, where: str) -> None:
    """BadRequestError for what no type says: names that are there twice or not at all, effects that miss another, poses
    that are not rigid."""
    for place, said in _faults(scene):
        raise fault(where, place, said)


def json_schema() -> str:
    """The JSON Schema of a scene file: what `json/Scene.json` holds, for editors of TOML."""
    schema = msgspec.json.schema(SceneFile)
    for definition in schema["$defs"].values():
        # Python 3.13 strips a docstring's indentation, earlier ones do not: the same text from all.
        definition["description"] = inspect.cleandoc(definition["description"])
    text = msgspec.json.format(msgspec.json.encode(schema, order="sorted"), indent=2)
    return text.decode() + "\n"


def _faults(scene: SceneFile) -> Iterator[tuple[str, str]]:
    """What is wrong: the place, and found and expected."""
    if scene.name is not None:
        try:
            check_name(scene.name, "name")
        except BadRequestError as error:
            yield "$.name", str(error)
    names = [effect_name(effect) for effect in scene.effects]
    yield from _twice(names, "effects", "effect")
    for number, effect in enumerate(scene.effects):
        missing = [needed for needed in effect.needs if needed not in names]
        if missing:
            add = " and ".join(f'[[effects]] effect = "{needed}"' for needed in missing)
            less = " and ".join(f"`{needed}`" for needed in missing)
            yield (
                f"$.effects[{number}]",
                f"`{names[number]}` means nothing without {less}: add {add}, or leave it out",
            )
        if isinstance(effect, Through):
            yield from _boxes(effect, f"$.effects[{number}].boxes")
    yield from _twice([item.name for item in scene.avatars], "avatars", "name")
    yield from _twice([item.name for item in scene.objects], "objects", "name")
    yield from _objects(scene, names)
    for number, archive in enumerate(scene.archives):
        yield from _path(archive.path, f"$.archives[{number}].path")
        yield from _pose(archive.pose, f"$.archives[{number}].pose")
    for number, avatar in enumerate(scene.avatars):
        yield from _path(avatar.file, f"$.avatars[{number}].file")
    for number, thing in enumerate(scene.objects):
        yield from _pose(thing.pose, f"$.objects[{number}].pose")
    if not 1e-100 < math.hypot(*scene.up) < 1e100:  # whose squares are neither
        yield "$.up", f"found {list(scene.up)}: expected a direction, of any length but zero"
    if scene.spawn is not None:
        yield from _position(scene.spawn.position, "$.spawn.position")
    if scene.radius_model is not None:
        try:
            parse_radius_model(scene.radius_model)
        except BadRequestError as error:
            yield "$.radius_model", str(error)


def _objects(scene: SceneFile, effects: list[str]) -> Iterator[tuple[str, str]]:
    """Objects of no known shape, or without the effect."""
    known = [item.name for item in scene.avatars]
    for number, item in enumerate(scene.objects):
        if item.avatar not in known:
            listed = f"one of {', '.join(map(shown, known))}" if known else "it in [[avatars]]"
            close = nearest(item.avatar, known)
            yield (
                f"$.objects[{number}].avatar",
                f"{shown(item.avatar)} is no avatar of the scene: expected {listed}{close}",
            )
    if scene.objects and "objects" not in effects:
        yield (
            "$.objects",
            f'{len(scene.objects)} without the effect: add [[effects]] effect = "objects", or leave them out',
        )


def _twice(names: list[str], what: str, field: str) -> Iterator[tuple[str, str]]:
    """Names that are there before."""
    for number, name in enumerate(names):
        if name in names[:number]:
            first = f"$.{what}[{names.index(name)}]"
            yield f"$.{what}[{number}].{field}", f"{shown(name)} again: expected once, as in {first}"


def _boxes(effect: Through, place: str) -> Iterator[tuple[str, str]]:
    """Boxes that hold nothing, or have the name of another."""
    for number, box in enumerate(effect.boxes):
        yield from _position(box.low, f"{place}[{number}].low")
        yield from _position(box.high, f"{place}[{number}].high")
        if not all(low <= high for low, high in zip(box.low, box.high, strict=True)):
            yield (
                f"{place}[{number}]",
                f"box {shown(box.name)} from {list(box.low)} to {list(box.high)}: expected low <= high along each axis",
            )
    yield from _twice([box.name for box in effect.boxes], place[2:], "name")


def _path(path: str, place: str) -> Iterator[tuple[str, str]]:
    """A path that no file has."""
    if "\0" in path:
        yield place, f"found {shown(path)}: expected a path, without the character NUL"


def _position(position: Vector, place: str) -> Iterator[tuple[str, str]]:
    """A position that no archive's lattice reaches."""
    if not all(abs(value) <= MAX_COORDINATE for value in position):
        yield place, f"found {list(position)}: expected coordinates within {MAX_COORDINATE:g} m"


def _pose(pose: list[list[float]], place: str) -> Iterator[tuple[str, str]]:
    """A pose that is not rigid, or shifts too far."""
    if pose[3] != [0.0, 0.0, 0.0, 1.0]:
        yield (
            f"{place}[3]",
            f"found {pose[3]}: expected the last row 0 0 0 1: a pose is 4 rows of 4, row-major",
        )
        return
    gram = _gram(pose)
    off = max(abs(gram[row][column] - (row == column)) for row in range(3) for column in range(3))
    if not off <= _ALMOST_RIGID:  # not so for NaN either
        yield (
            place,
            f"scales or shears, by {off:.2g}: expected a rotation and a shift, within {_ALMOST_RIGID:g}",
        )
    elif _determinant(pose) < 0:
        yield place, "mirrors: expected a rotation and a shift"
    else:
        yield from _position((pose[0][3], pose[1][3], pose[2][3]), place)


def _gram(pose: list[list[float]]) -> list[list[float]]:
    """Dot products of the rows of a pose's rotation: those of unit vectors at right angles, were it exact."""
    return [
        [sum(a * b for a, b in zip(one[:3], other[:3], strict=True)) for other in pose[:3]]
        for one in pose[:3]
    ]


def _determinant(pose: list[list[float]]) -> float:
    """Of a pose's rotation."""
    (a, b, c, _), (d, e, f, _), (g, h, i, _) = pose[:3]
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def _rigid(items: list[Any]) -> list[Any]:
    """Archives or objects with poses whose rotations are rotations to the last digits.

    (3 R - R R' R) / 2 squares the distance of R from the nearest rotation: from 1e-6, twice is enough.
    """
    made = []
    for item in items:
        pose = item.pose
        for _ in range(2):
            gram = _gram(pose)
            if all(abs(gram[i][j] - (i == j)) <= _RIGID for i in range(3) for j in range(3)):
                break
            pose = [
                [1.5 * pose[i][j] - 0.5 * sum(gram[i][k] * pose[k][j] for k in range(3)) for j in range(3)]
                + [pose[i][3]]
                for i in range(3)
            ] + [pose[3]]
        made.append(item if pose is item.pose else structs.replace(item, pose=pose))
    return made
