"""`solidcloud serve`: serve an archive or a scene over zenoh."""

from pathlib import Path
from typing import Annotated

import typer

from .command_options import among, parse_bytes


def serve(
    what: Annotated[
        Path, typer.Argument(metavar="ARCHIVE|SCENE.toml", help="Folder of an archive, or a scene file.")
    ],
    name: Annotated[
        str | None,
        typer.Option(help="Scene name for clients; default: the name in the scene file, or of the folder."),
    ] = None,
    listen: Annotated[str, typer.Option(help="Zenoh endpoint to listen on.")] = "tcp/127.0.0.1:7447",
    cache: Annotated[str, typer.Option(help="Memory bound of decoded voxels.")] = "512MB",
    policy: Annotated[
        str,
        typer.Option(
            help="Eviction policy of the voxel cache: lru, or lru+prefetch, which also loads voxels ahead of users.",
            autocompletion=among("lru", "lru+prefetch"),
        ),
    ] = "lru+prefetch",
    level_bytes: Annotated[
        str | None,
        typer.Option(
            help="The part of --cache for levels of detail, such as 64MB; default: a sixteenth. 0B: use none."
        ),
    ] = None,
    metrics_port: Annotated[
        int, typer.Option(help="TCP port of Prometheus metrics, at http://127.0.0.1:PORT/metrics; 0: none.")
    ] = 0,
    key_file: Annotated[
        Path | None,
        typer.Option(
            help="File with the key that authenticates replies, 64 hex digits, shared with the clients; default: a "
            "new key, which clients of the same user find automatically."
        ),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(
            help="New log file of all users' frames, for solidcloud replay; it grows without bound."
        ),
    ] = None,
    max_request_seconds: Annotated[
        float,
        typer.Option(
            help="Time limit of one request or one part of a path [s]; what was not computed by then is unknown."
        ),
    ] = 2.0,
    max_slow: Annotated[
        int, typer.Option(help="Maximum number of simultaneous requests that run longer than 10 ms.")
    ] = 4,
    max_in_flight_by_client: Annotated[
        int,
        typer.Option(
            help="Maximum number of simultaneous requests of one client; all clients without a liveliness token "
            "count as one."
        ),
    ] = 64,
    max_avatar_bytes: Annotated[
        str, typer.Option(help="Memory bound of the avatars of all clients, about 54 bytes per point.")
    ] = "512MB",
    max_avatar_bytes_by_client: Annotated[
        str, typer.Option(help="Memory bound of the avatars of one client.")
    ] = "256MB",
    max_avatars: Annotated[int, typer.Option(help="Maximum number of avatars of all clients.")] = 16384,
    max_avatars_by_client: Annotated[
        int, typer.Option(help="Maximum number of avatars of one client.")
    ] = 4096,
    max_avatar_clients: Annotated[
        int, typer.Option(help="Maximum number of clients that have avatars.")
    ] = 1024,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Allow an endpoint that other hosts can reach.")
    ] = False,
) -> None:
    """Serve an archive or a scene until Ctrl-C.

    Clients connect over zenoh. An archive is served with the effect stop: an avatar that touches the
    scan is stopped.
    """
    import logging
    import os
    import signal
    import sys
    from contextlib import ExitStack

    from ....schemas.runtime.compiling import has_compiled, kernel_files
    from ...scene import Scene
    from ...simulation.replay import recorded
    from ...zenoh_common.key_files import read_given_key
    from ...zenoh_server.serve_loop import serve as serve_scenes
    from ...zenoh_server.server_config import ServerConfig
    from ..output.compile_notice import compile_notices
    from ..warming.kernel_rehearsal import rehearse
    from ..warming.parallel_warming import warmed_in_parallel

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
    level = None if level_bytes is None else parse_bytes(level_bytes, "--level-bytes")
    if key_file is not None:
        read_given_key(key_file)  # raises before the archive is opened and warmed
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())  # until `serve_scenes` waits for signals
    files = kernel_files()
    with ExitStack() as stack, ExitStack() as start:
        start.enter_context(compile_notices())
        if start.enter_context(files.starting()):
            rehearse(what, files)
        start.enter_context(warmed_in_parallel(what))
        scene = stack.enter_context(
            Scene.open(what, name, budget_bytes=budget, policy=policy, level_bytes=level)
        )
        if log is not None:
            stack.enter_context(recorded(scene, what, log))
        if not serve_scenes([scene], config, ready=start.close):
            # A request or a compilation is still running. Nothing is left to write, and closing the
            # archive would wait for it. If the start has ended without compiling, a kernel may hang:
            # its mark stays, so that the next start tries the kernels first.
            if has_compiled():
                start.close()
            logging.shutdown()
            os._exit(0)
