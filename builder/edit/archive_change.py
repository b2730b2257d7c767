"""Change of an archive, in a transaction: lock it, build the change in a hidden folder, publish it.

New shards are written beside the old ones under new names, and a new index replaces the old one in
one rename. At every moment the folder is therefore either the old archive or the new one. Shards
that the index no longer names are deleted afterwards. If a change is killed, the next one deletes
the files that it left.
"""

import os
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ...schemas.archive.index import INDEX_NAME, SHARD_FOLDER, Header, Source
from ...schemas.archive.level import LEVEL_FOLDER
from ...schemas.archive.vtkhdf import PREVIEW_NAME
from ...schemas.errors import BadRequestError, CorruptError, FormatError
from ...schemas.runtime.new_file import sync_path
from ..build_limits import bytes_beside_records, readers_that_fit
from ..config import BuildConfig
from ..kernels.points.content_hash import SEEDS
from ..kernels.points.voxel_records import position_hash_sum
from ..passes.level_pass import replace_level, write_level
from ..passes.preview import write_preview
from ..passes.verify import voxel_faults
from ..resume.lock import locked
from ..resume.transaction import Transaction
from ..run.executor import Progress
from ..sources.common.colours import parse_classes
from ..spool.run_files import spool_dtype
from ..voxel.record_points import leaves_of

# Points of a unit that reads stored voxels: a few records at a time, on every machine.
UNIT_POINTS = 1 << 21
# End of the advice for a voxel that is too large to be read back: nothing of a change is kept.
OTHERWISE = ", or build again with a smaller --voxel; the archive is what it was"

_OURS = re.compile(r"[0-9]{1,9}-[0-9]{1,9}\.h5(\..*\.?tmp|\.tmp)?")


