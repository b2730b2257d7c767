"""Transient errors of reading a scan, such as those of a network, which are not faults of the scan.

They end the build, because the archive would otherwise lack a valid scan.
"""

import errno
from pathlib import Path

from ...schemas.errors import ScanError
from ...schemas.runtime.interrupts import check_interrupt

# Errors of a disk, a network or an overloaded machine.
TRANSIENT = frozenset(
    {errno.EIO, errno.EMFILE, errno.ENFILE, errno.ENODEV, errno.ENXIO, errno.ESTALE, errno.ETIMEDOUT,
     errno.ENOTCONN, errno.EHOSTDOWN, errno.EHOSTUNREACH, errno.EREMOTEIO}
)  # fmt: skip


def raise_transient(error: ScanError, path: Path) -> None:
    """Raise Interrupted or the OSError if a file could not be read for a transient reason.

    Lack of memory is detected where it occurs, in every pass (sources/common/scan.py
    `library_errors`).
    """
    check_interrupt()
    cause = error.__cause__
    if isinstance(cause, OSError) and cause.errno in TRANSIENT:
        raise OSError(cause.errno, cause.strerror, str(path)) from None
