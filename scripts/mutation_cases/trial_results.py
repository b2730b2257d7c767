"""Outcomes of all trials, kept in a JSON file where an interrupted run continues."""

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .trial import PASSED, REFUSED, Outcome

if TYPE_CHECKING:
    from .mutants import Mutant  # needs cosmic-ray

EVERY = 20  # trials between two writes


def digest(text: bytes) -> str:
    """Return a digest that identifies a source."""
    return hashlib.sha256(text).hexdigest()[:16]


def digest_tests(folder: Path, tests: tuple[str, ...]) -> str:
    """Return a digest of a file's tests: the test files and their shared modules."""
    paths = sorted(
        {
            *(folder / name.split("::")[0] for name in tests),
            *(folder / "tests").glob("*.py"),
            *(folder / "tests" / "support").glob("*.py"),
        }
    )
    return digest(b"".join(path.read_bytes() for path in paths))


@dataclass
class FileResults:
    """Results of one file.

    source, tests: digests.
    complete: no mutant is left.
    tried: key -> its row, which holds line, function, was and now of a survivor, else the kind of
    its outcome.
    again: keys of those that survived a former version of the tests. They are tried again, whatever
    the size of the sample; otherwise the share of killed mutants would appear too large.
    """

    source: str
    tests: str
    seed: int
    complete: bool = False
    tried: dict[str, dict[str, Any] | str] = field(default_factory=dict)
    again: list[str] = field(default_factory=list)
    owner: "Results | None" = None

    def wants(self, mutant: "Mutant", sample: int, under_way: int) -> bool:
        """Return whether to try a mutant, in a sample of this size, with other trials running."""
        if mutant.key in self.again:
            return True
        return mutant.key not in self.tried and self.lacks(sample, under_way + len(self.again))

    def lacks(self, sample: int, under_way: int) -> bool:
        """Return whether a sample of this size needs mutants beyond those tried and running."""
        return self.counted() + under_way < sample

    def add(self, mutant: "Mutant", outcome: Outcome) -> None:
        """Record an outcome."""
        self.again = [key for key in self.again if key != mutant.key]
        survivor = {name: getattr(mutant, name) for name in ("line", "function", "was", "now")}
        self.tried[mutant.key] = survivor if outcome.kind == PASSED else outcome.kind
        if self.owner and len(self.tried) % EVERY == 0:
            self.owner.save()

    def count(self, kind: str) -> int:
        """Return the number of outcomes of this kind."""
        return sum(row == kind for row in self.tried.values()) if kind != PASSED else len(self.survivors())

    def survivors(self) -> list[dict[str, Any]]:
        """Return the rows of survivors, in source order."""
        return sorted((r for r in self.tried.values() if isinstance(r, dict)), key=lambda row: row["line"])

    def counted(self) -> int:
        """Return the number that count: all but those that the compiler would have refused."""
        return len(self.tried) - self.count(REFUSED)

    def killed(self) -> int:
        """Return the number that a test noticed."""
        return self.counted() - self.count(PASSED)


class Results:
    """Results of all files.

    place: where they are kept.
    """

    def __init__(self, place: Path, files: dict[str, FileResults]) -> None:
        self.place, self.files = place, files
        for own in files.values():
            own.owner = self

    def take(self, file: str, source: str, tests: str, seed: int) -> FileResults:
        """Return the valid results of a file.

        Results of another source or seed, and survivors of other tests, are excluded.
        """
        own = self.files.get(file)
        if own is None or (own.source, own.seed) != (digest(source.encode()), seed):
            own = FileResults(digest(source.encode()), tests, seed)
        elif own.tests != tests:
            own.again += [key for key, row in own.tried.items() if isinstance(row, dict)]
            own.tried = {key: row for key, row in own.tried.items() if not isinstance(row, dict)}
            own.tests = tests
        own.complete, own.owner = False, self
        self.files[file] = own
        return own

    def save(self) -> None:
        """Write the file."""
        data = {
            name: {key: value for key, value in vars(own).items() if key != "owner"}
            for name, own in sorted(self.files.items())
        }
        self.place.write_text(json.dumps(data, indent=1, sort_keys=True) + "\n")


def load(place: Path) -> Results:
    """Read a file of results; return empty results where it is missing."""
    data = json.loads(place.read_text()) if place.is_file() else {}
    return Results(place, {name: FileResults(**own) for name, own in data.items()})
