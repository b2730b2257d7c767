"""`solidcloud export`: write the points of an archive to a file."""

from pathlib import Path
from typing import Annotated

import typer

from ..command_options import ArchivePath, AsJson, among, interruptible, needs_extra, print_json


def export(
    archive: ArchivePath,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="File to write: .laz, .las, .ply or .vtkhdf.")
    ],
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            help="Export only points with low <= coordinate < high on each axis [m]; default: all points.",
            metavar="X0 Y0 Z0 X1 Y1 Z1",
        ),
    ] = None,
    form: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="laz, las, ply or vtkhdf; default: from the file's suffix.",
            autocompletion=among("laz", "las", "ply", "vtkhdf"),
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
    as_json: AsJson = False,
) -> None:
    """Write an archive's points to a file.

    Coordinates equal those in the archive, bit for bit. Intensity and scan number are written if
    stored.
    """
    from .....builder.export.export_archive import export_archive
    from .....schemas.runtime.os_errors import naming_write_errors
    from ...output.archive_facts import print_export
    from ...output.progress_display import progress_listener

    with interruptible(), needs_extra("readers"), naming_write_errors(output), progress_listener() as bars:
        done = export_archive(archive, output, box=box, form=form, overwrite=overwrite, progress=bars)
    if as_json:
        print_json({**done._asdict(), "file": str(done.file)})
    else:
        print_export(done)
