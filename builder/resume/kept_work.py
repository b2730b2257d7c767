"""Rules by which a restart keeps or discards the finished work of an interrupted build.

The finished work of a build is in its hidden folder, certified by a journal: for each unit of work
an entry, a small JSON file. It is written once everything it refers to is durable on disk. An entry
is therefore never wrong, at whatever moment the power fails. The same command resumes the build:

- `build_directory` keeps the work if the build is the same, by software, options and scans
  (build_identity.py). It refuses another build, and keeps nothing with --fresh.
- `run_unfinished` repeats the units that have no entry, or whose files are not intact:
  `RunsIntact`, `ShardIntact`. Files that no entry certifies are deleted unread.
- `discard_damaged_runs` reads every run once, before any is used. A run that differs from what was
  written is discarded, with everything made from it.
- `BuildDirectory.discard` and `start_over` discard work that is found wrong later: data read back
  that differ from the data written, and scans that changed while they were read.
"""

import json
import os
import shutil
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from ...schemas.archive.archive_writer import file_checksum
from ...schemas.archive.index import SHARD_FOLDER
from ...schemas.errors import BadRequestError, CorruptError, ScanError, SolidcloudError
from ...schemas.runtime.interrupts import check_interrupt
from ...schemas.runtime.new_file import TEMPORARY_SUFFIX, is_temporary, new_file, remove_temporaries
from ..run.executor import Executor, Progress
from ..spool.run_files import RunSums, is_run_damaged, run_sizes
from .build_identity import check_same
from .transaction import Transaction

Unit = TypeVar("Unit")
Result = TypeVar("Result")

# Folders of runs; each is made from the one before it.
RUN_FOLDERS = ("spool", "filter-near", "filter-thin")
# Name of the first journal entry, which describes the build, and of its field that names the work
# folder.
BUILD_ENTRY, WORK_FOLDER_FIELD = "build", "word"


@dataclass(frozen=True, slots=True)
class Journal:
    """Journal of one build. folder: hidden folder of the build.

    Picklable: the process that does the work writes the entry.
    """

    folder: Path

    def write_entry(self, name: str, what: Any) -> None:
        """Write the entry `name`, such as "survey/000003".

        what: any JSON value, including infinities.
        """
        path = self.path(name)
        path.parent.mkdir(exist_ok=True)
        with new_file(path) as file:
            file.write(json.dumps(what, sort_keys=True).encode())

    def read_entry(self, name: str) -> Any:
        """Return the contents of an entry, or None if there is none."""
        try:
            return json.loads(self.path(name).read_bytes())
        except (FileNotFoundError, ValueError):  # no entry, or one truncated by a disk that lost writes
            return None

    def remove_entry(self, name: str) -> None:
        """Remove an entry whose files are missing or damaged."""
        self.path(name).unlink(missing_ok=True)

    def remove_entries_of(self, path: Path) -> None:
        """Remove every entry that certifies a file of this name."""
        for entry in self.folder.rglob("*.json"):
            name = entry.relative_to(self.folder).with_suffix("").as_posix()
            content = self.read_entry(name)
            if isinstance(content, dict) and (
                path.name == content.get("name") or path.name in content.get("runs", ())
            ):
                self.remove_entry(name)

    def path(self, name: str) -> Path:
        """Return the file of an entry."""
        return self.folder / f"{name}.json"


@dataclass(frozen=True, slots=True)
class Work(Generic[Unit, Result]):
    """Units of one kind, and the form of their results in the journal. All functions are picklable.

    run: execute a unit; its output is durable on disk when it returns.
    dump, load: convert a result to a JSON value, and back.
    is_intact: return whether the files that a journalled result refers to still exist.
    """

    run: Callable[[Unit], Result]
    dump: Callable[[Result], Any]
    load: Callable[[Any], Result]
    is_intact: Callable[[Result], bool] = lambda _: True


@dataclass(frozen=True, slots=True)
class _Journalled(Generic[Unit, Result]):
    """Function that executes a unit in any process and journals its result there."""

    journal: Journal
    run: Callable[[Unit], Result]
    dump: Callable[[Result], Any]

    def __call__(self, named: tuple[str, Unit]) -> Result:
        name, unit = named
        result = self.run(unit)
        check_interrupt()  # results made while a signal arrived are not trusted
        self.journal.write_entry(name, self.dump(result))
        return result


