"""Spool: all points of a build, quantised, in sorted runs on disk.

Voxels are read from the runs in order. A run consists of two files that share only their name:

- `NAME.run`: packed rows, see `spool_dtype`, sorted by (voxel key, Morton code in the voxel,
  scan_index, intensity);
- `NAME.keys`: its directory, uint64 words: the keys of its voxels, ascending, then the first row of
  each voxel, then the total number of rows. `s` voxels take `2 s + 1` words.

The files contain no checksums; journal entries record their sizes and checksums (`RunSums`). A
`Spool` is a folder of runs. It holds no rows: each access reads the rows of a voxel from the few
runs that have some.
"""

import json
import os
import uuid
import zlib
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive_writer import file_checksum
from ...schemas.archive.voxel_grid import Lattice, voxel_coordinates
from ...schemas.errors import CorruptError
from ...schemas.process.interrupts import check_interrupt
from ..config import BuildConfig
from ..kernels.points.content_hash import SEEDS, content_sum
from ..kernels.points.octree_cells import voxel_codes
from ..resume.journal import TEMPORARY_SUFFIX, new_file

RUN_SUFFIX = ".run"
KEYS_SUFFIX = ".keys"
# Suffix of the file of all merged directories.
MERGED_SUFFIX = f".directory{TEMPORARY_SUFFIX}"
# Voxels of runs that are merged at a time. Merging all of 1,400 runs of 1,500 voxels each at once
# took 200 MB in each process; 5,000 scans would have taken two gigabytes.
MERGED_ENTRIES = 1 << 18

# Distance in rows between the Morton codes that are read to find a block of a voxel in a run. One
# more read of this many rows, 48 kB, then finds the end of a block. 10^8 rows need 24,000 codes.
CODE_STRIDE = 4096
# A voxel key has three coordinates of 21 bits.
KEY_BITS = 63

# Sums of a run as a JSON value: size and `file_checksum` of NAME.run, then those of NAME.keys.
RunSums = list[int]


def spool_dtype(config: BuildConfig) -> np.dtype:
    """Return the dtype of a row of the spool."""
    fields: list[tuple[Any, ...]] = [("local", "<i4", (3,))]
    if "scan" in config.keep:
        fields.append(("scan_index", "<u2"))
    if "intensity" in config.keep:
        fields.append(("intensity", "<f4"))
    return np.dtype(fields)


def canonical_columns(rows: NDArray) -> tuple[NDArray, ...]:
    """Return the sort keys of rows within a Morton code, least significant first (np.lexsort)."""
    return tuple(rows[name] for name in ("intensity", "scan_index") if name in (rows.dtype.names or ()))


def row_codes(rows: NDArray) -> NDArray[np.uint64]:
    """Return the Morton codes (n,) of rows in their voxel."""
    return np.asarray(voxel_codes(np.ascontiguousarray(rows["local"])), np.uint64)


def places_sum(key: int, local: NDArray[np.int32], lattice: Lattice) -> int:
    """Return the sum modulo 2^64 of a hash of the lattice coordinates of each point of a voxel.

    local: (n, 3) coordinates in the voxel.
    """
    corner = voxel_coordinates(np.array([key], np.uint64))[0] * lattice.voxel_steps
    return int(content_sum(np.ascontiguousarray((local + corner).T).view(np.uint64), SEEDS[0]))


def write_run(path: Path, keys: NDArray[np.uint64], rows: NDArray) -> None:
    """Sort rows (n,) and write them as the run `path` (NAME.run). n >= 1.

    keys: (n,) voxel of each row.
    """
    order = np.lexsort((*canonical_columns(rows), row_codes(rows), keys))
    rows, keys = rows[order], keys[order]
    found, starts = np.unique(keys, return_index=True)
    with new_run(path) as file:
        file.write(rows.tobytes())
    write_directory(path, found, np.append(starts, len(keys)).astype(np.int64))


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


