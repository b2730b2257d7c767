"""What has been tried, kept in results.json beside this file, so that a run goes on where the last one ended."""

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .mutants import Mutant
from .trial import PASSED, REFUSED, Outcome

PLACE = Path(__file__).with_name("results.json")
EVERY = 20  # trials between two writings


def digest(text: bytes) -> str:
    """Names a source; long enough to tell two from each other."""
    return hashlib.sha256(text).hexdigest()[:16]


def digest_tests(folder: Path, tests: tuple[str, ...]) -> str:
    """Names what the tests of a file are: they themselves and what they share."""
    paths = sorted({*(folder / name.split("::")[0] for name in tests), *(folder / "tests").glob("*.py")})
    return digest(b"".join(path.read_bytes() for path in paths))


@dataclass
class FileResults:
    """Those of one file. source, tests: digests.  complete: no mutant is left.  tried: key -> its row.

    A row: of a survivor its line, function, was and now, of another the kind of its outcome.  again: keys of those that
    survived other tests than there are now; they are to be tried again, whatever the size of the sample, or a larger
    share would seem killed than is.
    """

    source: str
    tests: str
    seed: int
    complete: bool = False
    tried: dict[str, dict[str, Any] | str] = field(default_factory=dict)
    again: list[str] = field(default_factory=list)
    owner: "Results | None" = None

    def wants(self, mutant: Mutant, sample: int, under_way: int) -> bool:
        """Whether to try it, in a sample of so many, while trials of others are under way."""
        if mutant.key in self.again:
            return True
        return mutant.key not in self.tried and self.lacks(sample, under_way + len(self.again))

    def lacks(self, sample: int, under_way: int) -> bool:
        """Whether mutants beyond those tried and under way are needed for a sample of so many."""
        return self.counted() + under_way < sample

    def add(self, mutant: Mutant, outcome: Outcome) -> None:
        """Take up an outcome."""
        self.again = [key for key in self.again if key != mutant.key]
        survivor = {name: getattr(mutant, name) for name in ("line", "function", "was", "now")}
        self.tried[mutant.key] = survivor if outcome.kind == PASSED else outcome.kind
        if self.owner and len(self.tried) % EVERY == 0:
            self.owner.save()

    def count(self, kind: str) -> int:
        """How many ended so."""
        return sum(row == kind for row in self.tried.values()) if kind != PASSED else len(self.survivors())

    def survivors(self) -> list[dict[str, Any]]:
        """Their rows, in the order of the source."""
        return sorted((r for r in self.tried.values() if isinstance(r, dict)), key=lambda row: row["line"])

    def counted(self) -> int:
        """How many count: all but those that the compiler would have refused."""
        return len(self.tried) - self.count(REFUSED)

    def killed(self) -> int:
        """How many of them a test noticed."""
        return self.counted() - self.count(PASSED)


class Results:
    """Those of all files."""

    def __init__(self, files: dict[str, FileResults]) -> None:
        self.files = files
        for own in files.values():
            own.owner = self

    def take(self, file: str, source: str, tests: str, seed: int) -> FileResults:
        """The results of a file that still hold: none of another source or seed, no survivor of other tests."""
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
        """Write results.json."""
        data = {
            name: {key: value for key, value in vars(own).items() if key != "owner"}
            for name, own in sorted(self.files.items())
        }
        PLACE.write_text(json.dumps(data, indent=1, sort_keys=True) + "\n")


def load() -> Results:
    """What results.json holds; nothing where it is not there."""
    data = json.loads(PLACE.read_text()) if PLACE.is_file() else {}
    return Results({name: FileResults(**own) for name, own in data.items()})
