"""What every scan reader gives: a scan, its blocks of points, and the errors it ends in.

A reader is a subclass of Scan that implements `_read`. It holds no open file, only what the header said,
so that scans can be listed by the thousand and sent to other processes.
"""

import errno
import hashlib
import importlib
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import ScanError, SolidcloudError
from ...schemas.interrupts import check

# A block of 2^18 points is 6 MiB of float64: large enough that the cost of a Python loop round is lost in
# it, small enough that a few of them count as nothing beside any --memory.
BLOCK_POINTS = 1 << 18

# Bytes of raw records held at once. A hostile header may claim records of 65,535 bytes (LAS) or a thousand
# properties (PLY); without this bound a block of them would be gigabytes.
BLOCK_BYTES = 64 << 20

# Bytes of a file that are hashed at a time.
HASHED_BYTES = 1 << 20

# No coordinate is farther from the origin than this [m] (NUMERICS.md, case 16).
FARTHEST = 1e9

# The reason under which points are counted that are not finite, or beyond FARTHEST.
NOT_FINITE = "not finite"

# The reason under which directions are counted that a scanner measured nothing in.
NO_RETURN = "no return"

# How far a quaternion's length may be from 1 (NUMERICS.md, case 4): float32 rounding passes, |q| = 1.01,
# which would stretch space by 1.5 %, does not.
QUATERNION_SLACK = 1e-6

# Added to bounds that were computed and not read [m]: covers float64 rounding up to 1e9 m (0.12 um a step).
BOUNDS_MARGIN = 1e-6

# Names a column of intensities goes by, in lower case; CloudCompare writes "scalar_" before its own.
INTENSITY_NAMES = ("intensity", "scalar_intensity")


_IDENTITY = np.eye(4)


class Lattice(NamedTuple):
    """The grid a source's own coordinates lie on, world frame: x = offset + k * scale [m]."""

    scale: tuple[float, float, float]
    offset: tuple[float, float, float]


class Block(NamedTuple):
    """Some points of a scan.

    xyz: (n, 3) float64, world frame [m], the scan's pose applied; may hold non-finite values.
    intensity: (n,) float32 in the source's own unit, or None where the source has none.
    """

    xyz: NDArray[np.float64]
    intensity: NDArray[np.float32] | None


