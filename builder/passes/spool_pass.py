"""Second pass over scans: quantises the points and spools them as sorted runs in bounded memory.

A worker holds a voxel number and a code per point. When its share of `memory_bytes` is full, or its
range of a scan ends, it groups the points by voxel, sorts the codes of each voxel, which contain
the coordinates, and writes them as one run (builder/spool/spool.py).
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.voxel_grid import KEY_BIAS, MAX_COORDINATE, Lattice, voxel_keys
from ...schemas.errors import ScanError
from ...schemas.runtime.interrupts import check_interrupt
from ..config import BuildConfig
from ..kernels.points.content_hash import SEEDS
from ..kernels.points.spool_rows import (
    FREE,
    fill_local,
    order_ties,
    place_points,
    rehash,
    scatter,
    usable_bounds,
)
from ..resume.kept_work import BuildDirectory, RunsIntact, Work, discard_damaged_runs, run_unfinished
from ..resume.transaction import Transaction
from ..sources.common.colours import eight_bits
from ..sources.common.scan import Scan, ScanBlock
from ..spool.point_order import packed_look, unpack_look
from ..spool.run_files import KEYS_SUFFIX, RUN_SUFFIX, RunSums, new_run, ranks, write_directory
from .survey_pass import Survey

# Bytes per point in a spooling worker: voxel number, code, and a copy of the code in sorted order.
# With intensity also its bits, a copy of them, and, for a run in one voxel, order, sorted codes and
# ranks. With colour or class the same of these, and ranks of 64 bits.
SPOOL_BYTES_A_POINT = 20
SPOOL_BYTES_A_POINT_WITH_INTENSITY = 52
SPOOL_BYTES_A_POINT_WITH_LOOK = 84
# In addition: one block being read and one being written.
SPOOL_BYTES = 48 << 20
# Least points of a run, whatever the memory: gathering a voxel from many small runs is slow.
MIN_RUN_POINTS = 1 << 16
# Rows generated at a time when a run is written.
WRITTEN_ROWS = 1 << 18


@dataclass(frozen=True, slots=True, eq=False)
class SpoolUnit:
    """Range of a scan to spool.

    number: of the scan.  start, stop: range of points; 0 and None for a scan that cannot seek.
    count: usable points according to the survey.
    dtype: of the rows; it may include a scan_index that the filters need and the archive omits.
    folder, name: of the runs.  run_points: points per run.
    brightest: greatest channel of the scan's colours, see `eight_bits`.
    """

    scan: Scan
    number: int
    start: int
    stop: int | None
    count: int
    lattice: Lattice
    config: BuildConfig
    dtype: np.dtype
    folder: Path
    name: str
    run_points: int
    brightest: float = 0.0


@dataclass(frozen=True, slots=True)
class Spooled:
    """Result of the second pass for a range.

    runs: name of each run -> sums of what was written.
    content: hash sums of the points, see `content_sum`.
    places: hash sum of their lattice coordinates alone, see `position_hash`.
    moved_max: largest distance along an axis that quantising moved a point [m].
    """

    runs: dict[str, RunSums]
    count: int
    content: list[int]
    places: int
    moved_max: float


def dump_spooled(spooled: Spooled) -> dict[str, Any]:
    """Convert a result to its journal entry."""
    return asdict(spooled)


def load_spooled(noted: dict[str, Any]) -> Spooled:
    """Convert a journal entry to a result."""
    return Spooled(**noted)


def run_points(memory_bytes: int, dtype: np.dtype) -> int:
    """Return the points that a run may have if a worker may hold `memory_bytes`."""
    each, names = SPOOL_BYTES_A_POINT, dtype.names or ()
    if "intensity" in names:
        each = SPOOL_BYTES_A_POINT_WITH_INTENSITY
    if "rgb" in names or "classification" in names:
        each = SPOOL_BYTES_A_POINT_WITH_LOOK
    return max(MIN_RUN_POINTS, (memory_bytes - SPOOL_BYTES) // each)


def spool_range(unit: SpoolUnit) -> Spooled:
    """Quantise a range of a scan and write it as runs.

    The runs are durable on disk when this returns. Pure and idempotent. Raise ScanError if the scan
    changed since the survey.
    """
    held = _RunBuffer(unit, min(unit.count, unit.run_points))
    kept = 0
    runs: dict[str, RunSums] = {}

    def flush() -> None:
        # The name includes how the range is cut: a worker given up by a session that cut it
        # differently may still write, and must not replace a run that is in use.
        path = unit.folder / f"{unit.name}-{unit.run_points}-{len(runs):04d}{RUN_SUFFIX}"
        runs[path.name] = held.write(path)

    for block in unit.scan.blocks(start=unit.start, stop=unit.stop):
        block = usable(block)
        kept += len(block.xyz)
        if kept > unit.count:
            break
        taken = 0
        while taken < len(block.xyz):
            taken += held.take(block, taken)
            if held.full:
                flush()
    if kept != unit.count:
        raise ScanError(
            f"{unit.scan.path}: {kept} points, expected {unit.count} as surveyed: still being written? build again"
        )
    if held.size:
        flush()
    *content, places = (int(total) for total in held.sums)
    return Spooled(runs, kept, content, places, held.moved_max)


def usable(block: ScanBlock) -> ScanBlock:
    """Return the points of a block that are finite and in range (NUMERICS.md N7, case 16)."""
    if usable_bounds(block.xyz, MAX_COORDINATE, np.empty(3), np.empty(3)) == len(block.xyz):
        return block
    good = (np.abs(block.xyz) <= MAX_COORDINATE).all(axis=1)  # false for NaN
    return block.taken(np.asarray(good))


class _RunBuffer:
    """Points that wait to be written as a run: voxel numbers and codes, and the voxels' keys."""

    def __init__(self, unit: SpoolUnit, capacity: int) -> None:
        self.dtype = unit.dtype
        self.lattice, self.number = unit.lattice, unit.number
        self.size, self.capacity = 0, capacity
        self.numbers, self.codes = np.empty(capacity, np.int32), np.empty(capacity, np.uint64)
        names = self.dtype.names or ()
        self.with_scan = "scan_index" in names
        # The content sums identify a point by the columns that the archive keeps.
        self.scan_named = "scan" in unit.config.keep
        self.bits = np.empty(capacity, np.uint32) if "intensity" in names else None
        with_look = "rgb" in names or "classification" in names
        self.looks = np.empty(capacity, np.uint32) if with_look else None
        self.brightest = unit.brightest
        self.sums, self.moved_max = np.zeros(3, np.uint64), 0.0
        self._room(1 << 14)

    @property
    def full(self) -> bool:
        """Return whether a run must be written before another point is taken."""
        return self.size == self.capacity

    def _room(self, voxels: int) -> None:
        """Make an empty hash table for up to `voxels` voxels, a power of two."""
        self.table, self.number_of = np.full(2 * voxels, FREE), np.empty(2 * voxels, np.int32)
        self.keys, self.known = np.empty(voxels, np.uint64), np.zeros(1, np.int64)

    def _grow(self) -> None:
        """Double the room for voxels and keep the existing ones."""
        keys, known = self.keys, self.known
        self._room(4 * len(keys))
        self.keys[: len(keys)], self.known = keys, known
        rehash(self.keys, int(known[0]), self.table, self.number_of)

    def take(self, block: ScanBlock, begin: int) -> int:
        """Take points of a block from point `begin` on; return how many were taken."""
        end = min(len(block.xyz), begin + self.capacity - self.size)
        to = slice(self.size, self.size + end - begin)
        kept: list[NDArray[np.unsignedinteger]] = []
        if self.scan_named:
            kept.append(np.full(end - begin, self.number, np.uint64))
        if self.bits is not None:
            self.bits[to] = intensity_bits(block, begin, end)
            kept.append(self.bits[to])
        if self.looks is not None:
            self.looks[to] = self._looks(block, begin, end)
            kept.append(self.looks[to])
        more = np.array(kept, np.uint64).reshape(len(kept), end - begin)
        done, moved, lowest, highest = place_points(
            np.ascontiguousarray(block.xyz[begin:end]),
            np.array(self.lattice.origin),
            self.lattice.step,
            self.lattice.voxel_steps,
            KEY_BIAS,
            more,
            SEEDS,
            (self.table, self.number_of, self.keys, self.known),
            self.numbers[to],
            self.codes[to],
            self.sums,
        )
        if lowest < -KEY_BIAS or highest >= KEY_BIAS:
            voxel_keys(np.array([[lowest] * 3, [highest] * 3]))  # raises the error for distant voxels
        if not done:
            self._grow()
        self.size += done
        self.moved_max = max(self.moved_max, moved)
        return done

    def _looks(self, block: ScanBlock, begin: int, end: int) -> NDArray[np.uint32]:
        """Return the looks (point_order.py) of points [begin, end), 0 for what the source lacks."""
        names, rgb, classes = self.dtype.names or (), None, None
        if block.rgb is not None and "rgb" in names:
            rgb = eight_bits(block.rgb[begin:end], self.brightest)
        if block.classification is not None and "classification" in names:
            classes = block.classification[begin:end]
        return (
            np.zeros(end - begin, np.uint32) if rgb is None and classes is None else packed_look(rgb, classes)
        )

    def write(self, path: Path) -> RunSums:
        """Sort the points, write them as the run `path` and forget them.

        Return the sums of the run.
        """
        size, voxels = self.size, int(self.known[0])
        numbers = self.numbers[:size]
        order = np.argsort(self.keys[:voxels])
        counts = np.bincount(numbers, minlength=voxels)[order]
        starts = np.concatenate([[0], np.cumsum(counts)])
        place = np.empty(voxels, np.int64)
        place[order] = starts[:-1]
        codes = np.empty(size, np.uint64)
        bits, looks = (self._by_voxel(column, place) for column in (self.bits, self.looks))
        scatter(numbers, self.codes[:size], place, codes)
        for begin, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
            check_interrupt()
            columns = (None if column is None else column[begin:end] for column in (bits, looks))
            sort_voxel(codes[begin:end], *columns)
        with new_run(path) as file:
            for rows in self._rows(codes, bits, looks):
                check_interrupt()
                file.write(rows.view(np.uint8).data)
        directory = write_directory(path, self.keys[:voxels][order], starts)
        self.size = 0
        self._room(len(self.keys))
        return [*file.sums, *directory]

    def _by_voxel(
        self, column: NDArray[np.uint32] | None, place: NDArray[np.int64]
    ) -> NDArray[np.uint32] | None:
        """Return a column in the order of the voxels. place: where each voxel begins."""
        if column is None:
            return None
        found = np.empty(self.size, np.uint32)
        scatter(self.numbers[: self.size], column[: self.size], place.copy(), found)
        return found

    def _rows(
        self, codes: NDArray[np.uint64], bits: NDArray[np.uint32] | None, looks: NDArray[np.uint32] | None
    ) -> Iterator[NDArray]:
        """Yield the rows of sorted codes, WRITTEN_ROWS at a time, each overwritten by the next."""
        rows = np.empty(min(len(codes), WRITTEN_ROWS), self.dtype)
        if self.with_scan:
            rows["scan_index"] = self.number
        for begin in range(0, len(codes), WRITTEN_ROWS):
            end = min(begin + WRITTEN_ROWS, len(codes))
            fill_local(codes[begin:end], rows["local"])
            if bits is not None:
                rows["intensity"][: end - begin] = bits[begin:end].view(np.float32)
            if looks is not None:
                unpack_look(looks[begin:end], rows[: end - begin])
            yield rows[: end - begin]


