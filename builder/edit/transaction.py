"""Transaction that changes an archive: lock it, build the change in a hidden folder, publish it.

New shards stand beside the old ones under new names, and a new index replaces the old one in one
rename. At every moment there is therefore either the old archive or the new one. Shards that no
index names any more are deleted afterwards. The next change deletes what a killed one left behind.
"""

import os
import re
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ...schemas.archive.index import INDEX_NAME, SHARD_FOLDER, Header, Source
from ...schemas.archive.vtkhdf import PREVIEW_NAME
from ...schemas.errors import BadRequestError, CorruptError, FormatError, SolidcloudError
from ...schemas.process.new_file import sync_folder
from ..config import BuildConfig
from ..kernels.points.content_hash import SEEDS
from ..kernels.points.voxel_records import position_hash_sum
from ..passes.preview import write_preview
from ..passes.verify import voxel_faults
from ..resume.build_directory import locked
from ..run.executor import Executor, worker_count
from ..run.make_executor import make_executor
from ..run.memory_shares import bytes_beside_records, jobs_that_fit, memory_share, readers_that_fit
from ..run.progress import Progress, Silent
from ..spool.spool import spool_dtype
from ..voxel.record_points import leaves_of

# Points of a unit that reads stored voxels: a few records at a time, on every machine.
UNIT_POINTS = 1 << 21
# End of the advice for a voxel that is too large to be read back: nothing of a change is kept.
OTHERWISE = ", or build again with a smaller --voxel; the archive is what it was"

_OURS = re.compile(r"[0-9]{1,9}-[0-9]{1,9}\.h5(\..*\.?tmp|\.tmp)?")


class Change:
    """Change in progress.

    archive: its old state.  target: its folder.  folder: the hidden folder.
    """

    def __init__(
        self,
        target: Path,
        folder: Path,
        archive: Archive,
        config: BuildConfig,
        executor: Executor,
        progress: Progress,
    ) -> None:
        self.target, self.folder, self.archive, self.config = target, folder, archive, config
        self.executor, self.progress = executor, progress
        self.dtype = spool_dtype(config)
        self.begin = time.perf_counter()
        self.seconds: dict[str, float] = {}
        self.published = False  # the new index has replaced the old one

    @property
    def share(self) -> int:
        """Return the bytes of data that each job may hold."""
        return memory_share(self.executor.jobs, self.config)

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
        """Return whether the change ends by reading all records, for `radius_now` or a preview."""
        return self.archive.header.radius_model == "mean" or (self.target / PREVIEW_NAME).exists()

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

    @contextmanager
    def stage(self, name: str, total: int, unit: str) -> Iterator[None]:
        """Time a stage and report it to the progress display."""
        begin = time.perf_counter()
        self.progress.start(name, total, unit)
        try:
            yield
        finally:
            self.progress.finish()
            self.seconds[name] = time.perf_counter() - begin

    def run(self, function: Callable[[Any], Any], units: Sequence[Any]) -> list[Any]:
        """Return function(unit) of each unit, in order; progress advances by `unit.points`."""
        return list(self.executor.map(function, units, self.progress, lambda unit: unit.points))

    def check_room(self, needed: int) -> None:
        """Refuse a change that needs more bytes than are free, before anything is written."""
        free = shutil.disk_usage(self.target.parent).free
        if needed > free:
            raise SolidcloudError(
                f"{self.target.parent}: {free} bytes free, the change needs about {needed}: make room; the archive is "
                "what it was"
            )

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
        config = config_of(archive.header, target, jobs, memory_bytes)
        folder = target.parent / f".{target.name}.changing"
        shutil.rmtree(folder, ignore_errors=True)
        delete_orphans(target, {name for name, _ in archive.shards()})
        try:
            for name in ("spool", "before", SHARD_FOLDER):
                (folder / name).mkdir(parents=True)
            jobs = jobs_that_fit(worker_count(jobs, archive.header.points), config)
            with make_executor(config, jobs) as executor:
                change = Change(target, folder, archive, config, executor, progress or Silent())
                with _machine_errors(change):
                    yield change
        finally:
            shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _machine_errors(change: Change) -> Iterator[None]:
    """Turn a disk or memory failure into an error that tells the state of the archive."""
    try:
        yield
    except (MemoryError, OSError) as error:
        state = "changed nevertheless" if change.published else "what it was"
        found, advice = str(error), "make room, or check the disk"
        if isinstance(error, MemoryError):
            found = f"out of memory ({error or 'no details'})"
            advice = "give fewer --jobs or a smaller --memory, or stop other programs"
        raise SolidcloudError(f"{change.target}: {found}: the archive is {state}: {advice}") from error


def config_of(header: Header, target: Path, jobs: int, memory_bytes: int) -> BuildConfig:
    """Return the options that an archive was built with.

    Raise BadRequestError for options under which no scan can be added later.
    """
    stored = dict(header.options)
    known = set(BuildConfig().identity()) | {"cells", "models", "normal_reach"}
    if others := sorted(set(stored) - known):
        raise BadRequestError(
            f"{target}: built with {', '.join(others)}, which depend on all scans together: build again"
        )
    for name in ("keep", "models"):
        if name in stored:
            stored[name] = frozenset(filter(None, stored[name].split(",")))
    return BuildConfig(**stored, jobs=jobs, memory_bytes=memory_bytes)


def delete_orphans(target: Path, named: set[str]) -> None:
    """Delete shards that the index does not name, and temporary files of an interrupted run."""
    for path in (target / SHARD_FOLDER).iterdir():
        if path.name not in named and _OURS.fullmatch(path.name):
            path.unlink()


def scan_name(source: Source) -> str:
    """Return the name of a scan in messages."""
    return f"{source.path}[{source.index}]"


def show_kept(change: Change, files: list[tuple[str, int]], new: set[str]) -> None:
    """Link the shards that stay into the hidden folder, which makes it readable as an archive."""
    for name, _ in files:
        if name not in new:
            (change.folder / SHARD_FOLDER / name).symlink_to(change.target / SHARD_FOLDER / name)


@contextmanager
def reading_back(change: Change, new: set[str]) -> Iterator[None]:
    """Say in a reading error whether the damaged file is new or an unchanged shard.

    new: names of the new shards. An index that cannot be read is new.
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

    Return the `places_sum` (spool.py).

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

    places: the `places_sum` that their points must have (spool.py). The sum detects damage to
    runs, which have no checksums. Raise CorruptError if a record is broken, or if the
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
    run deletes the old shards. A preview, if there is one, is still the old one for a moment; it
    names its generation.
    """
    shards, preview = change.target / SHARD_FOLDER, change.folder / PREVIEW_NAME
    if (change.target / PREVIEW_NAME).exists():
        with Archive(change.folder) as archive, change.stage("preview", archive.header.points, "points"):
            write_preview(change.folder, change.executor, change.progress)
    try:
        for name in new:
            os.rename(change.folder / SHARD_FOLDER / name, shards / name)
        sync_folder(shards)
        os.replace(change.folder / INDEX_NAME, change.target / INDEX_NAME)
        change.published = True
    except BaseException:
        # The disk tells whether the index was renamed: an interrupt is raised after the call has
        # returned, and a call may report failure although a file server has done it. A renamed
        # index names these shards.
        change.published = not (change.folder / INDEX_NAME).exists()
        if not change.published:
            for name in new:
                with suppress(OSError):
                    (shards / name).unlink()
        raise
    if preview.exists():
        os.replace(preview, change.target / PREVIEW_NAME)
    sync_folder(change.target)
    delete_orphans(change.target, named)
