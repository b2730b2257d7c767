"""The spool: all points of a build, quantised, in sorted runs on disk, from which any voxel is read in order.

A run is two files that say nothing of each other but their name:

- `NAME.run`: packed rows, see `spool_dtype`, sorted by (voxel key, Morton code in the voxel, scan_index, intensity);
- `NAME.keys`: its directory, uint64 words: the keys of its voxels ascending, then the row each begins at, then how many
  rows there are. `s` voxels are `2 s + 1` words.

A `Spool` is a folder of runs. It holds no rows: a voxel's are read from the few runs that have some of it, each time.
"""

import os
from collections.abc import Collection
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.errors import CorruptError
from ..schemas.voxel_grid import Lattice, voxel_coordinates
from .config import BuildConfig
from .journal import new_file
from .kernels.content import SEEDS, content_sum
from .kernels.octree import voxel_codes

RUN_SUFFIX = ".run"
KEYS_SUFFIX = ".keys"

# Every so many rows of a voxel in a run, one Morton code is read to find a block: then a block's end is found with
# one more read of so many rows, 48 kB, and 10^8 rows are known by 24,000 codes.
CODE_STRIDE = 4096


def spool_dtype(config: BuildConfig) -> np.dtype:
    """A row of the spool."""
    fields: list[tuple[Any, ...]] = [("local", "<i4", (3,))]
    if "scan" in config.keep:
        fields.append(("scan_index", "<u2"))
    if "intensity" in config.keep:
        fields.append(("intensity", "<f4"))
    return np.dtype(fields)


def canonical_columns(rows: NDArray) -> tuple[NDArray, ...]:
    """The columns of rows, least significant first, that the order within a Morton code goes by, for np.lexsort."""
    return tuple(rows[name] for name in ("intensity", "scan_index") if name in (rows.dtype.names or ()))


def row_codes(rows: NDArray) -> NDArray[np.uint64]:
    """The Morton codes (n,) of rows in their voxel."""
    return np.asarray(voxel_codes(np.ascontiguousarray(rows["local"])), np.uint64)


def places_sum(key: int, local: NDArray[np.int32], lattice: Lattice) -> int:
    """Sum modulo 2^64 of a hash of the lattice coordinates of each point, local (n, 3), of a voxel."""
    corner = voxel_coordinates(np.array([key], np.uint64))[0] * lattice.voxel_steps
    return int(content_sum(np.ascontiguousarray((local + corner).T).view(np.uint64), SEEDS[0]))


def write_run(path: Path, keys: NDArray[np.uint64], rows: NDArray) -> None:
    """Sort rows (n,), in any order, of the voxels `keys` (n,), and write them as the run `path` (NAME.run), n >= 1."""
    order = np.lexsort((*canonical_columns(rows), row_codes(rows), keys))
    rows, keys = rows[order], keys[order]
    found, starts = np.unique(keys, return_index=True)
    with new_run(path) as file:
        file.write(rows.tobytes())
    write_directory(path, found, np.append(starts, len(keys)).astype(np.int64))


def new_run(path: Path) -> AbstractContextManager[BinaryIO]:
    """The file of a run, to be written in order; it has its name when it is whole and on disk for good."""
    return new_file(path)


def write_directory(path: Path, keys: NDArray[np.uint64], starts: NDArray[np.int64]) -> None:
    """Write the directory of the run `path`: keys (s,) ascending, starts (s + 1,)."""
    with new_file(path.with_suffix(KEYS_SUFFIX)) as file:
        file.write(np.concatenate([keys.astype("<u8"), starts.astype("<u8")]).tobytes())


def read_directory(path: Path) -> tuple[NDArray[np.uint64], NDArray[np.int64]]:
    """keys (s,) and starts (s + 1,) of the run `path`."""
    words = np.fromfile(path.with_suffix(KEYS_SUFFIX), "<u8")
    voxels = len(words) // 2
    return words[:voxels], words[voxels:].astype(np.int64)


class _Part(NamedTuple):
    """Some rows of one voxel in one run: from row `start`, `size` of them."""

    run: int
    start: int
    size: int


class _Directory(NamedTuple):
    """All runs' directories, merged: voxel i has the entries first[i] to first[i + 1] of run, start and size."""

    paths: list[Path]
    keys: NDArray[np.uint64]
    first: NDArray[np.int64]
    run: NDArray[np.int64]
    start: NDArray[np.int64]
    size: NDArray[np.int64]


