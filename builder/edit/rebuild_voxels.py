"""Rebuilding of the voxels that a change affects: new records, new index, and their publication."""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ...schemas.archive.archive_writer import write_index
from ...schemas.archive.index import SHARD_FOLDER, Header, RadiusNow, Source
from ...schemas.archive.voxel_grid import voxel_coordinates
from ...schemas.errors import CorruptError
from ..build_limits import (
    ARCHIVE_BYTES_A_POINT,
    DENSE_POINTS,
    RADIUS_SAMPLE,
    SCRATCH_BYTES_A_POINT,
)
from ..passes.build_shards import Shard, ShardUnit, build_shard, max_neighbours, plan_shards
from ..passes.point_spacing import archive_mean
from ..passes.spool_pass import MIN_RUN_POINTS
from ..sources.coincident_scans import coincident_sources
from ..spool.spool import Spool
from .affected_voxels import affected_voxels
from .archive_change import Change, link_kept_shards, publish, reading_back, verify_new
from .stored_points import (
    RUN_BYTES_A_POINT,
    CappedUnit,
    GatherUnit,
    count_capped,
    gather,
)


class ChangeSummary(NamedTuple):
    """Result of a change.

    generation: of the archive now.  points_before, points: in the archive.
    voxels: number in the archive.  built: number rebuilt.  gone: number that became empty.
    bytes: of the new shards.  dead_bytes: of replaced records that stay on disk in shards still in
    use.
    radius: the stored radius [m].  radius_now: the radius of the points now; None if it was given.
    scans: scans added or removed, as the index names them.
    skipped: reason -> points of the added scans that were left out.
    warnings: sentences about the added scans.
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
    skipped: dict[str, int]
    warnings: tuple[str, ...] = ()


class ChangeSpec(NamedTuple):
    """Intended change. header: with the new sources.  scans: names of the scans added or removed.

    boxes: key -> box (2, 3) of the points that change, lattice.  dropped: scans whose points are
    removed.
    places: `position_hash` of the points already spooled (run_files.py).  added: key -> number of
    these points.
    """

    header: Header
    scans: tuple[str, ...]
    boxes: Mapping[int, NDArray[np.int64]]
    dropped: frozenset[int] = frozenset()
    places: int = 0
    added: Mapping[int, int] = {}


def rebuild(change: Change, spec: ChangeSpec, check: Callable[[], None] = lambda: None) -> ChangeSummary:
    """Rebuild what a change affects, and publish it. check: called before publication.

    Raise CorruptError if the data read back differ from the data written, and SolidcloudError if
    there is not enough disk space, or not enough memory for a voxel. After an error the archive is
    unchanged.
    """
    before = change.archive.header
    header = replace(spec.header, generation=before.generation + 1, radius_now=None)
    rebuilt, read = affected_voxels(change.archive, spec.boxes)
    built, there = _points_after(change, rebuilt, spec.added)
    for counts in (change.points[read], there if change.reads_all else built):
        change.readers(counts)
    change.check_space(_room(change, header, rebuilt, read, built))
    gathered = _gather(change, rebuilt, read, spec.dropped)
    spool = Spool(change.folder / "spool", change.dtype, header.lattice)
    wanted = set(spec.boxes) | set(change.archive.voxels["key"][rebuilt].tolist())
    shards = _build(change, header, spool, wanted)
    header, table, files = _new_index(change, header, rebuilt, shards)
    header = replace(
        header,
        radius_counts=before.radius_counts - gathered.radius_counts + sum(s.radius_counts for s in shards),
        radius_capped=before.radius_capped - gathered.capped + sum(s.radius_capped for s in shards),
    )
    _check_counts(change, header)
    new = {s.name for s in shards}
    link_kept_shards(change, files, new)
    write_index(change.folder, header, table, files)
    to_read = table if change.reads_all else np.concatenate([table[:0], *(s.rows for s in shards)])
    with reading_back(change, new), change.reading(to_read["rows"][:, 2].astype(np.int64)):
        header = _measure(change, header)
        write_index(change.folder, header, table, files)
        verify_new(change, new, spec.places + gathered.places)
        check()
        publish(change, sorted(new), {name for name, _ in files})
    return ChangeSummary(
        archive=change.target,
        generation=header.generation,
        scans=spec.scans,
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
        skipped=_left_out(header.sources[len(before.sources) :]),
        warnings=coincident_sources(header.sources[len(before.sources) :]),
    )


def _left_out(sources: Sequence[Source]) -> dict[str, int]:
    """Return the points left out of some scans, by reason."""
    return dict(sum((Counter(source.skipped) for source in sources), Counter[str]()))


def _points_after(
    change: Change, rebuilt: NDArray[np.int64], added: Mapping[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return upper bounds on the points of each voxel to build, and of each final voxel."""
    keys, points = change.archive.voxels["key"], change.points
    new, counts = np.array(list(added), np.uint64), np.array(list(added.values()), np.int64)
    at = np.minimum(np.searchsorted(keys, new), len(keys) - 1)
    known = keys[at] == new
    points[at[known]] += counts[known]
    more = counts[~known]
    return np.concatenate([points[rebuilt], more]), np.concatenate([points, more])


