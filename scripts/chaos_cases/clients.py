"""A client of a chaos run: a process that asks one question after another and judges each answer.

It is killed, stopped and started again while it asks. What it finds wrong it writes to a file of its own.
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

from . import board as b
from .ground import SCENE, Request, ask, with_avatars
from .judge import judge

TIMEOUT = 5.0
# Between two questions of one id [s]: the machine is shared with the server.
PACE = 0.01
# A question to a server that is away is answered at once: no more of these a second than this.
PAUSE_AWAY = 0.02


class Asker:
    """One process's questions, under one or more client ids that ask at the same time."""

    def __init__(self, folder: Path, slot: int, endpoint: str, seed: int, requests: list[Request]) -> None:
        self.board = b.Board(folder / "board")
        self.row = self.board.client(slot)
        self.endpoint, self.seed, self.requests = endpoint, seed, requests
        self.said: Counter[str] = Counter()
        self.causes: Counter[str] = Counter()
        self._log = (folder / f"wrong-{slot}.jsonl").open("a")
        self._claims = (folder / f"claims-{slot}.jsonl").open("a")
        self._causes = folder / f"causes-{slot}-{os.getpid()}.json"
        self._lock = threading.Lock()

    def ended(self) -> bool:
        """Return whether the driver wants no more, or is gone."""
        driver = self.board.driver
        return bool(driver[b.STOP]) or time.monotonic() - driver[b.HEARTBEAT] > b.ORPHANED

    def run(self, ids: int) -> None:
        """Ask under so many ids until told to stop."""
        still = b.Stillness(self.row, ids)
        threads = [threading.Thread(target=self._run, args=(number, still)) for number in range(ids)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()

    def _run(self, number: int, still: b.Stillness) -> None:
        """Ask under one id."""
        rng = np.random.default_rng([self.seed, number])
        with Client(self.endpoint, scene=SCENE, timeout=TIMEOUT) as client, with_avatars(client):
            while not self.ended():
                if self.board.driver[b.PAUSE]:
                    still.set(number, True)
                    time.sleep(0.01)
                    continue
                still.set(number, False)
                if self.board.driver[b.PAUSE]:
                    continue  # the driver may have taken it for still
                try:
                    self._ask(client, self.requests[int(rng.integers(len(self.requests)))])
                except Exception as error:  # a client that crashes is a fault as well
                    self._count(b.ERRORS, f"{type(error).__name__}: {str(error)[:200]}")
                    time.sleep(PAUSE_AWAY)
                time.sleep(PACE)

    def _ask(self, client: Any, request: Request) -> None:
        """Ask one question, judge the answer and count it."""
        begin = time.monotonic()
        before = self.board.now()
        try:
            got = ask(client, request.op, request.arguments, request.parameters)
        except BusyError as error:
            self._count(b.BUSY, f"busy: {_kind(error)}")
            time.sleep(PAUSE_AWAY)
            return
        after = self.board.now()
        served = self.board.served_since(begin)
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
        """Return whether an answer was made here, because nobody gave one."""
        if hasattr(got, "engine_seconds"):
            return len(got) > 0 and got.engine_seconds == 0.0
        return not got.simulated

    def _claim(self, avatar: str, got: Moved, served: int) -> None:
        """Write down a frame that ended clear, but not where it would have if all were known: judged in the end."""
        with self._lock:
            self._claims.write(
                json.dumps({"avatar": avatar, "pose": got.pose.tolist(), "served": served}) + "\n"
            )
            self._claims.flush()

    def _note(
        self, request: Request, found: Any, served: int, before: b.Now, after: b.Now, begin: float
    ) -> None:
        """Write down what was wrong."""
        note = {
            "op": request.op, "served": served, "before": before, "after": after, "asked": begin,
            "answered": time.monotonic(), "faults": found.faults[:5], "clear": found.clear, "right": found.right,
            "unknown": found.unknown,
        }  # fmt: skip
        self._log.write(json.dumps(note) + "\n")
        self._log.flush()

    def _count(self, column: int, cause: str) -> None:
        """Count a question that was refused, by what was said."""
        with self._lock:
            self.row[b.ASKED] += 1
            self.row[column] += 1
            self.causes[cause] += 1
            self._causes.write_text(json.dumps(self.causes))


def _kind(error: Exception) -> str:
    """Return the beginning of a message, without its numbers."""
    return "".join("N" if c.isdigit() else c for c in str(error))[:120]


def main(folder: Path, slot: int, endpoint: str, seed: int, ids: int) -> None:
    """Be one client process."""
    requests = pickle.loads((folder / "pool.pickle").read_bytes())
    Asker(folder, slot, endpoint, seed, requests).run(ids)
