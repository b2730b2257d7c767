"""The optional stage between spool and shards: points are left out, and counted; off unless asked for.

Three rules, each exact in integers of the lattice:

- `moving (R, SCANS)`: a point is left out where fewer than SCANS other scans have a point within R of it, although
  SCANS other scans have points within 8 R: they saw the place, and not it. What moved while scans that overlap were
  made is seen by one of them only. Where fewer than SCANS others came within 8 R it stays: none could have seen it.
- `outliers (R, COUNT)`: a point is left out where fewer than COUNT other distinct points lie within R.
- `thin STEP`: of each cube of STEP, rounded to whole lattice steps, one point stays: the one nearest to its middle, of
  equally near ones the first in Morton order within the cube, then by scan and intensity. With the lattice step itself
  exact duplicates become one. Whatever is left out lies less than sqrt(3) STEP from what stays of its cube.

`moving` and `outliers` both look at all points as they were scanned, so that neither depends on the other; what both
leave out is counted as moving. `thin` then chooses among what they leave.

Distances are inclusive, compared as integers: R is taken as the decimal number it is written as, over the step written
as one. Cubes are counted from the lattice's origin and may lie across voxels: who lives on the border is looked up in
the voxels around. So which points stay is a function of the points, their scans and the options; not of the voxels'
size, the order of scans, jobs or memory. No more than a voxel's edge around a point is looked at: a rule that needs
more is refused by name.

A unit is consecutive voxels; it writes one run. Memory a job: about 150 bytes a point of 2^19, for a voxel with more
is taken in cubes by Morton range, and what lies around one is read piece by piece. A single lattice position is held
whole, however many points are there.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from math import isqrt
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.errors import BadRequestError, CorruptError
from ..schemas.voxel_grid import Lattice
from .blocks import Block, BlockReader, Box, Grid, NearPoints
from .config import BuildConfig
from .executor import Executor
from .journal import Journal, Work, new_file, resumed
from .kernels.filter import best_of_cells, count_others, other_scans
from .progress import Progress
from .spool import RUN_SUFFIX, Spool, canonical_columns, places_sum, row_codes, spool_dtype, write_directory

# Why a point was left out, as `info` says it.
MOVING, OUTLIER, THINNED = "moving", "outliers", "thinned"

# Points in a work unit.
UNIT_POINTS = 1 << 21
# How far from a point `moving` asks whether others saw the place, in its distance.
SEEN = 8
# Scans that `moving` remembers of a point: 16 bytes each.
MAX_SCANS_ASKED = 16

# Reason -> scan -> points left out.
Counts = dict[str, dict[int, int]]


class Reach(NamedTuple):
    """A distance and a number. squared: of the distance [steps^2].  steps: of it, whole.  number: see the rule."""

    squared: int
    steps: int
    number: int


class Rules(NamedTuple):
    """What is left out, in lattice steps; None: not asked for. seen: `moving`'s wider reach.  thin: a cube's edge."""

    moving: Reach | None
    seen: Reach | None
    outliers: Reach | None
    thin: int | None


class FilterUnit(NamedTuple):
    """Voxels to be filtered. keys: ascending.  dtype: of the rows written.  path: of the run written."""

    keys: tuple[int, ...]
    points: int
    spool: Spool
    rules: Rules
    dtype: np.dtype
    path: Path


class Filtered(NamedTuple):
    """What one unit left. name: of its run.  size: of it [bytes]; 0: nothing was left, and there is no run.

    places_before, places: the `places_sum` of what it read and of what it left.
    """

    name: str
    size: int
    left_out: Counts
    places_before: int
    places: int


def is_filtered(config: BuildConfig) -> bool:
    """Whether any rule is asked for."""
    return not (config.thin is None and config.outliers is None and config.moving is None)


def filter_dtype(config: BuildConfig) -> np.dtype:
    """A row of the spool that the filters read: with the scan, which they need, and count by, whatever is kept."""
    names = spool_dtype(config).names or ()
    fields: list[tuple[Any, ...]] = [("local", "<i4", (3,)), ("scan_index", "<u2")]
    if "intensity" in names:
        fields.append(("intensity", "<f4"))
    return np.dtype(fields)


def filter_passes(config: BuildConfig) -> int:
    """How often all points are gone through: progress counts up to this many times their number."""
    return (config.moving is not None or config.outliers is not None) + (config.thin is not None)


def _reach(option: str, metres: float, number: int, lattice: Lattice, wider: int = 1) -> Reach:
    """`wider` times a distance. Raises BadRequestError where it is under a lattice step or over a voxel."""
    ratio = Fraction(repr(metres)) / Fraction(repr(lattice.step)) * wider
    squared = int(ratio * ratio)
    if squared < 1:
        raise BadRequestError(
            f"{option} {metres:g}: expected at least the lattice step, {lattice.step:g} m: give a larger distance"
        )
    if isqrt(squared) > lattice.voxel_steps:
        around = f", looks {metres * wider:g} m around each point" if wider > 1 else ""
        raise BadRequestError(
            f"{option} {metres:g}{around}: expected at most a voxel, {lattice.voxel_size:g} m: give a smaller distance "
            "or a larger --voxel"
        )
    return Reach(squared, isqrt(squared), number)


def make_rules(config: BuildConfig, lattice: Lattice) -> Rules:
    """The rules in lattice steps. Raises BadRequestError for what cannot be done on this lattice."""
    moving = seen = outliers = thin = None
    if config.moving is not None:
        distance, scans = config.moving
        if scans > MAX_SCANS_ASKED:
            raise BadRequestError(f"--moving {distance:g},{scans}: expected 1 to {MAX_SCANS_ASKED} scans")
        moving = _reach("--moving", distance, scans, lattice)
        seen = _reach("--moving", distance, scans, lattice, SEEN)
    if config.outliers is not None:
        outliers = _reach("--outliers", *config.outliers, lattice)
    if config.thin is not None:
        thin = max(1, round(Fraction(repr(config.thin)) / Fraction(repr(lattice.step))))
        if thin > lattice.voxel_steps:
            raise BadRequestError(
                f"--thin {config.thin:g}: expected at most a voxel, {lattice.voxel_size:g} m: give less or a larger "
                "--voxel"
            )
    return Rules(moving, seen, outliers, thin)


def filtered_spool(
    spool: Spool, config: BuildConfig, folder: Path, executor: Executor, progress: Progress, journal: Journal
) -> tuple[Spool, Counts]:
    """Leave out what the options say, into new runs below `folder`; also what was left out of each scan, by reason.

    spool: its rows are of `filter_dtype`; those of the result are of `spool_dtype`. A pass that was interrupted goes on
    where its notes say. Raises BadRequestError for rules that the lattice cannot do, and where no point is left.
    """
    rules = make_rules(config, spool.lattice)
    passes = []
    if rules.moving or rules.outliers:
        passes.append(("filter-near", rules._replace(thin=None)))
    if rules.thin:
        passes.append(("filter-thin", Rules(None, None, None, rules.thin)))
    left_out: Counts = {}
    for i, (name, rule) in enumerate(passes):
        target = folder / name
        target.mkdir(parents=True, exist_ok=True)
        dtype = spool_dtype(config) if i == len(passes) - 1 else spool.dtype
        units = _units(spool, rule, dtype, target)
        work = Work(filter_voxels, _dump, _load, _Holds(target))
        named = [(f"{name}/{unit.path.stem}", unit) for unit in units]
        results = resumed(journal, executor, work, named, progress, lambda unit: unit.points)
        for result in results:
            _add(left_out, result.left_out)
        if spool.places not in (None, sum(r.places_before for r in results) % (1 << 64)):
            raise CorruptError(
                f"{spool.folder}: points that are not those of the scans: check disk and memory",
                (spool.folder,),
            )
        runs, places = [r.name for r in results if r.size], sum(r.places for r in results) % (1 << 64)
        spool = Spool(target, dtype, spool.lattice, runs, places)
        if not len(spool.keys):
            raise BadRequestError(
                "no point is left: expected some: give --thin, --outliers or --moving other figures"
            )
    return spool, left_out


def _units(spool: Spool, rules: Rules, dtype: np.dtype, folder: Path) -> list[FilterUnit]:
    """Consecutive voxels of together about UNIT_POINTS."""
    units: list[FilterUnit] = []
    all_keys, counts = spool.keys, spool.counts
    groups = np.cumsum(counts) // UNIT_POINTS
    for group in np.split(np.arange(len(groups)), np.flatnonzero(np.diff(groups)) + 1):
        keys, points = tuple(all_keys[group].tolist()), int(counts[group].sum())
        path = folder / f"{len(units):06d}{RUN_SUFFIX}"
        units.append(FilterUnit(keys, points, spool, rules, dtype, path))
    return units


def _dump(result: Filtered) -> dict[str, Any]:
    """A result as JSON holds it."""
    return result._asdict()


def _load(noted: dict[str, Any]) -> Filtered:
    """A result from what JSON made of it: its scans became text."""
    counts = {reason: {int(scan): n for scan, n in of.items()} for reason, of in noted["left_out"].items()}
    return Filtered(**{**noted, "left_out": counts})


@dataclass(frozen=True, slots=True)
class _Holds:
    """Whether the run that a note speaks of is in the folder, as long as it was."""

    folder: Path

    def __call__(self, result: Filtered) -> bool:
        path = self.folder / result.name
        return (path.stat().st_size if path.exists() else 0) == result.size


def _add(total: Counts, more: Counts) -> None:
    """Add up what was left out."""
    for reason, scans in more.items():
        held = total.setdefault(reason, {})
        for scan, count in scans.items():
            held[scan] = held.get(scan, 0) + count


def filter_voxels(unit: FilterUnit) -> Filtered:
    """Write what stays of the unit's voxels as one run. Pure and idempotent; run in any process."""
    left_out: Counts = {}
    reader = BlockReader(unit.spool)
    keys: list[int] = []
    starts = [0]
    before = after = 0
    with new_file(unit.path) as file:
        for key in unit.keys:
            kept = 0
            for block in reader.blocks(key):
                thin = unit.rules.thin
                verdict = _thinned(block, reader, thin) if thin else _near(block, reader, unit.rules)
                _add(left_out, _counted(block.rows, verdict))
                rows = _narrowed(block.rows[verdict == KEPT], unit.dtype)
                before += places_sum(key, block.rows["local"], unit.spool.lattice)
                after += places_sum(key, rows["local"], unit.spool.lattice)
                file.write(rows[np.lexsort((*canonical_columns(rows), row_codes(rows)))].tobytes())
                kept += len(rows)
            if kept:
                keys.append(key)
                starts.append(starts[-1] + kept)
    if not keys:
        unit.path.unlink()
        return Filtered(unit.path.name, 0, left_out, before, after)
    write_directory(unit.path, np.array(keys, np.uint64), np.array(starts, np.int64))
    return Filtered(unit.path.name, unit.path.stat().st_size, left_out, before, after)


