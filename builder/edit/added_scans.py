"""Preparation of scans that are added to an archive: check for duplicates, survey and spool."""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.index import Header, Source
from ...schemas.archive.units import MAX_SCANS
from ...schemas.archive.voxel_grid import voxel_coordinates
from ...schemas.errors import BadRequestError, ScanError
from ..build_limits import ARCHIVE_BYTES_A_POINT
from ..passes.radius_classes import ALL_CODES
from ..passes.spool_pass import SpoolUnit, run_points, spool_range
from ..passes.survey_pass import Survey, hash_file, join_ranges, ranges, survey_range, unopened_survey
from ..sources.coincident_scans import is_one_position
from ..sources.common.scan import Scan
from ..sources.scan_files import InputFile, open_scans
from ..spool.spool import Spool
from .archive_change import Change, scan_name

# Most scans that an error message names.
MAX_NAMED = 10
# Most rows of a voxel in memory at once while its box is computed.
BOX_POINTS = 1 << 18


class AddOptions(NamedTuple):
    """Selection of the scans to add.

    again: also add scans that the archive already contains.
    new_only: skip scans that the archive already contains.
    strict: refuse a scan with points that are not finite, or beyond 1e9 m.
    """

    again: bool = False
    new_only: bool = False
    strict: bool = False


def survey_added(change: Change, inputs: Sequence[InputFile], wanted: AddOptions) -> list[Survey]:
    """Return the surveys of the scans of `inputs` to add, all of them usable.

    Scans that the archive already contains are reported before any points are read.
    Raise ScanError for unusable scans, BadRequestError for scans that cannot be added.
    """
    if faults := [unopened_survey(item.path, item.fault).fault for item in inputs if not item.scans]:
        raise ScanError("\n  ".join(faults))
    scans = [scan for item in inputs for scan in item.scans]
    files = list(dict.fromkeys(scan.path for scan in scans))
    with change.stage("hash", len(files), "files"):
        hashes = dict(
            zip(files, change.executor.map(hash_file, files, change.progress, lambda _: 1), strict=True)
        )
    if not wanted.again:
        scans = _not_in(
            change, scans, {path: digest for path, (digest, _) in hashes.items()}, wanted.new_only
        )
    count = len(change.archive.header.sources) + len(scans)
    if change.archive.header.scan_index and count > MAX_SCANS:
        raise BadRequestError(
            f"{change.target}: {count} scans including removed ones, --keep scan holds {MAX_SCANS}: build again"
        )
    about = sum(scan.declared_count or 0 for scan in scans)
    cut = [ranges(scan, about) for scan in scans]
    with change.stage("survey", about, "points"):
        parts = iter(change.run(survey_range, [unit for units in cut for unit in units]))
        surveys = [
            join_ranges(scan, [next(parts) for _ in units], hashes[scan.path])
            for scan, units in zip(scans, cut, strict=True)
        ]
    if faults := [survey.fault for survey in surveys if survey.fault]:
        raise ScanError("\n  ".join(faults))
    if not any(survey.count for survey in surveys):
        raise ScanError(f"{surveys[0].path}: no usable point, expected at least one: nothing to add")
    if wanted.strict and (unclean := [survey for survey in surveys if survey.unclean]):
        found = (f"{survey.path}: {survey.unclean}" for survey in unclean)
        raise ScanError("\n  ".join(found) + ", expected none with --strict: clean the scan")
    return surveys


def _not_in(change: Change, scans: list[Scan], hashes: Mapping[Path, str], new_only: bool) -> list[Scan]:
    """Return the scans whose contents are not yet in the archive.

    Raise BadRequestError, naming the scans that are already there, if there are any and `new_only`
    is not set, or if no new scan remains.
    """
    known = {(s.sha256, s.index): scan_name(s) for s in change.archive.header.sources if not s.fault}
    new, there = [], []
    for scan in scans:
        key, name = (hashes[scan.path], scan.index), f"{scan.path}[{scan.index}]"
        if key in known and key[0]:
            there.append(f"{name} is already in the archive, as {known[key]}")
            continue
        known[key] = name
        new.append(scan)
    if there and not (new and new_only):
        more = [f"and {len(there) - MAX_NAMED} more"] if len(there) > MAX_NAMED else []
        advice = (
            "nothing is new"
            if new_only
            else "leave out those already in the archive, or give --new, or --again to add them twice"
        )
        raise BadRequestError(
            "\n  ".join([f"{len(there)} of {len(scans)} scans: {advice}", *there[:MAX_NAMED], *more])
        )
    return new


