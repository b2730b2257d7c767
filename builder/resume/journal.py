"""Journal of a build on disk: entries that allow the same command to resume after a kill.

An entry is a small JSON file, also called a note. It is written once, when everything it refers to
is durable on disk, and certifies these files. The next build deletes, unread, the files that no
entry certifies. An entry is therefore never wrong, at whatever moment the power fails. Work without
an entry is repeated.
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

from ...schemas.process.interrupts import check_interrupt
from ...schemas.process.new_file import sync_folder
from ..run.executor import Executor
from ..run.progress import Progress

Unit = TypeVar("Unit")
Result = TypeVar("Result")

TEMPORARY_SUFFIX = ".tmp"
_TEMPORARY = re.compile(r".+\.([0-9a-f]{32}|[0-9a-f]{12}-\d+-\d+|directory)\.tmp")


@contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing that gets its name only when it is complete and durable on disk.

    Its temporary name is unique, because a unit that a cluster has given up may still be running.
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
    """Return whether a name is a temporary name, made here or by schemas/process/new_file.py."""
    return _TEMPORARY.fullmatch(path.name) is not None


def remove_temporaries(folder: Path) -> None:
    """Remove every temporary file below a folder."""
    for path in folder.rglob(f"*{TEMPORARY_SUFFIX}"):
        path.unlink(missing_ok=True)


@dataclass(frozen=True, slots=True)
class Journal:
    """Journal of one build. folder: hidden folder of the build.

    Picklable: the process that does the work writes the entry.
    """

    folder: Path

    def note(self, name: str, what: Any) -> None:
        """Write the entry `name`, such as "survey/000003".

        what: any JSON value, including infinities.
        """
        path = self.path(name)
        path.parent.mkdir(exist_ok=True)
        with new_file(path) as file:
            file.write(json.dumps(what, sort_keys=True).encode())

    def recall(self, name: str) -> Any:
        """Return the contents of an entry, or None if there is none."""
        try:
            return json.loads(self.path(name).read_bytes())
        except (FileNotFoundError, ValueError):  # no entry, or one truncated by a disk that lost writes
            return None

    def forget(self, name: str) -> None:
        """Remove an entry whose files are missing or damaged."""
        self.path(name).unlink(missing_ok=True)

    def forget_file(self, path: Path) -> None:
        """Remove every entry that certifies a file of this name."""
        for note in self.folder.rglob("*.json"):
            name = note.relative_to(self.folder).with_suffix("").as_posix()
            what = self.recall(name)
            if isinstance(what, dict) and (
                path.name == what.get("name") or path.name in what.get("runs", ())
            ):
                self.forget(name)

    def path(self, name: str) -> Path:
        """Return the file of an entry."""
        return self.folder / f"{name}.json"


@dataclass(frozen=True, slots=True)
class Work(Generic[Unit, Result]):
    """Units of one kind, and the form of their results in the journal. All functions are picklable.

    run: execute a unit; its output is durable on disk when it returns.
    dump, load: convert a result to a JSON value, and back.
    holds: return whether the files that a journalled result refers to still exist.
    """

    run: Callable[[Unit], Result]
    dump: Callable[[Result], Any]
    load: Callable[[Any], Result]
    holds: Callable[[Result], bool] = lambda _: True


@dataclass(frozen=True, slots=True)
class _Noting(Generic[Unit, Result]):
    """Function that executes a unit in any process and journals its result there."""

    journal: Journal
    run: Callable[[Unit], Result]
    dump: Callable[[Result], Any]

    def __call__(self, named: tuple[str, Unit]) -> Result:
        name, unit = named
        result = self.run(unit)
        check_interrupt()  # results made while a signal arrived are not trusted
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
    """Return the result of each unit (entry name, unit), in order, journalled or computed now."""
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
