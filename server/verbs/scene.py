"""`solidcloud scene new`, `scene check`: a scene file to begin with, and whether one is right."""

from pathlib import Path
from typing import Annotated

import typer

from .options import AsJson, print_json


def new(
    archives: Annotated[list[Path], typer.Argument(help="Folders of archives.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The file to write.")] = Path("scene.toml"),
    name: Annotated[
        str | None, typer.Option(help="Scene name for clients; left out: the file's, without suffix.")
    ] = None,
    avatar: Annotated[
        list[Path] | None,
        typer.Option(
            help="Points of an avatar that every user finds, named nearly as the file; may be repeated."
        ),
    ] = None,
    effects: Annotated[
        str, typer.Option(help="What is simulated, with commas between; the others are commented out.")
    ] = "stop",
    force: Annotated[bool, typer.Option("--force", help="Replace the file if it is there.")] = False,
) -> None:
    """Write a scene file with every field explained."""
    import shlex

    from ..scene_new import new_scene

    wanted = [effect.strip() for effect in effects.split(",") if effect.strip()]
    new_scene(out, archives, avatar or [], effects=wanted, name=name, force=force)
    print(f"{out}: written; edit it, then: {shlex.join(['solidcloud', 'scene', 'check', str(out)])}")


def check(
    file: Annotated[Path, typer.Argument(help="A scene file.")],
    as_json: AsJson = False,
) -> None:
    """Say what a scene is and which effects run, in which order; exit code 2 where it is wrong, 3 for bad data."""
    from ..console import print_facts
    from ..report.points import read_avatar
    from ..scene_check import check_scene_file, scene_facts, scene_json

    checked = check_scene_file(file, read_avatar)
    if as_json:
        print_json(scene_json(checked))
    else:
        print_facts(scene_facts(checked))
