"""Base class of all scans, blocks of points, and the errors that readers raise.

A reader is a subclass of Scan that implements `_read`. It holds no open file, only what the header
declares. A scan is therefore small and can be pickled: thousands can be listed and sent to other
processes.
"""

import copy
import errno
import hashlib
import importlib
import re
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import MAX_COORDINATE
from ....schemas.errors import ScanError, SolidcloudError
from ....schemas.runtime.interrupts import check_interrupt
from .colours import CLASS, CLASSIFICATION, class_counts

# A block of 2^18 points is 6 MiB of float64: large enough to hide the cost of one round of the
# Python loop, small enough that a few blocks are negligible beside any --memory.
BLOCK_POINTS = 1 << 18

# Maximum bytes of raw records held at once. A hostile header may claim records of 65,535 bytes
# (LAS) or a thousand properties (PLY); without this bound a block of them would take gigabytes.
BLOCK_BYTES = 64 << 20

# Bytes of a file hashed per read.
HASHED_BYTES = 1 << 20

# Drop reasons of points that are not finite, and of those that lie beyond MAX_COORDINATE.
NOT_FINITE = "not finite"
BEYOND = "beyond 1e9 m"

# Drop reason of directions in which the scanner measured nothing.
NO_RETURN = "no return"

# Maximum deviation of a quaternion's length from 1 (NUMERICS.md, case 4). float32 rounding passes;
# |q| = 1.01, which would stretch space by 1.5 %, does not.
QUATERNION_SLACK = 1e-6

# Margin added to computed bounds [m]: covers float64 rounding up to 1e9 m (0.12 um per operation).
BOUNDS_MARGIN = 1e-6

# Column names of intensity, in lower case; CloudCompare prefixes its own with "scalar_".
INTENSITY_NAMES = ("intensity", "scalar_intensity")


IDENTITY = np.eye(4)
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")


class SourceLattice(NamedTuple):
    """Grid on which a source stores its coordinates, world frame: x = offset + k * scale [m]."""

    scale: tuple[float, float, float]
    offset: tuple[float, float, float]


class ScanBlock(NamedTuple):
    """Some points of a scan.

    xyz: (n, 3) float64, world frame [m], with the scan's pose applied; may hold non-finite values.
    intensity: (n,) float32 in the source's own unit, or None where the source has none.
    rgb: (n, 3) uint8, uint16 or float32 as the file has them (`eight_bits` of colours.py converts).
    classification: (n,) uint8. Both are None where the source has none or they are not wanted.
    """

    xyz: NDArray[np.float64]
    intensity: NDArray[np.float32] | None
    rgb: NDArray[Any] | None = None
    classification: NDArray[np.uint8] | None = None

    def taken(self, which: NDArray[np.bool_]) -> "ScanBlock":
        """Return the selected points."""
        return ScanBlock._make(None if column is None else column[which] for column in self)


