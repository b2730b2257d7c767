"""Reading an archive to its end, which `add`, `remove` or a build may meanwhile put another in the place of."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..schemas.archive import Archive
from ..schemas.errors import FormatError, SolidcloudError
from ..schemas.index import Header


@contextmanager
def unchanged(folder: Path, header: Header) -> Iterator[None]:
    """Raise SolidcloudError where the archive in `folder` is not that of `header` any more when all is read.

    What was read then is of two archives, and any error met on the way comes of that. Otherwise errors are what they
    were.
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
        return  # whoever reads has told of it, or will
    if (now.archive_id, now.generation) != (header.archive_id, header.generation):
        raise SolidcloudError(
            f"{folder}: changed while it was read, generation {header.generation} and then {now.generation}"
            f"{' of another build' if now.archive_id != header.archive_id else ''}: give the command again"
        )
