"""Spool: all points of a build, quantised, in sorted runs on disk (run_files.py).

A `Spool` is a folder of runs. It keeps no rows in memory: each access reads the rows of a voxel, in
order, from the few runs that have rows of it.
"""

import json
import os
import uuid
from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.voxel_grid import Lattice
from ...schemas.errors import CorruptError
from ...schemas.runtime.interrupts import check_interrupt
from ...schemas.runtime.new_file import TEMPORARY_SUFFIX
from .run_files import RUN_SUFFIX, read_directory, row_codes

# Suffix of the file of all merged directories.
MERGED_SUFFIX = f".directory{TEMPORARY_SUFFIX}"
# Voxels of runs that are merged at a time. Merging all of 1,400 runs of 1,500 voxels each at once
# took 200 MB in each process; 5,000 scans would have taken two gigabytes.
MERGED_ENTRIES = 1 << 18

# Distance in rows between the Morton codes that are read to find a block of a voxel in a run. One
# more read of this many rows, 48 kB, then finds the end of a block. 10^8 rows need 24,000 codes.
CODE_STRIDE = 4096


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
    places: the `position_hash` that all its rows must have; None: not known.
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
