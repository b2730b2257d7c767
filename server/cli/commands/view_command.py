"""`solidcloud view`: walk through a scene in the browser."""

from pathlib import Path
from typing import Annotated

import typer

from .command_options import (
    AvatarHollow,
    AvatarUnits,
    AvatarUp,
    KeyFile,
    among,
    avatar_options,
    needs_extra,
    parse_bytes,
    print_avatar,
)


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
            help="Points or mesh of the users' avatar, facing +y once its z is up; default: a figure of 1.75 m."
        ),
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="Path whose clashes are shown: CSV file t,x,y,z,qw,qx,qy,qz, or TUM trajectory (.tum, .txt)."
        ),
    ] = None,
    cache: Annotated[
        str | None,
        typer.Option(help="Memory bound of decoded voxels of the server that is started; default: 512MB."),
    ] = None,
    up: Annotated[
        str | None,
        typer.Option(
            help="Axis of an archive that points up: x, y or z; default: z.",
            autocompletion=among("x", "y", "z"),
        ),
    ] = None,
    avatar_up: AvatarUp = None,
    avatar_units: AvatarUnits = None,
    avatar_hollow: AvatarHollow = None,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True,
    key_file: KeyFile = None,
) -> None:
    """Walk through a scene in the browser.

    Ctrl-C ends it. The page is served to this host only. The server moves the users: it stops them at
    the scan, and an archive is served such that they stand on the ground and climb steps. The page can
    switch the effects of a server that this command has started.
    """
    import signal
    import sys
    import threading
    import webbrowser
    from contextlib import ExitStack

    with needs_extra("view"):
        from ...viewer.viewer import viewing
    from ....schemas.errors import BadRequestError
    from ...avatars.avatar_shape import avatar_shape
    from ..scene_files.viewed_scene import viewed_scene
    from .viewed_server import ViewedServer

    options: list[str] = []
    if cache is not None:
        parse_bytes(cache, "--cache")
        options = ["--cache", cache]
    if what is None and (cache is not None or up is not None):
        raise BadRequestError(
            "--cache and --up belong to a server that this command starts: name an archive or a scene file"
        )

    shape = None
    if avatar is not None:
        shape = avatar_shape(avatar, **avatar_options(avatar_up, avatar_units, avatar_hollow))
        print_avatar(avatar, shape)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    server: ViewedServer | None = None
    with ExitStack() as stack:
        if what is not None:
            file = stack.enter_context(viewed_scene(what, up))
            # Without a word until the libraries are loaded, the command seems to hang.
            print(f"starting a server of {what}", file=sys.stderr, flush=True)
            server = stack.enter_context(ViewedServer(file, *options))
            connect = server.endpoint
        url = stack.enter_context(
            viewing(connect, scene, port=port, avatar=shape, key_file=key_file, switch=server, poses=poses)
        )
        print(f"viewer: {url}  (Ctrl-C ends it)", flush=True)
        if server is not None:
            print(
                "walk with W A S D, look by dragging; all keys are at the foot of the settings",
                file=sys.stderr,
            )
        if browser:
            # Some browsers return only when they are closed.
            threading.Thread(target=webbrowser.open, args=(url,), daemon=True).start()
        try:
            threading.Event().wait()
        except KeyboardInterrupt:
            return  # Ctrl-C is the regular way to end
