"""A client of a chaos run: a process that sends one query after another and checks each answer.

It may be killed, frozen and restarted meanwhile. It writes the faults that it finds to its own file.
"""

import json
import os
import pickle
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from solidcloud.schemas.errors import BusyError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.motion_messages import Moved
from solidcloud.server.client import Client

from . import scoreboard as b
from .answer_check import judge
from .fixtures import SCENE, Request, ask, with_avatars

TIMEOUT = 5.0
# Pause between two queries of one id [s]: the machine is shared with the server.
PACE = 0.01
# Pause after a query without a server, which is answered at once [s].
PAUSE_AWAY = 0.02


class QueryingClient:
    """Queries of one process, under one or more client ids at the same time."""

    def __init__(self, folder: Path, slot: int, endpoint: str, seed: int, requests: list[Request]) -> None:
        self.scoreboard = b.Scoreboard(folder / "board")
        self.row = self.scoreboard.client(slot)
        self.endpoint, self.seed, self.requests = endpoint, seed, requests
        self.said: Counter[str] = Counter()
        self.causes: Counter[str] = Counter()
        self._log = (folder / f"wrong-{slot}.jsonl").open("a")
        self._claims = (folder / f"claims-{slot}.jsonl").open("a")
        self._causes = folder / f"causes-{slot}-{os.getpid()}.json"
        self._lock = threading.Lock()

    def ended(self) -> bool:
        """Return whether the driver has ended the run, or was killed."""
        driver = self.scoreboard.driver
        return bool(driver[b.STOP]) or time.monotonic() - driver[b.HEARTBEAT] > b.ORPHANED

    def run(self, ids: int) -> None:
        """Send queries under `ids` ids until the run ends."""
        still = b.IdleFlags(self.row, ids)
        threads = [threading.Thread(target=self._run, args=(number, still)) for number in range(ids)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def _run(self, number: int, still: b.IdleFlags) -> None:
        """Send queries under one id."""
        rng = np.random.default_rng([self.seed, number])
        with Client(self.endpoint, scene=SCENE, timeout=TIMEOUT) as client, with_avatars(client):
            while not self.ended():
                if self.scoreboard.driver[b.PAUSE]:
                    still.set(number, True)
                    time.sleep(0.01)
                    continue
                still.set(number, False)
                if self.scoreboard.driver[b.PAUSE]:
                    continue  # the driver may already count it as idle
                try:
                    self._ask(client, self.requests[int(rng.integers(len(self.requests)))])
                except Exception as error:  # a crash of a client is a fault, too
                    self._count(b.ERRORS, f"{type(error).__name__}: {str(error)[:200]}")
                    time.sleep(PAUSE_AWAY)
                time.sleep(PACE)

    def _ask(self, client: Any, request: Request) -> None:
        """Send one query, check the answer and count it."""
        begin = time.monotonic()
        before = self.scoreboard.now()
        try:
            got = ask(client, request.op, request.arguments, request.parameters)
        except BusyError as error:
            self._count(b.BUSY, f"busy: {_kind(error)}")
            time.sleep(PAUSE_AWAY)
            return
        after = self.scoreboard.now()
        served = self.scoreboard.served_since(begin)
        truths = [truth for generation, truth in enumerate(request.truths) if served >> generation & 1]
        found = judge(got, truths)
        away = not (before.up or after.up) and before.epoch == after.epoch
        nobody = self._silent(got)
        if isinstance(got, Moved) and found.unknown and got.verdict == Verdict.CLEAR:
            self._claim(request.arguments[0], got, served)
        with self._lock:
            row = self.row
            row[b.ASKED] += 1
            row[b.RIGHT] += found.right
            row[b.UNKNOWN] += found.unknown
            row[b.NOBODY] += found.unknown if nobody else 0
            row[b.MISSING] += int((getattr(got, "voxels_missing", np.zeros(0)) > 0).sum())
            row[b.WRONG] += len(found.faults)
            row[b.FALSE_CLEAR] += found.false_clear
            row[b.CLEAR_AWAY] += found.clear if away else 0
            if found.right and not found.faults:
                row[b.RIGHT_AT] = time.monotonic()
            if found.faults or (away and found.clear):
                self._note(request, found, served, before, after, begin)
        if nobody:
            time.sleep(PAUSE_AWAY)

    @staticmethod
    def _silent(got: Any) -> bool:
        """Return whether the client made the answer itself, because no server answered."""
        if hasattr(got, "engine_seconds"):
            return len(got) > 0 and got.engine_seconds == 0.0
        return not got.simulated

    def _claim(self, avatar: str, got: Moved, served: int) -> None:
        """Record a frame that is reported clear with something unknown; it is judged at the end."""
        with self._lock:
            self._claims.write(
                json.dumps({"avatar": avatar, "pose": got.pose.tolist(), "served": served}) + "\n"
            )
            self._claims.flush()

    def _note(
        self,
        request: Request,
        found: Any,
        served: int,
        before: b.ServerState,
        after: b.ServerState,
        begin: float,
    ) -> None:
        """Record the faults of an answer."""
        note = {
            "op": request.op, "served": served, "before": before, "after": after, "asked": begin,
            "answered": time.monotonic(), "faults": found.faults[:5], "clear": found.clear, "right": found.right,
            "unknown": found.unknown,
        }  # fmt: skip
        self._log.write(json.dumps(note) + "\n")
        self._log.flush()

    def _count(self, column: int, cause: str) -> None:
        """Count a refused query by its error message."""
        with self._lock:
            self.row[b.ASKED] += 1
            self.row[column] += 1
            self.causes[cause] += 1
            self._causes.write_text(json.dumps(self.causes))


def _kind(error: Exception) -> str:
    """Return the beginning of a message, without its numbers."""
    return "".join("N" if c.isdigit() else c for c in str(error))[:120]


def main(folder: Path, slot: int, endpoint: str, seed: int, ids: int) -> None:
    """Run one client process."""
    requests = pickle.loads((folder / "pool.pickle").read_bytes())
    QueryingClient(folder, slot, endpoint, seed, requests).run(ids)
