"""Points of an archive's voxels back into sorted runs, and which voxels hold points of a scan: work units.

What an added scan does not touch stays as it is on disk; of what it touches the stored points are spooled again, beside
the new ones, so that a voxel is built of both as if all had come together.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.archive import Archive
from ..schemas.codec import OpenRecord
from ..schemas.radius_model import LOCAL_CLASSES, RADIUS_CLASSES, RIM_BIT
from .classes import voxel_classes
from .config import BuildConfig
from .record_points import taken
from .shards import gather_voxel
from .spool import RUN_SUFFIX, Spool, spool_dtype, write_run

# Bytes a point that is held while a run is written: rows, Morton codes, keys, their order and the sorted copies.
RUN_BYTES_A_POINT = 96

_FROM_CORNER = np.zeros(3, np.int64)


class GatherUnit(NamedTuple):
    """Voxels of an archive to be spooled. rows: of its index.  points: in them.

    spool: folder of the runs.  name: of them.  dropped: scans whose points are left out.  before: folder for runs with
    those too, or None.  run_points: points a run.
    """

    archive: Path
    rows: tuple[int, ...]
    points: int
    spool: Path
    name: str
    dropped: frozenset[int]
    before: Path | None
    config: BuildConfig
    run_points: int


class Gathered(NamedTuple):
    """radius_counts: (32,) int64, points of each radius class as stored.  perhaps_few: keys of the voxels that may have
    points with too few neighbours for a class."""

    radius_counts: NDArray[np.int64]
    perhaps_few: tuple[int, ...]


class FindUnit(NamedTuple):
    """Voxels of an archive in which points of some scans are looked for. points: in them."""

    archive: Path
    rows: tuple[int, ...]
    points: int
    scans: frozenset[int]


class Found(NamedTuple):
    """A voxel that holds points of those scans. row: of the index.  box: (2, 3) lattice, of those points.

    counts: points of each scan.
    """

    row: int
    box: NDArray[np.int64]
    counts: dict[int, int]


class FewUnit(NamedTuple):
    """Voxels of which the points with too few neighbours are to be counted."""

    keys: tuple[int, ...]
    points: int
    spool: Spool
    config: BuildConfig
    most_near: int


def stored_column(record: OpenRecord, name: str, rows: NDArray[np.int64]) -> NDArray:
    """A column (m,) of some points of a record, whose dtype has it."""
    kind, at = record.dtype.fields[name][:2]  # type: ignore[index]  # its dtype has fields
    planes = record.planes[at : at + kind.itemsize]
    return np.ascontiguousarray(planes[:, rows].T).view(kind).reshape(-1)


def record_rows(record: OpenRecord, dtype: np.dtype) -> Iterator[NDArray]:
    """The points of a record as rows of the spool, a block at a time, in stored order."""
    columns = [name for name in dtype.names or () if name != "local"]
    for block in taken(record, _FROM_CORNER):
        rows = np.empty(len(block.rows), dtype)
        rows["local"] = block.xyz
        for name in columns:
            rows[name] = stored_column(record, name, block.rows)
        yield rows


class _Runs:
    """Rows that wait to be written as runs NAME-0000, NAME-0001, ... of a folder."""

    def __init__(self, folder: Path, name: str, run_points: int) -> None:
        self._folder, self._name, self._run_points = folder, name, run_points
        self._held: list[tuple[int, NDArray]] = []
        self._waiting = self._written = 0

    def take(self, key: int, rows: NDArray) -> None:
        """Rows of one voxel."""
        if len(rows):
            self._held.append((key, rows))
            self._waiting += len(rows)
        if self._waiting >= self._run_points:
            self.write()

    def write(self) -> None:
        """Write what waits."""
        if not self._held:
            return
        keys = np.repeat(np.array([key for key, _ in self._held], np.uint64), [len(r) for _, r in self._held])
        rows = np.concatenate([rows for _, rows in self._held])
        self._held, self._waiting = [], 0
        write_run(self._folder / f"{self._name}-{self._written:04d}{RUN_SUFFIX}", keys, rows)
        self._written += 1


def gather(unit: GatherUnit) -> Gathered:
    """Write the stored points of voxels as runs. Raises CorruptError."""
    dtype = spool_dtype(unit.config)
    runs = _Runs(unit.spool, unit.name, unit.run_points)
    before = _Runs(unit.before, unit.name, unit.run_points) if unit.before else None
    dropped = np.array(sorted(unit.dropped), np.int64)
    counts, perhaps_few = np.zeros(RADIUS_CLASSES, np.int64), []
    wanted = {name for name in dtype.names or () if name != "local"} | {"radius_class"}
    with Archive(unit.archive) as archive:
        for row in unit.rows:
            record, key = archive.open_voxel(row, columns=wanted), int(archive.voxels["key"][row])
            with archive.locating(row):
                for rows in record_rows(record, dtype):
                    if before:
                        before.take(key, rows)
                    kept = rows[~np.isin(rows["scan_index"], dropped)] if len(dropped) else rows
                    runs.take(key, kept)
            if archive.header.radius_class:
                each = record.class_counts()
                counts += each
                if few_are_possible(each, archive.header.models):
                    perhaps_few.append(key)
    for written in (runs, before):
        if written:
            written.write()
    return Gathered(counts, tuple(perhaps_few))


def few_are_possible(counts: NDArray[np.int64], models: tuple[str, ...]) -> bool:
    """Whether a voxel with so many points of each class may hold some with too few neighbours.

    Those have the last local class, and no rim.
    """
    last = LOCAL_CLASSES - 1 if "local" in models else 0
    assert last < RIM_BIT
    return int(counts[last]) > 0


def find_scans(unit: FindUnit) -> list[Found]:
    """The voxels that hold points of some scans. Raises CorruptError."""
    scans = np.array(sorted(unit.scans), np.int64)
    found = []
    with Archive(unit.archive) as archive:
        for row in unit.rows:
            record = archive.open_voxel(row, columns={"scan_index"})
            low, high = np.full(3, 1 << 31, np.int64), np.full(3, -1, np.int64)
            counts: dict[int, int] = {}
            column = _whole_column(record, "scan_index")
            if not np.isin(column, scans).any():
                continue
            for scan in scans.tolist():
                if here := int(np.count_nonzero(column == scan)):
                    counts[scan] = here
            with archive.locating(row):
                for block in taken(record, _FROM_CORNER):
                    xyz = block.xyz[np.isin(column[block.rows], scans)]
                    if len(xyz):
                        low, high = np.minimum(low, xyz.min(axis=0)), np.maximum(high, xyz.max(axis=0))
            corner = archive.coordinates[row] * archive.header.lattice.voxel_steps
            found.append(Found(row, np.stack([low, high]) + corner, counts))
    return found


def _whole_column(record: OpenRecord, name: str) -> NDArray:
    """A column of all points of a record."""
    kind, at = record.dtype.fields[name][:2]  # type: ignore[index]  # its dtype has fields
    return np.ascontiguousarray(record.planes[at : at + kind.itemsize].T).view(kind).reshape(-1)


def count_few(unit: FewUnit) -> int:
    """The points of some voxels that have too few neighbours for a class, as `radius_capped` counts them."""
    return sum(
        voxel_classes(
            key, gather_voxel(unit.spool.rows(key)).local, unit.config.models, unit.spool, unit.most_near
        ).few
        for key in unit.keys
    )