def run_unfinished(
    journal: Journal,
    executor: Executor,
    work: Work[Unit, Result],
    units: Sequence[tuple[str, Unit]],
    progress: Progress,
    size: Callable[[Unit], int],
) -> list[Result]:
    """Return the result of each unit (entry name, unit), in order, journalled or computed now."""
    results: dict[str, Result] = {}
    for name, unit in units:
        entry = journal.read_entry(name)
        if entry is None:
            continue
        result = work.load(entry)
        if work.is_intact(result):
            results[name] = result
            progress.advance(size(unit))
        else:
            journal.remove_entry(name)
    left = [named for named in units if named[0] not in results]
    done = executor.map(
        _Journalled(journal, work.run, work.dump), left, progress, lambda named: size(named[1])
    )
    for (name, _), result in zip(left, done, strict=True):
        results[name] = result
    return [results[name] for name, _ in units]


def building_folder(target: Path) -> Path:
    """Return the hidden folder in which the archive `target` is made."""
    return target.parent / f".{target.name}.building"


@dataclass
class BuildDirectory:
    """Hidden folder of a build, and the folder in it that holds the finished work.

    The name of the work folder is unique; an entry in the hidden folder records it. A unit of an
    earlier build that a cluster worker is still running therefore finds no folder to write to.
    hidden: the hidden folder.  entry: the journal entry of the build.
    surveyed: all scans were read to their end once and can be built as requested; later errors
    remove nothing.
    staffed: workers are available; from now on, a refusal concerns the request itself.
    """

    hidden: Path
    entry: dict[str, Any]
    surveyed: bool = False
    staffed: bool = False

    def start_over(self) -> None:
        """Discard all finished work, because the files it was read from have changed."""
        remove_building(self.hidden)

    def discard(self, path: Path) -> None:
        """Discard a run or a shard that differs from what was written.

        path: the file; or the folder of a spool, to discard everything except the survey.
        What was made from a run is discarded with it.
        """
        if path.is_dir():
            self._keep(("survey",))
            return
        if path.parent.name in RUN_FOLDERS:
            self.discard_made_of(path.parent.name)
        self.journal.remove_entries_of(path)

    def discard_made_of(self, folder: str) -> None:
        """Discard the filtered runs and shards made from a folder of RUN_FOLDERS."""
        self._keep(("survey", *RUN_FOLDERS[: RUN_FOLDERS.index(folder) + 1]))

    def _keep(self, names: Sequence[str]) -> None:
        """Keep these folders of finished work, and rename the work folder.

        Units that still work on the rest, or on untrusted data, then have no folder to write to.
        """
        old = self.folder
        entry = {**self.entry, WORK_FOLDER_FIELD: uuid.uuid4().hex}
        folder = self.hidden / entry[WORK_FOLDER_FIELD]
        folder.mkdir()
        for name in names:
            with suppress(FileNotFoundError):
                os.rename(old / name, folder / name)
        Journal(self.hidden).write_entry(BUILD_ENTRY, entry)
        self.entry = entry
        _remove(old)
        self.make_folders()

    def make_folders(self) -> None:
        """Create the folders that passes write to."""
        for folder in (self.folder, self.folder / "spool", self.archive, self.archive / SHARD_FOLDER):
            folder.mkdir(exist_ok=True)

    @property
    def folder(self) -> Path:
        """Return the work folder."""
        return self.hidden / str(self.entry[WORK_FOLDER_FIELD])

    @property
    def journal(self) -> Journal:
        """Return the journal of the finished work."""
        return Journal(self.folder)

    @property
    def archive(self) -> Path:
        """Return the folder that will be renamed to the target."""
        return self.folder / "archive"


@contextmanager
def build_directory(target: Path, what: dict[str, Any], *, fresh: bool) -> Iterator[BuildDirectory]:
    """Resume an interrupted build of `what`, or begin one; see build_identity.py `describe_build`.

    Finished work is kept whatever happens: hours of work are worth more than a clean disk. There
    are two exceptions. An impossible request or a faulty scan, detected in the survey of a build
    that began here, leaves nothing behind. Data that differ from what was written are discarded,
    and nothing else is. Raise BadRequestError for a folder that holds a different build, and leave
    it as it is.
    """
    hidden = building_folder(target)
    if fresh:
        remove_building(hidden)
        if (file := Journal(hidden).path(BUILD_ENTRY)).exists():
            raise SolidcloudError(
                f"{file}: cannot be removed, as --fresh requires, and the build would resume from it: remove "
                f"{hidden} by hand, then give the same command again"
            )
    entry = Journal(hidden).read_entry(BUILD_ENTRY)
    if entry is not None:
        check_same(hidden, entry, json.loads(json.dumps(what)))
    build_dir = BuildDirectory(hidden, entry or {**what, WORK_FOLDER_FIELD: uuid.uuid4().hex})
    try:
        if entry is None:  # a new build, or one killed before it wrote its first entry
            remove_building(hidden)
            hidden.mkdir(exist_ok=True)
            Journal(hidden).write_entry(BUILD_ENTRY, build_dir.entry)
        _prepare(build_dir)
        yield build_dir
    except BaseException as error:
        refused = isinstance(error, BadRequestError | ScanError)
        if entry is None and not build_dir.surveyed and refused:
            remove_building(hidden)
        elif hidden.exists():
            for path in error.paths if isinstance(error, CorruptError) else ():
                build_dir.discard(path)
            remove_temporaries(hidden)
            if refused and build_dir.staffed:
                raise type(error)(
                    f"{error}; what is done is kept in {hidden}: with other options or other scans give --fresh"
                ) from error
        raise
    remove_building(hidden)


