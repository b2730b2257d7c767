"""The folder that an archive is made in, and how it gets the name asked for: locked, hidden, renamed when whole."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..schemas.archive import INDEX_NAME, SHARD_FOLDER, sync_folder
from ..schemas.errors import BadRequestError, CorruptError, ScanError
from ..schemas.vtkhdf import PREVIEW_NAME
from .journal import Journal, remove_temporaries
from .lock import locked as locked
from .resume import check_same

# The note of what is built, the first of all.
BEGUN = "build"


def check_target(target: Path, overwrite: bool) -> None:
    """Refuse to write where something else is."""
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return
    if not (target / INDEX_NAME).is_file():
        raise BadRequestError(f"{target}: exists and is no archive, expected a new folder: give another -o")
    if not overwrite:
        raise BadRequestError(f"{target}: an archive is here already: give another -o, or --overwrite")
    shards = list((target / SHARD_FOLDER).iterdir()) if (target / SHARD_FOLDER).is_dir() else []
    strangers = [p for p in target.iterdir() if p.name not in (INDEX_NAME, SHARD_FOLDER, PREVIEW_NAME)]
    strangers += [p for p in shards if p.suffix != ".h5" or not p.is_file()]
    if strangers:
        raise BadRequestError(
            f"{strangers[0]}: not part of an archive, and --overwrite would delete it: move it, or give another -o"
        )


@contextmanager
def made_parents(target: Path) -> Iterator[None]:
    """Make the folders above the target; after a failure, remove those that were made here."""
    made = [folder for folder in target.parents if not folder.exists()]
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        for folder in made:
            with suppress(OSError):  # somebody else uses it by now
                folder.rmdir()
        raise


def building_folder(target: Path) -> Path:
    """The hidden folder that the archive `target` is made in."""
    return target.parent / f".{target.name}.building"


@dataclass
class Workplace:
    """The hidden folder of a build. journal: what is done.  archive: what will be renamed to the target.

    surveyed: all scans were read to their end once and can be built as asked: what is found later removes nothing.
    """

    journal: Journal
    archive: Path
    surveyed: bool = False

    def start_over(self) -> None:
        """Forget all that is done: the files it was read from are not what they were."""
        remove_building(self.folder)

    def distrust(self, path: Path) -> None:
        """Forget what was found not to be what was written: a run or a shard, or, by their folder, all points."""
        if not path.is_dir():
            self.journal.forget_file(path)
            return
        for name in ("done", "archive", "spool", *(p.name for p in self.folder.glob("filter-*"))):
            shutil.rmtree(self.folder / name, ignore_errors=True)

    @property
    def folder(self) -> Path:
        """The hidden folder itself."""
        return self.journal.folder


@contextmanager
def workplace(target: Path, what: dict[str, Any], *, fresh: bool) -> Iterator[Workplace]:
    """Go on with a build of `what` that was interrupted, or begin one; see resume.py `described`.

    What is done stays, whatever happens: hours of work are worth more than a clean disk. Only a request that cannot be
    done, and a scan at fault, found in the survey of a build that began here, leave nothing; of what is found not to be
    what was written, that is forgotten and no more. Raises BadRequestError for
    a build that was begun of something else, which it leaves as it is.
    """
    folder = building_folder(target)
    journal = Journal(folder)
    if fresh:
        remove_building(folder)
    begun = journal.recall(BEGUN)
    if begun is not None:
        check_same(folder, begun, json.loads(json.dumps(what)))
    place = Workplace(journal, folder / "archive")
    try:
        if begun is None:  # nothing, or killed before it could say what it was
            remove_building(folder)
            folder.mkdir()
            journal.note(BEGUN, what)
        remove_temporaries(folder)
        for name in ("spool", "archive", f"archive/{SHARD_FOLDER}"):
            (folder / name).mkdir(exist_ok=True)
        yield place
    except BaseException as error:
        if begun is None and not place.surveyed and isinstance(error, BadRequestError | ScanError):
            remove_building(folder)
        elif folder.exists():
            for path in error.paths if isinstance(error, CorruptError) else ():
                place.distrust(path)
            remove_temporaries(folder)
        raise
    remove_building(folder)


def forget_finished(target: Path, what: dict[str, Any]) -> None:
    """Remove what a build left that was killed just after it had published `what`."""
    folder = building_folder(target)
    if Journal(folder).recall(BEGUN) in (None, json.loads(json.dumps(what))):
        remove_building(folder)


def remove_building(folder: Path) -> None:
    """Remove the hidden folder of a build, the note of what it is last: killed here, it can still be told."""
    if folder.is_dir():
        for path in folder.iterdir():
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
    shutil.rmtree(folder, ignore_errors=True)


def recover(target: Path) -> None:
    """Finish what an earlier build with `overwrite` left when it was killed between its two renames."""
    old = target.parent / f".{target.name}.old"
    if old.exists() and not target.exists():
        os.rename(old, target)
    shutil.rmtree(old, ignore_errors=True)


def publish_folder(folder: Path, target: Path, overwrite: bool) -> None:
    """Give the finished folder its name."""
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
    sync_folder(target.parent)
