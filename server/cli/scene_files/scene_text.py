"""Text of a new scene file.

The file has the given archives and avatars, and every other field commented out with its default.
The text is generated from the types in schemas/scene/scene_file.py and effect_table.py, so that
no field is missing.
"""

import inspect
import json
import re
import textwrap
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, get_args

import msgspec

from ....schemas.errors import BadRequestError
from ....schemas.scene.effect_table import AnyEffect, Through
from ....schemas.scene.scene_file import FORMAT, SceneLimits, identity

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_WIDTH = 100


class SceneContent(NamedTuple):
    """Content of a new scene file.

    archives: paths, relative to the file.  avatars: the fields of each.
    effects: names of the effects to enable.  models: radius models that all archives store.
    low, high: bounds of the archives, world frame [m].
    spawn: position of users at their start, world frame [m]; None: an example, commented out.
    spawn_note: sentence about how the spawn was found, or why there is none.
    """

    archives: Sequence[str]
    avatars: Sequence[Mapping[str, Any]]
    effects: Collection[str]
    name: str | None
    models: Sequence[str]
    low: Sequence[float]
    high: Sequence[float]
    spawn: Sequence[float] | None = None
    spawn_note: str = ""


def scene_text(begin: SceneContent) -> str:
    """Return the text of a scene file.

    Raises BadRequestError for a path that TOML cannot represent, or for an unknown effect.
    """
    kinds = {str(kind.__struct_config__.tag): kind for kind in get_args(AnyEffect)}
    for name in begin.effects:
        if name not in kinds:
            raise BadRequestError(f"--effects {name}: expected one or more of {', '.join(kinds)}")
    lines = [*_head(begin), *_places(begin), *_limits()]
    lines += _comment(
        "Effects: only those declared here run. Their order is fixed, see `solidcloud scene check`."
    )
    for name, kind in kinds.items():
        lines += ["", *_effect(name, kind, begin, name in begin.effects)]
    return "\n".join(lines) + "\n"


def toml_value(value: Any) -> str:
    """Format a value as TOML: any value of the scene file's types, as built-in types, except None.

    Raises BadRequestError for text that is not Unicode, such as a file name in another encoding.
    """
    if isinstance(value, str):
        try:
            value.encode()
        except UnicodeEncodeError:
            raise BadRequestError(
                f"{value!r}: not valid UTF-8, expected a name that a scene file can hold: rename it"
            ) from None
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool | int):
        return str(value).lower()
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, dict):
        pairs = (f"{_key(name)} = {toml_value(inner)}" for name, inner in value.items() if inner is not None)
        return "{" + ", ".join(pairs) + "}"
    return "[" + ", ".join(map(toml_value, value)) + "]"


def _key(name: str) -> str:
    """Format a key as TOML."""
    return name if _BARE_KEY.fullmatch(name) else toml_value(name)


def _head(begin: SceneContent) -> Iterator[str]:
    """Yield the top-level fields."""
    yield "# A scene for `solidcloud serve`: archives, avatars, dynamic objects, and simulated effects."
    yield "# `solidcloud scene check` checks this file. Lengths are metres; paths are relative to this file;"
    yield "# a line that begins with # and no space is a default or an example."
    yield ""
    yield f"format = {FORMAT}"
    yield ""
    yield from _comment("Name of the scene for clients. Default: this file's name without its suffix.")
    yield f"name = {toml_value(begin.name)}" if begin.name else '#name = "hall"'
    yield ""
    yield from _comment("Direction opposite to gravity; a vector of any length.")
    yield "#up = [0.0, 0.0, 1.0]"
    yield ""
    held = ", ".join(begin.models)
    yield from _comment(
        f"Radius of the sphere that represents a scan point. The archives store {held}; fixed:METRES always works. "
        "Default: the radius stored in each archive."
    )
    yield f"#radius_model = {toml_value(begin.models[-1] if begin.models else 'mean')}"
    yield ""
    yield from _comment(
        "Distance by which contact may be early in frames, 0 to 0.1: the default of the `tolerance` of `sweep`. "
        "Poses are exact: an avatar at rest is never stopped by it."
    )
    yield "#tolerance = 0.0"
    if not begin.effects:
        yield ""
        yield from _comment("No effects: nothing stops an avatar. Remove this line to declare effects below.")
        yield "effects = []"


