"""`solidcloud scene new` and `scene check`: create a scene file and check one."""

from pathlib import Path
from typing import Annotated

import typer

from .command_options import AsJson, AvatarHollow, AvatarUnits, AvatarUp, avatar_options, print_json


def new(
    archives: Annotated[list[Path], typer.Argument(help="Folders of archives.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Scene file to write.")] = Path("scene.toml"),
    name: Annotated[
        str | None, typer.Option(help="Scene name for clients; default: the file name without suffix.")
    ] = None,
    avatar: Annotated[
        list[Path] | None,
        typer.Option(
            help="Points or mesh of an avatar that all users may use; its name is that of the file; may be repeated."
        ),
    ] = None,
    effects: Annotated[
        str, typer.Option(help="Effects to enable, separated by commas; the others are commented out.")
    ] = "stop",
    avatar_up: AvatarUp = None,
    avatar_units: AvatarUnits = None,
    avatar_hollow: AvatarHollow = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
) -> None:
    """Write a scene file, every field explained.

    Users start on the floor near the middle, at a place where the avatars were tried.
    """
    import shlex
    import sys

    from ....schemas.runtime.own_command import own_command
    from ..scene_files.scene_new import new_scene

    wanted = [effect.strip() for effect in effects.split(",") if effect.strip()]
    spawn = new_scene(
        output,
        archives,
        avatar or [],
        effects=wanted,
        name=name,
        overwrite=overwrite,
        avatar_options=avatar_options(avatar_up, avatar_units, avatar_hollow),
    )
    if spawn is None:
        print(f"{output}: no place to stand was found: see [spawn] in it", file=sys.stderr)
    print(f"{output}: written; edit it, then: {own_command()} {shlex.join(['scene', 'check', str(output)])}")


def check(
    file: Annotated[Path, typer.Argument(help="Scene file.")],
    as_json: AsJson = False,
) -> None:
    """Check a scene file and describe the scene.

    The effects are listed in their order. Exit code 2: the file is invalid. Exit code 3: an archive
    or avatar it names is invalid.
    """
    from ..output.console import print_facts
    from ..scene_files.scene_check import check_scene_file, scene_facts, scene_json

    checked = check_scene_file(file)
    if as_json:
        print_json(scene_json(checked))
    else:
        print_facts(scene_facts(checked))