def is_other_run(path: Path, sums: RunSums) -> bool:
    """Return whether a run differs from what was written and is therefore unusable.

    Reads both files.

    A missing file is no difference: what was made from the run while it existed is correct.
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


class _Part(NamedTuple):
    """Consecutive rows of one voxel in one run: `size` rows from row `start` on."""

    run: int
    start: int
    size: int


class _Directory(NamedTuple):
    """Merged directories of all runs. Rows first[i] to first[i + 1] of `entries` belong to voxel i.

    keys, counts: (v,), see Spool.  first: (v + 1,).  entries: (e, 3): run, start, size. All arrays
    are mapped from a file.
    """

    paths: list[Path]
    keys: NDArray[np.uint64]
    counts: NDArray[np.int64]
    first: NDArray[np.int64]
    entries: NDArray[np.int64]


def _merge_directories(paths: Sequence[Path], row_bytes: int, path: Path) -> None:
    """Merge the directories of runs and write them as the file `path`.

    row_bytes: size of the rows of the runs.
    The file holds uint64 words: the numbers of voxels, of entries, and of bytes of names; keys,
    first, entries and counts as in `_Directory`; then the runs' names as JSON. This takes 24 bytes
    of memory per voxel, and 100 per entry of MERGED_ENTRIES.
    """
    keys = _all_keys(paths, row_bytes)
    pairs = np.zeros(len(keys) + 1, np.int64)
    for run in paths:
        pairs[1 + np.searchsorted(keys, read_directory(run, row_bytes)[0])] += 1
    first = np.cumsum(pairs)
    counts = np.empty(len(keys), np.int64)
    names = json.dumps([run.name for run in paths]).encode()
    with open(path, "wb") as file:
        file.write(np.array([len(keys), first[-1], len(names)], "<u8").tobytes())
        file.write(keys.astype("<u8").tobytes() + first.astype("<i8").tobytes())
        begin = 0
        while begin < len(keys):
            most = int(first[begin]) + MERGED_ENTRIES
            end = max(begin + 1, int(np.searchsorted(first, most, "right")) - 1)
            table = _entries_of(paths, row_bytes, keys[begin], keys[end - 1])
            counts[begin:end] = np.add.reduceat(table[:, 2], first[begin:end] - first[begin])
            file.write(table.astype("<i8").tobytes())
            begin = end
        file.write(counts.astype("<i8").tobytes() + names)


def _all_keys(paths: Sequence[Path], row_bytes: int) -> NDArray[np.uint64]:
    """Return the keys of all voxels in some runs, ascending."""
    keys, waiting, held = np.empty(0, np.uint64), [np.empty(0, np.uint64)], 0
    for run in paths:
        waiting.append(read_directory(run, row_bytes)[0])
        held += len(waiting[-1])
        if held > MERGED_ENTRIES:
            keys, waiting, held = np.unique(np.concatenate([keys, *waiting])), [], 0
    return np.unique(np.concatenate([keys, *waiting]))


def _entries_of(paths: Sequence[Path], row_bytes: int, low: np.uint64, high: np.uint64) -> NDArray[np.int64]:
    """Return run, start and size (e, 3) of the voxels `low` to `high`, sorted by key, then run."""
    keys, tables = [], []
    for number, run in enumerate(paths):
        found, starts = read_directory(run, row_bytes)
        which = slice(int(np.searchsorted(found, low)), int(np.searchsorted(found, high, "right")))
        begin, end = starts[:-1][which], starts[1:][which]
        keys.append(found[which].copy())
        tables.append(np.stack([np.full(len(begin), number), begin, end - begin], axis=1))
    return np.concatenate(tables)[np.argsort(np.concatenate(keys), kind="stable")]


def _open_directories(path: Path) -> _Directory:
    """Map the file of `_merge_directories`: a process that needs a few voxels loads only these."""
    words = np.asarray(np.memmap(path, "<i8", "r", shape=(path.stat().st_size // 8,)))
    voxels, entries, length = (int(n) for n in words[:3])
    ends = np.cumsum([3, voxels, voxels + 1, 3 * entries, voxels])
    keys, first, table, counts = (words[a:b] for a, b in pairwise(ends.tolist()))
    with open(path, "rb") as file:
        file.seek(8 * int(ends[-1]))
        names = json.loads(file.read(length))
    paths = [path.parent / name for name in names]
    return _Directory(paths, keys.view(np.uint64), counts, first, table.reshape(-1, 3))


class Spool:
    """Folder of sorted runs. Picklable and small; its directories are read on first use.

    Safe in any process, and from one thread at a time. Open it after all runs are written: it does
    not see later ones.
    places: the `places_sum` that all its rows must have; None: not known.
    """

    def __init__(
        self,
        folder: Path,
        dtype: np.dtype,
        lattice: Lattice,
        runs: Collection[str] | None = None,
        places: int | None = None,
    ) -> None:
        """Use the runs in `folder`, with rows of `dtype` and voxels of `lattice`.

        Reads nothing yet.

        runs: names of the runs to use; None: all in the folder.
        """
        self.folder, self.dtype, self.lattice = Path(folder), np.dtype(dtype), lattice
        self.runs, self.places = None if runs is None else tuple(sorted(runs)), places
        self._file: Path | None = None
        self._directory: _Directory | None = None
        self._sampled: tuple[int, list[NDArray[np.uint64]]] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to pickle.

        The directories are merged first, into a file that each process maps.
        """
        self._merged()
        return {**self.__dict__, "runs": (), "_directory": None, "_sampled": None}

    @property
    def keys(self) -> NDArray[np.uint64]:
        """Return the keys (v,) of the voxels that hold points, ascending."""
        return self._merged().keys

    @property
    def counts(self) -> NDArray[np.int64]:
        """Return the number of points (v,) of each voxel of `keys`."""
        return self._merged().counts

    def count(self, key: int) -> int:
        """Return the number of points of a voxel; 0 if the voxel has none."""
        return sum(part.size for part in self._parts(key))

    def rows(self, key: int) -> list[NDArray]:
        """Return the rows of a voxel, one array per run that has some, each in canonical order."""
        return [self._read(part) for part in self._parts(key)]

    def block_count(self, key: int, code_lo: int, code_hi: int) -> int:
        """Return how many points of a voxel have a Morton code in [code_lo, code_hi)."""
        return sum(part.size for part in self._block(key, code_lo, code_hi))

    def block_rows(self, key: int, code_lo: int, code_hi: int) -> list[NDArray]:
        """Return the rows of a voxel in a Morton code range, one array per run that has some.

        The range is [code_lo, code_hi).
        """
        return [self._read(part) for part in self._block(key, code_lo, code_hi)]

    def block_windows(self, key: int, code_lo: int, code_hi: int, points: int) -> list[Iterator[NDArray]]:
        """Iterate over the same rows window by window, with one iterator per run.

        One window of each iterator together have about `points` points.
        """
        parts = self._block(key, code_lo, code_hi)
        most = max(1, points // max(1, len(parts)))
        return [self._windows(part, most) for part in parts]

    def _windows(self, part: _Part, most: int) -> Iterator[NDArray]:
        """Yield the rows of a part, at most `most` at a time."""
        for at in range(0, part.size, most):
            yield self._read(_Part(part.run, part.start + at, min(most, part.size - at)))

    def _merged(self) -> _Directory:
        """Return the merged directories, sorted by key, then by run name.

        Merge them on first use.
        """
        if self._directory is None:
            if self._file is None:
                names = self.runs
                if names is None:
                    names = tuple(sorted(path.name for path in self.folder.glob(f"*{RUN_SUFFIX}")))
                # The file serves this session only. The next build removes it with the other
                # temporary files.
                path = self.folder / f"{uuid.uuid4().hex}{MERGED_SUFFIX}"
                _merge_directories([self.folder / name for name in names], self.dtype.itemsize, path)
                self._file = path
            self._directory = _open_directories(self._file)
        return self._directory

    def _parts(self, key: int) -> list[_Part]:
        """Return where a voxel's rows are."""
        merged = self._merged()
        at = int(np.searchsorted(merged.keys, np.uint64(key)))
        if at == len(merged.keys) or int(merged.keys[at]) != key:
            return []
        which = slice(int(merged.first[at]), int(merged.first[at + 1]))
        return [_Part(*part) for part in merged.entries[which].tolist()]

    def _read(self, part: _Part) -> NDArray:
        """Read the rows of a part.

        Raise CorruptError if the run is shorter than its directory says.
        """
        check_interrupt()
        path = self._merged().paths[part.run]
        rows = np.fromfile(path, self.dtype, part.size, offset=part.start * self.dtype.itemsize)
        if len(rows) != part.size:
            raise CorruptError(
                f"{path}: ends before row {part.start + part.size}: check the disk, and give the same command again",
                (path,),
            )
        return rows

    def _block(self, key: int, code_lo: int, code_hi: int) -> list[_Part]:
        """Return where the rows of a block are; runs without any are left out."""
        found = []
        for part, samples in zip(self._parts(key), self._samples(key), strict=True):
            begin = self._first_at_least(part, samples, code_lo)
            end = self._first_at_least(part, samples, code_hi)
            if end > begin:
                found.append(_Part(part.run, part.start + begin, end - begin))
        return found

    def _samples(self, key: int) -> list[NDArray[np.uint64]]:
        """Return the code of every CODE_STRIDE'th row of each part of a voxel.

        Those of the last voxel are cached.
        """
        if self._sampled is None or self._sampled[0] != key:
            self._sampled = (key, [self._sample(part) for part in self._parts(key)])
        return self._sampled[1]

    def _sample(self, part: _Part) -> NDArray[np.uint64]:
        """Read the code of every CODE_STRIDE'th row of a part, with one small read each."""
        size = self.dtype.itemsize
        with open(self._merged().paths[part.run], "rb", buffering=0) as file:
            rows = b"".join(
                os.pread(file.fileno(), size, (part.start + row) * size)
                for row in range(0, part.size, CODE_STRIDE)
            )
        return row_codes(np.frombuffer(rows, self.dtype))

    def _first_at_least(self, part: _Part, samples: NDArray[np.uint64], code: int) -> int:
        """Return the first row of a part whose code is at least `code`.

        Return the part's size if there is no such row.
        """
        stride = int(
            np.searchsorted(samples, np.uint64(code))
        )  # samples[stride - 1] < code <= samples[stride]
        if stride == 0:
            return 0
        begin = (stride - 1) * CODE_STRIDE
        rows = self._read(_Part(part.run, part.start + begin, min(CODE_STRIDE, part.size - begin)))
        return begin + int(np.searchsorted(row_codes(rows), np.uint64(code)))
