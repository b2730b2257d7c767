"""`solidcloud accuracy`: measure accuracy against query time."""

from pathlib import Path
from typing import Annotated

import typer

from .command_options import AvatarUnits, AvatarUp, interruptible, needs_extra, read_avatar_points


def accuracy(
    archive: Annotated[
        Path | None, typer.Argument(help="Folder of an archive; default: one built from a generated façade.")
    ] = None,
    avatar: Annotated[
        Path | None, typer.Option(help="Points of the avatar; default: a generated human figure.")
    ] = None,
    avatar_up: AvatarUp = None,
    avatar_units: AvatarUnits = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the report.")] = Path("report"),
    full: Annotated[bool, typer.Option("--full", help="More settings, poses and repetitions.")] = False,
) -> None:
    """Measure what accuracy costs in query time.

    Measures times in memory and from disk against the error allowed. Writes an HTML page, charts and JSON.
    """
    import tempfile

    from ....schemas.runtime.os_errors import naming_write_errors

    with needs_extra("made"):
        from ...report.accuracy.accuracy_report import run as measure
    from ...report.accuracy.measurement.measurement_plan import BRIEF, FULL
    from ...report.accuracy.page.accuracy_texts import findings
    from ..output.progress_display import progress_listener

    with (
        interruptible(),
        naming_write_errors(output),
        tempfile.TemporaryDirectory(prefix="solidcloud-accuracy-") as scratch,
        progress_listener() as bars,
    ):
        body = None if avatar is None else read_avatar_points(avatar, avatar_up, avatar_units)
        report = measure(output, Path(scratch), FULL if full else BRIEF, bars, archive, body)
    for line in (
        *report.facts["warnings"],
        *findings(report),
    ):
        print(line)
    print(f"wrote {output / 'accuracy.html'}, accuracy.json and charts")