# Verdicts of a point; REASONS[v - 1] for the others.
KEPT = 0
REASONS = (MOVING, OUTLIER, THINNED)


def _counted(rows: NDArray, verdict: NDArray[np.uint8]) -> Counts:
    """What was left out of each scan."""
    found: Counts = {}
    for number, reason in enumerate(REASONS, 1):
        scans, counts = np.unique(rows["scan_index"][verdict == number], return_counts=True)
        if len(scans):
            found[reason] = dict(zip(scans.tolist(), counts.tolist(), strict=True))
    return found


def _narrowed(rows: NDArray, dtype: np.dtype) -> NDArray:
    """The columns of rows that `dtype` has."""
    found = np.empty(len(rows), dtype)
    for name in dtype.names or ():
        found[name] = rows[name]
    return found


def _near(block: Block, reader: BlockReader, rules: Rules) -> NDArray[np.uint8]:
    """Verdicts of `moving` and `outliers`."""
    verdict = np.full(len(block.rows), KEPT, np.uint8)
    if rules.outliers is not None:
        verdict[_is_outlier(block, reader, rules.outliers)] = 1 + REASONS.index(OUTLIER)
    if rules.moving is not None and rules.seen is not None:
        alone = (
            _scans_around(block, reader, rules.moving, np.ones(len(block.rows), np.bool_))
            < rules.moving.number
        )
        if alone.any():
            seen = _scans_around(block, reader, rules.seen, alone) >= rules.seen.number
            verdict[alone & seen] = 1 + REASONS.index(MOVING)
    return verdict