def intensity_bits(block: ScanBlock, begin: int, end: int) -> NDArray[np.uint32]:
    """Return the bits of the intensities of points [begin, end), 0 if the source has none.

    Each value has one bit pattern (no -0.0, one NaN), or the bytes would depend on the order of
    duplicates.
    """
    if block.intensity is None:
        return np.zeros(end - begin, np.uint32)
    intensity = block.intensity[begin:end] + np.float32(0)
    return np.where(np.isnan(intensity), np.float32(np.nan), intensity).astype(np.float32).view(np.uint32)


def sort_voxel(
    codes: NDArray[np.uint64], bits: NDArray[np.uint32] | None, looks: NDArray[np.uint32] | None = None
) -> None:
    """Sort the codes (n,) of a voxel in place, and with them the bits of their intensities and looks.

    The intensities, then the looks, order equal codes.
    """
    if bits is None and looks is None:
        codes.sort()
        return
    order = np.argsort(codes)
    codes[:] = codes[order]
    if (codes[1:] == codes[:-1]).any():
        first = None if bits is None else ranks(bits)
        if looks is None:
            order_ties(codes, order, first)
        else:
            order_ties(
                codes, order, looks if first is None else first.astype(np.uint64) << np.uint64(32) | looks
            )
    for column in (bits, looks):
        if column is not None:
            column[:] = column[order]


