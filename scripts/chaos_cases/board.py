"""What the driver tells its clients and they tell it: numbers in a file that all of them have mapped.

Each client writes its own row and nobody else's; the driver writes the first. Times are of time.monotonic(), which is
one clock for all processes of a machine [s].
"""

import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# Of the driver: alive at; everybody is to stop; to pause; which generations may be served, as bits; whether a server
# may be up; a count of its starts and ends; and until when each generation was served that is not any more.
HEARTBEAT, STOP, PAUSE, SERVED, UP, EPOCH, UNTIL = range(7)
# Of a client: counts of questions and rows; when it last heard a right answer; whether all its ids are still.
(
    ASKED,
    RIGHT,
    UNKNOWN,
    MISSING,
    NOBODY,
    BUSY,
    WRONG,
    FALSE_CLEAR,
    CLEAR_AWAY,
    ERRORS,
    RIGHT_AT,
    IDLE,
) = range(12)
COUNTS = (
    "asked",
    "right",
    "unknown",
    "missing",
    "nobody",
    "busy",
    "wrong",
    "false_clear",
    "clear_away",
    "errors",
)
COLUMNS = 16
# A client whose driver has said nothing for so long ends: it was killed.
ORPHANED = 30.0


class Now(NamedTuple):
    """What the driver says at a moment."""

    up: bool
    epoch: int


class Stillness:
    """Tells on a client's row whether all of its ids are still."""

    def __init__(self, row: NDArray[Any], ids: int) -> None:
        """None of them is still."""
        self._row, self._ids = row, ids
        self._still: set[int] = set()
        self._lock = threading.Lock()
        row[IDLE] = 0

    def set(self, number: int, still: bool) -> None:
        """Tell of one of the ids, from 0."""
        with self._lock:
            (self._still.add if still else self._still.discard)(number)
            self._row[IDLE] = len(self._still) == self._ids


class Board:
    """The numbers, mapped."""

    def __init__(self, path: Path, rows: int | None = None) -> None:
        """Map the file; rows: make it, for so many clients."""
        if rows is not None:
            np.zeros((rows + 1, COLUMNS)).tofile(path)
        self._all: NDArray[Any] = np.memmap(path, np.float64, "r+").reshape(-1, COLUMNS)

    @property
    def driver(self) -> NDArray[Any]:
        """Return the driver's row."""
        return self._all[0]

    def client(self, slot: int) -> NDArray[Any]:
        """Return the row of a client."""
        return self._all[slot + 1]

    def now(self) -> Now:
        """Return what the driver says."""
        row = self._all[0]
        return Now(bool(row[UP]), int(row[EPOCH]))

    def serve(self, generations: int) -> None:
        """Tell which generations may be served from now on, as bits."""
        row = self._all[0]
        for generation in range(COLUMNS - UNTIL):
            if int(row[SERVED]) & ~generations & 1 << generation:
                row[UNTIL + generation] = time.monotonic()
        row[SERVED] = generations

    def served_since(self, begin: float) -> int:
        """Return which generations may have been served at any time since `begin`, as bits."""
        row = self._all[0]
        served = int(row[SERVED])  # first: what ends meanwhile is in it
        ended = [g for g in range(COLUMNS - UNTIL) if row[UNTIL + g] >= begin]
        return served | sum(1 << generation for generation in ended if not served >> generation & 1)

    def totals(self) -> dict[str, int]:
        """Return the counts of all clients together."""
        sums = self._all[1:].sum(axis=0)
        return {name: int(sums[column]) for column, name in enumerate(COUNTS)}
