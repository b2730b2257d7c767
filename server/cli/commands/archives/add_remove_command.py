"""`solidcloud add`, `remove` and `reload`: write and hot-reload a new generation of an archive."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..command_options import (
    ArchivePath,
    AsJson,
    KeyFile,
    interruptible,
    parse_bytes,
    print_json,
    print_warning,
)

if TYPE_CHECKING:
    from .....builder.edit.rebuild_voxels import ChangeSummary

Jobs = Annotated[int, typer.Option(help="Worker processes; 0: one per core, fewer for little work.")]
Memory = Annotated[str, typer.Option(help="Memory bound of the build, all processes together.")]


def add(
    archive: ArchivePath,
    scans: Annotated[
        list[Path], typer.Argument(help="Scans, folders of scans, or a scans.toml, as for solidcloud build.")
    ],
    again: Annotated[
        bool, typer.Option("--again", help="Also add scans that the archive already contains.")
    ] = False,
    new_only: Annotated[
        bool,
        typer.Option(
            "--new", help="Skip scans that the archive already contains, for a folder that has grown."
        ),
    ] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Fail on a point that is not finite.")] = False,
    jobs: Jobs = 0,
    memory: Memory = "2GB",
    as_json: AsJson = False,
) -> None:
    """Add scans to an archive. Only the voxels that they touch are built again.

    The result is a new generation, which a running server serves after solidcloud reload.
    """
    from .....builder.edit.edit_archive import add_scans
    from .....schemas.runtime.os_errors import naming_write_errors
    from ...output.progress_display import progress_listener

    with (
        interruptible(lambda: _archive_state(archive)),
        naming_write_errors(archive),
        progress_listener() as bars,
    ):
        summary = add_scans(
            archive,
            scans,
            again=again,
            new_only=new_only,
            strict=strict,
            jobs=jobs,
            memory_bytes=parse_bytes(memory, "--memory"),
            progress=bars,
        )
    _print(summary, "added", as_json)


def remove(
    archive: ArchivePath,
    scans: Annotated[
        list[str], typer.Argument(help="Paths or numbers of scans, as solidcloud info prints them.")
    ],
    jobs: Jobs = 0,
    memory: Memory = "2GB",
    as_json: AsJson = False,
) -> None:
    """Remove scans from an archive.

    The archive must have been built with --keep scan. Only the voxels that the scans touch are
    built again. The result is a new generation, which a running server serves after solidcloud
    reload.
    """
    from .....builder.edit.edit_archive import remove_scans
    from .....schemas.runtime.os_errors import naming_write_errors
    from ...output.progress_display import progress_listener

    with (
        interruptible(lambda: _archive_state(archive)),
        naming_write_errors(archive),
        progress_listener() as bars,
    ):
        summary = remove_scans(
            archive, scans, jobs=jobs, memory_bytes=parse_bytes(memory, "--memory"), progress=bars
        )
    _print(summary, "removed", as_json)


def _archive_state(archive: Path) -> str:
    """Return a sentence about the state of an archive after a change to it was interrupted."""
    from .....schemas.archive.archive import Archive
    from .....schemas.errors import FormatError

    try:
        with Archive(archive) as held:
            return f"{archive} is complete, at generation {held.header.generation}"
    except FormatError as error:
        return str(error)


def _print(summary: "ChangeSummary", what: str, as_json: bool) -> None:
    """Print the summary of a change, with its warnings on standard error."""
    for warning in summary.warnings:
        print_warning(warning)
    now = summary.radius_now
    if as_json:
        print_json(
            {
                **summary._asdict(),
                "archive": str(summary.archive),
                "radius_now": None if now is None else now.radius,
                "radius_now_error": None if now is None else now.error,
            }
        )
        return
    from ...output.console import bytes_text, length_text, print_facts

    stages = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in summary.stages.items())
    dead = f", {bytes_text(summary.dead_bytes)} unused in older shards" if summary.dead_bytes else ""
    radius = length_text(summary.radius)
    if now is not None:
        change = 100 * (now.radius / summary.radius - 1) if summary.radius else 0.0
        radius += f", unchanged; measured on the present points: {length_text(now.radius)} ({change:+.1f} %)"
    print_facts(
        (
            ("archive", f"{summary.archive}, generation {summary.generation}"),
            *((what, scan) for scan in summary.scans),
            ("points", f"{summary.points:,}, before {summary.points_before:,}"),
            ("voxels", f"{summary.built:,} of {summary.voxels:,} built, {summary.gone:,} emptied"),
            ("written", f"{bytes_text(summary.bytes)} in new shards{dead}"),
            ("radius", radius),
            *(("left out", f"{count:,} points: {reason}") for reason, count in summary.skipped.items()),
            ("time", f"{summary.seconds:.1f} s ({stages})"),
        )
    )


def reload(
    scene: Annotated[str, typer.Option(help="Name of the scene.")],
    connect: Annotated[str, typer.Option(help="Zenoh endpoint of the server.")] = "tcp/127.0.0.1:7447",
    key_file: KeyFile = None,
    as_json: AsJson = False,
) -> None:
    """Reload an archive in a running server.

    The server loads the present generation of the archive without dropping requests.
    """
    import msgspec

    from ....client import Client

    with Client(connect, scene=scene, key_file=key_file) as client:
        answer = client.reload()
    if as_json:
        print_json(msgspec.to_builtins(answer))
    else:
        print(
            f"{answer.scene}: generation {answer.generation_after}, before {answer.generation_before}; "
            f"{answer.points:,} points, {answer.seconds:.1f} s"
        )
