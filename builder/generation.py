"""One generation more of an archive: scans added or removed, and only the voxels built that this touches.

How the new archive takes the old one's place is change.py's.
"""

import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..schemas.archive import SHARD_FOLDER, Archive, write_index
from ..schemas.errors import BadRequestError, CorruptError, ScanError
from ..schemas.index import Header, RadiusNow, Source
from ..schemas.voxel_grid import Lattice, voxel_coordinates
from .change import Change, changing, publish, show_kept, verify_new
from .classes import class_limits
from .config import RADIUS_SAMPLE
from .partition import SpoolUnit, run_points, spool_range
from .passes import MAX_SCANS, VOXEL_BYTES_A_POINT
from .pipeline import ARCHIVE_BYTES_A_POINT, open_inputs
from .progress import Progress
from .resume import changed_inputs, described
from .scan_list import Input
from .shards import Shard, ShardUnit, build_shard, plan_shards
from .sources import Scan
from .spacing import archive_mean
from .spool import Spool
from .stored_points import (
    RECORD_BYTES_A_POINT,
    RUN_BYTES_A_POINT,
    FewUnit,
    FindUnit,
    Found,
    GatherUnit,
    count_few,
    find_scans,
    gather,
)
from .survey import Survey, hash_file, joined, ranges, survey_range, unopened

# Scans that an error names.
MOST_NAMED = 10

