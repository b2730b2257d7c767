"""Helpers of the commands: common options, sizes in bytes, missing libraries, errors, JSON, interrupts."""

import json
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ....schemas.errors import BadRequestError, SolidcloudError
from ....schemas.runtime.interrupts import (
    Interrupted,
    check_interrupt,
    deferring_interrupts,
    interrupt_pending,
    stop_insisting,
)
from ....schemas.runtime.own_command import with_own_command

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ...scene_interface import AvatarShape

ArchivePath = Annotated[Path, typer.Argument(help="Folder of an archive.")]
KeyFile = Annotated[
    Path | None,
    typer.Option(help="File with the server's key; default: the key that a server of this user has stored."),
]
AvatarUp = Annotated[
    str | None,
    typer.Option(help="Axis of the avatar's file that points up: x, y or z; default: z, of glTF y."),
]
AvatarUnits = Annotated[
    str | None,
    typer.Option(
        help="Unit of the avatar's file: m, mm, cm, dm, km, in, ft, us-ft or yd; default: the file's, or m."
    ),
]
AvatarHollow = Annotated[
    bool | None,
    typer.Option("--avatar-hollow", help="Leave the inside of a closed mesh empty, instead of filling it."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]


def parse_bytes(text: str, option: str) -> int:
    """Parse a size such as 512MB or 2GB into bytes (powers of 1024).

    Raises BadRequestError, which names the option.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)i?B?", text.strip(), re.IGNORECASE)
    if not match:
        raise BadRequestError(f"{option} {text!r}: expected a size such as 512MB or 2GB")
    return int(float(match[1]) * 1024 ** " KMGT".index(match[2].upper() or " "))


@contextmanager
def needs_extra(name: str) -> Iterator[None]:
    """Raise SolidcloudError naming the extra to install if one of its libraries is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("solidcloud"):
            raise
        raise SolidcloudError(
            f"the library {error.name!r} is not installed: pip install 'solidcloud[{name}]'"
        ) from None


def print_error(message: str, code: int) -> int:
    """Print an error on standard error and return the exit code.

    The message becomes one line; only indented lines, as in lists, stay on lines of their own.
    Commands in it are written as a shell can run them.
    """
    line = re.sub(r"\s*\n(?!  )", " ", message.rstrip())
    print(f"error: {with_own_command(line)}", file=sys.stderr)
    return code


def print_warning(message: str) -> None:
    """Print a warning on standard error. Commands in it are written as a shell can run them."""
    print(f"warning: {with_own_command(message)}", file=sys.stderr)


def among(*words: str) -> Callable[[str], list[str]]:
    """Return a function by which a shell completes one of these words."""

    def complete(incomplete: str) -> list[str]:
        return [word for word in words if word.startswith(incomplete)]

    return complete


def print_json(value: Any) -> None:
    print(json.dumps(value, indent=1, allow_nan=False))


@contextmanager
def interruptible(describe_remains: Callable[[], str] | None = None) -> Iterator[None]:
    """Let SIGINT and SIGTERM end the work in this block.

    describe_remains: returns a sentence about what the work has left behind; None: it leaves nothing.
    Raises Interrupted with that sentence as its text.
    """
    with deferring_interrupts():
        try:
            yield
            check_interrupt()
        except BaseException as error:
            if not isinstance(error, KeyboardInterrupt) and not (
                interrupt_pending() and isinstance(error, Exception)
            ):
                raise
            stop_insisting()
            raise Interrupted(describe_remains() if describe_remains else "") from None


def avatar_options(
    avatar_up: str | None, avatar_units: str | None, avatar_hollow: bool | None = None
) -> dict[str, Any]:
    """Return the options of an avatar's file that were given, as `avatar_shape` takes them."""
    given = {"up": avatar_up, "units": avatar_units, "hollow": avatar_hollow}
    return {name: value for name, value in given.items() if value is not None}


def read_avatar_points(file: Path, avatar_up: str | None, avatar_units: str | None) -> "NDArray[np.float64]":
    """Read the points (n, 3) of an avatar's file or the vertices of a mesh [m]; print what was taken."""
    from ...avatars.avatar_shape import read_avatar
    from ...scene_interface import AvatarShape

    read = read_avatar(file, avatar_up, avatar_units)
    print_avatar(file, AvatarShape(read.points, None, 0, f"points or vertices: a surface; {read.axes}"))
    return read.points


def print_avatar(file: Path, shape: "AvatarShape") -> None:
    """Print on standard error what was taken of an avatar's file."""
    count = len(shape.surface) + shape.inner_points
    print(f"avatar {file.name}: {count:,} points, {shape.description}", file=sys.stderr)
