"""The scene file, `scene.toml`: what a scene is made of, and which effects it calls for.

Read by `solidcloud serve` and `solidcloud scene check`; SCENE.md says it in prose. Paths are relative to the file.
"""

import math
from collections import Counter
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from .effects import AnyEffect, Stop, Through, Vector
from .errors import BadRequestError
from .radius_model import parse_radius_model

Matrix = Annotated[list[Annotated[list[float], msgspec.Meta(min_length=4, max_length=4)]], msgspec.Meta(min_length=4, max_length=4)]  # fmt: skip  # noqa: E501
SceneName = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9._-]{1,64}$")]
ItemName = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]


def identity() -> list[list[float]]:
    """The pose of what stays where it is."""
    return [[float(row == column) for column in range(4)] for row in range(4)]


class _Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A part of the file: what it does not know it refuses."""


class ArchiveItem(_Part, frozen=True):
    """An archive. path: its folder.  pose: archive to world, rigid, row-major."""

    path: str
    pose: Matrix = msgspec.field(default_factory=identity)


class AvatarItem(_Part, frozen=True):
    """An avatar that every user finds there. file: a scan or mesh of it.  radius: of its points [m]; left out: half
    the mean closest-point distance."""

    name: ItemName
    file: str
    radius: Annotated[float, msgspec.Meta(ge=0)] | None = None


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
    `stop` and `sweep` never.  frame_visits: its twin that needs no clock, node visits.  longest_move: of a frame [m].
    """

    users: Annotated[int, msgspec.Meta(ge=1, le=1024)] = 64
    frame_ms: Annotated[float, msgspec.Meta(gt=0)] | None = None
    frame_visits: Annotated[int, msgspec.Meta(gt=0)] | None = None
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


def read_scene(path: Path) -> SceneFile:
    """The scene of a file, all that can be said without opening an archive checked. BadRequestError: what is wrong,
    with file, place and what is allowed."""
    try:
        text = path.read_bytes()
    except OSError as error:
        raise BadRequestError(
            f"{path}: {error.strerror}: expected a scene file: make one with: solidcloud scene new"
        ) from None
    return parse_scene(text, str(path))


def parse_scene(text: bytes, where: str) -> SceneFile:
    """The scene of a file's bytes; where: its name, for errors."""
    try:
        scene = msgspec.toml.decode(text, type=SceneFile)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise BadRequestError(f"{where}: {error}") from None
    check_scene(scene, where)
    return scene


def check_scene(scene: SceneFile, where: str) -> None:
    """BadRequestError for what no type says: names that are there twice or not at all, effects that miss another."""
    names = [effect_name(effect) for effect in scene.effects]
    for number, effect in enumerate(scene.effects):
        for needed in effect.needs:
            if needed not in names:
                raise BadRequestError(
                    f"{where}: `{names[number]}` means nothing without `{needed}` - at `$.effects[{number}]`: "
                    f'add [[effects]] effect = "{needed}", or leave it out'
                )
        if isinstance(effect, Through):
            _check_boxes(effect, number, where)
    _check_once(names, "effects", where)
    _check_once([item.name for item in scene.avatars], "avatars", where)
    _check_once([item.name for item in scene.objects], "objects", where)
    known = {item.name for item in scene.avatars}
    for number, item in enumerate(scene.objects):
        if item.avatar not in known:
            raise BadRequestError(
                f"{where}: avatar {item.avatar!r} is none of {', '.join(sorted(known)) or 'no avatars'} - at "
                f"`$.objects[{number}].avatar`"
            )
    if scene.objects and "objects" not in names:
        raise BadRequestError(
            f'{where}: objects without the effect: add [[effects]] effect = "objects" - at `$.objects`'
        )
    if not 0 < math.hypot(*scene.up) < math.inf:
        raise BadRequestError(f"{where}: {list(scene.up)}: expected a direction - at `$.up`")
    if scene.radius_model is not None:
        try:
            parse_radius_model(scene.radius_model)
        except BadRequestError as error:
            raise BadRequestError(f"{where}: {error} - at `$.radius_model`") from None


def _check_once(names: list[str], what: str, where: str) -> None:
    """BadRequestError for a name that is there twice."""
    for name, count in Counter(names).items():
        if count > 1:
            at = len(names) - 1 - names[::-1].index(name)
            raise BadRequestError(
                f"{where}: {name!r} is there {count} times, expected once - at `$.{what}[{at}]`"
            )


def _check_boxes(effect: Through, number: int, where: str) -> None:
    """BadRequestError for a box that holds nothing."""
    for at, box in enumerate(effect.boxes):
        if not all(low <= high for low, high in zip(box.low, box.high, strict=True)):
            raise BadRequestError(
                f"{where}: box {box.name!r} from {list(box.low)} to {list(box.high)}: expected low <= high - at "
                f"`$.effects[{number}].boxes[{at}]`"
            )
