"""Optional filter pass between spool and shards.

It leaves out points by the rules of filter_rules.py and counts them. A unit is a sequence of
consecutive voxels; it writes one run. A job takes about 150 bytes for each of at most 2^19 points:
a voxel with more is processed in cubes by Morton range, and the surroundings of a cube are read
piece by piece. Only the points at a single lattice position are always held at once.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError, CorruptError
from ..config import BuildConfig
from ..resume.kept_work import RUN_FOLDERS, Journal, RunsIntact, Work, run_unfinished
from ..run.executor import Executor, Progress
from ..spool.run_files import (
    RUN_SUFFIX,
    RunSums,
    canonical_columns,
    new_run,
    position_hash,
    row_codes,
    spool_dtype,
    write_directory,
)
from ..spool.spool import Spool
from ..spool.spool_blocks import BlockReader
from .filter_rules import Rules, make_rules
from .filter_verdicts import KEPT, REASONS, near_verdicts, thin_verdicts

# Points in a work unit.
UNIT_POINTS = 1 << 21

# Reason -> scan -> number of points left out.
Counts = dict[str, dict[int, int]]


class FilterUnit(NamedTuple):
    """Voxels to filter. keys: ascending.  dtype: of the rows written.  path: of the run written."""

    keys: tuple[int, ...]
    points: int
    spool: Spool
    rules: Rules
    dtype: np.dtype
    path: Path


class Filtered(NamedTuple):
    """Result of one unit. runs: name of its run -> sums of the run; empty if no point remains.

    places_before, places: the `position_hash` of the points read and of the points kept.
    """

    runs: dict[str, RunSums]
    left_out: Counts
    places_before: int
    places: int


def filtered_spool(
    spool: Spool, config: BuildConfig, folder: Path, executor: Executor, progress: Progress, journal: Journal
) -> tuple[Spool, Counts]:
    """Filter the points of a spool by the options of `config` into new runs below `folder`.

    Return the new spool and the number of points left out of each scan, by reason.
    spool: its rows have `filter_dtype`; those of the result have `spool_dtype`. An interrupted pass
    resumes from its journal. Raise BadRequestError for rules that are impossible on the lattice,
    and if no point remains.
    """
    rules = make_rules(config, spool.lattice)
    passes = []
    if rules.moving or rules.outliers:
        passes.append((RUN_FOLDERS[1], rules._replace(thin=None)))
    if rules.thin:
        passes.append((RUN_FOLDERS[2], Rules(None, None, None, rules.thin)))
    left_out: Counts = {}
    for i, (name, rule) in enumerate(passes):
        target = folder / name
        target.mkdir(parents=True, exist_ok=True)
        dtype = spool_dtype(config) if i == len(passes) - 1 else spool.dtype
        units = _units(spool, rule, dtype, target)
        work = Work(filter_voxels, _dump, _load, RunsIntact(target))
        named = [(f"{name}/{unit.path.stem}", unit) for unit in units]
        results = run_unfinished(journal, executor, work, named, progress, lambda unit: unit.points)
        for result in results:
            _add(left_out, result.left_out)
        if spool.places not in (None, sum(r.places_before for r in results) % (1 << 64)):
            raise CorruptError(
                f"{spool.folder}: the points are not those of the scans: check disk and memory",
                (spool.folder,),
            )
        runs, places = [name for r in results for name in r.runs], sum(r.places for r in results) % (1 << 64)
        spool = Spool(target, dtype, spool.lattice, runs, places)
        if not len(spool.keys):
            raise BadRequestError(
                "no point is left, expected some: change the figures of --thin, --outliers or --moving"
            )
    return spool, left_out


def _units(spool: Spool, rules: Rules, dtype: np.dtype, folder: Path) -> list[FilterUnit]:
    """Group consecutive voxels into units of about UNIT_POINTS points."""
    units: list[FilterUnit] = []
    all_keys, counts = spool.keys, spool.counts
    groups = np.cumsum(counts) // UNIT_POINTS
    for group in np.split(np.arange(len(groups)), np.flatnonzero(np.diff(groups)) + 1):
        keys, points = tuple(all_keys[group].tolist()), int(counts[group].sum())
        path = folder / f"{len(units):06d}{RUN_SUFFIX}"
        units.append(FilterUnit(keys, points, spool, rules, dtype, path))
    return units


def _dump(result: Filtered) -> dict[str, Any]:
    """Convert a result to what JSON holds."""
    return result._asdict()


def _load(noted: dict[str, Any]) -> Filtered:
    """Convert a result from JSON, where scan numbers became text."""
    counts = {reason: {int(scan): n for scan, n in of.items()} for reason, of in noted["left_out"].items()}
    return Filtered(**{**noted, "left_out": counts})


def _add(total: Counts, more: Counts) -> None:
    """Add counts of points left out to a total."""
    for reason, scans in more.items():
        held = total.setdefault(reason, {})
        for scan, count in scans.items():
            held[scan] = held.get(scan, 0) + count


def filter_voxels(unit: FilterUnit) -> Filtered:
    """Write the remaining points of the unit's voxels as one run.

    This is pure and idempotent, and runs in any process.
    """
    left_out: Counts = {}
    reader = BlockReader(unit.spool)
    keys: list[int] = []
    starts = [0]
    before = after = 0
    with new_run(unit.path) as file:
        for key in unit.keys:
            kept = 0
            for block in reader.blocks(key):
                thin = unit.rules.thin
                verdict = (
                    thin_verdicts(block, reader, thin) if thin else near_verdicts(block, reader, unit.rules)
                )
                _add(left_out, _counted(block.rows, verdict))
                rows = _narrowed(block.rows[verdict == KEPT], unit.dtype)
                before += position_hash(key, block.rows["local"], unit.spool.lattice)
                after += position_hash(key, rows["local"], unit.spool.lattice)
                file.write(rows[np.lexsort((*canonical_columns(rows), row_codes(rows)))].tobytes())
                kept += len(rows)
            if kept:
                keys.append(key)
                starts.append(starts[-1] + kept)
    if not keys:
        unit.path.unlink(
            missing_ok=True
        )  # another worker that was given up but still runs this unit may have removed it
        return Filtered({}, left_out, before, after)
    directory = write_directory(unit.path, np.array(keys, np.uint64), np.array(starts, np.int64))
    return Filtered({unit.path.name: [*file.sums, *directory]}, left_out, before, after)


def _counted(rows: NDArray, verdict: NDArray[np.uint8]) -> Counts:
    """Count the points left out of each scan, by reason."""
    found: Counts = {}
    for number, reason in enumerate(REASONS, 1):
        scans, counts = np.unique(rows["scan_index"][verdict == number], return_counts=True)
        if len(scans):
            found[reason] = dict(zip(scans.tolist(), counts.tolist(), strict=True))
    return found


def _narrowed(rows: NDArray, dtype: np.dtype) -> NDArray:
    """Keep only the columns of rows that `dtype` has."""
    found = np.empty(len(rows), dtype)
    for name in dtype.names or ():
        found[name] = rows[name]
    return found
