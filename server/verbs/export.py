"""`solidcloud export`: points back out of an archive."""

from pathlib import Path
from typing import Annotated

import typer

from .interrupt import interruptible
from .options import ArchivePath, AsJson, needs_extra, print_json


def export(
    archive: ArchivePath,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="File to write: .laz, .las, .ply or .vtkhdf.")
    ],
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            help="Only points in x0 y0 z0 x1 y1 z1 [m], each low <= coordinate < high; left out: all.",
            metavar="X0 Y0 Z0 X1 Y1 Z1",
        ),
    ] = None,
    form: Annotated[
        str | None, typer.Option("--format", help="laz, las, ply or vtkhdf; left out: by the file's suffix.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there.")] = False,
    as_json: AsJson = False,
) -> None:
    """Write an archive's points to a file.

    Coordinates are the archive's own, to the last bit; intensity and scan where they are stored.
    """
    from ...builder.export import export_archive
    from ...schemas.os_errors import writing
    from ..progress import progress_listener
    from .facts import print_export

    with interruptible(), needs_extra("readers"), writing(output), progress_listener() as bars:
        done = export_archive(archive, output, box=box, form=form, overwrite=overwrite, progress=bars)
    if as_json:
        print_json({**done._asdict(), "file": str(done.file)})
    else:
        print_export(done)
