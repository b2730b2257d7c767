"""Work units that convert stored voxels back to sorted runs, and that find the voxels of a scan.

Voxels that an added scan does not affect are unchanged on disk. The stored points of the affected
voxels are spooled again, beside the new ones. A voxel is then built from both as in a single build.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ...schemas.archive.codec import DecompressedRecord
from ...schemas.archive.radius_model import LOCAL_CLASSES, RADIUS_CLASSES, RIM_BIT
from ...schemas.kernels.morton import morton_decode
from ...schemas.runtime.new_file import new_file
from ..build_limits import is_dense
from ..config import BuildConfig
from ..kernels.points.content_hash import SEEDS
from ..kernels.points.octree_cells import voxel_codes
from ..kernels.points.spool_rows import fill_local
from ..kernels.points.voxel_records import position_hash_sum
from ..passes.radius_classes import voxel_classes
from ..spool.run_files import RUN_SUFFIX, canonical_columns, position_hash, spool_dtype, write_directory
from ..spool.spool import Spool
from ..voxel.coincident_points import heap_place
from ..voxel.dense_voxel import is_heap, plan_parts
from ..voxel.record_points import iter_points, leaves_of
from ..voxel.voxel_octree import gather_voxel

# Bytes per point held while a run is written: code and columns, and for one voxel order, sorted
# copies and rows. This is in addition to the record that they are read from (build_limits.py).
RUN_BYTES_A_POINT = 60
# Points of a record whose scan numbers are examined together.
LOOKED_AT = 1 << 16

_FROM_CORNER = np.zeros(3, np.int64)


class GatherUnit(NamedTuple):
    """Voxels of an archive to spool. rows: of its index.  points: their total number.

    spool: folder of the runs.  name: of the runs.  dropped: scans whose points are left out.
    before: folder for runs that include these points, or None.  run_points: points per run.
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
    """Result of spooling stored voxels.

    radius_counts: (32,) int64, points of each radius class as stored.
    perhaps_capped: keys of the voxels that may have points with too few neighbours for a class.
    places: `position_hash` of the points that are not left out (run_files.py).
    """

    radius_counts: NDArray[np.int64]
    perhaps_capped: tuple[int, ...]
    places: int


class FindUnit(NamedTuple):
    """Voxels of an archive to search for points of some scans. points: their total number."""

    archive: Path
    rows: tuple[int, ...]
    points: int
    scans: frozenset[int]


class VoxelOfScans(NamedTuple):
    """Voxel that holds points of these scans.

    row: of the index.  box: (2, 3) lattice, of those points.  counts: points of each scan.
    """

    row: int
    box: NDArray[np.int64]
    counts: dict[int, int]


class CappedUnit(NamedTuple):
    """Voxels whose points with too few neighbours are to be counted."""

    keys: tuple[int, ...]
    points: int
    spool: Spool
    config: BuildConfig
    max_neighbours: int


def stored_column(record: DecompressedRecord, name: str, rows: NDArray[np.int64]) -> NDArray:
    """Return a column (m,) or (m, 3) of some points of a record, whose dtype must have it."""
    kind, at = record.dtype.fields[name][:2]  # type: ignore[index]  # its dtype has fields
    planes = record.planes[at : at + kind.itemsize]
    return np.ascontiguousarray(planes[:, rows].T).view(kind.base).reshape(-1, *kind.shape)


class _Points(NamedTuple):
    """Points of one voxel.

    codes: (n,) uint64, Morton codes, which contain the coordinates.  columns: (n,) by name.
    """

    codes: NDArray[np.uint64]
    columns: dict[str, NDArray]


def record_points(record: DecompressedRecord, dtype: np.dtype) -> Iterator[_Points]:
    """Yield the points of a record, with the columns of a spool row, a block at a time."""
    columns = [name for name in dtype.names or () if name != "local"]
    for block in iter_points(record, _FROM_CORNER):
        yield _Points(
            voxel_codes(block.xyz), {name: stored_column(record, name, block.rows) for name in columns}
        )


class _Runs:
    """Points that wait to be written as runs NAME-0000, NAME-0001 and so on of a folder.

    They are written in order of voxel keys.
    """

    def __init__(self, folder: Path, name: str, dtype: np.dtype, run_points: int) -> None:
        self._folder, self._name, self._dtype, self._run_points = folder, name, dtype, run_points
        self._held: dict[int, list[_Points]] = {}
        self._waiting = self._written = 0

    def take(self, key: int, points: _Points) -> None:
        """Add points of one voxel."""
        if len(points.codes):
            self._held.setdefault(key, []).append(points)
            self._waiting += len(points.codes)
        if self._waiting >= self._run_points:
            self.write()

    def write(self) -> None:
        """Write the waiting points as a run."""
        if not self._held:
            return
        path = self._folder / f"{self._name}-{self._written:04d}{RUN_SUFFIX}"
        starts = [0]
        with new_file(path) as file:
            for parts in self._held.values():
                rows = sorted_rows(parts, self._dtype)
                parts.clear()
                file.write(rows.view(np.uint8).data)
                starts.append(starts[-1] + len(rows))
        write_directory(path, np.array(list(self._held), np.uint64), np.array(starts, np.int64))
        self._held, self._waiting = {}, 0
        self._written += 1