class Change(Transaction):
    """Change in progress. archive: its old state."""

    def __init__(
        self, target: Path, archive: Archive, config: BuildConfig, progress: Progress | None
    ) -> None:
        super().__init__("change", target, target.parent / f".{target.name}.changing", config, progress)
        self.archive = archive
        self.dtype = spool_dtype(config)
        self.begin = time.perf_counter()
        self.published = False  # the new index has replaced the old one

    @property
    def outcome(self) -> str:
        """Return the end of an error message, which says what a failure leaves."""
        return f"; the archive is {'changed nevertheless' if self.published else 'what it was'}"

    @property
    def with_classes(self) -> bool:
        """Return whether points have radius classes."""
        return self.archive.header.radius_class

    @property
    def points(self) -> NDArray[np.int64]:
        """Return the number of points (v,) of each voxel of the old archive."""
        return self.archive.voxels["rows"][:, 2].astype(np.int64)

    @property
    def reads_all(self) -> bool:
        """Return whether the change ends by reading all records.

        They are read for `radius_now`, a preview or a level.
        """
        derived = (self.target / PREVIEW_NAME).exists() or (self.target / LEVEL_FOLDER).exists()
        return self.archive.header.radius_model == "mean" or derived

    def readers(self, counts: NDArray[np.int64]) -> int:
        """Return the number of jobs that may read back voxels of `counts` points at a time.

        Raise SolidcloudError if the memory does not suffice for one job.
        """
        return readers_that_fit(counts, self.executor.jobs, self.config, OTHERWISE)

    @contextmanager
    def reading(self, counts: NDArray[np.int64]) -> Iterator[int]:
        """Limit the jobs at work to the number that may read back voxels of `counts` points.

        Yield the number of bytes that each may hold beside the record of a voxel. Raise as
        `readers` does.
        """
        readers = self.readers(counts)
        self.executor.at_once = readers
        try:
            yield bytes_beside_records(counts, readers, self.executor.jobs, self.config)
        finally:
            self.executor.at_once = self.executor.jobs

    def units_of(self, rows: NDArray[np.int64]) -> list[tuple[tuple[int, ...], int]]:
        """Group rows of the index into units of about UNIT_POINTS points.

        Return (rows, points) of each.
        """
        points = self.points[rows]
        if not len(rows):
            return []
        cuts = np.flatnonzero(np.diff((np.cumsum(points) - points) // UNIT_POINTS, prepend=-1))
        ends = [*cuts[1:].tolist(), len(rows)]
        return [
            (tuple(rows[a:b].tolist()), int(points[a:b].sum()))
            for a, b in zip(cuts.tolist(), ends, strict=True)
        ]


@contextmanager
def changing(target: Path, jobs: int, memory_bytes: int, progress: Progress | None) -> Iterator[Change]:
    """Lock an archive and open it for a change.

    Provide a hidden folder, which is deleted at the end.
    """
    target = target.resolve()
    if not (target / INDEX_NAME).is_file():
        raise FormatError(
            f"{target}: no archive here ({INDEX_NAME} not found): build one with `solidcloud build`"
        )
    with locked(target), Archive(target) as archive:
        change = Change(target, archive, config_of(archive.header, target, jobs, memory_bytes), progress)
        shutil.rmtree(change.folder, ignore_errors=True)
        delete_orphans(target, {name for name, _ in archive.shards()})
        try:
            for name in ("spool", "before", SHARD_FOLDER):
                (change.folder / name).mkdir(parents=True)
            with change.workers(archive.header.points), change.machine_errors():
                yield change
        finally:
            shutil.rmtree(change.folder, ignore_errors=True)


def config_of(header: Header, target: Path, jobs: int, memory_bytes: int) -> BuildConfig:
    """Return the options that an archive was built with.

    Raise BadRequestError for options under which no scan can be added later.
    """
    stored = dict(header.options)
    known = set(BuildConfig().identity()) | {"cells", "leaf_cells", "models", "drop_classes"}
    if others := sorted(set(stored) - known):
        raise BadRequestError(
            f"{target}: built with {', '.join(others)}, which depend on all scans together: build again"
        )
    for name in ("keep", "models"):
        if name in stored:
            stored[name] = frozenset(filter(None, stored[name].split(",")))
    stored["drop_classes"] = parse_classes(stored.get("drop_classes", ""))
    return BuildConfig(**stored, jobs=jobs, memory_bytes=memory_bytes)


def delete_orphans(target: Path, named: set[str]) -> None:
    """Delete shards that the index does not name, and temporary files of an interrupted run."""
    for path in (target / SHARD_FOLDER).iterdir():
        if path.name not in named and _OURS.fullmatch(path.name):
            path.unlink()


def scan_name(source: Source) -> str:
    """Return the name of a scan in messages."""
    return f"{source.path}[{source.index}]"


def link_kept_shards(change: Change, files: list[tuple[str, int]], new: set[str]) -> None:
    """Link the shards that stay into the hidden folder, which makes it readable as an archive."""
    for name, _ in files:
        if name not in new:
            (change.folder / SHARD_FOLDER / name).symlink_to(change.target / SHARD_FOLDER / name)


@contextmanager
def reading_back(change: Change, new: set[str]) -> Iterator[None]:
    """Add to a CorruptError of the block whether the damaged file is new or an unchanged shard.

    new: names of the new shards. An index that cannot be read counts as new.
    """
    try:
        yield
    except FormatError as error:
        if isinstance(error, CorruptError) and not {path.name for path in error.paths} & new:
            # The error names the path through a link in the hidden folder, which no longer exists
            # when a user reads it.
            raise CorruptError(str(error).replace(str(change.folder), str(change.target))) from error
        raise CorruptError(
            f"{error}: the data read back differ from the data written: check disk and memory, and give the command "
            "again; the archive is what it was"
        ) from error


class _ReadUnit(NamedTuple):
    """New voxels to read back. rows: of the index in `folder`.  points: their total."""

    folder: Path
    rows: tuple[int, ...]
    points: int


def _read_back(unit: _ReadUnit) -> int:
    """Check voxels as verify.py does, reading all their columns.

    Return the `position_hash` (run_files.py).

    Raise CorruptError if a voxel has a fault.
    """
    places = 0
    with Archive(unit.folder) as archive:
        for row in unit.rows:
            record = archive.open_voxel(row)
            with archive.locating(row):
                faults = voxel_faults(archive, row, record, deep=False)
                record.class_counts()
                corner = archive.coordinates[row] * record.voxel_steps
                places += int(position_hash_sum(leaves_of(record), corner, SEEDS[0]))
            if faults:
                raise CorruptError(faults[0], (archive.shard_path(int(archive.voxels["shard"][row])),))
            del record  # free it before the next one is read
    return places


def verify_new(change: Change, new: set[str], places: int) -> None:
    """Read back every voxel that was built. The files of all other voxels are unchanged.

    places: the `position_hash` that their points must have (run_files.py). The sum detects damage
    to runs, which have no checksums. Raise CorruptError if a record is broken, or if the
    records are valid but hold other points.
    """
    with Archive(change.folder) as archive:
        fresh = np.array([name in new for name, _ in archive.shards()], bool)
        rows = np.flatnonzero(fresh[archive.voxels["shard"]])
        points = archive.voxels["rows"][:, 2].astype(np.int64)
    cuts = np.array_split(rows, max(1, int(points[rows].sum()) // UNIT_POINTS))
    units = [_ReadUnit(change.folder, tuple(c.tolist()), int(points[c].sum())) for c in cuts if len(c)]
    with change.stage("verify", int(points[rows].sum()), "points"):
        found = sum(change.run(_read_back, units))
    if (found - places) % (1 << 64):
        raise CorruptError(
            f"{change.target}: the points built anew are not those that were stored and read: the data read back "
            "differ from the data written: check disk and memory, and give the command again; "
            "the archive is what it was"
        )


def publish(change: Change, new: list[str], named: set[str]) -> None:
    """Move the new shards into the archive, replace its index and delete shards it does not name.

    If the process is killed before the index is renamed, the archive is the old one, and the next
    run deletes the new shards. If it is killed afterwards, the archive is the new one, and the next
    run deletes the old shards. An existing preview and an existing level are replaced slightly
    later; until then they name the old generation.
    """
    shards, preview = change.target / SHARD_FOLDER, change.folder / PREVIEW_NAME
    level = change.target / LEVEL_FOLDER
    if (change.target / PREVIEW_NAME).exists():
        with Archive(change.folder) as archive, change.stage("preview", archive.header.points, "points"):
            write_preview(change.folder, change.executor, change.progress)
    if level.exists():
        with Archive(change.folder) as archive, change.stage("level", archive.header.points, "points"):
            write_level(change.folder, change.executor, change.progress)
    try:
        for name in new:
            os.rename(change.folder / SHARD_FOLDER / name, shards / name)
        sync_path(shards)
        os.replace(change.folder / INDEX_NAME, change.target / INDEX_NAME)
        change.published = True
    except BaseException:
        # Look on the disk whether the index was renamed: an interrupt is raised after the call has
        # returned, and a call may fail although a file server has executed it. A renamed index
        # names these shards.
        change.published = not (change.folder / INDEX_NAME).exists()
        if not change.published:
            for name in new:
                with suppress(OSError):
                    (shards / name).unlink()
        raise
    if preview.exists():
        os.replace(preview, change.target / PREVIEW_NAME)
    if level.exists():
        replace_level(change.target, change.folder / LEVEL_FOLDER, change.folder / "old level")
    sync_path(change.target)
    delete_orphans(change.target, named)
