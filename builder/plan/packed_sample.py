"""Estimate of the archive's bytes per point.

The code that builds archives packs some compact blocks of points. How well points compress depends
on how close they are to each other, across all scans. The sample is therefore not thinned: it
consists of whole cubes of the octree around points spread evenly over the scans, with all points in
them. Scans are read whole if there is time, otherwise in pieces around those points. The missing
density of the pieces is extrapolated from how the bytes per point change when points are left out.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.codec import encode_voxel
from ...schemas.archive.voxel_grid import Lattice
from ...schemas.errors import ScanError
from ...schemas.runtime.interrupts import check_interrupt
from ..config import BuildConfig
from ..kernels.points.occupied_cubes import FREE, find_cube_points, insert_all
from ..passes.spool_pass import usable
from ..sources.common.scan import Scan, ScanBlock
from ..voxel.voxel_octree import VoxelPoints, build_voxel
from .rates import Rates

# Number of blocks to pack, and points per block: packing takes about 1 us per point.
BLOCKS, BLOCK_POINTS = 48, 12_000
# Scans with fewer points than this in total are packed whole, a voxel at a time.
ALL_POINTS = 400_000
# A cube is gathered with room for this multiple of its points, because the density of scans varies.
ROOM = 4
# Time limit of reading [s], limit per point if that is more, and cost of finding the cubes per
# point [s].
READ_SECONDS, READ_SECONDS_A_POINT, FIND_SECONDS = 2.0, 2e-8, 1e-8
# Points read to find the centre of a block; some of them may be invalid returns.
PROBE_POINTS = 256
# Scans are read whole if there is time for this share of them.
MAX_SHARE = 0.8
# Key and archive id of the sample's records; as hard to compress as any other.
_KEY, _ID = 0x1B3A75C2D49E6F08, bytes.fromhex("8f1e6a03b7c95d2470eb42d81fa6395c")
# Most points held before cubes with too many points are halved.
MAX_HELD = 6_000_000


class Packed(NamedTuple):
    """Result of packing a sample.

    bytes_a_point: bytes per point of the records, including the columns scan and intensity if they
    are kept.  points: number packed.  share: fraction of all points that was read.
    voxels: number that hold points; None if not all points were read.
    """

    bytes_a_point: float
    points: int
    share: float
    voxels: int | None


class BrokenScanError(ScanError):
    """Error for a scan that cannot be read. scan: that scan."""

    def __init__(self, scan: Scan, cause: ScanError) -> None:
        """Take over the message of the cause."""
        super().__init__(str(cause))
        self.scan = scan


class _Gathered(NamedTuple):
    """Points of the chosen cubes: slot (n,), local (n, 3) [steps], scan (n,) and intensity (n,)."""

    slot: NDArray[np.int64]
    local: NDArray[np.int32]
    scan: NDArray[np.uint16]
    intensity: NDArray[np.float32]

    def rows(self, which: NDArray) -> "_Gathered":
        """Return the selected points."""
        return _Gathered(*(column[which] for column in self))


_NOTHING = _Gathered(
    np.empty(0, np.int64), np.empty((0, 3), np.int32), np.empty(0, np.uint16), np.empty(0, np.float32)
)


class _Cubes:
    """Cubes of the octree, each around a point.

    around: (c, 3) int64, the point in its voxel [steps].  chosen: (c, 5), see `find_cube_points`.
    weight: (c,), number of drawn points in the cube.
    """

    def __init__(self, drawn: NDArray[np.float64], lattice: Lattice, shift: int) -> None:
        """Choose the cubes of 2^shift steps that contain the points (n, 3) [m]."""
        steps = lattice.to_lattice(drawn)
        voxels = steps // lattice.voxel_steps
        at = steps - voxels * lattice.voxel_steps
        most = (1 << 20) - 1
        x, y, z = (np.clip(voxels, -most, most) + most).T
        cubes = np.column_stack([(x << 42) | (y << 21) | z, at >> shift, np.full(len(at), shift)])
        found, first, self.weight = np.unique(cubes, axis=0, return_index=True, return_counts=True)
        self.chosen, self.around = np.ascontiguousarray(found, np.int64), at[first]

    def shrink(self, slot: int, found: _Gathered, mine: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Halve a cube around its point.

        Return a mask of the points `mine` that are still in it.
        """
        shift = self.chosen[slot, 4] - 1
        cube = self.around[slot] >> shift
        self.chosen[slot, 1:4], self.chosen[slot, 4] = cube, shift
        return mine & (found.local >> shift == cube).all(axis=1)

    def cropped(self, found: _Gathered, most: int) -> _Gathered:
        """Return the points found, with cubes halved until none holds more than `most`."""
        keep = np.ones(len(found.slot), bool)
        for slot in np.flatnonzero(np.bincount(found.slot, minlength=1) > most).tolist():
            mine = found.slot == slot
            keep &= ~mine
            while np.count_nonzero(mine) > most and self.chosen[slot, 4]:
                mine = self.shrink(slot, found, mine)
            keep |= mine
        return found.rows(keep)


