"""The folder that an archive is made in, and how it gets the name asked for: locked, hidden, renamed when whole."""

import json
import os
import shutil
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..schemas.errors import BadRequestError, CorruptError, ScanError, SolidcloudError
from ..schemas.index_file import INDEX_NAME
from ..schemas.new_file import sync_folder
from ..schemas.shard import SHARD_FOLDER
from ..schemas.vtkhdf import PREVIEW_NAME
from .journal import TEMPORARY_SUFFIX, Journal, is_temporary, remove_temporaries
from .lock import locked as locked
from .resume import check_same

# Folders of runs, each made of those before it.
RUN_FOLDERS = ("spool", "filter-near", "filter-thin")
# The note of what is built, the first of all; and what in it names the folder that holds what is done.
BEGUN, WORD = "build", "word"


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
    # A unit that was given up may have left a file without a name, of a build killed before it could remove it.
    strangers += [p for p in shards if not p.is_file() or (p.suffix != ".h5" and not is_temporary(p))]
    if strangers:
        raise BadRequestError(
            f"{strangers[0]}: not part of an archive, and --overwrite would delete it: move it, or give another -o"
        )


@contextmanager
def made_parents(target: Path) -> Iterator[None]:
    """Make the folders above the target; after a failure, remove those that were made here."""
    made = [folder for folder in target.parents if not folder.exists()]
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
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
    """The hidden folder of a build, and the folder in it that holds what is done.

    That one has a name that is nobody else's, which the note in the hidden folder tells: a unit of an earlier build
    that a worker of a cluster still runs finds no folder to write to. hidden: the hidden folder.  begun: its note.
    surveyed: all scans were read to their end once and can be built as asked: what is found later removes nothing.
    staffed: there is somebody to do the work: what is refused from then on is what was asked for.
    """

    hidden: Path
    begun: dict[str, Any]
    surveyed: bool = False
    staffed: bool = False

    def start_over(self) -> None:
        """Forget all that is done: the files it was read from are not what they were."""
        remove_building(self.hidden)

    def distrust(self, path: Path) -> None:
        """Forget what was found not to be what was written: a run or a shard, or, by their folder, all points.

        What was made of a run is forgotten with it.
        """
        if path.is_dir():
            self._keep(("survey",))
            return
        if path.parent.name in RUN_FOLDERS:
            self.distrust_made_of(path.parent.name)
        self.journal.forget_file(path)

    def distrust_made_of(self, folder: str) -> None:
        """Forget what was made of the runs in a folder of RUN_FOLDERS: what filters left of them, and shards."""
        self._keep(("survey", *RUN_FOLDERS[: RUN_FOLDERS.index(folder) + 1]))

    def _keep(self, names: Sequence[str]) -> None:
        """Keep these folders of what is done, under another name: who still works on the rest of it, and of what is not
        believed, has nowhere to write what comes of it.
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
        """Make the folders that passes write to."""
        for folder in (self.folder, self.folder / "spool", self.archive, self.archive / SHARD_FOLDER):
            folder.mkdir(exist_ok=True)

    @property
    def folder(self) -> Path:
        """Where all is that is done."""
        return self.hidden / str(self.begun[WORD])

    @property
    def journal(self) -> Journal:
        """What is done."""
        return Journal(self.folder)

    @property
    def archive(self) -> Path:
        """What will be renamed to the target."""
        return self.folder / "archive"


@contextmanager
def workplace(target: Path, what: dict[str, Any], *, fresh: bool) -> Iterator[Workplace]:
    """Go on with a build of `what` that was interrupted, or begin one; see resume.py `described`.

    What is done stays, whatever happens: hours of work are worth more than a clean disk. Only a request that cannot be
    done, and a scan at fault, found in the survey of a build that began here, leave nothing; of what is found not to be
    what was written, that is forgotten and no more. Raises BadRequestError for
    a build that was begun of something else, which it leaves as it is.
    """
    hidden = building_folder(target)
    if fresh:
        remove_building(hidden)
        if (note := Journal(hidden).path(BEGUN)).exists():
            raise SolidcloudError(
                f"{note}: cannot be removed, as --fresh asks, and the build would go on from it: remove {hidden} by "
                "hand, then give the same command again"
            )
    begun = Journal(hidden).recall(BEGUN)
    if begun is not None:
        check_same(hidden, begun, json.loads(json.dumps(what)))
    place = Workplace(hidden, begun or {**what, WORD: uuid.uuid4().hex})
    try:
        if begun is None:  # nothing, or killed before it could say what it was
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
    """Make the folders of a build, and remove what is not of it."""
    for path in place.hidden.iterdir():
        if path.is_dir() and path != place.folder:
            _remove(path)
    remove_temporaries(place.hidden)
    place.make_folders()


def forget_finished(target: Path, what: dict[str, Any]) -> None:
    """Remove what a build left that was killed just after it had published `what`."""
    folder = building_folder(target)
    begun = Journal(folder).recall(BEGUN)
    if begun is None or {**begun, WORD: ""} == {**json.loads(json.dumps(what)), WORD: ""}:
        # What units that were given up left in it after its rename; anything else there is somebody's own.
        left = (target / SHARD_FOLDER).glob(f"*{TEMPORARY_SUFFIX}") if folder.is_dir() else ()
        for path in filter(is_temporary, left):
            path.unlink(missing_ok=True)
        remove_building(folder)


def remove_building(folder: Path) -> None:
    """Remove the hidden folder of a build, the note of what it is last: killed here, it can still be told."""
    if folder.is_dir():
        for path in folder.iterdir():
            if path.is_dir():
                _remove(path)
    shutil.rmtree(folder, ignore_errors=True)


def _remove(folder: Path) -> None:
    """Remove a folder, first of all from where a unit that still runs would write into it while it is emptied."""
    with suppress(OSError):
        os.rename(folder, gone := folder.with_name(uuid.uuid4().hex))
        folder = gone
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
    # Of a unit that was given up and still runs: from now on it can name no other.
    remove_temporaries(target)
    sync_folder(target.parent)
