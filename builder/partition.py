"""Scans -> points sorted into voxels, with bounded memory: survey, lattice, spool.

Two passes over every scan. The survey finds bounds, counts and faults; then the lattice is fixed, and the
second pass quantises the points and spools them: whenever a worker holds its share of `memory_bytes`, it sorts
that by voxel and writes it as one run. A voxel is later gathered from the few runs that hold some of it.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.errors import ScanError
from ..schemas.voxel_grid import MAX_COORDINATE, MAX_VOXEL_STEPS, MIN_STEP, Lattice, make_lattice, voxel_keys
from .config import DEFAULT_STEP, BuildConfig
from .kernels.content import content_sum
from .octree import VoxelPoints
from .sources import Block, Scan, header_bounds, open_scans, sha256_of
from .spool import canonical_columns, row_codes

# Bytes a point that a spooling worker holds while it sorts: coordinates, keys, order and the sorted copy.
SPOOL_BYTES_A_POINT = 120

# A header's bounds are believed when no point lies farther outside [m]: they are rounded, but not by more.
BOUNDS_WITHIN = 0.01

_SEEDS = (np.uint64(0x9E3779B97F4A7C15), np.uint64(0xD1B54A32D192ED03))


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """What the first pass found of one scan.

    scan: the reader, its `dropped` filled.  sha256: of its file.  count: points that can be kept.
    low, high: (3,) float64 world [m] of those; infinite when there are none.  not_finite: points left out.
    fault: why the scan cannot be used, or "".  region: (2, 3) world [m] that a faulty scan may have covered; None:
    not known.  empty: nothing was lost with it.
    """

    scan: Scan | None
    path: Path
    sha256: str
    count: int
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    not_finite: int
    fault: str = ""
    region: NDArray[np.float64] | None = None
    empty: bool = False


class Run(NamedTuple):
    """One sorted run of the spool. keys: (s,) uint64, ascending.  starts: (s + 1,) int64, rows of each key."""

    path: Path
    keys: NDArray[np.uint64]
    starts: NDArray[np.int64]


class Spooled(NamedTuple):
    """What the second pass made of one scan.

    content: sums that identify the points, see `content_sum`.  moved_max: farthest along an axis that quantising
    moved a point [m].
    """

    runs: tuple[Run, ...]
    content: tuple[int, int]
    moved_max: float
    dropped: dict[str, int]


def open_all(path: Path, spacing: float | None) -> tuple[list[Scan], str]:
    """The scans of one file, or the fault that keeps it from being opened."""
    try:
        return open_scans(path, spacing=spacing), ""
    except ScanError as error:
        return [], str(error)


def _usable(block: Block) -> NDArray[np.bool_]:
    """Which points of a block are finite and within the coordinates admitted (NUMERICS.md N7, case 16)."""
    inside = np.abs(block.xyz) <= MAX_COORDINATE  # false for NaN
    return np.asarray(inside.all(axis=1))


def survey_scan(
    scan: Scan, tick: Callable[[int], None] = lambda _: None, sha256: Callable[[Path], str] = sha256_of
) -> Survey:
    """Read a scan once: bounds, counts, and whether it can be read to its end. sha256: of a file, may remember."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    count = not_finite = 0
    digest = ""
    try:
        digest = sha256(scan.path)
        for block in scan.blocks():
            good = _usable(block)
            xyz = block.xyz[good] if not good.all() else block.xyz
            if len(xyz):
                low, high = np.minimum(low, xyz.min(axis=0)), np.maximum(high, xyz.max(axis=0))
            count += len(xyz)
            not_finite += len(good) - len(xyz)
            tick(len(good))
    except ScanError as error:
        return Survey(scan, scan.path, digest, 0, low, high, not_finite, str(error), _region(scan, low, high))
    fault = (
        ""
        if count
        else f"{scan.path}: scan {scan.index} holds no usable point, expected at least one: leave it out"
    )
    nothing_lost = count == 0 and not_finite == 0
    region = None if count or nothing_lost else _region(scan, low, high)
    return Survey(scan, scan.path, digest, count, low, high, not_finite, fault, region, nothing_lost)