class Scan(ABC):
    """One posed point cloud in one file, read in blocks.

    path, index: the file, and the number of this scan in it, from 0.
    format: "las", "laz", "e57", "ply", "pcd", "ptx", "pts", "text", "mesh" or "glb".
    declared_count: number of points the header declares, invalid ones included; None where it
    declares none.
    pose: (4, 4) float64, scan frame -> world frame; the identity where the file has none.
    lattice: the grid of the source's coordinates, or None.
    bounds: (2, 3) float64 world frame [m], low and high corner as the header declares them, or
    None.
    dropped: reason -> number of points the reader left out; reset when blocks() starts, filled
    while it is iterated.
    seekable: True where blocks() can begin and end at any point and reads only that range
    (`SeekableScan`).
    units: unit of the coordinates, see `axis_metres` (units.py). up: the axis that points up,
    "z", "y" or "x". Both are what the file or its format states, or the usual value where these
    state none. blocks() does not convert coordinates.
    units_note: which unit the file states, and where, if that is not the metre; or "".
    crs: the coordinate reference system's text, or "".
    columns: columns that the points have besides coordinates: "intensity", "rgb", "classification".
    wanted: columns, of the last two, that blocks() delivers; set before a scan is read.
    drop_classes: numbers of classes, and SYNTHETIC, whose points blocks() leaves out; likewise.
    fault: error found in this scan's header while other scans of the file are readable; or "".
    notes: what the reader assumed where the header is wrong, one line each; they become warnings.
    """

    seekable = False
    units = "m"
    up = "z"
    units_note = ""
    crs = ""
    columns: frozenset[str] = frozenset()
    wanted: frozenset[str] = frozenset()
    drop_classes: frozenset[int | str] = frozenset()
    fault = ""
    notes: tuple[str, ...] = ()

    def __init__(
        self,
        path: Path,
        format: str,
        *,
        index: int = 0,
        declared_count: int | None = None,
        pose: NDArray[np.float64] | None = None,
        lattice: SourceLattice | None = None,
        bounds: NDArray[np.float64] | None = None,
    ) -> None:
        self.path = path
        self.index = index
        self.format = format
        self.declared_count = declared_count
        self.pose = np.eye(4) if pose is None else pose
        self.lattice = lattice
        self.bounds = bounds
        self.dropped: dict[str, int] = {}

    def trusted_bounds(self) -> NDArray[np.float64] | None:
        """Return the bounds of a scan that cannot be read to its end, or None if they may be damaged.

        A reader that can read more points than blocks() delivers checks that they lie within.
        """
        return self.bounds

    def delivers(self, column: str) -> bool:
        """Return whether blocks() delivers "rgb" or "classification"."""
        wanted = column in self.wanted or (column == CLASSIFICATION and bool(self.drop_classes))
        return wanted and column in self.columns

    def blocks(
        self, block_points: int = BLOCK_POINTS, start: int = 0, stop: int | None = None
    ) -> Iterator[ScanBlock]:
        """Read the points in file order, at most `block_points` at a time.

        start, stop: range of declared points to read, dropped points counted too. Only a seekable
        scan accepts values other than 0 and None.
        Memory is bounded by the block size, whatever the file claims. Each call starts a new pass.
        Raises ScanError when the file is broken or ends before the declared count.
        """
        if block_points < 1:
            raise ValueError(f"block_points is {block_points}, expected at least 1")
        self.dropped = {}
        blocks = self._read_range(block_points, start, stop)
        with library_errors(self.path):
            for block in blocks:
                check_interrupt()
                yield self._without_classes(block)

    def count_classes(self, start: int = 0, stop: int | None = None) -> Counter[str]:
        """Count the points of a range by class, and by WITHHELD and SYNTHETIC if they have such flags.

        The keys are the drop reasons, and "points" for all that were read. Raises as blocks() does.
        """
        scan, found = copy.copy(self), Counter[str]()
        scan.wanted = frozenset({CLASSIFICATION})
        for block in scan.blocks(BLOCK_POINTS, start, stop):
            found += class_counts(block.classification)
        return found

    def _without_classes(self, block: ScanBlock) -> ScanBlock:
        """Return the points of a block whose class is not left out; count the others."""
        if block.classification is None or not self.drop_classes:
            return block
        counts = np.bincount(block.classification, minlength=256)
        drop = [number for number in self.drop_classes if isinstance(number, int) and counts[number]]
        for number in drop:
            reason = f"{CLASS} {number}"
            self.dropped[reason] = self.dropped.get(reason, 0) + int(counts[number])
        return block.taken(~np.isin(block.classification, drop)) if drop else block

    def _read_range(self, block_points: int, start: int, stop: int | None) -> Iterator[ScanBlock]:
        """Return the blocks of a range. Only the whole range is allowed; SeekableScan overrides this."""
        if (start, stop) != (0, None):
            raise ValueError(f"points {start} to {stop} of a scan that cannot seek, expected 0 to None")
        return self._read(block_points)

    @abstractmethod
    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        """Yield all blocks. blocks() converts any exception."""


class SeekableScan(Scan):
    """Scan with directly addressable records; subclasses implement `_read_between`, not `_read`."""

    seekable = True

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        return self._read_range(block_points, 0, None)

    def _read_range(self, block_points: int, start: int, stop: int | None) -> Iterator[ScanBlock]:
        count = self.declared_count or 0
        stop = count if stop is None else stop
        if not 0 <= start <= stop <= count:
            raise ValueError(f"points {start} to {stop} of a scan of {count}")
        return self._read_between(block_points, start, stop) if start < stop else iter(())

    @abstractmethod
    def _read_between(self, block_points: int, start: int, stop: int) -> Iterator[ScanBlock]:
        """Yield the blocks of points [start, stop), start < stop. blocks() converts any exception."""


class BrokenScan(Scan):
    """Unreadable scan in a file with other, readable scans; reading it raises its fault."""

    def __init__(self, path: Path, format: str, index: int, fault: str) -> None:
        super().__init__(path, format, index=index)
        self.fault = fault

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        raise ScanError(self.fault)


def scan_error(path: Path, found: str, expected: str, what_to_do: str) -> ScanError:
    """Build the error for an unreadable scan, in the one message form all readers use.

    found may hold names of the file, whose control characters are escaped.
    """
    found = _CONTROL.sub(lambda each: ascii(each[0])[1:-1], found)
    return ScanError(f"{path}: {found}, expected {expected}: {what_to_do}")


def damaged_error(path: Path, found: str, expected: str) -> ScanError:
    """Build the error for a scan whose file is truncated or damaged, see `scan_error`."""
    return scan_error(path, found, expected, "fetch the file again, it is truncated or damaged")


