"""Scene file `scene.toml`: archives, avatars, objects and limits of a scene, and its effects.

`solidcloud serve` and `solidcloud scene check` read it; SCENE.md documents it. Paths are relative
to the file.
"""

import inspect
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import structs

from ..archive.radius_model import parse_radius_model
from ..archive.rigid_pose import gram, rigid_fault
from ..archive.voxel_grid import MAX_COORDINATE
from ..errors import BadRequestError
from ..wire.key_expressions import check_name
from .effect_table import LEAST_TOLERANCE, MAX_TOLERANCE, AnyEffect, Stop, Sweep, Through, Vector, effect_name
from .toml_faults import MAX_BYTES, decode, format_value, suggestion, toml_error

SUFFIX = ".toml"
FORMAT = 1
# A pose that deviates from a rigid one by at most this is made rigid, because a file may state
# seven digits (NUMERICS.md case 4).
_ALMOST_RIGID = 1e-6
# A pose that deviates by at most this is unchanged; the server requires 1e-9 (NUMERICS.md N6).
_RIGID = 1e-12

Matrix = Annotated[list[Annotated[list[float], msgspec.Meta(min_length=4, max_length=4)]], msgspec.Meta(min_length=4, max_length=4)]  # fmt: skip  # noqa: E501
# Python's `$` also matches before a final line end.
SceneName = Annotated[
    str,
    msgspec.Meta(
        pattern=r"^[A-Za-z0-9._-]{1,64}$(?!\n)", description="1 to 64 of A-Z, a-z, 0-9, '.', '_' and '-'"
    ),
]
PathText = Annotated[str, msgspec.Meta(min_length=1)]
ItemName = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]


def identity() -> list[list[float]]:
    """Return the identity pose."""
    return [[float(row == column) for column in range(4)] for row in range(4)]


class _Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base class of the file's tables. Unknown fields are refused."""


class ArchiveItem(_Part, frozen=True):
    """Archive of a scene.

    path: its folder.  pose: archive to world, rigid, row-major.
    """

    path: PathText
    pose: Matrix = msgspec.field(default_factory=identity)


class AvatarItem(_Part, frozen=True):
    """Avatar that every user may use.

    file: a scan or mesh of it.
    radius: of its points [m]; omitted: half the mean closest-point distance, of a mesh a hundredth of
    the square root of its area.
    up, units: the axis of the file that points up, and its unit of length; omitted: as its format
    states, otherwise z and m.
    scale: factor of all lengths, the radius too.
    hollow: leave the inside of a closed mesh empty.
    """

    name: SceneName
    file: PathText
    radius: Annotated[float, msgspec.Meta(ge=0, le=8)] | None = None
    up: Literal["x", "y", "z"] | None = None
    units: Literal["m", "mm", "cm", "dm", "km", "in", "ft", "us-ft", "yd"] | None = None
    scale: Annotated[float, msgspec.Meta(ge=0.001, le=1000)] = 1.0
    hollow: bool = False


class ObjectItem(_Part, frozen=True):
    """Dynamic object.

    avatar: its shape, one of `avatars`.  pose: the initial pose.
    kind: `kinematic` if users set its pose, `pushed` if users push it.
    """

    name: ItemName
    avatar: ItemName
    pose: Matrix = msgspec.field(default_factory=identity)
    kind: Literal["kinematic", "pushed"] = "kinematic"


class Spawn(_Part, frozen=True):
    """Initial pose of users.

    position: of the avatar's origin, world [m].
    heading: rotation about up [degrees].
    """

    position: Vector
    heading: float = 0.0


class SceneLimits(_Part, frozen=True):
    """Limits of a scene's cost.

    users: number of users at the same time.
    longest_move: farthest motion of a frame [m].
    """

    users: Annotated[int, msgspec.Meta(ge=1, le=1024)] = 64
    longest_move: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 100.0