def _pieces(
    block: Block, reader: BlockReader, reach: Reach, left: NDArray[np.bool_]
) -> Iterator[tuple[NearPoints, NDArray[np.int64], NDArray[np.int32], Grid]]:
    """What lies within reach of the points that are `left` (n,), piece by piece, as long as some are.

    Each time: a piece, the queries left in the order of their cells, their positions, and the grid. The block's own
    points come first: in dense places they settle all of it.
    """
    low, high = block.bounds()
    box = low - reach.steps, high + reach.steps
    own = NearPoints.of(block.rows, block.low - box[0])
    grid = Grid.over(box, reach.steps)

    def queries() -> NDArray[np.int64]:
        which = np.flatnonzero(left)
        return which[np.argsort(grid.cells(own.positions[which]), kind="stable")]

    which = queries()
    yield own, which, own.positions[which], grid
    which = queries()
    if not len(which):
        return
    low, high = own.positions[which].min(axis=0) + box[0], own.positions[which].max(axis=0) + box[0]
    base, box = box[0], (low - reach.steps, high + reach.steps)
    grid = Grid.over(box, reach.steps)
    own = own._replace(positions=own.positions - (box[0] - base).astype(np.int32))
    for piece in reader.around(block, box):
        which = queries()
        if not len(which):
            return
        yield piece, which, own.positions[which], grid


