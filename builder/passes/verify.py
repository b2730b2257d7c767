"""Verification of an archive: reopens it and checks every invariant that FORMAT.md states."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ...schemas.archive.codec import DecompressedRecord
from ...schemas.archive.index import INDEX_NAME, SHARD_FOLDER, Header
from ...schemas.archive.level import LEVEL_FOLDER, open_level
from ...schemas.archive.radius_model import RADIUS_CLASSES
from ...schemas.errors import BadRequestError, CorruptError, FormatError, SolidcloudError
from ...schemas.runtime.interrupts import check_interrupt
from ..kernels.points.content_hash import SEEDS
from ..kernels.points.voxel_records import last_unenclosing_node, measure_points, position_hash_sum
from ..run.executor import Executor, Progress, Silent, jobs_of, run_units, voxel_ranges, worker_count
from ..voxel.exact_enclosure import loose_nodes, sample_nodes
from ..voxel.record_points import leaves_of, spheres_of
from .level_pass import check_level
from .preview import preview_faults


class VerifyReport(NamedTuple):
    """Result of a verification: what was checked, and every fault, one sentence each.

    exact_nodes: bounds verified in Python integers, out of `nodes`.
    notes: facts that are not faults: unknown files, shards that no voxel uses any more.
    damaged: shards with faults.  others: whether the records are valid, but contain other points
    than expected.
    """

    voxels: int
    points: int
    faults: tuple[str, ...]
    nodes: int = 0
    exact_nodes: int = 0
    notes: tuple[str, ...] = ()
    damaged: tuple[str, ...] = ()
    others: bool = False


# Cost of verifying a point relative to building it, for `worker_count`: 10, 60 and 6,000 ns were
# measured, and 600 ns for building.
_WORK, _DEEP_WORK, _EXACT_WORK = 1 / 60, 1 / 10, 10


class _Unit(NamedTuple):
    """Voxels to check. asked: nodes of each voxel to verify exactly; None: none.

    summed: compute the sum of their points' positions.
    """

    folder: Path
    rows: range
    deep: bool
    asked: list[NDArray[np.int64]] | None
    summed: bool
    points: int


class _Found(NamedTuple):
    """Result of a unit.

    points: in voxels that could be read.  classes: (RADIUS_CLASSES,), of those points.
    places: sum of their positions, see `position_hash`; 0 if not requested.  damaged: shards with
    faults.
    """

    faults: list[str]
    points: int
    classes: NDArray[np.int64]
    proved: int
    places: int
    damaged: set[Path]


def verify_archive(
    folder: Path,
    *,
    deep: bool = False,
    exact: bool = False,
    sample: int | None = None,
    progress: Progress | None = None,
    executor: Executor | None = None,
    places: int | None = None,
) -> VerifyReport:
    """Read every record and check it.

    deep: also check that every bound encloses all points below it, exactly, and that normals are
    those of the points.
    exact: verify the bounds once more in Python integers, without compiled code.
    sample: verify only this many of them, spread over the archive; None: all.
    executor: runs the work; None: this process.
    places: the `position_hash` that all points must have (run_files.py); None: not known.

    A job holds one voxel: 12 bytes per point of it, 16 with intensities, and 40 if bounds are
    verified. Raise FormatError or CorruptError only if the index itself cannot be used,
    BadRequestError for an invalid sample, SolidcloudError if the archive changes meanwhile; a
    broken record is a fault.
    """
    if sample is not None and (not exact or sample < 1):
        raise BadRequestError(f"--sample {sample}: expected 1 or more, and --exact with it")
    progress = progress or Silent()
    with Archive(folder) as archive:
        header = archive.header
        counts = archive.voxels["rows"].astype(np.int64)
        notes = _strangers(archive)
        faults, more = preview_faults(folder, header)
    asked = sample_nodes(counts[:, 1], sample) if exact else None
    units = [
        _Unit(
            folder,
            rows,
            deep,
            asked[rows.start : rows.stop] if asked is not None else None,
            places is not None,
            int(counts[rows.start : rows.stop, 2].sum()),
        )
        for rows in voxel_ranges(counts[:, 2], jobs_of(executor))
    ]
    progress.start("verify", header.points, "points")
    with unchanged(folder, header):  # because each unit opens the archive again
        results = list(run_units(executor, _verify_rows, units, progress, lambda unit: unit.points))
        with Archive(folder) as archive:
            # Points outside their voxel would be indices outside the arrays that make a level.
            sound = not any(part.faults for part in results)
            of_level, about_level = level_faults(archive, executor, deep=deep and sound)
    progress.finish()
    found = [
        result for _, result in sorted(zip(units, results, strict=True), key=lambda pair: pair[0].rows.start)
    ]
    faults += [*(fault for part in found for fault in part.faults), *of_level]
    points = sum(part.points for part in found)
    others = False
    classes = np.sum([part.classes for part in found], axis=0, dtype=np.int64)
    if not faults and (classes != header.radius_counts).any():
        faults.append(
            f"{folder}: radius classes counted {classes.tolist()} in the records, "
            f"{header.radius_counts.tolist()} in the index: rebuild it"
        )
    if not faults and places is not None and sum(part.places for part in found) % (1 << 64) != places:
        others = True
        faults.append(f"{folder}: the points in the records are not those of the scans: rebuild it")
    proved = sum(part.proved for part in found)
    damaged = tuple(sorted({str(path) for part in found for path in part.damaged}))
    return VerifyReport(
        len(counts),
        points,
        tuple(faults),
        int(counts[:, 1].sum()),
        proved,
        (*notes, *more, *about_level),
        damaged,
        others,
    )


@contextmanager
def unchanged(folder: Path, header: Header) -> Iterator[None]:
    """Raise SolidcloudError if the archive in `folder` is not that of `header` after the block.

    The block has then read a mix of two archives, which may have caused any other error. Otherwise
    errors pass unchanged.
    """
    try:
        yield
    except Exception:
        _check_unchanged(folder, header)
        raise
    _check_unchanged(folder, header)


def _check_unchanged(folder: Path, header: Header) -> None:
    try:
        with Archive(folder) as archive:
            now = archive.header
    except (FormatError, OSError):
        return  # the reader has reported it, or will
    if (now.archive_id, now.generation) != (header.archive_id, header.generation):
        raise SolidcloudError(
            f"{folder}: changed while it was read, generation {header.generation} and then {now.generation}"
            f"{' of another build' if now.archive_id != header.archive_id else ''}: give the command again"
        )


def verify_jobs(folder: Path, jobs: int, *, deep: bool, exact: bool) -> int:
    """Return the number of processes for `verify_archive`.

    It is `jobs`, or for 0 one per core if the archive is large enough.
    """
    with Archive(folder) as archive:
        points = archive.header.points
    return worker_count(jobs, int(points * (_EXACT_WORK if exact else _DEEP_WORK if deep else _WORK)))


def _verify_rows(unit: _Unit) -> _Found:
    """Check a range of voxels; runs in any process."""
    faults: list[str] = []
    points = proved = places = 0
    damaged: set[Path] = set()
    classes = np.zeros(RADIUS_CLASSES, np.int64)
    with Archive(unit.folder) as archive:
        for i, row in enumerate(unit.rows):
            known = len(faults)
            check_interrupt()
            try:
                record = archive.open_voxel(row, columns=("radius_class",))
                with archive.locating(row):
                    faults += voxel_faults(archive, row, record, unit.deep)
                    counted = record.class_counts()
                if unit.summed:
                    corner = archive.coordinates[row] * record.voxel_steps
                    places += int(position_hash_sum(leaves_of(record), corner, SEEDS[0]))
                del record
                if unit.asked is not None:
                    loose = loose_nodes(*archive.read_voxel(row), unit.asked[i].tolist())
                    faults += [_loose(archive, row, node) for node in loose]
                    proved += len(unit.asked[i]) - len(loose)
            except (CorruptError, OSError) as error:
                check_interrupt()
                faults.append(str(error))
            else:
                points += int(archive.voxels["rows"][row, 2])
                classes += counted
            if len(faults) > known:
                damaged.add(archive.shard_path(int(archive.voxels["shard"][row])))
    return _Found(faults, points, classes, proved, places, damaged)


def _loose(archive: Archive, row: int, node: int) -> str:
    """Return the fault of a bound that does not enclose its points."""
    return f"{archive.where(row)}: node {node} does not enclose its points: rebuild the archive"


def voxel_faults(archive: Archive, row: int, record: DecompressedRecord, deep: bool) -> list[str]:
    """Return the faults of one voxel that opening it does not detect.

    Raise CorruptError for a point outside its cell.
    """
    faults = []
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    leaves = leaves_of(record)
    if not measure_points(leaves, np.int64(record.voxel_steps), low, high):
        raise CorruptError(f"voxel {record.key:#x}: a point outside its cell")
    record.check_bounds(np.stack([low, high]))
    # An archive may have no slabs at all: readers treat a node without a normal as a node without a
    # slab.
    nodes = record.nodes
    stray = np.flatnonzero(nodes.slab.any(axis=0) & ~nodes.normal.any(axis=0))
    if len(stray):
        faults.append(f"{archive.where(row)}: node {stray[0]} has a slab but no normal: rebuild the archive")
    if deep:
        node = last_unenclosing_node(leaves, spheres_of(record), nodes.normal, nodes.slab)
        if node >= 0:
            faults.append(_loose(archive, row, node))
    return faults


def level_faults(archive: Archive, executor: Executor | None, *, deep: bool) -> tuple[list[str], list[str]]:
    """Return the faults of the level of an archive, and notes on it; both are empty without a level.

    deep: also check that it is that of the archive's points.
    """
    folder = archive.folder / LEVEL_FOLDER
    if not (folder / INDEX_NAME).is_file():
        return [], []
    try:
        level = open_level(archive)
    except FormatError as error:
        return [str(error)], []
    if level is None:
        return [], [f"{folder}: belongs to another archive or generation"]
    level.close()
    points = archive.voxels["rows"][:, 2].astype(np.int64)
    faults = list(verify_archive(folder, executor=executor).faults)
    if deep and not faults:
        faults += check_level(archive.folder, executor, voxel_ranges(points, jobs_of(executor)), points)
    return faults, []


def _strangers(archive: Archive) -> list[str]:
    """Return notes on unused shards and on files that the index does not name."""
    shards = archive.folder / SHARD_FOLDER
    used = set(np.unique(archive.voxels["shard"]).tolist())
    named = [archive.shard_path(number) for number in range(archive.shard_count())]
    dead = [path for number, path in enumerate(named) if number not in used]
    notes = [f"{path}: no voxel uses this shard any more" for path in dead]
    strangers = sorted(set(shards.iterdir()) - set(named))
    return notes + [f"{path}: not part of this archive: left by a build or by hand" for path in strangers]
