"""What a build has done so far, on disk: notes by which the same command goes on after a kill.

A note is a small JSON file that is written once, when all that it speaks of is on disk for good, and vouches for it.
What no note vouches for is deleted by the next build, never read. So a note is never wrong, whenever the power goes;
work of which it was not yet written is done again.
"""

import json
import os
import re
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Generic, TypeVar

from ..schemas.interrupts import check
from ..schemas.new_file import sync_folder
from .executor import Executor
from .progress import Progress

Unit = TypeVar("Unit")
Result = TypeVar("Result")

TEMPORARY_SUFFIX = ".tmp"
_TEMPORARY = re.compile(r".+\.([0-9a-f]{32}|[0-9a-f]{12}-\d+-\d+|directory)\.tmp")


@contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """A file to be written, that has its name only when it is whole and on disk for good.

    Its temporary name is nobody else's: a unit that a cluster has given up may still run somewhere.
    """
    temporary = path.with_name(f"{path.name}.{uuid.uuid4().hex}{TEMPORARY_SUFFIX}")
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def is_temporary(path: Path) -> bool:
    """Whether a name is that of a file that has none yet, given here or by schemas/new_file.py."""
    return _TEMPORARY.fullmatch(path.name) is not None


def remove_temporaries(folder: Path) -> None:
    """Remove every file below a folder that has no name yet."""
    for path in folder.rglob(f"*{TEMPORARY_SUFFIX}"):
        path.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class Journal:
    """The notes of one build. folder: the hidden one it is made in. Picklable: whoever does the work notes it."""

    folder: Path

    def note(self, name: str, what: Any) -> None:
        """Write the note `name`, such as "survey/000003": anything that JSON holds, infinities among it."""
        path = self.path(name)
        path.parent.mkdir(exist_ok=True)
        with new_file(path) as file:
            file.write(json.dumps(what, sort_keys=True).encode())

    def recall(self, name: str) -> Any:
        """What was noted, or None."""
        try:
            return json.loads(self.path(name).read_bytes())
        except (FileNotFoundError, ValueError):  # none, or cut short by a disk that lied
            return None

    def forget(self, name: str) -> None:
        """Remove a note: what it vouched for is not there."""
        self.path(name).unlink(missing_ok=True)

    def forget_file(self, path: Path) -> None:
        """Remove every note that vouches for a file, by its name."""
        for note in self.folder.rglob("*.json"):
            name = note.relative_to(self.folder).with_suffix("").as_posix()
            what = self.recall(name)
            if isinstance(what, dict) and (
                path.name == what.get("name") or path.name in what.get("runs", ())
            ):
                self.forget(name)

    def path(self, name: str) -> Path:
        """The file of a note."""
        return self.folder / f"{name}.json"


@dataclass(frozen=True, slots=True)
class Work(Generic[Unit, Result]):
    """Units of one kind, and how their results are noted. All functions are picklable.

    run: does a unit; what it wrote is on disk for good when it returns.  dump, load: a result to what JSON holds, and
    back.  holds: whether what a noted result speaks of is still there.
    """

    run: Callable[[Unit], Result]
    dump: Callable[[Result], Any]
    load: Callable[[Any], Result]
    holds: Callable[[Result], bool] = lambda _: True


@dataclass(frozen=True, slots=True)
class _Noting(Generic[Unit, Result]):
    """Does a unit in any process, and notes its result there."""

    journal: Journal
    run: Callable[[Unit], Result]
    dump: Callable[[Result], Any]

    def __call__(self, named: tuple[str, Unit]) -> Result:
        name, unit = named
        result = self.run(unit)
        check()  # what was made while a signal came is not believed
        self.journal.note(name, self.dump(result))
        return result


def resumed(
    journal: Journal,
    executor: Executor,
    work: Work[Unit, Result],
    units: Sequence[tuple[str, Unit]],
    progress: Progress,
    size: Callable[[Unit], int],
) -> list[Result]:
    """The result of each unit (name of its note, unit), in order: as noted, or done now."""
    results: dict[str, Result] = {}
    for name, unit in units:
        noted = journal.recall(name)
        if noted is None:
            continue
        result = work.load(noted)
        if work.holds(result):
            results[name] = result
            progress.advance(size(unit))
        else:
            journal.forget(name)
    left = [named for named in units if named[0] not in results]
    done = executor.map(_Noting(journal, work.run, work.dump), left, progress, lambda named: size(named[1]))
    for (name, _), result in zip(left, done, strict=True):
        results[name] = result
    return [results[name] for name, _ in units]