@contextmanager
def library_errors(path: Path) -> Iterator[None]:
    """Convert exceptions of a format's library or of the file system to ScanError.

    After the command is interrupted, any exception becomes Interrupted. Exhausted memory becomes a
    SolidcloudError.
    """
    try:
        yield
        check_interrupt()
    except SolidcloudError:
        check_interrupt()
        raise
    except BaseException as error:
        if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
            raise SolidcloudError(
                f"{path}: out of memory while reading, expected a few blocks of points to fit: give fewer --jobs "
                "or stop other programs, then give the same command again; if that does not help, leave the file out"
            ) from error
        # A Rust panic inside lazrs is a BaseException subclass, not an Exception.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        check_interrupt()
        # libe57 appends a page of debugging text to its message; the first line is sufficient.
        first_line = next(iter(str(error).strip().splitlines()), "")
        raise scan_error(
            path,
            f"{type(error).__name__} ({first_line})",
            "a readable scan",
            "check the file, or fetch it again from where it came",
        ) from error


def reader_library(name: str, path: Path) -> ModuleType:
    """Import a format's library on first use; unused readers cost no import time.

    Raises ScanError where the library is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise scan_error(
            path,
            f"the library {name!r} to read it is missing ({error})",
            "it to be installed",
            "pip install 'solidcloud[readers]'",
        ) from error


def checked_bounds(bounds: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return header bounds (2, 3) [m], or None where no point could lie in them.

    Writers that do not know the bounds leave zeros, infinities or the largest float64 (some with
    high below low).
    """
    believable = np.isfinite(bounds).all() and (np.abs(bounds) <= MAX_COORDINATE).all()
    if believable and (bounds[0] <= bounds[1]).all() and (bounds[0] < bounds[1]).any():
        return bounds
    return None


def apply_pose(pose: NDArray[np.float64], xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Transform points by a pose: R·p + t, float64.

    pose: (4, 4).
    xyz: (n, 3) [m], scan frame.
    Returns (n, 3) [m], world frame.
    The sum has a fixed order, ((x + y) + z) + t. A matrix product is unsuitable: BLAS chooses its
    order by the number of rows, and the same point would get different bits in a block of another
    size.
    """
    x, y, z = xyz[:, 0], xyz[:, 1], xyz[:, 2]
    if np.array_equal(pose, IDENTITY):
        return xyz
    moved = np.empty_like(xyz)
    with np.errstate(over="ignore", invalid="ignore"):  # non-finite points stay non-finite
        for axis in range(3):
            r = pose[axis]
            moved[:, axis] = ((x * r[0] + y * r[1]) + z * r[2]) + r[3]
    return moved


def quaternion_pose(
    path: Path, index: int, quaternion: Sequence[float | None], translation: Sequence[float | None]
) -> NDArray[np.float64]:
    """Return the pose (4, 4) of a rotation w, x, y, z and a translation x, y, z [m].

    A part that is None becomes the identity. So does a rotation of 0 0 0 0, which programs write if
    they know no rotation, see `zero_rotation_note`. index: number of the scan, for the message.
    Raises ScanError for values that form no pose.
    """
    pose = np.eye(4)
    given = [number for number in (*quaternion, *translation) if number is not None]
    whole = list(quaternion).count(None) % 4 == 0 and list(translation).count(None) % 3 == 0
    if not whole or not np.isfinite(given).all():
        raise scan_error(
            path,
            f"scan {index} with rotation {list(quaternion)} and translation {list(translation)}",
            "four and three finite numbers",
            "register the scan again",
        )
    if None not in quaternion and any(quaternion):
        w, x, y, z = (float(number or 0.0) for number in quaternion)
        length = np.sqrt(w * w + x * x + y * y + z * z)
        if not abs(length - 1.0) <= QUATERNION_SLACK:
            raise scan_error(
                path,
                f"scan {index} with a rotation quaternion of length {length:.9g}",
                f"1 within {QUATERNION_SLACK:g}",
                "register the scan again",
            )
        w, x, y, z = w / length, x / length, y / length, z / length
        pose[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    if None not in translation:
        pose[:3, 3] = [float(number or 0.0) for number in translation]
    return pose


def zero_rotation_note(path: Path, index: int, rotation: Sequence[float | None]) -> tuple[str, ...]:
    """Return the note about a scan whose rotation is zero, or (). rotation: its numbers in a row."""
    if None in rotation or any(rotation):
        return ()
    return (f"{path}: scan {index} has a rotation of zeros, read as no rotation: check how the scan lies",)


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's bytes in hexadecimal, reading it as a stream. Raises ScanError."""
    with library_errors(path), path.open("rb", buffering=0) as file:
        digest, buffer = hashlib.sha256(), memoryview(bytearray(HASHED_BYTES))
        while size := file.readinto(buffer):
            check_interrupt()
            digest.update(buffer[:size])
    return digest.hexdigest()
