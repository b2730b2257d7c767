"""Numbers of a scan's points by class and flag, for `solidcloud inspect`: exact, or by a sample."""

from collections import Counter

from ...schemas.errors import ScanError
from ...schemas.runtime.interrupts import check_interrupt
from .common.colours import CLASSIFICATION
from .common.scan import Scan

# Points read in total, at least of a file, and in how many ranges, to count those of a class; and
# bytes of a file that cannot seek and is read whole for this. LAZ takes about 0.2 s for 10^6
# points.
COUNTED_POINTS, LEAST_COUNTED, COUNTED_RANGES, COUNTED_BYTES = 10**7, 1 << 15, 4, 16 << 20


def counted_points(files: int) -> int:
    """Return how many points of each of some files are read to count classes."""
    return max(LEAST_COUNTED, COUNTED_POINTS // max(1, files))


def count_classes(scan: Scan, most: int) -> Counter[str] | None:
    """Count the points of a scan by class and flag, see `Scan.count_classes`.

    most: if the scan has more points and can seek, this many are read, in ranges over all of it.
    The result is None for other large files, and for a scan without classes or that cannot be read.
    """
    count = scan.declared_count or 0
    try:
        if scan.fault or CLASSIFICATION not in scan.columns:
            return None
        if count <= most if scan.seekable else scan.path.stat().st_size <= COUNTED_BYTES:
            return scan.count_classes()
        if not scan.seekable:
            return None
        part = most // COUNTED_RANGES
        starts = [k * (count - part) // (COUNTED_RANGES - 1) for k in range(COUNTED_RANGES)]
        return sum((scan.count_classes(start, start + part) for start in starts), Counter[str]())
    except (ScanError, OSError):
        check_interrupt()
        return None  # the build reports it