def unopened(path: Path, fault: str) -> Survey:
    """The survey of a file that cannot be opened, or, with no fault, that holds no scan at all."""
    none = np.zeros(3)
    if not fault:
        fault = f"{path}: holds no scan, expected at least one: leave it out"
        return Survey(None, path, "", 0, none, none, 0, fault, None, empty=True)
    return Survey(None, path, "", 0, none, none, 0, fault, header_bounds(path))


def _region(scan: Scan, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Where a scan that broke off may have had points: its header's bounds and what was read of it.

    None, not known: without such bounds, or when a point read lies outside them, for then they are wrong.
    """
    if scan.bounds is None:
        return None
    if (low < scan.bounds[0] - BOUNDS_WITHIN).any() or (high > scan.bounds[1] + BOUNDS_WITHIN).any():
        return None
    return np.stack([np.minimum(scan.bounds[0], low), np.maximum(scan.bounds[1], high)])


def choose_lattice(surveys: list[Survey], config: BuildConfig) -> tuple[Lattice, str]:
    """The dataset's lattice, and where its step is from: "given", "sources" or "default".

    The origin is the least coordinate on each axis, exactly: so a scene moved by a shift that float64 holds exactly
    is quantised to the same integers (NUMERICS.md case 1). Raises BadRequestError for impossible sizes.
    """
    origin = np.min([s.low for s in surveys], axis=0)
    step, source = config.resolution, "given"
    if step is None:
        step, source = _shared_step(surveys), "sources"
    if source == "sources" and not (
        step and max(MIN_STEP, config.voxel / MAX_VOXEL_STEPS) <= step <= config.voxel
    ):
        step, source = DEFAULT_STEP, "default"
    assert step is not None
    return make_lattice(origin, step, config.voxel), source


def _shared_step(surveys: list[Survey]) -> float | None:
    """The step of the lattice on which all sources lie, if they share one: same scale, offsets apart by whole steps."""
    lattices = [s.scan.lattice for s in surveys if s.scan is not None]
    if not lattices or any(lattice is None for lattice in lattices):
        return None
    first = lattices[0]
    assert first is not None
    step = first.scale[0]
    for lattice in lattices:
        assert lattice is not None
        if any(scale != step for scale in lattice.scale):
            return None
        apart = (np.array(lattice.offset) - np.array(first.offset)) / step
        # Offsets are decimal text rounded to float64: a millionth of a step is theirs, more is another lattice.
        if (
            not np.isfinite(apart).all()
            or (np.abs(apart - np.rint(apart)) > 1e-6 * np.maximum(1, np.abs(apart) * 1e-9)).any()
        ):
            return None
    return float(step)


def spool_dtype(config: BuildConfig) -> np.dtype:
    """A row of the spool."""
    fields: list[tuple] = [("local", "<i4", (3,))]
    if "scan" in config.keep:
        fields.append(("scan_index", "<u2"))
    if "intensity" in config.keep:
        fields.append(("intensity", "<f4"))
    return np.dtype(fields)


@dataclass(frozen=True, slots=True, eq=False)
class SpoolUnit:
    """One scan to be spooled. number: its place among the scans.  run_points: points a run."""

    scan: Scan
    number: int
    count: int
    lattice: Lattice
    config: BuildConfig
    folder: Path
    run_points: int


def spool_scan(unit: SpoolUnit, tick: Callable[[int], None] = lambda _: None) -> Spooled:
    """Quantise a scan and write it as runs sorted by voxel. Raises ScanError when it changed since the survey."""
    dtype = spool_dtype(unit.config)
    runs: list[Run] = []
    held: list[tuple[NDArray[np.uint64], NDArray]] = []
    waiting, kept = 0, 0
    content = [0, 0]
    moved_max = 0.0
    for block in unit.scan.blocks():
        good = _usable(block)
        xyz = block.xyz[good]
        lattice = unit.lattice.to_lattice(xyz)
        rows = np.zeros(len(xyz), dtype)
        columns = [lattice[:, k].astype(np.uint64) for k in range(3)]
        if "scan_index" in rows.dtype.names:
            rows["scan_index"] = unit.number
            columns.append(rows["scan_index"].astype(np.uint64))
        if "intensity" in rows.dtype.names and block.intensity is not None:
            # One bit pattern a value, or bytes would depend on the order of duplicates: no -0.0, one NaN.
            intensity = block.intensity[good] + np.float32(0)
            rows["intensity"] = np.where(np.isnan(intensity), np.float32(np.nan), intensity)
            columns.append(rows["intensity"].view(np.uint32).astype(np.uint64))
        voxels = unit.lattice.voxel_of(lattice)
        rows["local"] = lattice - voxels * unit.lattice.voxel_steps
        for i, seed in enumerate(_SEEDS):
            content[i] = (content[i] + int(content_sum(np.stack(columns), seed))) % (1 << 64)
        if len(xyz):
            moved_max = max(moved_max, float(np.abs(unit.lattice.to_world(lattice) - xyz).max()))
        held.append((voxel_keys(voxels), rows))
        waiting, kept = waiting + len(xyz), kept + len(xyz)
        if waiting >= unit.run_points:
            runs.append(_write_run(unit, len(runs), held))
            held, waiting = [], 0
        tick(len(good))
    if waiting:
        runs.append(_write_run(unit, len(runs), held))
    if kept != unit.count:
        raise ScanError(
            f"{unit.scan.path}: {kept} points, {unit.count} a moment ago: still being written? build again"
        )
    return Spooled(tuple(runs), (content[0], content[1]), moved_max, dict(unit.scan.dropped))


def _write_run(unit: SpoolUnit, run: int, held: list[tuple[NDArray[np.uint64], NDArray]]) -> Run:
    """Sort what is held by voxel and write it as one file."""
    keys = np.concatenate([k for k, _ in held])
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    path = unit.folder / f"{unit.number:06d}-{run:06d}.run"
    with open(path, "wb") as file:
        file.write(np.concatenate([r for _, r in held])[order].view(np.uint8).data)
    found, starts = np.unique(keys, return_index=True)
    return Run(path, found, np.append(starts, len(keys)).astype(np.int64))


def voxel_rows(key: int, runs: tuple[Run, ...], dtype: np.dtype) -> Iterator[NDArray]:
    """The rows of one voxel, run by run, of those that hold some of it."""
    for run in runs:
        at = int(np.searchsorted(run.keys, np.uint64(key)))
        if at < len(run.keys) and int(run.keys[at]) == key:
            start, count = int(run.starts[at]), int(run.starts[at + 1] - run.starts[at])
            yield np.fromfile(run.path, dtype, count, offset=start * dtype.itemsize)


def gather_voxel(key: int, runs: tuple[Run, ...], dtype: np.dtype) -> VoxelPoints:
    """All points of one voxel, from the runs that hold some of it."""
    rows = np.concatenate(list(voxel_rows(key, runs, dtype)))
    names = dtype.names or ()
    return VoxelPoints(
        np.ascontiguousarray(rows["local"]),
        np.ascontiguousarray(rows["scan_index"]) if "scan_index" in names else None,
        np.ascontiguousarray(rows["intensity"]) if "intensity" in names else None,
    )


class RunSpool(NamedTuple):
    """The runs of this pass as builder/spool.py `Spool` gives its own, as far as shards.py and classes.py ask."""

    runs: tuple[Run, ...]
    dtype: np.dtype
    lattice: Lattice

    @property
    def keys(self) -> NDArray[np.uint64]:
        """(v,) the voxels that hold points, ascending."""
        return np.unique(np.concatenate([run.keys for run in self.runs]))

    def rows(self, key: int) -> list[NDArray]:
        """A voxel's rows, one array a run that holds some, each in canonical order."""
        return [
            r[np.lexsort((*canonical_columns(r), row_codes(r)))]
            for r in voxel_rows(key, self.runs, self.dtype)
        ]

    def count(self, key: int) -> int:
        """How many points a voxel holds."""
        return sum(map(len, voxel_rows(key, self.runs, self.dtype)))