class SceneFile(_Part, frozen=True):
    """Content of a scene file.

    format: 1.  up: against gravity; any length but zero.
    radius_model: of the scan's spheres, stored in all archives; omitted: each archive's single
    radius.
    tolerance: distance by which contact may be early in frames [m]: see `sweep_tolerance`.
    effects: in any order; the server runs them in a fixed order.
    """

    format: Literal[1]
    archives: Annotated[list[ArchiveItem], msgspec.Meta(min_length=1)]
    name: SceneName | None = None
    up: Vector = (0.0, 0.0, 1.0)
    radius_model: str | None = None
    tolerance: Annotated[float, msgspec.Meta(ge=0, le=MAX_TOLERANCE)] = 0.0
    avatars: list[AvatarItem] = []
    objects: list[ObjectItem] = []
    spawn: Spawn | None = None
    limits: SceneLimits = SceneLimits()
    effects: list[AnyEffect] = msgspec.field(default_factory=lambda: [Stop()])


def sweep_tolerance(scene: SceneFile) -> float:
    """Return the tolerance of the sweeps of a scene's frames [m].

    Contact of a pose is never early: an avatar that stands within the tolerance of a floor could
    not move any more.
    """
    given = next((each.tolerance for each in scene.effects if isinstance(each, Sweep)), None)
    return max(scene.tolerance, LEAST_TOLERANCE) if given is None else given


def scene_of(archive: str) -> SceneFile:
    """Return the scene of an archive without a scene file: the archive and the effect `stop`."""
    return SceneFile(format=1, archives=[ArchiveItem(path=archive)])


def up_of(scene: SceneFile) -> Vector:
    """Return the unit vector against gravity."""
    length = math.hypot(*scene.up)
    x, y, z = (value / length for value in scene.up)
    return x, y, z


def scene_name(scene: SceneFile, path: Path) -> str:
    """Return a scene's name for clients: its `name`, or by default the file's name without suffix.

    Raises BadRequestError if the file's name is not a valid name.
    """
    if scene.name is not None:
        return scene.name
    try:
        return check_name(path.stem, "the file's name")
    except BadRequestError as error:
        raise BadRequestError(f"{path}: {error}: give the scene a `name`") from None


def read_scene(path: Path) -> SceneFile:
    """Read a scene file and check everything that needs no archive.

    Raises BadRequestError with file, place, what was found and what is allowed.
    """
    if path.suffix != SUFFIX:
        raise BadRequestError(
            f"{path}: expected a scene file, with a name that ends in {SUFFIX}, by which `serve` recognises it"
        )
    try:
        with open(path, "rb") as file:
            text = file.read(MAX_BYTES + 1)  # limits the read if a scan was given by mistake
    except OSError as error:
        raise BadRequestError(
            f"{path}: {error.strerror}: expected a scene file: make one with: solidcloud scene new"
        ) from None
    return parse_scene(text, str(path))


def parse_scene(text: bytes, where: str) -> SceneFile:
    """Parse a scene file's bytes and make its poses rigid to the last digits.

    where: the file's name, for errors.
    """
    scene = decode(text, SceneFile, where)
    for place, said in _faults(scene):
        raise toml_error(where, place, said, text)
    return structs.replace(
        scene, archives=_orthonormalise(scene.archives), objects=_orthonormalise(scene.objects)
    )


def json_schema() -> str:
    """Return the JSON Schema of a scene file, for editors of TOML.

    `json/Scene.json` holds the same text.
    """
    schema = msgspec.json.schema(SceneFile)
    for definition in schema["$defs"].values():
        # Python 3.13 strips a docstring's indentation, earlier versions do not; cleandoc gives the
        # same text on all.
        definition["description"] = inspect.cleandoc(definition["description"])
    text = msgspec.json.format(msgspec.json.encode(schema, order="sorted"), indent=2)
    return text.decode() + "\n"


