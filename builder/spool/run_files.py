"""Files of sorted runs: rows of points on disk, each with a directory of its voxels.

A run consists of two files that share only their name:

- `NAME.run`: packed rows, see `spool_dtype`, sorted by (voxel key, Morton code in the voxel,
  scan_index, intensity, rgb, classification);
- `NAME.keys`: its directory, uint64 words: the keys of its voxels, ascending, then the first row of
  each voxel, then the total number of rows. `s` voxels take `2 s + 1` words.

The files contain no checksums; journal entries record their sizes and checksums (`RunSums`).
"""

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive_writer import file_checksum
from ...schemas.archive.voxel_grid import Lattice, voxel_coordinates
from ...schemas.errors import CorruptError
from ...schemas.runtime.new_file import new_file
from ..config import BuildConfig
from ..kernels.points.content_hash import SEEDS, content_sum
from ..kernels.points.octree_cells import voxel_codes
from .point_order import sort_keys

RUN_SUFFIX = ".run"
KEYS_SUFFIX = ".keys"
# A voxel key has three coordinates of 21 bits.
KEY_BITS = 63

# Sums of a run as a JSON value: size and `file_checksum` of NAME.run, then those of NAME.keys.
RunSums = list[int]


def spool_dtype(config: BuildConfig) -> np.dtype:
    """Return the dtype of a row of the spool."""
    fields: list[tuple[Any, ...]] = [("local", "<i4", (3,))]
    if "scan" in config.keep:
        fields.append(("scan_index", "<u2"))
    return np.dtype(fields + _scan_columns(config))


def _scan_columns(config: BuildConfig) -> list[tuple[Any, ...]]:
    """Return the fields of a row that hold what the scans say of a point."""
    kinds: list[tuple[Any, ...]] = [("intensity", "<f4"), ("rgb", "u1", (3,)), ("classification", "u1")]
    return [kind for kind in kinds if kind[0] in config.keep]


def filter_dtype(config: BuildConfig) -> np.dtype:
    """Return the dtype of spool rows that the filters read.

    It always has the scan number, which the filters need and count by, whatever columns are kept.
    """
    fields: list[tuple[Any, ...]] = [("local", "<i4", (3,)), ("scan_index", "<u2")]
    return np.dtype(fields + _scan_columns(config))


def canonical_columns(rows: NDArray) -> tuple[NDArray, ...]:
    """Return the sort keys of rows within a Morton code, least significant first (np.lexsort)."""
    return sort_keys({name: rows[name] for name in rows.dtype.names or ()})


def ranks(bits: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Return integers ordered like the float32 values of these bits.

    NaN is last, as in np.lexsort.
    """
    negative = (bits >> np.uint32(31)).astype(bool)
    return np.where(negative, ~bits, bits | np.uint32(1 << 31)).astype(np.uint32)


def row_codes(rows: NDArray) -> NDArray[np.uint64]:
    """Return the Morton codes (n,) of rows in their voxel."""
    return np.asarray(voxel_codes(np.ascontiguousarray(rows["local"])), np.uint64)


def position_hash(key: int, local: NDArray[np.int32], lattice: Lattice) -> int:
    """Return the sum modulo 2^64 of a hash of the lattice coordinates of each point of a voxel.

    local: (n, 3) coordinates in the voxel.
    """
    corner = voxel_coordinates(np.array([key], np.uint64))[0] * lattice.voxel_steps
    return int(content_sum(np.ascontiguousarray((local + corner).T).view(np.uint64), SEEDS[0]))


class SummedFile:
    """File being written, with the sums of its contents. sums: size, and `file_checksum`."""

    def __init__(self, file: BinaryIO) -> None:
        """Start with empty sums."""
        self._file, self.sums = file, [0, 0]

    def write(self, data: bytes | memoryview) -> None:
        """Append bytes."""
        self._file.write(data)
        # The checksum is of the data in memory, because it has to detect a disk that reads back
        # other data.
        self.sums = [self.sums[0] + len(data), zlib.crc32(data, self.sums[1])]


@contextmanager
def new_run(path: Path) -> Iterator[SummedFile]:
    """Open the file of a run, to be written in order.

    It gets its name when complete and durable.
    """
    with new_file(path) as file:
        yield SummedFile(file)


def write_directory(path: Path, keys: NDArray[np.uint64], starts: NDArray[np.int64]) -> list[int]:
    """Write the directory of the run `path`; return its sums.

    keys: (s,) ascending.  starts: (s + 1,) ascending.
    """
    with new_run(path.with_suffix(KEYS_SUFFIX)) as file:
        file.write(np.concatenate([keys.astype("<u8"), starts.astype("<u8")]).tobytes())
    return file.sums


def run_sizes(path: Path) -> tuple[int | None, int | None]:
    """Return the sizes of a run's two files; None for a missing file."""
    files = (path, path.with_suffix(KEYS_SUFFIX))
    first, second = (file.stat().st_size if file.is_file() else None for file in files)
    return first, second


def is_run_damaged(path: Path, sums: RunSums) -> bool:
    """Return whether a run differs from what was written and is therefore unusable.

    Reads both files.

    A missing file does not count as damage: results that were made from the run are correct.
    """
    written = zip((path, path.with_suffix(KEYS_SUFFIX)), sums[::2], sums[1::2], strict=True)
    return any(
        file.is_file() and (file.stat().st_size != size or file_checksum(file) != checksum)
        for file, size, checksum in written
    )


def read_directory(path: Path, row_bytes: int) -> tuple[NDArray[np.uint64], NDArray[np.int64]]:
    """Read keys (s,) and starts (s + 1,) of the run `path`.

    row_bytes: size of its rows. Raise CorruptError for words that cannot be a directory of this
    run. Only the checksum detects a directory that is possible but differs from what was written.
    """
    words = np.fromfile(path.with_suffix(KEYS_SUFFIX), "<u8")
    voxels = len(words) // 2
    keys, starts = words[:voxels], words[voxels:]
    if (
        path.with_suffix(KEYS_SUFFIX).stat().st_size != 8 * (2 * voxels + 1)
        or (keys[1:] <= keys[:-1]).any()
        or (keys >> np.uint64(KEY_BITS)).any()
        or starts[0] != 0
        or (starts[1:] <= starts[:-1]).any()
        or int(starts[-1]) * row_bytes != path.stat().st_size
    ):
        raise CorruptError(
            f"{path.with_suffix(KEYS_SUFFIX)}: not the directory of {path.name}, {path.stat().st_size} bytes: "
            "check the disk, and give the same command again",
            (path,),
        )
    return keys, starts.astype(np.int64)