def sorted_rows(parts: list[_Points], dtype: np.dtype) -> NDArray:
    """Return the points of one voxel as spool rows, in the order of a run.

    Codes are sorted alone, and by the columns where they are equal; then coordinates are made from
    the codes. Sorting rows by all columns takes five times as long.
    """
    codes = np.concatenate([part.codes for part in parts])
    names = [name for name in dtype.names or () if name != "local"]
    rows = np.empty(len(codes), dtype)
    if not names:
        codes.sort()
    else:
        order = np.argsort(codes)
        codes = codes[order]
        for name in names:
            rows[name] = np.concatenate([part.columns[name] for part in parts])[order]
        same = np.zeros(len(codes) + 1, bool)
        same[1:-1] = codes[1:] == codes[:-1]
        tied = np.flatnonzero(same[1:] | same[:-1])
        again = tied[np.lexsort((*canonical_columns(rows[tied]), codes[tied]))]
        for name in names:
            rows[name][tied] = rows[name][again]
    fill_local(codes, rows["local"])
    return rows


def gather(unit: GatherUnit) -> Gathered:
    """Write the stored points of voxels as runs. Raise CorruptError if a record cannot be read."""
    dtype = spool_dtype(unit.config)
    runs = _Runs(unit.spool, unit.name, dtype, unit.run_points)
    before = _Runs(unit.before, unit.name, dtype, unit.run_points) if unit.before else None
    dropped = np.array(sorted(unit.dropped), np.int64)
    counts, perhaps_capped, places = np.zeros(RADIUS_CLASSES, np.int64), [], 0
    wanted = {name for name in dtype.names or () if name != "local"} | {"radius_class"}
    with Archive(unit.archive) as archive:
        for row in unit.rows:
            record, key = archive.open_voxel(row, columns=wanted), int(archive.voxels["key"][row])
            places += int(
                position_hash_sum(leaves_of(record), archive.coordinates[row] * record.voxel_steps, SEEDS[0])
            )
            with archive.locating(row):
                for points in record_points(record, dtype):
                    if before:
                        before.take(key, points)
                    if len(dropped):
                        points, gone = _without(points, dropped)
                        places -= position_hash(
                            key, morton_decode(gone).astype(np.int32), archive.header.lattice
                        )
                    runs.take(key, points)
            if archive.header.radius_class:
                each = record.class_counts()
                counts += each
                if may_be_capped(each, archive.header.models):
                    perhaps_capped.append(key)
            del record  # free it before the next one is read
    for written in (runs, before):
        if written:
            written.write()
    return Gathered(counts, tuple(perhaps_capped), places)


def _without(points: _Points, scans: NDArray[np.int64]) -> tuple[_Points, NDArray[np.uint64]]:
    """Return the points that are not of the given scans, and the codes of those that are."""
    kept = ~np.isin(points.columns["scan_index"], scans)
    columns = {name: column[kept] for name, column in points.columns.items()}
    return _Points(points.codes[kept], columns), points.codes[~kept]


def may_be_capped(counts: NDArray[np.int64], models: tuple[str, ...]) -> bool:
    """Return whether a voxel may hold points with too few neighbours.

    counts: points of each class. Such points have the last local class, and no rim.
    """
    last = LOCAL_CLASSES - 1 if "local" in models else 0
    assert last < RIM_BIT
    return int(counts[last]) > 0


def find_scans(unit: FindUnit) -> list[VoxelOfScans]:
    """Find the voxels that hold points of some scans.

    Raise CorruptError if a record cannot be read.
    """
    scans = np.array(sorted(unit.scans), np.int64)
    found = []
    with Archive(unit.archive) as archive:
        for row in unit.rows:
            record = archive.open_voxel(row, columns={"scan_index"})
            if not _holds_scans(record, scans):
                del record  # free it before the next one is read
                continue
            low, high = np.full(3, 1 << 31, np.int64), np.full(3, -1, np.int64)
            counts = np.zeros(len(scans), np.int64)
            with archive.locating(row):
                for block in iter_points(record, _FROM_CORNER):
                    of = stored_column(record, "scan_index", block.rows)
                    if len(xyz := block.xyz[np.isin(of, scans)]):
                        low, high = np.minimum(low, xyz.min(axis=0)), np.maximum(high, xyz.max(axis=0))
                    counts += [np.count_nonzero(of == scan) for scan in scans]
            del record
            corner = archive.coordinates[row] * archive.header.lattice.voxel_steps
            each = dict(zip(scans.tolist(), counts.tolist(), strict=True))
            found.append(
                VoxelOfScans(row, np.stack([low, high]) + corner, {s: n for s, n in each.items() if n})
            )
    return found


def _holds_scans(record: DecompressedRecord, scans: NDArray[np.int64]) -> bool:
    """Return whether a record has points of some scans; reads only the column of scan numbers."""
    kind, at = record.dtype.fields["scan_index"][:2]  # type: ignore[index]  # its dtype has fields
    planes = record.planes[at : at + kind.itemsize]
    for begin in range(0, planes.shape[1], LOOKED_AT):
        of = np.ascontiguousarray(planes[:, begin : begin + LOOKED_AT].T).view(kind).reshape(-1)
        if np.isin(of, scans).any():
            return True
    return False


def count_capped(unit: CappedUnit) -> int:
    """Count the points of voxels with too few neighbours for a class, as in `radius_capped`."""
    return sum(_capped_of(key, unit) for key in unit.keys)


def _capped_of(key: int, unit: CappedUnit) -> int:
    """Count such points of one voxel.

    A dense voxel is processed in the parts that it is built in.
    """
    spool, models = unit.spool, unit.config.models
    if not is_dense(spool.count(key), unit.config):
        local = gather_voxel(spool.rows(key)).local
        return voxel_classes(key, local, models, spool, unit.max_neighbours).capped
    few = 0
    for part in plan_parts(spool, key, unit.config):
        codes, times = range(part[0].code, part[-1].code_end), 1
        if is_heap(part):  # all points have the same class
            local, times = heap_place(codes.start), part[0].points
        else:
            local = gather_voxel(spool.block_rows(key, codes.start, codes.stop)).local
        few += times * voxel_classes(key, local, models, spool, unit.max_neighbours, codes).capped
    return few
