"""`solidcloud view`: walk through a scene in the browser."""

from pathlib import Path
from typing import Annotated

import typer

from .command_options import KeyFile, needs_extra


def view(
    what: Annotated[
        Path | None,
        typer.Argument(
            metavar="[ARCHIVE|SCENE.toml]",
            help="Folder of an archive, or a scene file, to serve; default: view a running server's scene.",
        ),
    ] = None,
    connect: Annotated[str, typer.Option(help="Zenoh endpoint of a running server.")] = "tcp/127.0.0.1:7447",
    scene: Annotated[
        str | None, typer.Option(help="Name of a running server's scene; default: the only one.")
    ] = None,
    port: Annotated[int, typer.Option(help="TCP port of the page; 0: a free one.")] = 0,
    avatar: Annotated[
        Path | None,
        typer.Option(
            help="Points or mesh of the users' avatar, z up, facing +y; default: a figure of 1.75 m."
        ),
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="Path whose clashes are shown: CSV file t,x,y,z,qw,qx,qy,qz, or TUM trajectory (.tum, .txt)."
        ),
    ] = None,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True,
    key_file: KeyFile = None,
) -> None:
    """Walk through a scene in the browser.

    Ctrl-C ends it. The page is served to this host only. The server moves the users: it stops them at
    the scan, and an archive is served such that they stand on the ground and climb steps. The page can
    switch the effects of a server that this command has started.
    """
    import signal
    import threading
    import webbrowser
    from contextlib import ExitStack

    with needs_extra("view"):
        from ...viewer.viewer import viewing
    from ..scene_files.viewed_scene import viewed_scene
    from .viewed_server import ViewedServer

    signal.signal(signal.SIGTERM, signal.default_int_handler)
    server: ViewedServer | None = None
    with ExitStack() as stack:
        if what is not None:
            server = stack.enter_context(ViewedServer(stack.enter_context(viewed_scene(what))))
            connect = server.endpoint
        url = stack.enter_context(
            viewing(connect, scene, port=port, avatar=avatar, key_file=key_file, switch=server, poses=poses)
        )
        print(f"viewer: {url}  (Ctrl-C ends it)", flush=True)
        if browser:
            # Some browsers return only when they are closed.
            threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            return  # Ctrl-C is the regular way to end
