"""Level of detail of an existing archive, written anew."""

from pathlib import Path

from ..passes.level_pass import replace_level, write_level
from ..run.executor import Progress
from .archive_change import changing


def renew_level(
    target: Path, *, jobs: int = 0, memory_bytes: int = 2 << 30, progress: Progress | None = None
) -> None:
    """Write the level of the archive in `target`, in place of an earlier one if there is one.

    The archive itself is unchanged, and its old level remains until the new one is complete. Raise
    FormatError or CorruptError if the archive cannot be read, SolidcloudError if the memory does
    not suffice.
    """
    with changing(Path(target), jobs, memory_bytes, progress) as change:
        points = change.archive.header.points
        with change.reading(change.points), change.stage("level", points, "points"):
            write_level(change.target, change.executor, change.progress, change.folder / "level")
        replace_level(change.target, change.folder / "level", change.folder / "old level")
