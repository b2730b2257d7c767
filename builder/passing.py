"""Errors of reading a scan that are none of the scan's: what is left out for one is left out for good."""

import errno
from pathlib import Path

from ..schemas.errors import ScanError
from ..schemas.interrupts import check

# Errors of a disk, a network or a machine with too much to do.
PASSING = frozenset(
    {errno.EIO, errno.EMFILE, errno.ENFILE, errno.ENODEV, errno.ENXIO, errno.ESTALE, errno.ETIMEDOUT,
     errno.ENOTCONN, errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.EREMOTEIO}
)  # fmt: skip


def raise_passing(error: ScanError, path: Path) -> None:
    """Raise where a file could not be read for a reason that is no fault of the scan: Interrupted, or the OSError.

    That there was no memory is told apart where it is found, in every pass (sources/scan.py `library_errors`).
    """
    check()
    cause = error.__cause__
    if isinstance(cause, OSError) and cause.errno in PASSING:
        raise OSError(cause.errno, cause.strerror, str(path)) from None
