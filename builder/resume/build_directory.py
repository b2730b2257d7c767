"""Build directory: hidden folder in which an archive is made; it is renamed when complete."""

import json
import os
import shutil
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...schemas.archive.index import INDEX_NAME, SHARD_FOLDER
from ...schemas.archive.vtkhdf import PREVIEW_NAME
from ...schemas.errors import BadRequestError, CorruptError, ScanError, SolidcloudError
from ...schemas.process.new_file import sync_folder
from .build_identity import check_same
from .journal import TEMPORARY_SUFFIX, Journal, is_temporary, remove_temporaries
from .lock import locked as locked

# Folders of runs; each is made from the one before it.
RUN_FOLDERS = ("spool", "filter-near", "filter-thin")
# Name of the first journal entry, which describes the build, and of its field that names the work
# folder.
BEGUN, WORD = "build", "word"


def check_target(target: Path, overwrite: bool) -> None:
    """Refuse to write to a target that holds anything else."""
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return
    if not (target / INDEX_NAME).is_file():
        raise BadRequestError(f"{target}: exists and is no archive, expected a new folder: give another -o")
    if not overwrite:
        raise BadRequestError(f"{target}: an archive is here already: give another -o, or --overwrite")
    shards = list((target / SHARD_FOLDER).iterdir()) if (target / SHARD_FOLDER).is_dir() else []
    strangers = [p for p in target.iterdir() if p.name not in (INDEX_NAME, SHARD_FOLDER, PREVIEW_NAME)]
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


def building_folder(target: Path) -> Path:
    """Return the hidden folder in which the archive `target` is made."""
    return target.parent / f".{target.name}.building"


@dataclass
class Workplace:
    """Hidden folder of a build, and the folder in it that holds the finished work.

    The name of the work folder is unique; an entry in the hidden folder records it. A unit of an
    earlier build that a cluster worker is still running therefore finds no folder to write to.
    hidden: the hidden folder.  begun: the entry.
    surveyed: all scans were read to their end once and can be built as requested; later errors
    remove nothing.
    staffed: workers are available; from now on, a refusal concerns the request itself.
    """

    hidden: Path
    begun: dict[str, Any]
    surveyed: bool = False
    staffed: bool = False

    def start_over(self) -> None:
        """Discard all finished work, because the files it was read from have changed."""
        remove_building(self.hidden)

    def distrust(self, path: Path) -> None:
        """Discard a run or a shard that differs from what was written.

        path: the file; or the folder of a spool, to discard everything except the survey.
        What was made from a run is discarded with it.
        """
        if path.is_dir():
            self._keep(("survey",))
            return
        if path.parent.name in RUN_FOLDERS:
            self.distrust_made_of(path.parent.name)
        self.journal.forget_file(path)

    def distrust_made_of(self, folder: str) -> None:
        """Discard the filtered runs and shards made from a folder of RUN_FOLDERS."""
        self._keep(("survey", *RUN_FOLDERS[: RUN_FOLDERS.index(folder) + 1]))

    def _keep(self, names: Sequence[str]) -> None:
        """Keep these folders of finished work, and rename the work folder.

        Units that still work on the rest, or on untrusted data, then have no folder to write to.
        """
        old = self.folder
        begun = {**self.begun, WORD: uuid.uuid4().hex}
        folder = self.hidden / begun[WORD]
        folder.mkdir()
        for name in names:
            with suppress(FileNotFoundError):
                os.rename(old / name, folder / name)
        Journal(self.hidden).note(BEGUN, begun)
        self.begun = begun
        _remove(old)
        self.make_folders()

    def make_folders(self) -> None:
        """Create the folders that passes write to."""
        for folder in (self.folder, self.folder / "spool", self.archive, self.archive / SHARD_FOLDER):
            folder.mkdir(exist_ok=True)

    @property
    def folder(self) -> Path:
        """Return the work folder."""
        return self.hidden / str(self.begun[WORD])

    @property
    def journal(self) -> Journal:
        """Return the journal of the finished work."""
        return Journal(self.folder)

    @property
    def archive(self) -> Path:
        """Return the folder that will be renamed to the target."""
        return self.folder / "archive"


@contextmanager
def workplace(target: Path, what: dict[str, Any], *, fresh: bool) -> Iterator[Workplace]:
    """Resume an interrupted build of `what`, or begin one; see build_identity.py `described`.

    Finished work is kept whatever happens: hours of work are worth more than a clean disk. There
    are two exceptions. An impossible request or a faulty scan, detected in the survey of a build
    that began here, leaves nothing behind. Data that differ from what was written are discarded,
    and nothing else is. Raise BadRequestError for a folder that holds a different build, and leave
    it as it is.
    """
    hidden = building_folder(target)
    if fresh:
        remove_building(hidden)
        if (note := Journal(hidden).path(BEGUN)).exists():
            raise SolidcloudError(
                f"{note}: cannot be removed, as --fresh requires, and the build would resume from it: remove "
                f"{hidden} by hand, then give the same command again"
            )
    begun = Journal(hidden).recall(BEGUN)
    if begun is not None:
        check_same(hidden, begun, json.loads(json.dumps(what)))
    place = Workplace(hidden, begun or {**what, WORD: uuid.uuid4().hex})
    try:
        if begun is None:  # a new build, or one killed before it wrote its first entry
            remove_building(hidden)
            hidden.mkdir(exist_ok=True)
            Journal(hidden).note(BEGUN, place.begun)
        _prepare(place)
        yield place
    except BaseException as error:
        refused = isinstance(error, BadRequestError | ScanError)
        if begun is None and not place.surveyed and refused:
            remove_building(hidden)
        elif hidden.exists():
            for path in error.paths if isinstance(error, CorruptError) else ():
                place.distrust(path)
            remove_temporaries(hidden)
            if refused and place.staffed:
                raise type(error)(
                    f"{error}; what is done is kept in {hidden}: with other options or other scans give --fresh"
                ) from error
        raise
    remove_building(hidden)


def _prepare(place: Workplace) -> None:
    """Create the folders of a build, and remove everything else."""
    for path in place.hidden.iterdir():
        if path.is_dir() and path != place.folder:
            _remove(path)
    remove_temporaries(place.hidden)
    place.make_folders()


def forget_finished(target: Path, what: dict[str, Any]) -> None:
    """Remove what remains of a build of `what` that was killed just after publishing."""
    folder = building_folder(target)
    begun = Journal(folder).recall(BEGUN)
    if begun is None or {**begun, WORD: ""} == {**json.loads(json.dumps(what)), WORD: ""}:
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


def recover(target: Path) -> None:
    """Finish an earlier build with `overwrite` that was killed between its two renames."""
    old = target.parent / f".{target.name}.old"
    if old.exists() and not target.exists():
        os.rename(old, target)
    shutil.rmtree(old, ignore_errors=True)


def publish_folder(folder: Path, target: Path, overwrite: bool) -> None:
    """Rename the finished folder to its target."""
    sync_folder(folder)
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
    sync_folder(target.parent)