def _room(
    change: Change,
    header: Header,
    rebuilt: NDArray[np.int64],
    read: NDArray[np.int64],
    built: NDArray[np.int64],
) -> int:
    """Estimate the bytes still to be written.

    These are the runs of the voxels read, the records of the voxels built, and the scratch files of
    dense voxels, one per job. built: (b,) upper bounds on the points of the voxels built.
    """
    archive, before = change.archive, change.archive.header
    # With radius classes, the points read are spooled a second time, in their state before the
    # change.
    a_point = change.dtype.itemsize * (2 if change.with_classes else 1)
    runs = int(archive.voxels["rows"][read, 2].sum(dtype=np.int64)) * a_point
    added = sum(source.count for source in header.sources[len(before.sources) :])
    records = int(archive.voxels["frame_bytes"][rebuilt].sum(dtype=np.int64)) + added * ARCHIVE_BYTES_A_POINT
    dense = np.sort(built[built > DENSE_POINTS])[-change.executor.jobs :]
    return runs + records + int(dense.sum()) * SCRATCH_BYTES_A_POINT


def _dead_bytes(archive: Archive, rebuilt: NDArray[np.int64], files: list[tuple[str, int]]) -> int:
    """Return the bytes of replaced records in shards that stay."""
    named = {name for name, _ in files}
    stays = np.array([name in named for name, _ in archive.shards()], bool)
    rows = archive.voxels[rebuilt]
    return int(rows["frame_bytes"][stays[rows["shard"]]].sum(dtype=np.int64))


class _Before(NamedTuple):
    """Stored state of the voxels to rebuild.

    radius_counts: of each class.  capped: their part of `radius_capped`.  places: `position_hash`
    of their points that stay (run_files.py).
    """

    radius_counts: NDArray[np.int64]
    capped: int
    places: int


def _gather(
    change: Change, rebuilt: NDArray[np.int64], read: NDArray[np.int64], dropped: frozenset[int]
) -> _Before:
    """Spool the stored points that are needed."""
    config, folder = change.config, change.folder
    before = folder / "before" if change.with_classes else None
    groups = [
        (rows, group) for rows in (rebuilt, np.setdiff1d(read, rebuilt)) for group in change.units_of(rows)
    ]
    with change.reading(change.points[read]) as beside:
        # With radius classes, two runs are filled at the same time.
        most = max(MIN_RUN_POINTS, beside // (RUN_BYTES_A_POINT * (2 if before else 1)))
        units = [
            GatherUnit(
                change.target,
                rows,
                points,
                folder / "spool",
                f"old-{number:06d}",
                dropped,
                before,
                config,
                most,
            )
            for number, (_, (rows, points)) in enumerate(groups)
        ]
        with change.stage("gather", sum(unit.points for unit in units), "points"):
            parts = [
                part
                for (rows, _), part in zip(groups, change.run(gather, units), strict=True)
                if rows is rebuilt
            ]
    counts = sum((part.radius_counts for part in parts), np.zeros(32, np.int64))
    places = sum(part.places for part in parts)
    keys = [part.perhaps_capped for part in parts if part.perhaps_capped]
    if not keys or before is None:
        return _Before(counts, 0, places)
    spool = Spool(before, change.dtype, change.archive.header.lattice)
    few = [
        CappedUnit(held, sum(map(spool.count, held)), spool, config, max_neighbours(change.share))
        for held in keys
    ]
    with change.stage("neighbours", sum(unit.points for unit in few), "points"):
        return _Before(counts, sum(change.run(count_capped, few)), places)


def _build(change: Change, header: Header, spool: Spool, wanted: set[int]) -> list[Shard]:
    """Build the voxels of `wanted` that hold points, into new shards in the hidden folder."""
    which = np.isin(spool.keys, np.array(sorted(wanted), np.uint64))
    units = [
        ShardUnit(
            number, header.generation, keys, points, spool, header.lattice, change.config, max_neighbours(change.share),
            header.archive_id, change.folder / SHARD_FOLDER,
        )
        for number, (keys, points) in enumerate(plan_shards(spool.keys[which], spool.counts[which]))
    ]  # fmt: skip
    with change.stage("build", sum(unit.points for unit in units), "points"):
        return change.run(build_shard, units)


def _new_index(
    change: Change, header: Header, rebuilt: NDArray[np.int64], shards: list[Shard]
) -> tuple[Header, NDArray, list[tuple[str, int]]]:
    """Return the new header, the rows of the new index, ascending, and the shards it names.

    The header has the counts and bounds of both kept and new voxels.
    """
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
    """Raise CorruptError unless the number of points equals that of the scans."""
    expected = sum(s.count for s in header.sources)
    if header.points != expected:
        raise CorruptError(
            f"{change.target}: {header.points} points after the change, expected {expected}: see solidcloud validate"
        )


def _measure(change: Change, header: Header) -> Header:
    """Measure the mean closest-point distance after the change, unless the radius was given."""
    if header.radius_model != "mean":
        return header
    with change.stage("radius", header.points, "points"):
        found = archive_mean(change.folder, RADIUS_SAMPLE, change.executor, change.progress)
    if not found.sample:
        return header
    return replace(header, radius_now=RadiusNow(found.mean / 2, found.error / 2, found.sample))
