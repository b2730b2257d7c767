"""`solidcloud seal`: seal an archive with a key, or make a key."""

from pathlib import Path
from typing import Annotated

import typer

from ..command_options import interruptible


def seal(
    archive: Annotated[
        Path | None, typer.Argument(metavar="ARCHIVE", help="Folder of an archive.", show_default=False)
    ] = None,
    key: Annotated[
        Path | None,
        typer.Option("--key", help="File with the key: at least 32 random bytes."),
    ] = None,
    new_key: Annotated[
        Path | None,
        typer.Option("--new-key", help="Write a random key to this new file, and seal nothing."),
    ] = None,
) -> None:
    """Seal an archive against forgery.

    Readers with the key find every change. Adding or removing scans removes the seal, and writing
    another level of detail removes that of the level: seal the archive again.
    """
    from .....schemas.archive.seal import MIN_KEY_BYTES, read_archive_key, write_new_key
    from .....schemas.errors import BadRequestError
    from .....schemas.process.os_errors import naming_write_errors
    from ...output.console import bytes_text
    from ...output.progress_display import progress_listener

    if (new_key is None) == (key is None) or (archive is None) != (key is None):
        raise BadRequestError("expected ARCHIVE and --key FILE, to seal it, or --new-key FILE alone")
    if new_key is not None:
        with naming_write_errors(new_key):
            write_new_key(new_key)
        print(f"{new_key}: a key of {MIN_KEY_BYTES} random bytes, which only you can read")
        return
    from .....builder.edit.seal_archive import seal_archive

    assert archive is not None and key is not None
    secret = read_archive_key(key)
    with (
        interruptible(lambda: f"{archive} is readable as before, and not sealed with this key"),
        naming_write_errors(archive),
        progress_listener() as bars,
    ):
        found = seal_archive(archive, secret, bars)
    level = " of it and its level of detail" if found.with_level else ""
    print(f"{archive}: sealed, {found.voxels:,} records{level} of {bytes_text(found.bytes)}")