class Spool:
    """A folder of sorted runs. Picklable, and cheap to send: what it knows of the runs is read on first use.

    Safe in any process, and from one thread at a time. Opened when all runs are written: later ones are not seen.
    places: what `places_sum` of all its rows must be; None: not known.
    """

    def __init__(
        self,
        folder: Path,
        dtype: np.dtype,
        lattice: Lattice,
        runs: Collection[str] | None = None,
        places: int | None = None,
    ) -> None:
        """Take the runs in `folder`, rows of `dtype`, voxels of `lattice`; nothing is read yet.

        runs: names of those that count; None: all that are there.
        """
        self.folder, self.dtype, self.lattice = Path(folder), np.dtype(dtype), lattice
        self.runs, self.places = None if runs is None else tuple(sorted(runs)), places
        self._directory: _Directory | None = None
        self._sampled: tuple[int, list[NDArray[np.uint64]]] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """What says where it is; each process reads the directories itself."""
        return {**self.__dict__, "_directory": None, "_sampled": None}

    @property
    def keys(self) -> NDArray[np.uint64]:
        """(v,) the voxels that hold points, ascending."""
        return self._merged().keys

    @property
    def counts(self) -> NDArray[np.int64]:
        """(v,) points of each voxel of `keys`."""
        merged = self._merged()
        if not len(merged.keys):
            return np.empty(0, np.int64)
        return np.add.reduceat(merged.size, merged.first[:-1])

    def count(self, key: int) -> int:
        """How many points a voxel holds; 0 for one that is not there."""
        return sum(part.size for part in self._parts(key))

    def rows(self, key: int) -> list[NDArray]:
        """A voxel's rows, one array a run that holds some, each in canonical order."""
        return [self._read(part) for part in self._parts(key)]

    def block_count(self, key: int, code_lo: int, code_hi: int) -> int:
        """How many of a voxel's points have a Morton code in [code_lo, code_hi)."""
        return sum(part.size for part in self._block(key, code_lo, code_hi))

    def block_rows(self, key: int, code_lo: int, code_hi: int) -> list[NDArray]:
        """The rows of a voxel whose Morton code is in [code_lo, code_hi), one array a run that holds some."""
        return [self._read(part) for part in self._block(key, code_lo, code_hi)]

    def _merged(self) -> _Directory:
        """All directories, sorted by key, then by the name of the run."""
        if self._directory is None:
            names = self.runs
            if names is None:
                names = tuple(sorted(path.name for path in self.folder.glob(f"*{RUN_SUFFIX}")))
            paths = [self.folder / name for name in names]
            read = [read_directory(path) for path in paths]
            none = [np.empty(0, np.uint64)]
            keys = np.concatenate(none + [k for k, _ in read])
            run = np.repeat(np.arange(len(paths)), [len(k) for k, _ in read])
            start = np.concatenate([np.empty(0, np.int64)] + [s[:-1] for _, s in read])
            size = np.concatenate([np.empty(0, np.int64)] + [np.diff(s) for _, s in read])
            order = np.argsort(keys, kind="stable")
            found, first = np.unique(keys[order], return_index=True)
            self._directory = _Directory(
                paths, found, np.append(first, len(keys)), run[order], start[order], size[order]
            )
        return self._directory

    def _parts(self, key: int) -> list[_Part]:
        """Where a voxel's rows lie."""
        merged = self._merged()
        at = int(np.searchsorted(merged.keys, np.uint64(key)))
        if at == len(merged.keys) or int(merged.keys[at]) != key:
            return []
        which = slice(int(merged.first[at]), int(merged.first[at + 1]))
        columns = (merged.run[which], merged.start[which], merged.size[which])
        return [_Part(*part) for part in zip(*(c.tolist() for c in columns), strict=True)]

    def _read(self, part: _Part) -> NDArray:
        """The rows of a part. Raises CorruptError for a run that is shorter than its directory says."""
        path = self._merged().paths[part.run]
        rows = np.fromfile(path, self.dtype, part.size, offset=part.start * self.dtype.itemsize)
        if len(rows) != part.size:
            raise CorruptError(
                f"{path}: ends before row {part.start + part.size}: check the disk, and give the same command again",
                (path,),
            )
        return rows

    def _block(self, key: int, code_lo: int, code_hi: int) -> list[_Part]:
        """Where the rows of a block lie; runs that hold none of it are left out."""
        found = []
        for part, samples in zip(self._parts(key), self._samples(key), strict=True):
            begin = self._first_at_least(part, samples, code_lo)
            end = self._first_at_least(part, samples, code_hi)
            if end > begin:
                found.append(_Part(part.run, part.start + begin, end - begin))
        return found

    def _samples(self, key: int) -> list[NDArray[np.uint64]]:
        """The code of every CODE_STRIDE'th row of each part of a voxel; of the last voxel asked they are kept."""
        if self._sampled is None or self._sampled[0] != key:
            self._sampled = (key, [self._sample(part) for part in self._parts(key)])
        return self._sampled[1]

    def _sample(self, part: _Part) -> NDArray[np.uint64]:
        """The code of every CODE_STRIDE'th row of a part, by one small read each."""
        size = self.dtype.itemsize
        with open(self._merged().paths[part.run], "rb", buffering=0) as file:
            rows = b"".join(
                os.pread(file.fileno(), size, (part.start + row) * size)
                for row in range(0, part.size, CODE_STRIDE)
            )
        return row_codes(np.frombuffer(rows, self.dtype))

    def _first_at_least(self, part: _Part, samples: NDArray[np.uint64], code: int) -> int:
        """The first row of a part whose code is not below `code`; its size where there is none."""
        stride = int(
            np.searchsorted(samples, np.uint64(code))
        )  # samples[stride - 1] < code <= samples[stride]
        if stride == 0:
            return 0
        begin = (stride - 1) * CODE_STRIDE
        rows = self._read(_Part(part.run, part.start + begin, min(CODE_STRIDE, part.size - begin)))
        return begin + int(np.searchsorted(row_codes(rows), np.uint64(code)))
