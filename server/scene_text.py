"""A scene file to begin with: the archives and avatars given, every other field commented out with its default.

Text is made of the types (schemas/scene.py, effects.py), so that no field is missing here.
"""

import inspect
import json
import re
import textwrap
from collections.abc import Collection, Iterator, Sequence
from typing import Any, NamedTuple, get_args

import msgspec

from ..schemas.effects import AnyEffect, Through
from ..schemas.errors import BadRequestError
from ..schemas.scene import FORMAT, Limits, identity

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_WIDTH = 100


class Beginning(NamedTuple):
    """What a new scene file says. archives, avatars: paths as it is to have them; avatars by name.

    effects: names.  models: of radius, that all archives hold.  low, high: of what is scanned, world [m].
    """

    archives: Sequence[str]
    avatars: Sequence[tuple[str, str]]
    effects: Collection[str]
    name: str | None
    models: Sequence[str]
    low: Sequence[float]
    high: Sequence[float]


def scene_text(begin: Beginning) -> str:
    """The text of a scene file. BadRequestError for a path that TOML cannot hold, or an effect that is none."""
    kinds = {str(kind.__struct_config__.tag): kind for kind in get_args(AnyEffect)}
    for name in begin.effects:
        if name not in kinds:
            raise BadRequestError(f"--effects {name}: expected some of {', '.join(kinds)}")
    lines = [*_head(begin), *_places(begin), *_limits()]
    lines += _comment(
        "Effects: what is not here is not simulated. They run in an order of their own, see `solidcloud scene check`."
    )
    for name, kind in kinds.items():
        lines += ["", *_effect(name, kind, begin, name in begin.effects)]
    return "\n".join(lines) + "\n"


def toml_value(value: Any) -> str:
    """A value as TOML: what msgspec makes of the types of a scene file, None apart.

    BadRequestError for text that is no Unicode, such as a file's name in other bytes.
    """
    if isinstance(value, str):
        try:
            value.encode()
        except UnicodeEncodeError:
            raise BadRequestError(
                f"{value!r}: a name that is no UTF-8, which a scene file cannot hold"
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
    """A key as TOML."""
    return name if _BARE_KEY.fullmatch(name) else toml_value(name)


def _head(begin: Beginning) -> Iterator[str]:
    """What is said once."""
    yield "# A scene for `solidcloud serve`: archives, what moves in them, and which effects are simulated."
    yield "# `solidcloud scene check` says whether all is well. Lengths are metres; paths are relative to this file;"
    yield "# what is commented out without a space behind the # is a default, or an example."
    yield ""
    yield f"format = {FORMAT}"
    yield ""
    yield from _comment("What clients call the scene. Left out: this file's name without its suffix.")
    yield f"name = {toml_value(begin.name)}" if begin.name else '#name = "hall"'
    yield ""
    yield from _comment("Against gravity; of any length.")
    yield "#up = [0.0, 0.0, 1.0]"
    yield ""
    held = ", ".join(begin.models)
    yield from _comment(
        f"How large a sphere a scan point stands for. The archives hold {held}; fixed:METRES always works. Left out: "
        "each archive's one figure."
    )
    yield f"#radius_model = {toml_value(begin.models[-1] if begin.models else 'mean')}"
    if not begin.effects:
        yield ""
        yield from _comment("No effects: nothing stops anybody. Take this line out to declare some below.")
        yield "effects = []"


def _places(begin: Beginning) -> Iterator[str]:
    """Archives, avatars, objects, where users begin."""
    pose = toml_value(identity())
    for path in begin.archives:
        yield from ("", "[[archives]]", f"path = {toml_value(path)}")
        yield f"#pose = {pose}  # archive to world, rigid, row by row"
    yield ""
    yield from _comment(
        "Avatars that every user finds: points of a scan or mesh, in its own frame. radius: of each point's sphere; "
        "left out: half the mean closest-point distance."
    )
    for name, file in begin.avatars:
        yield from (
            "[[avatars]]",
            f"name = {toml_value(name)}",
            f"file = {toml_value(file)}",
            "#radius = 0.01",
            "",
        )
    if not begin.avatars:
        yield from ("#[[avatars]]", '#name = "visitor"', '#file = "visitor.ply"', "#radius = 0.01", "")
    yield from _comment(
        "Dynamic objects, in the shape of an avatar; they need the effect `objects`. kind: kinematic, where it is told "
        "to be, or pushed, by users."
    )
    shape = begin.avatars[0][0] if begin.avatars else "visitor"
    yield from (
        "#[[objects]]",
        '#name = "door"',
        f"#avatar = {toml_value(shape)}",
        f"#pose = {pose}",
        '#kind = "kinematic"',
    )
    yield ""
    yield from _comment(
        "Where users begin: the avatar's origin; turned about up, in degrees. Left out: where they say."
    )
    middle = [round((low + high) / 2, 3) for low, high in zip(begin.low[:2], begin.high[:2], strict=True)]
    yield from (
        "#[spawn]",
        f"#position = {toml_value([*middle, round(begin.low[2], 3)])}",
        "#heading = 0.0",
        "",
    )


def _limits() -> Iterator[str]:
    """What a scene may cost."""
    yield from _comment(
        "users: at a time. frame_ms, frame_visits: of one user's frame, for effects that are no safety; left out: no "
        "bound. longest_move: of a frame."
    )
    yield "#[limits]"
    for name, value in msgspec.to_builtins(Limits()).items():
        yield f"#{name} = {toml_value({'frame_ms': 5.0, 'frame_visits': 20_000}[name] if value is None else value)}"
    yield ""


def _effect(name: str, kind: Any, begin: Beginning, declared: bool) -> Iterator[str]:
    """One effect, commented out unless declared."""
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
    """Lines of a comment."""
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ", break_on_hyphens=False)