def _faults(scene: SceneFile) -> Iterator[tuple[str, str]]:
    """Yield the place and the explanation of each fault."""
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
                f"`{names[number]}` requires {less}: add {add}, or leave it out",
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
    if not 1e-100 < math.hypot(*scene.up) < 1e100:  # outside, squares overflow or underflow
        yield "$.up", f"found {list(scene.up)}: expected a direction, of any length but zero"
    if scene.spawn is not None:
        yield from _position(scene.spawn.position, "$.spawn.position")
    if scene.radius_model is not None:
        try:
            parse_radius_model(scene.radius_model)
        except BadRequestError as error:
            yield "$.radius_model", str(error)


def _objects(scene: SceneFile, effects: list[str]) -> Iterator[tuple[str, str]]:
    """Yield faults of objects with an unknown shape, or without the effect `objects`."""
    known = [item.name for item in scene.avatars]
    for number, item in enumerate(scene.objects):
        if item.avatar not in known:
            listed = f"one of {', '.join(map(format_value, known))}" if known else "it in [[avatars]]"
            close = suggestion(item.avatar, known)
            yield (
                f"$.objects[{number}].avatar",
                f"{format_value(item.avatar)} is not an avatar of the scene: expected {listed}{close}",
            )
    if scene.objects and "objects" not in effects:
        yield (
            "$.objects",
            f"found {len(scene.objects)} without the effect `objects`: "
            'add [[effects]] effect = "objects", or leave them out',
        )


def _twice(names: list[str], what: str, field: str) -> Iterator[tuple[str, str]]:
    """Yield faults of names that occur twice."""
    for number, name in enumerate(names):
        if name in names[:number]:
            first = f"$.{what}[{names.index(name)}]"
            yield (
                f"$.{what}[{number}].{field}",
                f"{format_value(name)} is a duplicate: expected once, as in {first}",
            )


def _boxes(effect: Through, place: str) -> Iterator[tuple[str, str]]:
    """Yield faults of boxes that are inverted, too far away, or named like another."""
    for number, box in enumerate(effect.boxes):
        yield from _position(box.low, f"{place}[{number}].low")
        yield from _position(box.high, f"{place}[{number}].high")
        if not all(low <= high for low, high in zip(box.low, box.high, strict=True)):
            yield (
                f"{place}[{number}]",
                f"box {format_value(box.name)} from {list(box.low)} to {list(box.high)}: expected low <= high along "
                "each axis",
            )
    yield from _twice([box.name for box in effect.boxes], place[2:], "name")


def _path(path: str, place: str) -> Iterator[tuple[str, str]]:
    """Yield the fault of a path that no file can have."""
    if "\0" in path:
        yield place, f"found {format_value(path)}: expected a path, without the character NUL"


def _position(position: Vector, place: str) -> Iterator[tuple[str, str]]:
    """Yield the fault of a position that no archive's lattice reaches."""
    if not all(abs(value) <= MAX_COORDINATE for value in position):
        yield place, f"found {list(position)}: expected coordinates within {MAX_COORDINATE:g} m"


def _pose(pose: list[list[float]], place: str) -> Iterator[tuple[str, str]]:
    """Yield the fault of a pose that is not rigid, or that shifts too far."""
    fault = rigid_fault(pose, _ALMOST_RIGID)
    if fault is not None:
        yield place, fault
    else:
        yield from _position((pose[0][3], pose[1][3], pose[2][3]), place)


def _orthonormalise(items: list[Any]) -> list[Any]:
    """Return archives or objects with their rotations orthonormalised to the last digits.

    The iteration (3 R - R R' R) / 2 squares the distance of R from the nearest rotation: two steps
    suffice from 1e-6.
    """
    made = []
    for item in items:
        pose = item.pose
        for _ in range(2):
            found = gram(pose)
            if all(abs(found[i][j] - (i == j)) <= _RIGID for i in range(3) for j in range(3)):
                break
            pose = [
                [1.5 * pose[i][j] - 0.5 * sum(found[i][k] * pose[k][j] for k in range(3)) for j in range(3)]
                + [pose[i][3]]
                for i in range(3)
            ] + [pose[3]]
        made.append(item if pose is item.pose else structs.replace(item, pose=pose))
    return made
