"""`solidcloud top`: live statistics of a server's cache and users."""

from contextlib import ExitStack
from typing import Annotated

import typer

from .command_options import AsJson, KeyFile, print_json


def top(
    scene: Annotated[str | None, typer.Option(help="Name of the scene; default: all served scenes.")] = None,
    connect: Annotated[str, typer.Option(help="Zenoh endpoint of the server.")] = "tcp/127.0.0.1:7447",
    interval: Annotated[float, typer.Option(help="Seconds between two updates.")] = 1.0,
    once: Annotated[bool, typer.Option("--once", help="Print one table and exit.")] = False,
    key_file: KeyFile = None,
    as_json: AsJson = False,
) -> None:
    """Show live statistics of a server.

    They are about its cache and its users, and are updated until Ctrl-C.
    """
    import msgspec

    from ....schemas.errors import BadRequestError
    from ...client import Client
    from ...zenoh_client.server_connection import scenes_at
    from ..output.top_display import watch

    if not 0.1 <= interval <= 3600:
        raise BadRequestError(f"--interval {interval}: expected 0.1 to 3600 seconds")
    with ExitStack() as stack:
        names = [scene] if scene is not None else scenes_at(connect, key_file=key_file)
        clients = [stack.enter_context(Client(connect, scene=name, key_file=key_file)) for name in names]
        if as_json:
            print_json([msgspec.to_builtins(client.stats()) for client in clients])
            return
        try:
            watch(clients, interval, once=once)
        except KeyboardInterrupt:
            return  # Ctrl-C is the regular way to end
