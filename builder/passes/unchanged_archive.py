"""Detection of an archive that `add`, `remove` or a build replaces while it is being read."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ...schemas.archive.archive import Archive
from ...schemas.archive.index import Header
from ...schemas.errors import FormatError, SolidcloudError


@contextmanager
def unchanged(folder: Path, header: Header) -> Iterator[None]:
    """Raise SolidcloudError if the archive in `folder` no longer is that of `header` after reading.

    What was read is then a mix of two archives, and any error on the way is a consequence.
    Otherwise errors pass unchanged.
    """
    try:
        yield
    except Exception:
        _check(folder, header)
        raise
    _check(folder, header)


def _check(folder: Path, header: Header) -> None:
    try:
        with Archive(folder) as archive:
            now = archive.header
    except (FormatError, OSError):
        return  # the reader has reported it, or will
    if (now.archive_id, now.generation) != (header.archive_id, header.generation):
        raise SolidcloudError(
            f"{folder}: changed while it was read, generation {header.generation} and then {now.generation}"
            f"{' of another build' if now.archive_id != header.archive_id else ''}: give the command again"
        )