class _Reader:
    """Reader of scans that counts voxels and gathers the points of cubes."""

    def __init__(self, scans: Sequence[Scan], lattice: Lattice) -> None:
        """Start with empty counts."""
        self.scans, self.lattice = scans, lattice
        self.read = 0
        self.table, self._known = np.full(1 << 12, FREE), np.zeros(1, np.int64)

    @property
    def voxels(self) -> int:
        """Return the number of voxels that hold points that were read."""
        return int(self._known[0])

    def gather(self, pieces: Sequence[tuple[int, int, int | None]], cubes: _Cubes | None) -> _Gathered:
        """Read pieces (scan, start, stop) and return the points in cubes.

        Halve cubes with too many points.
        """
        parts, held = [_NOTHING], 0
        chosen = np.empty((0, 5), np.int64) if cubes is None else cubes.chosen
        for number, start, stop in pieces:
            for block in _usable_blocks(self.scans[number], start, stop):
                parts.append(self.taken(number, block, chosen))
                held += len(parts[-1].slot)
                if cubes is not None and held > MAX_HELD:
                    parts = [cubes.cropped(_joined(parts), ROOM * BLOCK_POINTS)]
                    held = len(parts[0].slot)
        return _joined(parts)

    def taken(self, number: int, block: ScanBlock, chosen: NDArray[np.int64]) -> _Gathered:
        """Return the points of a block that are in chosen cubes."""
        lattice, size = self.lattice, len(block.xyz)
        self.read += size
        picked, slots = np.empty(size, np.int64), np.empty(size, np.int64)
        local = np.empty((size, 3), np.int64)
        count = done = 0
        while done < size:
            more, past = find_cube_points(
                block.xyz[done:], np.array(lattice.origin), lattice.step, lattice.voxel_steps, chosen,
                self.table, self._known, picked[count:], slots[count:], local[count:],
            )  # fmt: skip
            picked[count : count + more] += done
            count, done = count + more, done + past
            if done < size:
                table = np.full(2 * len(self.table), FREE)
                insert_all(self.table, table)
                self.table = table
        light = np.zeros(size, np.float32) if block.intensity is None else block.intensity
        return _Gathered(
            slots[:count],
            local[:count].astype(np.int32),
            np.full(count, number % (1 << 16), np.uint16),
            light[picked[:count]],
        )


def _usable_blocks(scan: Scan, start: int, stop: int | None) -> Iterator[ScanBlock]:
    """Yield the usable points of a piece of a scan; if it cannot seek, from its beginning.

    Raise BrokenScanError if the scan cannot be read.
    """
    seen = 0
    try:
        for block in scan.blocks(start=start, stop=stop) if scan.seekable else scan.blocks():
            yield usable(block)
            seen += len(block.xyz)
            if stop is not None and seen >= stop - start:
                return
    except ScanError as error:
        raise BrokenScanError(scan, error) from error


