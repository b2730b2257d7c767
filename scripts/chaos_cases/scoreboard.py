"""Numbers that the driver and its clients exchange, in a file that all of them map.

Each client writes its own row only; the driver writes the first. Times are of time.monotonic(),
which is one clock for all processes of a machine [s].
"""

import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# Columns of the driver: time of its last heartbeat; whether clients are to stop; to pause; the
# generations that may be served, as bits; whether a server may be up; the number of its starts and
# ends; and until when each earlier generation was served.
HEARTBEAT, STOP, PAUSE, SERVED, UP, EPOCH, UNTIL = range(7)
# Columns of a client: counts of queries and rows; time of its last right answer; whether all its ids
# are idle.
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
# A client ends if its driver has sent no heartbeat for this long: the driver was killed [s].
ORPHANED = 30.0


class ServerState(NamedTuple):
    """State of the server, by the driver."""

    up: bool
    epoch: int


class IdleFlags:
    """Flag in a client's row of whether all of its ids are idle."""

    def __init__(self, row: NDArray[Any], ids: int) -> None:
        """Begin with no idle id."""
        self._row, self._ids = row, ids
        self._still: set[int] = set()
        self._lock = threading.Lock()
        row[IDLE] = 0

    def set(self, number: int, still: bool) -> None:
        """Set the state of one of the ids, from 0."""
        with self._lock:
            (self._still.add if still else self._still.discard)(number)
            self._row[IDLE] = len(self._still) == self._ids


class Scoreboard:
    """The mapped numbers."""

    def __init__(self, path: Path, rows: int | None = None) -> None:
        """Map the file. rows: create it for this number of clients."""
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

    def now(self) -> ServerState:
        """Return the state of the server."""
        row = self._all[0]
        return ServerState(bool(row[UP]), int(row[EPOCH]))

    def serve(self, generations: int) -> None:
        """Set the generations that may be served from now on, as bits."""
        row = self._all[0]
        for generation in range(COLUMNS - UNTIL):
            if int(row[SERVED]) & ~generations & 1 << generation:
                row[UNTIL + generation] = time.monotonic()
        row[SERVED] = generations

    def served_since(self, begin: float) -> int:
        """Return the generations that may have been served at any time since `begin`, as bits."""
        row = self._all[0]
        served = int(row[SERVED])  # read first: it includes a generation that ends meanwhile
        ended = [g for g in range(COLUMNS - UNTIL) if row[UNTIL + g] >= begin]
        return served | sum(1 << generation for generation in ended if not served >> generation & 1)

    def totals(self) -> dict[str, int]:
        """Return the sums of all clients' counts."""
        sums = self._all[1:].sum(axis=0)
        return {name: int(sums[column]) for column, name in enumerate(COUNTS)}