class Scan(ABC):
    """One posed cloud in one file, read in blocks.

    path, index: the file, and which of its scans this is, from 0.
    format: "las", "laz", "e57", "ply", "pcd", "ptx", "pts", "text", "mesh" or "glb".
    declared_count: points the header says there are, invalid ones included; None where it says nothing.
    pose: (4, 4) float64, scan frame -> world frame, the identity where the file has none.
    lattice: the grid of the source's coordinates, None where there is none.
    bounds: (2, 3) float64 world frame [m], low and high corner as the header declares them, or None.
    dropped: reason -> points left out by the reader; filled while blocks() is iterated, reset when it starts.
    seekable: blocks() can begin and end anywhere, at the cost of what it reads (`SeekableScan`).
    units: what one of its lengths is, a key of METRES (placed.py); up: its axis that is up, "z", "y" or "x"; as the
    format prescribes or, usual, nobody says. blocks() gives coordinates as they are.  crs: the coordinate reference
    system's text, or "".  fault: what is wrong with it by its header, though others of its file can be read; or "".
    """

    seekable = False
    units = "m"
    up = "z"
    crs = ""
    fault = ""

    def __init__(
        self,
        path: Path,
        format: str,
        *,
        index: int = 0,
        declared_count: int | None = None,
        pose: NDArray[np.float64] | None = None,
        lattice: Lattice | None = None,
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

    def blocks(
        self, block_points: int = BLOCK_POINTS, start: int = 0, stop: int | None = None
    ) -> Iterator[Block]:
        """Read the points, in the order of the file, at most `block_points` at a time.

        start, stop: which of the declared points to read, those that are dropped counted too; only a seekable scan
        takes other than 0 and None. Memory is bounded by the block, whatever the file claims. Each call starts anew.
        Raises ScanError when the file is broken or ends before its header said.
        """
        if block_points < 1:
            raise ValueError(f"block_points is {block_points}, expected at least 1")
        self.dropped = {}
        blocks = self._read_range(block_points, start, stop)
        with library_errors(self.path):
            for block in blocks:
                check()
                yield block

    def _read_range(self, block_points: int, start: int, stop: int | None) -> Iterator[Block]:
        """The blocks of a range; refuses any but the whole, which SeekableScan does not."""
        if (start, stop) != (0, None):
            raise ValueError(f"points {start} to {stop} of a scan that cannot seek, expected 0 to None")
        return self._read(block_points)

    @abstractmethod
    def _read(self, block_points: int) -> Iterator[Block]:
        """Yield the blocks; may raise anything, blocks() converts it."""


class SeekableScan(Scan):
    """A scan of records that can be found without reading those before: `_read_between` in place of `_read`."""

    seekable = True

    def _read(self, block_points: int) -> Iterator[Block]:
        return self._read_range(block_points, 0, None)

    def _read_range(self, block_points: int, start: int, stop: int | None) -> Iterator[Block]:
        count = self.declared_count or 0
        stop = count if stop is None else stop
        if not 0 <= start <= stop <= count:
            raise ValueError(f"points {start} to {stop} of a scan of {count}")
        return self._read_between(block_points, start, stop) if start < stop else iter(())

    @abstractmethod
    def _read_between(self, block_points: int, start: int, stop: int) -> Iterator[Block]:
        """Yield the blocks of points [start, stop), start < stop; may raise anything, blocks() converts it."""


class BrokenScan(Scan):
    """A scan that cannot be read, of a file in which others can: reading it raises its fault."""

    def __init__(self, path: Path, format: str, index: int, fault: str) -> None:
        super().__init__(path, format, index=index)
        self.fault = fault

    def _read(self, block_points: int) -> Iterator[Block]:
        raise ScanError(self.fault)


def read_records(
    file: BufferedReader, path: Path, record: np.dtype[Any], count: int, block_points: int, what: str
) -> Iterator[NDArray[Any]]:
    """Read `count` records of one size from where the file stands, in blocks of bounded memory.

    what: of the records, for the message.  Yields (n,) of `record`, n > 0, overwritten by the next.
    Raises ScanError where the file ends before.
    """
    step = max(1, min(block_points, count, BLOCK_BYTES // record.itemsize))
    # One buffer for all blocks: fresh memory a block costs as much in page faults as the copy into it.
    buffer = np.empty(step, record)
    raw = buffer.view(np.uint8).data
    for seen in range(0, count, step):
        wanted = min(step, count - seen)
        # readinto() of a buffered file reads on until it has all, or the file ends.
        got = file.readinto(raw[: wanted * record.itemsize]) // record.itemsize
        if got < wanted:
            raise scan_error(
                path,
                f"the file ends {count - seen - got} {what} too soon",
                "as many as its header declares",
                "fetch the file again, it is truncated",
            )
        yield buffer[:wanted]


def scan_error(path: Path, found: str, expected: str, what_to_do: str) -> ScanError:
    """The error for a scan that cannot be read; every reader's message has this one form."""
    return ScanError(f"{path}: {found}, expected {expected}: {what_to_do}")


@contextmanager
def library_errors(path: Path) -> Iterator[None]:
    """Turn whatever a format's library or the file system raises into a ScanError.

    What is raised once the command is interrupted is Interrupted, and that memory ran out is a SolidcloudError.
    """
    try:
        yield
        check()
    except SolidcloudError:
        check()
        raise
    except BaseException as error:
        if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM):
            raise SolidcloudError(
                f"{path}: out of memory while it was read, expected a few blocks of points to fit: give fewer --jobs "
                "or stop other programs, then the same command again; where that does not help, leave it out"
            ) from error
        # A panic inside lazrs (Rust) is a BaseException of its own and not an Exception.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        check()
        # libe57 appends a page of debugging text to its message; the first line says it all.
        first_line = next(iter(str(error).strip().splitlines()), "")
        raise scan_error(
            path,
            f"{type(error).__name__} ({first_line})",
            "a readable scan",
            "check the file, or fetch it again from where it came",
        ) from error


def reader_library(name: str, path: Path) -> ModuleType:
    """Import a format's library on first use, so that nobody pays for readers they do not use.

    Raises ScanError where it is not installed.
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
    """Bounds out of a header, (2, 3) [m], or None where they are no box a point could be in.

    Writers that do not know them leave zeros, infinities or the largest float64 (high below low in some).
    """
    believable = np.isfinite(bounds).all() and (np.abs(bounds) <= FARTHEST).all()
    if believable and (bounds[0] <= bounds[1]).all() and (bounds[0] < bounds[1]).any():
        return bounds
    return None


def apply_pose(pose: NDArray[np.float64], xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Move points by a pose: R·p + t, float64.

    pose: (4, 4).  xyz: (n, 3) [m], scan frame.  Returns (n, 3) [m], world frame.
    Summed in one order, ((x + y) + z) + t, and not by a matrix product: BLAS chooses its order by the
    number of rows, so the same point would come out with other bits in a block of another size.
    """
    x, y, z = xyz[:, 0], xyz[:, 1], xyz[:, 2]
    if np.array_equal(pose, _IDENTITY):
        return xyz
    moved = np.empty_like(xyz)
    with np.errstate(over="ignore", invalid="ignore"):  # points that are not finite stay so
        for axis in range(3):
            r = pose[axis]
            moved[:, axis] = ((x * r[0] + y * r[1]) + z * r[2]) + r[3]
    return moved


def quaternion_pose(
    path: Path, index: int, quaternion: Sequence[float | None], translation: Sequence[float | None]
) -> NDArray[np.float64]:
    """A pose (4, 4) of a rotation w, x, y, z and a translation x, y, z [m]; the identity for what is None.

    index: of the scan, for the message. Raises ScanError for numbers that are no pose.
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
    if None not in quaternion:
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


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file's bytes in hexadecimal, read as a stream. Raises ScanError."""
    with library_errors(path), path.open("rb", buffering=0) as file:
        digest, buffer = hashlib.sha256(), memoryview(bytearray(HASHED_BYTES))
        while size := file.readinto(buffer):
            check()
            digest.update(buffer[:size])
    return digest.hexdigest()