def spool_added(change: Change, surveys: list[Survey]) -> tuple[float, int]:
    """Spool the new scans.

    Return the largest distance that quantising moved a point [m] and the `position_hash`
    (run_files.py).
    """
    header, dtype, folder = change.archive.header, change.dtype, change.folder / "spool"
    most, first = run_points(change.share, dtype), len(change.archive.header.sources)
    change.check_space(sum(survey.count for survey in surveys) * (dtype.itemsize + ARCHIVE_BYTES_A_POINT))
    units = [
        SpoolUnit(
            survey.scan, number, part.start, part.stop, part.count, header.lattice, change.config, dtype, folder,
            f"new-{number:06d}-{part.start:012d}", most, survey.brightest,
        )
        for number, survey in enumerate(surveys, first)
        for part in survey.parts
        if survey.scan is not None
    ]  # fmt: skip
    with change.stage("spool", sum(unit.count for unit in units), "points"):
        spooled = list(change.executor.map(spool_range, units, change.progress, lambda unit: unit.count))
    return max(found.moved_max for found in spooled), sum(found.places for found in spooled)


def source_of(survey: Survey) -> Source:
    """Return the index entry of a scan that was added."""
    scan = survey.scan
    assert scan is not None
    return Source(
        str(survey.path), scan.index, scan.format, survey.sha256, survey.count, scan.pose, survey.dropped,
        crs=scan.crs, units=scan.units, up=scan.up, one_place=is_one_position(survey.low, survey.high, survey.count),
    )  # fmt: skip


def no_longer_unknown(header: Header, surveys: Sequence[Survey]) -> Header:
    """Return the header without the unknown regions of scans that are added now.

    A build had left these scans out. They are matched by path. The region of a file that could not
    be opened stays until all scans in it are in the archive.
    """
    added = {(os.path.realpath(s.path), s.scan.index) for s in surveys if s.scan is not None}
    there = {(os.path.realpath(s.path), s.index) for s in header.sources if not s.fault}
    files = {path for path, _ in added}

    @cache
    def is_complete(path: str) -> bool:
        return path in files and {(path, scan.index) for scan in open_scans(Path(path))} <= added | there

    sources, gone = [], set()
    for source in header.sources:
        path = os.path.realpath(source.path)
        # The entry of a file that could not be opened stands for all scans in it.
        here = (path, source.index) in added if source.format else is_complete(path)
        if source.unknown is not None and here:
            gone.add(source.unknown)
            fault = f"{scan_name(source)}: left out at first, added in generation {header.generation + 1}"
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


def box_of(key: int, spool: Spool) -> NDArray[np.int64]:
    """Return the bounding box (2, 3) of a voxel's rows in lattice coordinates.

    At most about BOX_POINTS rows of a large voxel are in memory at a time.
    """
    if spool.count(key) <= BOX_POINTS:
        parts: Iterable[NDArray] = spool.rows(key)
    else:
        parts = chain.from_iterable(spool.block_windows(key, ALL_CODES.start, ALL_CODES.stop, BOX_POINTS))
    low, high = np.full(3, spool.lattice.voxel_steps), np.full(3, -1)
    for rows in parts:
        low, high = np.minimum(low, rows["local"].min(axis=0)), np.maximum(high, rows["local"].max(axis=0))
    corner = voxel_coordinates(np.array([key], np.uint64))[0] * spool.lattice.voxel_steps
    return np.stack([low, high]).astype(np.int64) + corner