def _joined(parts: Sequence[_Gathered]) -> _Gathered:
    return _Gathered(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def packed_sample(
    scans: Sequence[Scan],
    counts: Sequence[int],
    lattice: Lattice,
    density: float,
    some: NDArray[np.float64] | None,
    config: BuildConfig,
    rates: Rates,
) -> Packed | None:
    """Pack some blocks of scans to measure their bytes per point.

    counts: approximate points of each scan.  density: approximate points per square metre.
    some: (m, 3) [m], points from all parts of all scans; None if only points from their beginnings
    are known. Return None if no point was found. Raise BrokenScanError for a scan that cannot be
    read.
    """
    total = sum(counts)
    if total <= ALL_POINTS:
        return _all_packed(scans, lattice, config)
    share = _share(scans, counts, rates)
    edge = np.sqrt(ROOM * BLOCK_POINTS / density)
    whole = int(lattice.voxel_steps - 1).bit_length()
    places = _places(counts)
    drawn = _drawn(scans, places, share)
    if not len(drawn):
        return None
    cubes = _Cubes(drawn, lattice, int(np.clip(np.log2(edge / lattice.step), 0, whole)))
    reader = _Reader(scans, lattice)
    found = reader.gather(_pieces(scans, counts, places, share), cubes)
    lacking = 1.0
    if share < 1 and some is not None:
        expected = (
            len(_Reader(scans, lattice).taken(0, ScanBlock(some, None), cubes.chosen).slot)
            / len(some)
            * total
        )
        lacking = max(1.0, expected / max(1, len(found.slot)))
    found = cubes.cropped(found, BLOCK_POINTS)
    each = _bytes_a_point(found, cubes.weight, lacking, lattice, config)
    return Packed(each, len(found.slot), min(1.0, reader.read / total), reader.voxels if share == 1 else None)


def _share(scans: Sequence[Scan], counts: Sequence[int], rates: Rates) -> float:
    """Return the share of all points that there is time to read; 1 if that is most of them."""
    reading = sum(
        count * (rates.read.get(scan.format, rates.read["las"]) + FIND_SECONDS)
        for scan, count in zip(scans, counts, strict=True)
    )
    share = max(READ_SECONDS, READ_SECONDS_A_POINT * sum(counts)) / reading
    return share if share < MAX_SHARE else 1.0


def _bytes_a_point(
    found: _Gathered, weight: NDArray, lacking: float, lattice: Lattice, config: BuildConfig
) -> float:
    """Return the mean over all blocks, for a density `lacking` times that of the points found."""
    each, less, weights = [], [], []
    rng = np.random.default_rng(0)
    for slot in np.unique(found.slot).tolist():
        block = found.rows(found.slot == slot)
        weights.append(weight[slot])
        each.append(_packed_bytes(block, lattice, config) / len(block.slot))
        if lacking > 1:
            half = block.rows(rng.permutation(len(block.slot))[: -(-len(block.slot) // 2)])
            less.append(_packed_bytes(half, lattice, config) / len(half.slot) - each[-1])
    mean = float(np.average(each, weights=weights))
    # Doubling the density saves as many bytes per point as halving it costs.
    return max(1.0, mean - float(np.average(less, weights=weights)) * np.log2(lacking)) if less else mean


def _packed_bytes(block: _Gathered, lattice: Lattice, config: BuildConfig) -> int:
    """Return the bytes of the record of points of one voxel."""
    check_interrupt()
    points = VoxelPoints(
        np.ascontiguousarray(block.local),
        block.scan if "scan" in config.keep else None,
        block.intensity if "intensity" in config.keep else None,
    )
    record = encode_voxel(build_voxel(_KEY, points, lattice.voxel_steps, config), _ID)
    return len(record.cells) + len(record.nodes) + len(record.points)


def _all_packed(scans: Sequence[Scan], lattice: Lattice, config: BuildConfig) -> Packed | None:
    """Pack every voxel of scans with few points."""
    pieces = [(number, 0, None) for number in range(len(scans))]
    reader = _Reader(scans, lattice)
    reader.gather(pieces, None)
    keys = np.sort(reader.table[reader.table != FREE])
    chosen = np.zeros((len(keys), 5), np.int64)
    chosen[:, 0], chosen[:, 4] = keys, int(lattice.voxel_steps - 1).bit_length()
    parts = [
        reader.taken(number, block, chosen)
        for number, start, stop in pieces
        for block in _usable_blocks(scans[number], start, stop)
    ]
    found = _joined([_NOTHING, *parts])
    if not len(found.slot):
        return None
    order = np.argsort(found.slot, kind="stable")
    voxels = np.split(order, np.flatnonzero(np.diff(found.slot[order])) + 1)
    size = sum(_packed_bytes(found.rows(which), lattice, config) for which in voxels)
    return Packed(size / len(order), len(order), 1.0, len(keys))


def _places(counts: Sequence[int]) -> list[tuple[int, int]]:
    """Return (scan, point) of BLOCKS points that are spread evenly over all scans."""
    ends = np.cumsum(counts)
    at = ((np.arange(BLOCKS) + 0.5) / BLOCKS * ends[-1]).astype(np.int64)
    numbers = np.searchsorted(ends, at, side="right")
    return list(zip(numbers.tolist(), (at - ends[numbers] + np.array(counts)[numbers]).tolist(), strict=True))


def _drawn(scans: Sequence[Scan], places: Sequence[tuple[int, int]], share: float) -> NDArray[np.float64]:
    """Return the points (n, 3) [m] at, or near, some places.

    A scan that cannot seek is sampled in the part that will be read.
    """
    found = [np.empty((0, 3))]
    for number, scan in enumerate(scans):
        wanted = [at for which, at in places if which == number]
        if scan.seekable:
            for at in wanted:
                stop = min(at + PROBE_POINTS, scan.declared_count or 0)
                found += [block.xyz[:1] for block in _usable_blocks(scan, at, stop)][:1]
            continue
        wanted, seen = [int(at * share) for at in wanted], 0
        blocks = _usable_blocks(scan, 0, None)
        for block in blocks if wanted else ():
            here = [at - seen for at in wanted if 0 <= at - seen < len(block.xyz)]
            found.append(block.xyz[here])
            seen += len(block.xyz)
            if seen > wanted[-1]:
                break
    return np.concatenate(found)


def _pieces(
    scans: Sequence[Scan], counts: Sequence[int], places: Sequence[tuple[int, int]], share: float
) -> list[tuple[int, int, int | None]]:
    """Return the pieces (scan, start, stop) to read: every scan whole, or pieces around places.

    share: fraction of the points to read.
    """
    pieces: list[tuple[int, int, int | None]] = []
    for number, (scan, count) in enumerate(zip(scans, counts, strict=True)):
        wanted = [at for which, at in places if which == number]
        if share == 1:
            pieces.append((number, 0, None))
        elif not scan.seekable:
            pieces.append((number, 0, max(1, int(count * share))))
        else:
            wanted = wanted or [count // 2]
            half = max(1, int(count * share / len(wanted)) // 2)
            past = 0
            for at in wanted:
                start, stop = max(past, at - half), min(count, at + half)
                if start < stop:
                    pieces.append((number, start, stop))
                past = max(past, stop)
    return pieces
