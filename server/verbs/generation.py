"""`solidcloud reload`: what a generation more of an archive means to a server."""

from typing import Annotated

import typer

from .options import AsJson, print_json


def reload(
    scene: Annotated[str, typer.Option(help="Name of the scene.")],
    connect: Annotated[str, typer.Option(help="zenoh endpoint of the server.")] = "tcp/127.0.0.1:7447",
    as_json: AsJson = False,
) -> None:
    """Have a server serve what is in the archive's folder now, without losing a question."""
    import msgspec

    from ..client import Client

    with Client(connect, scene=scene) as client:
        answer = client.reload()
    if as_json:
        print_json(msgspec.to_builtins(answer))
    else:
        print(
            f"{answer.scene}: generation {answer.generation_after}, was {answer.generation_before}; "
            f"{answer.points:,} points, {answer.seconds:.1f} s"
        )
