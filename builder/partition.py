"""The second pass over scans: points quantised, and spooled as runs sorted by voxel and Morton code, memory bounded.

A worker holds a voxel number and a code a point; when its share of `memory_bytes` is full, or its range of a scan is
at its end, it brings them into the order of their voxels, sorts each voxel's codes, which hold the coordinates, and
writes them as one run (builder/spool.py).
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..schemas.errors import ScanError
from ..schemas.interrupts import check
from ..schemas.voxel_grid import KEY_BIAS, MAX_COORDINATE, Lattice, voxel_keys
from .config import BuildConfig
from .kernels.content import SEEDS
from .kernels.spool import FREE, fill_local, order_ties, place_points, rehash, scatter, usable_bounds
from .sources import Block, Scan
from .spool import RUN_SUFFIX, RunSums, new_run, run_sizes, write_directory

# Bytes a point that a spooling worker holds: voxel number, code, and the code once more in order; with intensity its
# bits, them once more, and, of a run in one voxel, order, sorted codes and ranks.
SPOOL_BYTES_A_POINT = 20
SPOOL_BYTES_A_POINT_WITH_INTENSITY = 52
# Beside that: a block as it is read, and one as it is written.
SPOOL_BYTES = 48 << 20
# A run is not smaller than this, whatever the memory: many small ones are slow to gather a voxel from.
LEAST_RUN_POINTS = 1 << 16
# Rows made at a time when a run is written.
WRITTEN_ROWS = 1 << 18


@dataclass(frozen=True, slots=True, eq=False)
class SpoolUnit:
    """A range of a scan to be spooled, 0 to None of one that cannot seek.

    number: of the scan.  count: points that the survey found usable.  dtype: of the rows; it may have a scan_index that
    the archive does not keep, for the filters.  name: of the runs.  run_points: points a run.
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


@dataclass(frozen=True, slots=True)
class Spooled:
    """What the second pass made of a range. runs: name of each -> what was written of it.

    content: sums that identify the points, see `content_sum`.  places: the same of their lattice coordinates alone, see
    `places_sum`.  moved_max: farthest along an axis that quantising
    moved a point [m].
    """

    runs: dict[str, RunSums]
    count: int
    content: list[int]
    places: int
    moved_max: float


def dump_spooled(spooled: Spooled) -> dict[str, Any]:
    """What was spooled, as its note says it."""
    return asdict(spooled)


def load_spooled(noted: dict[str, Any]) -> Spooled:
    """What was spooled, from its note."""
    return Spooled(**noted)


class HasRuns(Protocol):
    """What speaks of runs. runs: name of each -> what was written of it."""

    @property
    def runs(self) -> dict[str, RunSums]:
        """The runs."""


@dataclass(frozen=True, slots=True)
class RunsHold:
    """Whether the runs that a note speaks of are in `folder`, as long as they were; their bytes: believed.py."""

    folder: Path

    def __call__(self, noted: HasRuns) -> bool:
        return all(run_sizes(self.folder / name) == tuple(sums[::2]) for name, sums in noted.runs.items())


def run_points(memory_bytes: int, dtype: np.dtype) -> int:
    """Points a run may hold where a worker may hold so many bytes."""
    with_intensity = "intensity" in (dtype.names or ())
    each = SPOOL_BYTES_A_POINT_WITH_INTENSITY if with_intensity else SPOOL_BYTES_A_POINT
    return max(LEAST_RUN_POINTS, (memory_bytes - SPOOL_BYTES) // each)


def spool_range(unit: SpoolUnit) -> Spooled:
    """Quantise a range of a scan and write it as runs. Raises ScanError when it changed since the survey.

    The runs are on disk for good when it returns. Pure and idempotent.
    """
    held = _Held(unit, min(unit.count, unit.run_points))
    kept = 0
    runs: dict[str, RunSums] = {}

    def flush() -> None:
        # Named by how the range is cut, too: a worker that was given up, of a session that cut it otherwise, may still
        # write, and must not put its run in the place of one that is in use.
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
            f"{unit.scan.path}: {kept} points, {unit.count} a moment ago: still being written? build again"
        )
    if held.size:
        flush()
    *content, places = (int(total) for total in held.sums)
    return Spooled(runs, kept, content, places, held.moved_max)


def usable(block: Block) -> Block:
    """The points of a block that are finite and within the coordinates admitted (NUMERICS.md N7, case 16)."""
    if usable_bounds(block.xyz, MAX_COORDINATE, np.empty(3), np.empty(3)) == len(block.xyz):
        return block
    good = (np.abs(block.xyz) <= MAX_COORDINATE).all(axis=1)  # false for NaN
    return Block(block.xyz[good], None if block.intensity is None else block.intensity[good])