def _places(begin: SceneContent) -> Iterator[str]:
    """Yield the archives, avatars, objects and the spawn."""
    pose = toml_value(identity())
    for path in begin.archives:
        yield from ("", "[[archives]]", f"path = {toml_value(path)}")
        yield f"#pose = {pose}  # archive to world, rigid, rows of a 4 x 4 matrix"
    yield ""
    yield from _comment(
        "Avatars that all users may use: points of a scan or mesh, in its own frame. radius: of each point's sphere; "
        "default: half the mean closest-point distance, of a mesh a hundredth of the square root of its area. up, "
        "units: of the file; default: as its format states, otherwise z and m. scale: factor of all lengths; "
        "default: 1. hollow: whether the inside of a closed mesh stays empty."
    )
    examples = {"radius": 0.01, "up": "y", "units": "mm", "scale": 0.5, "hollow": True}
    for avatar in begin.avatars or [{}]:
        off = "" if avatar else "#"
        fields = avatar or {"name": "visitor", "file": "visitor.ply"}
        yield f"{off}[[avatars]]"
        yield from (f"{off}{field} = {toml_value(value)}" for field, value in fields.items())
        left = {field: value for field, value in examples.items() if field not in fields}
        yield from (f"#{field} = {toml_value(value)}" for field, value in left.items())
        yield ""
    yield from _comment(
        "Dynamic objects, in the shape of an avatar; they need the effect `objects`. kind: kinematic, at the pose that "
        "is set for it, or pushed, moved by users who touch it."
    )
    shape = begin.avatars[0]["name"] if begin.avatars else "visitor"
    yield from (
        "#[[objects]]",
        '#name = "door"',
        f"#avatar = {toml_value(shape)}",
        f"#pose = {pose}",
        '#kind = "kinematic"',
    )
    yield ""
    yield from _comment(
        "Initial pose of users: position of the avatar's origin; heading about the up axis, in degrees. Default: the "
        f"pose that the user sends. {begin.spawn_note}".rstrip()
    )
    middle = [round((low + high) / 2, 3) for low, high in zip(begin.low, begin.high, strict=True)]
    off = "#" if begin.spawn is None else ""
    yield from (
        f"{off}[spawn]",
        f"{off}position = {toml_value(list(begin.spawn or middle))}",
        f"{off}heading = 0.0",
        "",
    )


def _limits() -> Iterator[str]:
    """Yield the limits."""
    yield from _comment("users: maximum at a time. longest_move: maximum motion of a frame.")
    yield "#[limits]"
    for name, value in msgspec.to_builtins(SceneLimits()).items():
        yield f"#{name} = {toml_value(value)}"
    yield ""


def _effect(name: str, kind: Any, begin: SceneContent, declared: bool) -> Iterator[str]:
    """Yield one effect, commented out unless declared."""
    for paragraph in inspect.cleandoc(kind.__doc__).split("\n\n"):
        yield from _comment(" ".join(paragraph.split()))
    if kind.needs:
        yield from _comment(f"Needs {', '.join(kind.needs)}.")
    off = "" if declared else "#"
    yield from (f"{off}[[effects]]", f'{off}effect = "{name}"')
    for field in msgspec.structs.fields(kind):
        if kind is Through:
            low, high = list(map(float, begin.low)), list(map(float, begin.low))
            box = {"name": "door", "low": low, "high": high}
            yield f"{off}boxes = [{toml_value(box)}]"
        elif field.default is None:
            yield f"#{field.name} = 0.1"
        else:
            default = field.default_factory() if field.default is msgspec.NODEFAULT else field.default
            yield f"{off}{field.name} = {toml_value(default)}"


def _comment(text: str) -> list[str]:
    """Wrap a text into comment lines."""
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ", break_on_hyphens=False)
