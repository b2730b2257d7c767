"""`solidcloud replay`: simulate the frames of a log again and compare them bit for bit."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from .command_options import AsJson, parse_bytes, print_json, print_warning


def replay(
    log: Annotated[Path, typer.Argument(help="Log written by solidcloud serve --log.")],
    what: Annotated[
        Path | None,
        typer.Argument(
            metavar="[ARCHIVE|SCENE.toml]",
            help="The archive or scene file that was served; default: the path in the log.",
        ),
    ] = None,
    cache: Annotated[str, typer.Option(help="Memory bound of decoded voxels.")] = "512MB",
    as_json: AsJson = False,
) -> int:
    """Simulate a log again and compare poses.

    Compares the pose of every frame, bit for bit. Exit code 1: some poses differ.
    """
    from ...scene import Scene
    from ...simulation.replay import check_same
    from ...simulation.replay import replay as replay_log
    from ...simulation.replay_log import read_log

    head, frames = read_log(log)
    path = Path(head.path) if what is None else what
    with Scene.open(path, head.scene, budget_bytes=parse_bytes(cache, "--cache")) as scene:
        if not check_same(head, scene.simulation, path):
            print_warning(f"{path} is not the scene file that was logged")
        found = replay_log(scene.simulation, frames)
    if as_json:
        print_json(asdict(found))
        return int(found.different > 0)
    print(f"{found.frames} frames, {found.turns} turns: {found.different or 'none'} different")
    if found.taken:
        print(f"{found.taken} turns taken from the log: they depended on voxels that were not in memory")
    if found.first is not None:
        print(f"first: {found.first}")
    if found.reloaded is not None:
        print(f"stopped before frame {found.reloaded}: the scene was reloaded there")
    return int(found.different > 0)