def _prepare(build_dir: BuildDirectory) -> None:
    """Create the folders of a build, and remove everything else."""
    for path in build_dir.hidden.iterdir():
        if path.is_dir() and path != build_dir.folder:
            _remove(path)
    remove_temporaries(build_dir.hidden)
    build_dir.make_folders()


def remove_finished_work(target: Path, what: dict[str, Any]) -> None:
    """Remove what remains of a build of `what` that was killed just after publishing."""
    folder = building_folder(target)
    entry = Journal(folder).read_entry(BUILD_ENTRY)
    if entry is None or {**entry, WORK_FOLDER_FIELD: ""} == {
        **json.loads(json.dumps(what)),
        WORK_FOLDER_FIELD: "",
    }:
        # Units that were given up may have written here after the rename; other files are not ours.
        left = (target / SHARD_FOLDER).glob(f"*{TEMPORARY_SUFFIX}") if folder.is_dir() else ()
        for path in filter(is_temporary, left):
            path.unlink(missing_ok=True)
        remove_building(folder)


def remove_building(folder: Path) -> None:
    """Remove the hidden folder of a build.

    Its first entry is removed last, so that a build killed here can still be identified.
    """
    if folder.is_dir():
        for path in folder.iterdir():
            if path.is_dir():
                _remove(path)
    shutil.rmtree(folder, ignore_errors=True)


def _remove(folder: Path) -> None:
    """Remove a folder.

    It is renamed first, so that a unit that is still running cannot write into it meanwhile.
    """
    with suppress(OSError):
        os.rename(folder, gone := folder.with_name(uuid.uuid4().hex))
        folder = gone
    shutil.rmtree(folder, ignore_errors=True)


def discard_damaged_runs(build_dir: BuildDirectory, build: Transaction) -> None:
    """Read each run named by a journal entry once, before any run is used.

    A build may resume weeks later, and no later pass would detect corruption: a flipped bit in a run
    would produce a valid archive of different points. Remove the entries of runs that differ from
    what was written, and everything that was made from them. A missing run is left to `RunsIntact`.
    """
    journalled = {folder: _journalled_runs(build_dir, folder) for folder in RUN_FOLDERS}
    total = sum(
        sum(sums[::2])
        for entries in journalled.values()
        for runs in entries.values()
        for sums in runs.values()
    )
    if not total:
        return
    with build.stage("compare", total, "bytes"):
        for folder, entries in journalled.items():
            damaged = []
            for entry, runs in entries.items():
                if any(is_run_damaged(build_dir.folder / folder / name, sums) for name, sums in runs.items()):
                    damaged.append(entry)
                build.progress.advance(sum(sum(sums[::2]) for sums in runs.values()))
            if damaged:
                # This must come first: after a kill in between, the next build finds the same runs
                # and returns here.
                build_dir.discard_made_of(folder)
                for entry in damaged:
                    build_dir.journal.remove_entry(entry)
                return  # the work of the later folders is already discarded


def _journalled_runs(build_dir: BuildDirectory, folder: str) -> dict[str, Mapping[str, RunSums]]:
    """Return the runs that each journal entry of a folder of runs names, by entry."""
    names = sorted(f"{folder}/{path.stem}" for path in (build_dir.folder / folder).glob("*.json"))
    entries = {name: build_dir.journal.read_entry(name) for name in names}
    return {name: entry["runs"] for name, entry in entries.items() if entry}


@dataclass(frozen=True, slots=True)
class RunsIntact:
    """Check that the runs of a journal entry are in `folder` with the right sizes.

    `discard_damaged_runs` checks their bytes.
    """

    folder: Path

    def __call__(self, noted: Any) -> bool:
        return all(run_sizes(self.folder / name) == tuple(sums[::2]) for name, sums in noted.runs.items())


@dataclass(frozen=True, slots=True)
class ShardIntact:
    """Check that the shard of a journal entry is in `folder`, byte for byte.

    This reads the shard once; no pass does so otherwise.
    """

    folder: Path

    def __call__(self, shard: Any) -> bool:
        path = self.folder / shard.name
        return path.is_file() and path.stat().st_size == shard.size and file_checksum(path) == shard.checksum
