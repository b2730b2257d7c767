"""`solidcloud serve`: archives over zenoh."""

from typing import Annotated

import typer

from .options import ArchivePath, parse_bytes


def serve(
    archive: ArchivePath,
    name: Annotated[str | None, typer.Option(help="Scene name for clients; left out: the folder's.")] = None,
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
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Allow an endpoint that other hosts reach.")
    ] = False,
) -> None:
    """Serve an archive over zenoh until told to stop."""
    import logging

    from ..app import serve as serve_scenes
    from ..config import ServerConfig
    from ..scene import Scene

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    config = ServerConfig(listen=listen, insecure=insecure, metrics_port=metrics_port)
    with Scene.open(archive, name, budget_bytes=parse_bytes(cache, "--cache"), policy=policy) as scene:
        serve_scenes([scene], config)
