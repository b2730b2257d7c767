"""`solidcloud level`: write the level of detail of an existing archive."""

from ..command_options import ArchivePath, interruptible, parse_bytes
from .add_remove_command import Jobs, Memory


def level(archive: ArchivePath, jobs: Jobs = 0, memory: Memory = "2GB") -> None:
    """Write the level of detail of an archive.

    Builds write one, unless --no-level is given; archives of earlier versions have none.
    """
    from .....builder.edit.renew_level import renew_level
    from .....schemas.process.os_errors import naming_write_errors
    from ...output.progress_display import progress_listener

    with (
        interruptible(lambda: f"{archive} is what it was"),
        naming_write_errors(archive),
        progress_listener() as bars,
    ):
        renew_level(archive, jobs=jobs, memory_bytes=parse_bytes(memory, "--memory"), progress=bars)
    print(f"{archive}: has a level of detail; a running server uses it after `solidcloud reload`")
