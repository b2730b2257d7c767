"""`solidcloud serve`: an archive or a scene over zenoh."""

from pathlib import Path
from typing import Annotated

import typer

from .options import parse_bytes


def serve(
    what: Annotated[
        Path, typer.Argument(metavar="ARCHIVE|SCENE.toml", help="Folder of an archive, or a scene file.")
    ],
    name: Annotated[
        str | None, typer.Option(help="Scene name for clients; left out: the scene file's, or the folder's.")
    ] = None,
    listen: Annotated[str, typer.Option(help="zenoh endpoint.")] = "tcp/127.0.0.1:7447",
    cache: Annotated[str, typer.Option(help="Decoded voxels kept in memory, at most.")] = "512MB",
    policy: Annotated[
        str,
        typer.Option(
            help="Which voxel goes for another: lru, lru+prefetch, distance or s3fifo. All but lru load ahead."
        ),
    ] = "lru+prefetch",
    metrics_port: Annotated[
        int, typer.Option(help="TCP port of Prometheus' text, at http://127.0.0.1:PORT/metrics; 0: none.")
    ] = 0,
    key_file: Annotated[
        Path | None,
        typer.Option(
            help="File with the key that replies are sealed with, 64 hex digits, for clients that have it too; left "
            "out: a new one, which clients of this user find by themselves."
        ),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(help="New file for the frames of all users, for solidcloud replay; it only grows."),
    ] = None,
    max_request_seconds: Annotated[
        float,
        typer.Option(help="Server time for one request or part of a path; what was not reached is unknown."),
    ] = 2.0,
    max_slow: Annotated[int, typer.Option(help="Requests at work for longer than 10 ms, at a time.")] = 4,
    max_in_flight_by_client: Annotated[
        int, typer.Option(help="Requests of one client at a time; all without a liveliness token are one.")
    ] = 64,
    max_avatar_bytes: Annotated[
        str, typer.Option(help="Memory for the avatars of all clients, some 54 bytes a point.")
    ] = "512MB",
    max_avatar_bytes_by_client: Annotated[str, typer.Option(help="The same for one client.")] = "256MB",
    max_avatars: Annotated[int, typer.Option(help="Avatars of all clients.")] = 16384,
    max_avatars_by_client: Annotated[int, typer.Option(help="Avatars of one client.")] = 4096,
    max_avatar_clients: Annotated[int, typer.Option(help="Clients that have avatars.")] = 1024,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Allow an endpoint that other hosts reach.")
    ] = False,
) -> None:
    """Serve an archive, which stops who touches it, or a scene over zenoh until told to stop."""
    import logging
    import os
    from contextlib import ExitStack

    from ...schemas.kernels.compiling import kernel_files
    from ..app import serve as serve_scenes
    from ..config import ServerConfig
    from ..key_files import read_given_key
    from ..replay import recorded
    from ..report.points import read_avatar
    from ..scene_file import open_scene
    from .rehearsal import rehearse

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    config = ServerConfig(
        listen=listen,
        insecure=insecure,
        metrics_port=metrics_port,
        key_file=key_file,
        max_request_seconds=max_request_seconds,
        max_slow=max_slow,
        max_in_flight_by_client=max_in_flight_by_client,
        max_avatar_bytes=parse_bytes(max_avatar_bytes, "--max-avatar-bytes"),
        max_avatar_bytes_by_client=parse_bytes(max_avatar_bytes_by_client, "--max-avatar-bytes-by-client"),
        max_avatars=max_avatars,
        max_avatars_by_client=max_avatars_by_client,
        max_avatar_clients=max_avatar_clients,
    )
    budget = parse_bytes(cache, "--cache")
    if key_file is not None:
        read_given_key(key_file)  # refused now, and not once the archive is warm
    files = kernel_files()
    with ExitStack() as stack, ExitStack() as start:
        if start.enter_context(files.starting()):
            rehearse(what, files)
        scene = stack.enter_context(
            open_scene(what, read_points=read_avatar, name=name, budget_bytes=budget, policy=policy)
        )
        if log is not None:
            stack.enter_context(recorded(scene, what, log))
        if not serve_scenes([scene], config, ready=start.close):
            # Nothing is left to write, and the archive would only be closed once the request ends.
            logging.shutdown()
            os._exit(0)
