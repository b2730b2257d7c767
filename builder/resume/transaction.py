"""Transaction in which build, add and remove write an archive.

Each holds the lock of the archive (lock.py) and works in a hidden folder beside it. The target name
refers to a complete archive at every moment, because the renames that publish come last.
"""

import errno
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from ...schemas.archive.index import INDEX_NAME, SHARD_FOLDER
from ...schemas.archive.level import LEVEL_FOLDER
from ...schemas.archive.vtkhdf import PREVIEW_NAME
from ...schemas.errors import BadRequestError, SolidcloudError
from ...schemas.runtime.new_file import is_temporary, remove_temporaries, sync_path
from ...schemas.runtime.os_errors import os_error_words
from ..build_limits import jobs_that_fit, memory_share
from ..config import BuildConfig
from ..run.executor import Executor, ProcessExecutor, Progress, Silent, worker_count


class Transaction:
    """Archive that is being written, with the options and workers, and the timer of its stages.

    target: its folder.  folder: the hidden folder.  what: "build" or "change".
    executor: runs the work units, inside `workers`.  seconds: of each stage so far.
    """

    executor: Executor

    def __init__(
        self, what: str, target: Path, folder: Path, config: BuildConfig, progress: Progress | None
    ) -> None:
        self.what, self.target, self.folder, self.config = what, target, folder, config
        self.progress: Progress = progress or Silent()
        self.seconds: dict[str, float] = {}

    @property
    def outcome(self) -> str:
        """Return the end of an error message, which states what is kept after a failure."""
        return f", then give the same command again: it resumes from the finished work in {self.folder}"

    @property
    def share(self) -> int:
        """Return the bytes of data that each job may hold."""
        return memory_share(self.executor.jobs, self.config)

    @contextmanager
    def workers(self, points: int) -> Iterator[None]:
        """Provide the executor, with as many processes as points and memory justify."""
        jobs = jobs_that_fit(worker_count(self.config.jobs, points), self.config)
        with make_executor(self.config, jobs) as self.executor:
            yield

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Time a stage that reports its own progress."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin

    @contextmanager
    def stage(self, name: str, total: int, unit: str) -> Iterator[None]:
        """Time a stage and report it, with its total amount of work."""
        with self.timed(name):
            self.progress.start(name, total, unit)
            try:
                yield
            finally:
                self.progress.finish()

    def run(self, function: Callable[[Any], Any], units: Sequence[Any]) -> list[Any]:
        """Return function(unit) of each unit, in order; progress advances by `unit.points`."""
        return list(self.executor.map(function, units, self.progress, lambda unit: unit.points))

    def check_space(self, needed: int, folder: Path | None = None) -> None:
        """Raise SolidcloudError if files of `needed` bytes will not fit on the disk.

        folder: existing files in it are included in `needed`; None: no file exists yet.
        """
        if folder is not None:
            needed -= sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        disk = self.target.parent
        free = shutil.disk_usage(disk).free
        if needed > free:
            raise SolidcloudError(
                f"{disk}: {free} bytes free, the {self.what} needs about {needed}: make room{self.outcome}"
            )

    @contextmanager
    def machine_errors(self) -> Iterator[None]:
        """Convert a failure of disk or memory to a SolidcloudError with advice and what is kept."""
        try:
            yield
        except MemoryError as error:
            raise SolidcloudError(
                f"{self.target}: out of memory ({error or 'no details'}): give fewer --jobs or a smaller --memory, or "
                f"stop other programs{self.outcome}"
            ) from error
        except OSError as error:
            # HDF5 puts the errno into its message only.
            full = error.errno in (errno.ENOSPC, errno.EDQUOT) or f"errno = {errno.ENOSPC}" in str(error)
            found = os_error_words(OSError(errno.ENOSPC, "") if full else error)
            where = f" ({error.filename})" if error.filename else ""
            raise SolidcloudError(f"{self.target.parent}{where}: {found}{self.outcome}") from error


def make_executor(config: BuildConfig, jobs: int) -> Executor:
    """Make the executor: a cluster if the options name one, otherwise `jobs` processes.

    One job runs in this process.
    """
    address = config.scheduler or config.cluster
    if address is None:
        return ProcessExecutor(jobs)
    # This import loads dask, which nothing else needs.
    from ..run.dask_cluster import ClusterExecutor

    return ClusterExecutor(address, config.memory_bytes)


def check_target(target: Path, overwrite: bool) -> None:
    """Raise BadRequestError for a target that is not a new folder, or an archive to overwrite."""
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return
    if not (target / INDEX_NAME).is_file():
        raise BadRequestError(
            f"{target}: exists and is not an archive, expected a new folder: give another -o"
        )
    if not overwrite:
        raise BadRequestError(f"{target}: an archive is here already: give another -o, or --overwrite")
    shards = list((target / SHARD_FOLDER).iterdir()) if (target / SHARD_FOLDER).is_dir() else []
    own = (INDEX_NAME, SHARD_FOLDER, PREVIEW_NAME, LEVEL_FOLDER)
    strangers = [p for p in target.iterdir() if p.name not in own]
    # A unit that was given up may have left a temporary file of a build that was killed before it
    # could remove it.
    strangers += [p for p in shards if not p.is_file() or (p.suffix != ".h5" and not is_temporary(p))]
    if strangers:
        raise BadRequestError(
            f"{strangers[0]}: not part of an archive, and --overwrite would delete it: move it, or give another -o"
        )


@contextmanager
def made_parents(target: Path) -> Iterator[None]:
    """Create the folders above the target; after a failure, remove those created here."""
    made = [folder for folder in target.parents if not folder.exists()]
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for folder in made:
            with suppress(OSError):  # another process uses it by now
                folder.rmdir()
        raise


def recover(target: Path) -> None:
    """Finish an earlier build with `overwrite` that was killed between its two renames."""
    old = target.parent / f".{target.name}.old"
    if old.exists() and not target.exists():
        os.rename(old, target)
    shutil.rmtree(old, ignore_errors=True)


def publish_folder(folder: Path, target: Path, overwrite: bool) -> None:
    """Rename the finished folder to its target."""
    sync_path(folder)
    if target.exists() and overwrite and (target / INDEX_NAME).is_file():
        old = target.parent / f".{target.name}.old"
        os.rename(target, old)
        try:
            os.rename(folder, target)
        except OSError:
            os.rename(old, target)
            raise
        shutil.rmtree(old)
    else:
        os.rename(folder, target)  # replaces an empty folder
    # Remove files of a unit that was given up and is still running: from now on it cannot create
    # others.
    remove_temporaries(target)
    sync_path(target.parent)
