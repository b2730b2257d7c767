"""Detection of scans whose points all lie at one position, which are most likely export errors.

Some exporters store a range of 0, at the scanner, for a direction without a return and do not mark
it as invalid.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import ScanError
from .common.scan import Scan

if TYPE_CHECKING:  # it would load the kernels, which a client that reads an avatar does not need
    from ...schemas.archive.index import Source

# A scan with at most this many points whose header declares no bounds is read to check it: some
# milliseconds.
MAX_READ = 1 << 16


def coincident_text(path: Path | str, index: int, count: int) -> str:
    """Return the warning about a scan whose `count` points all lie at one place."""
    return (
        f"{path}: all {count:,} points of scan {index} lie at one place, expected a surface: check what wrote it, or "
        "leave the scan out"
    )


def is_one_position(low: NDArray[np.float64], high: NDArray[np.float64], count: int | None) -> bool:
    """Return whether several points with the bounds low, high (3,) are at one position.

    A single point is no fault.
    """
    return count is not None and count > 1 and bool((low == high).all())


def coincident_sources(sources: "Iterable[Source]") -> tuple[str, ...]:
    """Return a warning for each scan of an archive whose points all lie at one place."""
    return tuple(coincident_text(s.path, s.index, s.count) for s in sources if s.one_place)


def coincident_scan(scan: Scan) -> str:
    """Return the warning about a scan by its header's bounds, or "".

    A small scan without declared bounds is read.
    """
    count = scan.declared_count
    if scan.fault or count is None:
        return ""
    bounds = scan.bounds
    if bounds is None and 1 < count <= MAX_READ:
        bounds = _read_bounds(scan)
    found = bounds is not None and is_one_position(bounds[0], bounds[1], count)
    return coincident_text(scan.path, scan.index, count) if found else ""


def _read_bounds(scan: Scan) -> NDArray[np.float64] | None:
    """Return the bounds (2, 3) of a scan's points, or None if it cannot be read.

    The build reports an unreadable scan later.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    try:
        for block in scan.blocks():
            low = np.minimum(low, block.xyz.min(axis=0, initial=np.inf))
            high = np.maximum(high, block.xyz.max(axis=0, initial=-np.inf))
    except ScanError:
        return None
    return np.stack([low, high])