def spool_scans(
    surveys: list[Survey],
    lattice: Lattice,
    dtype: np.dtype,
    build_dir: BuildDirectory,
    build: Transaction,
) -> list[Spooled]:
    """Run the second pass: write quantised points to disk, sorted by voxel."""
    discard_damaged_runs(build_dir, build)
    folder = build_dir.folder / "spool"
    most = run_points(build.share, dtype)
    units = []
    for number, survey in enumerate(surveys):
        for part in survey.parts:
            assert survey.scan is not None
            name = f"{number:06d}-{part.start:012d}"
            unit = SpoolUnit(
                survey.scan,
                number,
                part.start,
                part.stop,
                part.count,
                lattice,
                build.config,
                dtype,
                folder,
                name,
                most,
                survey.brightest,
            )
            units.append((f"spool/{name}", unit))
    notes = [build_dir.journal.read_entry(f"spool/{note.stem}") for note in folder.glob("*.json")]
    _sweep_spool(folder, {name for noted in notes if noted for name in noted["runs"]})
    work = Work(spool_range, dump_spooled, load_spooled, RunsIntact(folder))
    with build.stage("spool", sum(s.count for s in surveys), "points"):
        spooled = run_unfinished(
            build_dir.journal, build.executor, work, units, build.progress, lambda unit: unit.count
        )
    # A range that had lost a run was spooled again, possibly into fewer runs than before.
    _sweep_spool(folder, {name for found in spooled for name in found.runs})
    return spooled


def _sweep_spool(folder: Path, vouched: set[str]) -> None:
    """Delete runs that are not in `vouched`, because a spool consists of all runs in its folder."""
    stems = {Path(name).stem for name in vouched}
    for suffix in (RUN_SUFFIX, KEYS_SUFFIX):
        for path in folder.glob(f"*{suffix}"):
            if path.stem not in stems:
                path.unlink(missing_ok=True)  # a worker that was given up may have removed it already