def _is_outlier(block: Block, reader: BlockReader, reach: Reach) -> NDArray[np.bool_]:
    """Which points have too few others around."""
    counts = np.zeros(len(block.rows), np.int64)
    left = np.ones(len(block.rows), np.bool_)
    for piece, which, queries, grid in _pieces(block, reader, reach, left):
        positions = piece.positions
        cells = grid.cells(positions)
        order = np.lexsort((*positions.T, cells))
        positions, cells = positions[order], cells[order]
        first = np.append(True, (positions[1:] != positions[:-1]).any(axis=1))
        positions, cells = positions[first], cells[first]
        found = counts[which]
        count_others(
            queries,
            grid.cells(queries),
            positions,
            cells,
            grid.across,
            grid.deep,
            reach.squared,
            reach.number,
            found,
        )
        counts[which] = found
        left[which] = found < reach.number
    return counts < reach.number


def _scans_around(
    block: Block, reader: BlockReader, reach: Reach, asked: NDArray[np.bool_]
) -> NDArray[np.int64]:
    """How many other scans, up to `reach.number`, have a point within reach of each point; 0 where not asked."""
    counts = np.zeros(len(block.rows), np.int64)
    found = np.full((len(block.rows), reach.number), -1, np.int64)
    scans = block.rows["scan_index"].astype(np.int64)
    left = asked.copy()
    for piece, which, queries, grid in _pieces(block, reader, reach, left):
        cells = grid.cells(piece.positions)
        order = np.lexsort((piece.scans, cells))
        of, cells = piece.scans[order], cells[order]
        starts = np.flatnonzero(np.append(True, (cells[1:] != cells[:-1]) | (of[1:] != of[:-1])))
        rows, held = found[which], counts[which]
        other_scans(
            queries, grid.cells(queries), scans[which], piece.positions[order],
            np.append(starts, len(of)), cells[starts], of[starts], grid.across, grid.deep, reach.squared, rows, held,
        )  # fmt: skip
        found[which], counts[which] = rows, held
        left[which] = held < reach.number
    return counts


def _thinned(block: Block, reader: BlockReader, edge: int) -> NDArray[np.uint8]:
    """Verdicts of `thin`: the best of each cube of the lattice stays, of all voxels' points in it."""
    low, high = block.bounds()
    box = low // edge * edge, high // edge * edge + (edge - 1)
    grid = Grid.over(box, edge)
    own = NearPoints.of(block.rows, block.low - box[0])
    best = _best(own, grid, edge)
    cells = grid.cells(own.positions[best])
    candidates = [own.taken(best)]
    if _lies_across(block, box, reader.spool.lattice.voxel_steps):
        for piece in reader.around(block, box):
            rival = piece.taken(np.isin(grid.cells(piece.positions), cells))
            if len(rival.scans):
                candidates.append(rival.taken(_best(rival, grid, edge)))
    # The block's own come first, so that of equal points one of them is found here, and by nobody else: others that
    # are equal are at the same place, and so in the same block.
    chosen = _best(NearPoints.joined(candidates), grid, edge)
    verdict = np.full(len(block.rows), 1 + REASONS.index(THINNED), np.uint8)
    verdict[best[chosen[chosen < len(best)]]] = KEPT
    return verdict


def _lies_across(block: Block, box: Box, voxel_steps: int) -> bool:
    """Whether cubes of a block's points reach out of it."""
    low = block.low + block.corner
    high = np.minimum(low + block.size, block.low + voxel_steps)
    return bool((box[0] < low).any() or (box[1] >= high).any())


def _best(points: NearPoints, grid: Grid, edge: int) -> NDArray[np.int64]:
    """The index of the best point of each cube, by cube."""
    cells = grid.cells(points.positions)
    inside = points.positions % edge
    away = (2 * inside.astype(np.int64) - (edge - 1)) ** 2
    return np.asarray(
        best_of_cells(
            np.argsort(cells, kind="stable"),
            cells,
            away.sum(axis=1),
            row_codes_of(inside),
            points.scans,
            points.intensities,
        )
    )


def row_codes_of(positions: NDArray[np.int32]) -> NDArray[np.uint64]:
    """Morton codes (n,) of positions (n, 3) in a cube of at most a voxel."""
    rows = np.empty(len(positions), [("local", "<i4", (3,))])
    rows["local"] = positions
    return row_codes(rows)