class _Held:
    """The points that wait to be written as a run: a voxel number and a code each, and the voxels' keys."""

    def __init__(self, unit: SpoolUnit, capacity: int) -> None:
        self.dtype = unit.dtype
        self.lattice, self.number = unit.lattice, unit.number
        self.size, self.capacity = 0, capacity
        self.numbers, self.codes = np.empty(capacity, np.int32), np.empty(capacity, np.uint64)
        names = self.dtype.names or ()
        self.with_scan = "scan_index" in names
        # A point is identified by what the archive keeps of it.
        self.scan_named = "scan" in unit.config.keep
        self.bits = np.empty(capacity, np.uint32) if "intensity" in names else None
        self.sums, self.moved_max = np.zeros(3, np.uint64), 0.0
        self._room(1 << 14)

    @property
    def full(self) -> bool:
        """Whether a run is to be written before another point is taken."""
        return self.size == self.capacity

    def _room(self, voxels: int) -> None:
        """An empty table for up to so many voxels, a power of two."""
        self.table, self.number_of = np.full(2 * voxels, FREE), np.empty(2 * voxels, np.int32)
        self.keys, self.known = np.empty(voxels, np.uint64), np.zeros(1, np.int64)

    def _grow(self) -> None:
        """Twice the room for voxels, with those there are in it."""
        keys, known = self.keys, self.known
        self._room(4 * len(keys))
        self.keys[: len(keys)], self.known = keys, known
        rehash(self.keys, int(known[0]), self.table, self.number_of)

    def take(self, block: Block, begin: int) -> int:
        """Take points of a block from point `begin` on; returns how many."""
        end = min(len(block.xyz), begin + self.capacity - self.size)
        to = slice(self.size, self.size + end - begin)
        more = np.empty((self.scan_named + (self.bits is not None), end - begin), np.uint64)
        if self.scan_named:
            more[0] = self.number
        if self.bits is not None:
            self.bits[to] = intensity_bits(block, begin, end)
            more[-1] = self.bits[to]
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
            voxel_keys(np.array([[lowest] * 3, [highest] * 3]))  # raises, and says it
        if not done:
            self._grow()
        self.size += done
        self.moved_max = max(self.moved_max, moved)
        return done

    def write(self, path: Path) -> RunSums:
        """Sort what is held and write it as the run `path`; then hold nothing. Returns what was written."""
        size, voxels = self.size, int(self.known[0])
        numbers = self.numbers[:size]
        order = np.argsort(self.keys[:voxels])
        counts = np.bincount(numbers, minlength=voxels)[order]
        starts = np.concatenate([[0], np.cumsum(counts)])
        place = np.empty(voxels, np.int64)
        place[order] = starts[:-1]
        codes = np.empty(size, np.uint64)
        bits = None
        if self.bits is not None:
            bits = np.empty(size, np.uint32)
            scatter(numbers, self.bits[:size], place.copy(), bits)
        scatter(numbers, self.codes[:size], place, codes)
        for begin, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
            check()
            sort_voxel(codes[begin:end], None if bits is None else bits[begin:end])
        with new_run(path) as file:
            for rows in self._rows(codes, bits):
                check()
                file.write(rows.view(np.uint8).data)
        directory = write_directory(path, self.keys[:voxels][order], starts)
        self.size = 0
        self._room(len(self.keys))
        return [*file.sums, *directory]

    def _rows(self, codes: NDArray[np.uint64], bits: NDArray[np.uint32] | None) -> Iterator[NDArray]:
        """The rows of sorted codes, WRITTEN_ROWS at a time, overwritten by the next."""
        rows = np.empty(min(len(codes), WRITTEN_ROWS), self.dtype)
        if self.with_scan:
            rows["scan_index"] = self.number
        for begin in range(0, len(codes), WRITTEN_ROWS):
            end = min(begin + WRITTEN_ROWS, len(codes))
            fill_local(codes[begin:end], rows["local"])
            if bits is not None:
                rows["intensity"][: end - begin] = bits[begin:end].view(np.float32)
            yield rows[: end - begin]


def intensity_bits(block: Block, begin: int, end: int) -> NDArray[np.uint32]:
    """The bits of the intensities of points [begin, end), 0 where the source has none.

    One pattern a value, or bytes would depend on the order of duplicates: no -0.0, one NaN.
    """
    if block.intensity is None:
        return np.zeros(end - begin, np.uint32)
    intensity = block.intensity[begin:end] + np.float32(0)
    return np.where(np.isnan(intensity), np.float32(np.nan), intensity).astype(np.float32).view(np.uint32)


def sort_voxel(codes: NDArray[np.uint64], bits: NDArray[np.uint32] | None) -> None:
    """Sort the codes (n,) of a voxel in place, and with them the bits of their intensities, which part equal ones."""
    if bits is None:
        codes.sort()
        return
    order = np.argsort(codes)
    codes[:] = codes[order]
    if (codes[1:] == codes[:-1]).any():
        order_ties(codes, order, ranks(bits))
    bits[:] = bits[order]


def ranks(bits: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Integers in the order of the float32 values of these bits, a NaN last, as np.lexsort has them."""
    negative = (bits >> np.uint32(31)).astype(bool)
    return np.where(negative, ~bits, bits | np.uint32(1 << 31)).astype(np.uint32)