# A block of a grid and those around it.
AROUND = np.stack(np.meshgrid(*[np.arange(-1, 2)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)

# What removing a scan leaves in its place, so that the numbers of the others stay.
REMOVED = "removed"


class ChangeSummary(NamedTuple):
    """What a change did. generation: of the archive now.  points_before, points: in it.  voxels: in it; built: of them,
    anew; gone: that hold nothing any more.

    bytes: of the new shards.  dead_bytes: of records that were replaced, but stay on disk in shards that are in use.
    radius: the stored figure; radius_now: what it would be now, None where it was given [m].
    scans: those added or removed, as the index names them.
    """

    archive: Path
    generation: int
    scans: tuple[str, ...]
    points_before: int
    points: int
    voxels: int
    built: int
    gone: int
    bytes: int
    dead_bytes: int
    seconds: float
    stages: dict[str, float]
    radius: float
    radius_now: RadiusNow | None


def add_scans(
    target: Path,
    paths: Sequence[Path],
    *,
    again: bool = False,
    new_only: bool = False,
    jobs: int = 0,
    memory_bytes: int = 2 << 30,
    progress: Progress | None = None,
) -> ChangeSummary:
    """Add scans to the archive in `target`: on its lattice, with its options, `radius` as it is stored.

    again: also scans that are in already; new_only: leave those out instead. The records are those that a build of all
    scans would have, on the same lattice and but for the numbers of scans, which go on from those there are. ScanError
    for a scan that cannot be used, BadRequestError for one that is in already, FormatError and CorruptError for an
    archive that cannot be read; the archive is then what it was.
    """
    with changing(Path(target), jobs, memory_bytes, progress) as change:
        inputs = open_inputs(paths, change.config)
        what = described(inputs, change.config)

        def check_unchanged() -> None:
            """A scan's hash need not go with the points that were read of it later."""
            if changed := changed_inputs(inputs, change.config, what):
                raise ScanError(
                    f"{changed}: changed while it was read, expected files that stay as they are: add it again"
                )

        surveys = _survey_added(change, inputs, again, new_only)
        try:
            moved = _spool_added(change, surveys)
        except ScanError:
            check_unchanged()
            raise
        check_unchanged()
        header = change.archive.header
        new = Spool(change.folder / "spool", change.dtype, header.lattice)
        boxes = {key: _box_of(key, new.rows(key), header.lattice) for key in new.keys.tolist()}
        sources = (*header.sources, *(_source(survey) for survey in surveys))
        names = tuple(_named(source) for source in sources[len(header.sources) :])
        header = _no_longer_unknown(header, surveys)
        sources = (*header.sources, *sources[len(header.sources) :])
        header = replace(header, sources=sources, moved_max=max(header.moved_max, moved))
        return _finish(change, header, boxes, frozenset(), names, check_unchanged)


def remove_scans(
    target: Path,
    scans: Sequence[str],
    *,
    jobs: int = 0,
    memory_bytes: int = 2 << 30,
    progress: Progress | None = None,
) -> ChangeSummary:
    """Remove scans from the archive in `target`, which must have been built with `keep` of "scan".

    scans: each a source's path as the index has it (all scans of a file of several), or PATH[INDEX], or its row. A
    source stays in its row, with no points, so that the numbers of the others stay. BadRequestError for a scan that is
    not in, and for the last ones; FormatError and CorruptError for an archive that cannot be read; the archive is then
    what it was.
    """
    with changing(Path(target), jobs, memory_bytes, progress) as change:
        header = change.archive.header
        if not header.scan_index:
            raise BadRequestError(
                f"{target}: built without --keep scan, so no point says which scan it is of: build again with "
                "it, or of the scans that are to stay"
            )
        rows = _rows_of(header.sources, scans, target)
        found = _find_removed(change, rows)
        boxes = {int(change.archive.voxels["key"][f.row]): f.box for f in found}
        sources = tuple(
            replace(s, count=0, fault=f"{_named(s)}: {REMOVED} in generation {header.generation + 1}")
            if row in rows
            else s
            for row, s in enumerate(header.sources)
        )
        names = tuple(_named(header.sources[row]) for row in sorted(rows))
        return _finish(change, replace(header, sources=sources), boxes, rows, names)


# --- what is added --------------------------------------------------------------------------------------


def _survey_added(change: Change, inputs: Sequence[Input], again: bool, new_only: bool) -> list[Survey]:
    """The scans of `inputs` that are to be added, all usable. What is in already is told before points are read."""
    if faults := [unopened(item.path, item.fault).fault for item in inputs if not item.scans]:
        raise ScanError("\n  ".join(faults))
    scans = [scan for item in inputs for scan in item.scans]
    files = list(dict.fromkeys(scan.path for scan in scans))
    with change.stage("hash", len(files), "files"):
        hashes = dict(
            zip(files, change.executor.map(hash_file, files, change.progress, lambda _: 1), strict=True)
        )
    if not again:
        scans = _not_in(change, scans, {path: digest for path, (digest, _) in hashes.items()}, new_only)
    count = len(change.archive.header.sources) + len(scans)
    if change.archive.header.scan_index and count > MAX_SCANS:
        raise BadRequestError(
            f"{change.target}: {count} scans with those removed, --keep scan holds {MAX_SCANS}: build again"
        )
    about = sum(scan.declared_count or 0 for scan in scans)
    cut = [ranges(scan, about) for scan in scans]
    with change.stage("survey", about, "points"):
        parts = iter(change.run(survey_range, [unit for units in cut for unit in units]))
        surveys = [
            joined(scan, [next(parts) for _ in units], hashes[scan.path])
            for scan, units in zip(scans, cut, strict=True)
        ]
    if faults := [survey.fault for survey in surveys if survey.fault]:
        raise ScanError("\n  ".join(faults))
    return surveys


def _not_in(change: Change, scans: list[Scan], hashes: Mapping[Path, str], new_only: bool) -> list[Scan]:
    """The scans that are not in yet, by what is in their files. BadRequestError names those that are in, and refuses
    them unless only new ones are wanted, and then to add none."""
    known = {(s.sha256, s.index): _named(s) for s in change.archive.header.sources if not s.fault}
    new, there = [], []
    for scan in scans:
        key, name = (hashes[scan.path], scan.index), f"{scan.path}[{scan.index}]"
        if key in known and key[0]:
            there.append(f"{name} is in already, as {known[key]}")
            continue
        known[key] = name
        new.append(scan)
    if there and not (new and new_only):
        more = [f"and {len(there) - MOST_NAMED} more"] if len(there) > MOST_NAMED else []
        advice = (
            "nothing is new"
            if new_only
            else "leave out what is in, or give --new, or --again to have it twice"
        )
        raise BadRequestError(
            "\n  ".join([f"{len(there)} of {len(scans)} scans: {advice}", *there[:MOST_NAMED], *more])
        )
    return new


def _spool_added(change: Change, surveys: list[Survey]) -> float:
    """Spool the new scans; returns the farthest that quantising moved a point [m]."""
    header, dtype, folder = change.archive.header, change.dtype, change.folder / "spool"
    most, first = run_points(change.share, dtype), len(change.archive.header.sources)
    change.check_room(sum(survey.count for survey in surveys) * (dtype.itemsize + ARCHIVE_BYTES_A_POINT))
    units = [
        SpoolUnit(
            survey.scan, number, part.start, part.stop, part.count, header.lattice, change.config, dtype, folder,
            f"new-{number:06d}-{part.start:012d}", most,
        )
        for number, survey in enumerate(surveys, first)
        for part in survey.parts
        if survey.scan is not None
    ]  # fmt: skip
    with change.stage("spool", sum(unit.count for unit in units), "points"):
        spooled = list(change.executor.map(spool_range, units, change.progress, lambda unit: unit.count))
    return max(found.moved_max for found in spooled)


def _source(survey: Survey) -> Source:
    """What the index says of a scan that was added."""
    scan = survey.scan
    assert scan is not None
    return Source(
        str(survey.path), scan.index, scan.format, survey.sha256, survey.count, scan.pose, survey.dropped,
        crs=scan.crs, units=scan.units, up=scan.up,
    )  # fmt: skip


def _no_longer_unknown(header: Header, surveys: Sequence[Survey]) -> Header:
    """The header without the regions of scans that a build left out and that are added now, by their paths."""
    added = {(os.path.realpath(s.path), s.scan.index) for s in surveys if s.scan is not None}
    files = {path for path, _ in added}
    sources, gone = [], set()
    for source in header.sources:
        path = os.path.realpath(source.path)
        # A file that could not be opened stands for all scans in it.
        here = (path, source.index) in added or (not source.format and path in files)
        if source.unknown is not None and here:
            gone.add(source.unknown)
            fault = f"{_named(source)}: left out at first, added in generation {header.generation + 1}"
            source = replace(source, fault=fault, unknown=None)
        sources.append(source)
    if not gone:
        return header
    kept = [row for row in range(len(header.unknown)) if row not in gone]
    number: dict[int | None, int | None] = {row: place for place, row in enumerate(kept)}
    number |= {-1: -1, None: None}
    return replace(
        header,
        sources=tuple(replace(source, unknown=number[source.unknown]) for source in sources),
        unknown=header.unknown[kept],
        unknown_everywhere=any(source.unknown == -1 for source in sources),
    )


def _box_of(key: int, parts: list[NDArray], lattice: Lattice) -> NDArray[np.int64]:
    """The box (2, 3) of a voxel's rows, lattice coordinates."""
    low = np.min([rows["local"].min(axis=0) for rows in parts], axis=0)
    high = np.max([rows["local"].max(axis=0) for rows in parts], axis=0)
    corner = voxel_coordinates(np.array([key], np.uint64))[0] * lattice.voxel_steps
    return np.stack([low, high]).astype(np.int64) + corner


# --- what is removed ------------------------------------------------------------------------------------


def _named(source: Source) -> str:
    """A scan as messages name it."""
    return f"{source.path}[{source.index}]"


def _rows_of(sources: Sequence[Source], scans: Sequence[str], target: Path) -> frozenset[int]:
    """The rows of the sources that are meant. BadRequestError names what is not in, and refuses to remove all."""
    held = {row: s for row, s in enumerate(sources) if not s.fault}
    rows: set[int] = set()
    for text in scans:
        wanted = {row for row, s in held.items() if text in (s.path, _named(s), f"{s.path} [{s.index}]")}
        if not wanted and text.isdecimal() and int(text) in held:
            wanted = {int(text)}
        if not wanted:
            there = ", ".join(f"{row}: {_named(s)}" for row, s in list(held.items())[:10])
            more = f" and {len(held) - 10} more (solidcloud info)" if len(held) > 10 else ""
            raise BadRequestError(f"{target}: {text} is no scan of this archive; there are {there}{more}")
        rows |= wanted
    if not rows:
        raise BadRequestError(f"{target}: no scan is named: name at least one")
    if not any(s.count for row, s in held.items() if row not in rows):
        raise BadRequestError(f"{target}: nothing would be left: remove the folder, or leave a scan in")
    return frozenset(rows)


def _find_removed(change: Change, scans: frozenset[int]) -> list[Found]:
    """The voxels that hold points of these scans, all of which must be found."""
    archive = change.archive
    rows = np.arange(len(archive.voxels))
    units = [FindUnit(change.target, held, points, scans) for held, points in change.units_of(rows)]
    with change.stage("find", archive.header.points, "points"):
        found: list[Found] = [voxel for part in change.run(find_scans, units) for voxel in part]
    for scan in sorted(scans):
        count, stored = sum(f.counts.get(scan, 0) for f in found), archive.header.sources[scan].count
        if count != stored:
            raise CorruptError(
                f"{change.target}: {count} points of scan {scan}, the index says {stored}: see solidcloud validate"
            )
    return found


# --- both -----------------------------------------------------------------------------------------------


def _finish(
    change: Change,
    header: Header,
    boxes: Mapping[int, NDArray[np.int64]],
    dropped: frozenset[int],
    names: tuple[str, ...],
    check: Callable[[], None] = lambda: None,
) -> ChangeSummary:
    """Build what the change touches, and publish it. boxes: key -> box (2, 3) of the points that change, lattice.

    header: with its sources as they are to be.  dropped: scans whose points go.  check: called before it is published.
    """
    before = change.archive.header
    header = replace(header, generation=before.generation + 1, radius_now=None)
    rebuilt, read = _touched(change.archive, boxes)
    change.check_room(_room(change, header, rebuilt, read))
    gathered, few = _gather(change, rebuilt, read, dropped)
    spool = Spool(change.folder / "spool", change.dtype, header.lattice)
    wanted = set(boxes) | set(change.archive.voxels["key"][rebuilt].tolist())
    shards = _build(change, header, spool, wanted)
    header, table, files = _new_index(change, header, rebuilt, shards)
    header = replace(
        header,
        radius_counts=before.radius_counts - gathered + sum(s.radius_counts for s in shards),
        radius_capped=before.radius_capped - few + sum(s.radius_capped for s in shards),
    )
    _check_counts(change, header)
    show_kept(change, files, {s.name for s in shards})
    write_index(change.folder, header, table, files)
    header = _measure(change, header)
    write_index(change.folder, header, table, files)
    verify_new(change, {s.name for s in shards})
    check()
    publish(change, [s.name for s in shards], {name for name, _ in files})
    return ChangeSummary(
        archive=change.target,
        generation=header.generation,
        scans=names,
        points_before=before.points,
        points=header.points,
        voxels=len(table),
        built=sum(len(s.rows) for s in shards),
        gone=len(change.archive.voxels) - int(np.isin(change.archive.voxels["key"], table["key"]).sum()),
        bytes=sum(s.size for s in shards),
        dead_bytes=_dead_bytes(change.archive, rebuilt, files),
        seconds=time.perf_counter() - change.begin,
        stages=change.seconds,
        radius=header.radius,
        radius_now=header.radius_now,
    )


def _room(change: Change, header: Header, rebuilt: NDArray[np.int64], read: NDArray[np.int64]) -> int:
    """Bytes, about, that are yet to be written: runs of what is read, and the records of what is built."""
    archive, before = change.archive, change.archive.header
    # With radius classes what is read is spooled once more, as it was before.
    a_point = change.dtype.itemsize * (2 if change.with_classes else 1)
    runs = int(archive.voxels["rows"][read, 2].sum(dtype=np.int64)) * a_point
    added = sum(source.count for source in header.sources[len(before.sources) :])
    records = int(archive.voxels["frame_bytes"][rebuilt].sum(dtype=np.int64)) + added * ARCHIVE_BYTES_A_POINT
    return runs + records


def _dead_bytes(archive: Archive, rebuilt: NDArray[np.int64], files: list[tuple[str, int]]) -> int:
    """Bytes of the records that were replaced, but stand in shards that stay."""
    named = {name for name, _ in files}
    stays = np.array([name in named for name, _ in archive.shards()], bool)
    rows = archive.voxels[rebuilt]
    return int(rows["frame_bytes"][stays[rows["shard"]]].sum(dtype=np.int64))


def _touched(
    archive: Archive, boxes: Mapping[int, NDArray[np.int64]]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of the index to be built anew where points in `boxes` change, and those whose points are needed for it.

    Where points have radius classes, those as far off as a neighbour counts have a say in each other.
    """
    lattice, keys = archive.header.lattice, archive.voxels["key"]
    touched = np.isin(keys, np.array(list(boxes), np.uint64))
    if not archive.header.radius_class:
        rows = np.flatnonzero(touched)
        return rows, rows
    reach2 = class_limits(lattice.step).reach2
    corner = archive.coordinates * lattice.voxel_steps
    held = np.stack([corner + archive.voxels["low"], corner + archive.voxels["high"]], axis=1)
    changed = np.stack(list(boxes.values()))
    rebuilt = touched | within_reach(held, changed, reach2)
    read = rebuilt | within_reach(held, np.concatenate([held[rebuilt], changed]), reach2)
    return np.flatnonzero(rebuilt), np.flatnonzero(read)


def within_reach(held: NDArray[np.int64], boxes: NDArray[np.int64], reach2: int) -> NDArray[np.bool_]:
    """Which boxes (v, 2, 3) lie within a squared distance of some of the others (b, 2, 3), corners inclusive.

    Both are put into blocks of a grid, and only boxes of neighbouring blocks held against each other: a block is as
    long as the longest of them and the reach, so that no other is near.
    """
    found = np.zeros(len(held), bool)
    if not len(held) or not len(boxes):
        return found
    farther = int(reach2**0.5) + 1  # no gap counts for more, so that squares stay small
    block = farther + 1 + max(int((each[:, 1] - each[:, 0]).max()) + 1 for each in (held, boxes))
    corners = np.concatenate([held[:, 0], boxes[:, 0]])
    block = max(
        block, int((corners.max(axis=0) - corners.min(axis=0)).max()) >> 20
    )  # their numbers fit 64 bits
    of_held, of_boxes = held[:, 0] // block, boxes[:, 0] // block
    least = np.minimum(of_held.min(axis=0), of_boxes.min(axis=0)) - 1
    _, size_y, size_z = (int(n) for n in np.maximum(of_held.max(axis=0), of_boxes.max(axis=0)) - least + 2)

    def numbered(blocks: NDArray[np.int64]) -> NDArray[np.int64]:
        x, y, z = (blocks - least).T
        return (x * size_y + y) * size_z + z

    place = numbered(of_held)
    order = np.argsort(place, kind="stable")
    place = place[order]
    by_block = np.argsort(numbered(of_boxes), kind="stable")
    starts = np.flatnonzero(np.diff(numbered(of_boxes)[by_block], prepend=-1))
    for here in np.split(by_block, starts[1:]):
        around = numbered(of_boxes[here[0]] + AROUND)
        first, past = np.searchsorted(place, around), np.searchsorted(place, around, side="right")
        left = np.concatenate([order[a:b] for a, b in zip(first.tolist(), past.tolist(), strict=True)])
        for low, high in boxes[here]:
            left = left[~found[left]]
            if not len(left):
                break
            gap = np.maximum(np.maximum(held[left, 0] - high, low - held[left, 1]), 0)
            gap = np.minimum(gap, farther + 1)
            found[left[(gap * gap).sum(axis=1) <= reach2]] = True
    return found


def _gather(
    change: Change, rebuilt: NDArray[np.int64], read: NDArray[np.int64], dropped: frozenset[int]
) -> tuple[NDArray[np.int64], int]:
    """Spool the stored points that are needed. Returns what the voxels to be rebuilt had of `radius_counts` and of
    `radius_capped`."""
    config, folder = change.config, change.folder
    densest = int(change.archive.voxels["rows"][read, 2].max(initial=0))
    most = max(1 << 16, (change.share - RECORD_BYTES_A_POINT * densest) // RUN_BYTES_A_POINT)
    before = folder / "before" if change.with_classes else None
    groups = [
        (rows, group) for rows in (rebuilt, np.setdiff1d(read, rebuilt)) for group in change.units_of(rows)
    ]
    units = [
        GatherUnit(
            change.target, rows, points, folder / "spool", f"old-{number:06d}", dropped, before, config, most
        )
        for number, (_, (rows, points)) in enumerate(groups)
    ]
    with change.stage("gather", sum(unit.points for unit in units), "points"):
        parts = [
            part for (rows, _), part in zip(groups, change.run(gather, units), strict=True) if rows is rebuilt
        ]
    counts = sum((part.radius_counts for part in parts), np.zeros(32, np.int64))
    keys = [part.perhaps_few for part in parts if part.perhaps_few]
    if not keys or before is None:
        return counts, 0
    spool = Spool(before, change.dtype, change.archive.header.lattice)
    few = [FewUnit(held, sum(map(spool.count, held)), spool, config, _most_near(change)) for held in keys]
    with change.stage("neighbours", sum(unit.points for unit in few), "points"):
        return counts, sum(change.run(count_few, few))


def _most_near(change: Change) -> int:
    """Points around a voxel that a job may hold beside it."""
    return max(1 << 16, change.share // (2 * VOXEL_BYTES_A_POINT))


def _build(change: Change, header: Header, spool: Spool, wanted: set[int]) -> list[Shard]:
    """Build the voxels of `wanted` that hold points, into new shards in the hidden folder."""
    which = np.isin(spool.keys, np.array(sorted(wanted), np.uint64))
    units = [
        ShardUnit(
            number, header.generation, keys, points, spool, header.lattice, change.config, _most_near(change),
            header.archive_id, change.folder / SHARD_FOLDER,
        )
        for number, (keys, points) in enumerate(plan_shards(spool.keys[which], spool.counts[which]))
    ]  # fmt: skip
    with change.stage("build", sum(unit.points for unit in units), "points"):
        return change.run(build_shard, units)


def _new_index(
    change: Change, header: Header, rebuilt: NDArray[np.int64], shards: list[Shard]
) -> tuple[Header, NDArray, list[tuple[str, int]]]:
    """The rows of the new index, ascending, the shards it names, and the header with counts and bounds of both."""
    kept = np.delete(change.archive.voxels, rebuilt)
    used, where = np.unique(kept["shard"], return_inverse=True)
    kept["shard"] = where
    files = [change.archive.shards()[number] for number in used.tolist()]
    tables = [kept]
    for number, shard in enumerate(shards, len(files)):
        rows = shard.rows.copy()
        rows["shard"] = number
        tables.append(rows)
    files += [(shard.name, shard.size) for shard in shards]
    table = np.concatenate(tables)
    table = table[np.argsort(table["key"], kind="stable")]
    base = voxel_coordinates(table["key"]) * header.lattice.voxel_steps
    header = replace(
        header,
        points=int(table["rows"][:, 2].sum(dtype=np.int64)),
        low=(base + table["low"]).min(axis=0),
        high=(base + table["high"]).max(axis=0),
    )
    return header, table, files


def _check_counts(change: Change, header: Header) -> None:
    """What is built must be what the scans had."""
    expected = sum(s.count for s in header.sources)
    if header.points != expected:
        raise CorruptError(
            f"{change.target}: {header.points} points after the change, expected {expected}: see solidcloud validate"
        )


def _measure(change: Change, header: Header) -> Header:
    """Measure the mean closest-point distance of what there is now; not where the radius was given."""
    if header.radius_model != "mean":
        return header
    with change.stage("radius", header.points, "points"):
        found = archive_mean(change.folder, RADIUS_SAMPLE, change.executor, change.progress)
    if not found.sample:
        return header
    return replace(header, radius_now=RadiusNow(found.mean / 2, found.error / 2, found.sample))
