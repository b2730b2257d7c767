"""The driver of a chaos run: starts a server and its clients, and does one harm after another to both.

All that decides what is done comes from one seed; when it is done, and so what is answered, does not.
"""

import multiprocessing
import os
import random
import signal
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from kills.calls import has_strace
from solidcloud.schemas.archive.index import INDEX_NAME
from solidcloud.schemas.errors import SolidcloudError
from solidcloud.server.client import Client

from . import board as b
from . import clients, strangers
from .ground import GENERATIONS, SCENE, Ground
from .lives import Lives

CLIENTS = 16
# The last of the clients ask under several ids each.
SEVERAL, IDS = 2, 6
QUIET_EVERY = 30.0
READY_SECONDS = 60.0
RIGHT_SECONDS = 20.0
# Harm and how often it is done; the first two are of the part of a run in which servers die.
KILLS = {"kill server": 3, "terminate server": 2}
HARM = {
    "kill client": 4, "freeze client": 4, "rogue": 4, "flood": 3, "heavy": 2, "invented": 2, "reload": 4, "hang up": 3,
    "flip bytes": 4, "flip index": 2, "truncate": 3, "read errors": 2,
}  # fmt: skip


# Harm that leaves avatars behind, which the server keeps for a minute. At the end of each period of the last life none
# is done for so long that the server has dropped them all [s]; memory is judged then.
LEAVES_AVATARS = ("invented", "heavy")
PERIOD, CALM, DROPPED = 120.0, 75.0, 70.0


def _forking() -> Any:
    """Return what forks processes that have imported all they need: 16 that import it anew take a minute."""
    from multiprocessing import forkserver

    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["chaos_cases.clients", "chaos_cases.strangers"])
    # The process that forks does not take over sys.path, and says nothing of what it cannot import.
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = str(Path(__file__).resolve().parents[1])
    try:
        forkserver.ensure_running()
    finally:
        del os.environ["PYTHONPATH"]
        if before is not None:
            os.environ["PYTHONPATH"] = before
    return context


class Storm:
    """One run. board, lives: what is told and what is served."""

    def __init__(
        self, folder: Path, ground: Ground, endpoint: str, seed: int, without: Sequence[str], say: Any
    ) -> None:
        self.folder, self.ground, self.endpoint, self.seed, self.say = folder, ground, endpoint, seed, say
        self.random = random.Random(seed)
        self.board = b.Board(folder / "board", CLIENTS)
        self.lives = Lives(ground, endpoint, self.board, folder / "server.log")
        self.done: Counter[str] = Counter()
        self.recovery: list[float] = []
        self.stuck: list[str] = []
        self.generation = 0
        self._context = _forking()
        self._clients: dict[int, Any] = {}
        self._born: dict[int, float] = {}
        self._frozen: dict[int, float] = {}
        self._strangers: list[tuple[Any, float]] = []
        self._disturbed = 0.0  # when harm was last done that leaves avatars behind
        self._harm = dict(HARM)
        for kind in [*without, *(() if has_strace() else ("read errors",))]:
            self._harm.pop(kind, None)

    def run(self, seconds: float) -> None:
        """Do harm for so long; servers die in the first 0.4 of it."""
        self.board.driver[b.HEARTBEAT] = time.monotonic()
        threading.Thread(target=self._live, daemon=True).start()
        self._serve(0)
        self.lives.start()
        try:
            for slot in range(CLIENTS):
                self._start_client(slot)
            self._until(
                lambda: all(self._client_row(slot)[b.RIGHT_AT] > 0 for slot in self._clients), READY_SECONDS
            )
            begin = time.monotonic()
            quiet_at = begin + QUIET_EVERY / 3
            periods = 0
            while (now := time.monotonic()) < begin + seconds:
                deadly = now < begin + 0.4 * seconds
                lived = now - self.lives.serving_at
                calm = not deadly and lived % PERIOD > PERIOD - CALM
                kinds = self._harm | (KILLS if deadly else {})
                kinds = {
                    kind: often for kind, often in kinds.items() if not (calm and kind in LEAVES_AVATARS)
                }
                if not deadly and int(lived / PERIOD) > periods:
                    self._quiet(calm=now - self._disturbed > DROPPED)
                periods = int(lived / PERIOD)
                kind = self.random.choices(list(kinds), list(kinds.values()))[0]
                self.say(f"{now - begin:6.1f} s  {kind}")
                self._do(kind)
                self._pause(self.random.uniform(0.2, 1.2))
                if time.monotonic() > quiet_at or time.monotonic() > begin + seconds:
                    self._quiet()
                    quiet_at = time.monotonic() + QUIET_EVERY
            self._heal()
            self._recover(time.monotonic())
        finally:
            self._end()

    def _do(self, kind: str) -> None:
        """Do one harm."""
        self.done[kind] += 1
        if kind in LEAVES_AVATARS:
            self._disturbed = time.monotonic()
        if kind in strangers.STRANGERS:
            self._stranger(kind)
        elif kind == "kill server":
            self._kill_server()
        elif kind == "terminate server":
            self.lives.terminate()
            self._pause(self.random.uniform(0.0, 1.0))
            self._restart()
        elif kind == "kill client":
            slot = self.random.randrange(CLIENTS)
            self._thaw(slot)
            process = self._clients.pop(slot)
            process.kill()
            process.join()
            self._start_client(slot)
        elif kind == "freeze client":
            slots = range(CLIENTS - SEVERAL, CLIENTS) if self.random.random() < 0.5 else range(CLIENTS)
            slot = self.random.choice(slots)
            os.kill(self._clients[slot].pid, signal.SIGSTOP)
            self._frozen[slot] = time.monotonic() + self.random.uniform(2.0, 5.0)
        elif kind in ("reload", "hang up"):
            self._switch(hang_up=kind == "hang up")
        else:
            self._damage(kind)

    def _kill_server(self) -> None:
        """Kill the server, now and then while it reloads; let another take its place, now and then; start one."""
        if self.random.random() < 0.3:
            self._offer((self.generation + 1) % GENERATIONS)
            self.lives.hang_up()
            self._pause(self.random.uniform(0.0, 0.3))
        self.lives.kill()
        if self.random.random() < 0.5:
            self.done["usurper"] += 1
            args = ("usurper", self.folder, self.endpoint, 0, 60.0)
            process = self._context.Process(target=strangers.main, args=args, daemon=True)
            process.start()
            self._pause(self.random.uniform(1.0, 3.0))
            process.kill()
            process.join()
        self._pause(self.random.uniform(0.0, 2.0))
        self._restart()

    def _restart(self) -> None:
        """Start another server, and time how long the clients take to hear right answers again."""
        surviving = [
            slot for slot, row in ((slot, self._client_row(slot)) for slot in self._clients)
            if row[b.RIGHT_AT] > self._born[slot] and slot not in self._frozen
        ]  # fmt: skip
        self.lives.start()
        self._serve(self.generation)
        self._recover(self.lives.serving_at, surviving)

    def _recover(self, since: float, slots: list[int] | None = None) -> None:
        """Note how long after `since` each of the clients heard its first right answer."""
        slots = [slot for slot in self._clients if slot not in self._frozen] if slots is None else slots
        self._until(lambda: all(self._client_row(slot)[b.RIGHT_AT] > since for slot in slots), RIGHT_SECONDS)
        took: list[float] = []
        for slot in slots:
            at = float(self._client_row(slot)[b.RIGHT_AT])
            took.append(max(0.0, at - since) if at > since else RIGHT_SECONDS)
            if at <= since:
                self.stuck.append(f"client {slot}: no right answer within {RIGHT_SECONDS:g} s of {since:.1f}")
        self.say(
            "         right again after " + " ".join(f"{seconds:.1f}" for seconds in sorted(took)) + " s"
        )
        self.recovery += took

    # Generations

    def _serve(self, generation: int) -> None:
        """Tell that this generation, and no other, is served."""
        self.generation = generation
        self.board.serve(1 << generation)

    def _offer(self, generation: int) -> None:
        """Put a generation into the folder, which may be served from now on."""
        self.board.serve(1 << generation | 1 << self.generation)
        self.ground.put(generation)
        self.generation = generation

    def _switch(self, *, hang_up: bool) -> None:
        """Have the server serve the other generation."""
        self._offer((self.generation + 1) % GENERATIONS)
        self._reload(hang_up=hang_up)

    def _reload(self, *, hang_up: bool = False) -> bool:
        """Have the server serve what is in the folder; False where it does not say that it does."""
        deadline = time.monotonic() + READY_SECONDS
        if hang_up:
            self.lives.hang_up()
        while time.monotonic() < deadline:
            self._beat()
            try:
                with Client(self.endpoint, scene=SCENE, timeout=5.0) as client:
                    served = client.info().generation if hang_up else client.reload().generation_after
            except SolidcloudError as error:
                self.done[f"reload not answered: {type(error).__name__}"] += 1
                self._pause(0.5)
                continue
            if served == self.generation:
                self._serve(self.generation)
                return True
            self._pause(0.1)
        self.stuck.append(f"generation {self.generation} was not served within {READY_SECONDS:g} s")
        return False

    # Files

    def _damage(self, kind: str) -> None:
        """Damage what the server reads, and mend it a moment later."""
        if kind == "read errors":
            self._read_errors()
        elif kind == "flip index":
            self._flip(self.ground.live / INDEX_NAME, 3)
            with suppress(SolidcloudError), Client(self.endpoint, scene=SCENE) as client:
                client.reload()
            self.ground.put(self.generation)
        else:
            for path in self.ground.shards():
                if kind == "flip bytes":
                    self._flip(path, 40)
                else:
                    os.truncate(path, int(path.stat().st_size * self.random.uniform(0.2, 0.9)))
            self._pause(self.random.uniform(1.0, 2.5))
        self._heal()

    def _heal(self) -> None:
        """Give all files their bytes back, and have the server open them."""
        self.ground.mend()
        self.ground.put(self.generation)
        self._reload()

    def _flip(self, path: Path, count: int) -> None:
        """Flip so many bits of a file, in place."""
        size = path.stat().st_size
        with path.open("r+b") as file:
            for _ in range(count):
                place = self.random.randrange(size)
                file.seek(place)
                byte = file.read(1)[0] ^ (1 << self.random.randrange(8))
                file.seek(place)
                file.write(bytes([byte]))

    def _read_errors(self) -> None:
        """Let every read of the server's files fail for a moment, as a disk that is dying does."""
        command = ["strace", "-f", "-p", str(self.lives.pid), "-o", os.devnull]
        command += ["-e", "trace=pread64", "-e", "inject=pread64:error=EIO"]
        with subprocess.Popen(command, stderr=subprocess.DEVNULL) as tracer:
            self._pause(self.random.uniform(0.5, 1.5))
            tracer.terminate()

    # Processes

    def _start_client(self, slot: int) -> None:
        """Start the client of a slot."""
        ids = IDS if slot >= CLIENTS - SEVERAL else 1
        seed = self.random.randrange(1 << 32)
        process = self._context.Process(
            target=clients.main, args=(self.folder, slot, self.endpoint, seed, ids), daemon=True
        )
        process.start()
        self._clients[slot], self._born[slot] = process, time.monotonic()

    def _thaw(self, slot: int) -> None:
        """Let a frozen client go on."""
        if self._frozen.pop(slot, None) is not None:
            os.kill(self._clients[slot].pid, signal.SIGCONT)

    def _stranger(self, kind: str) -> None:
        """Start one that does harm for a few seconds."""
        seconds = self.random.uniform(1.0, 4.0)
        args = (kind, self.folder, self.endpoint, self.random.randrange(1 << 32), seconds)
        process = self._context.Process(target=strangers.main, args=args, daemon=True)
        process.start()
        self._strangers.append((process, time.monotonic() + seconds + 5.0))

    def _client_row(self, slot: int) -> Any:
        return self.board.client(slot)

    # Time

    def _live(self) -> None:
        """Say that the driver lives, for as long as it does."""
        while True:
            self.board.driver[b.HEARTBEAT] = time.monotonic()
            time.sleep(1.0)

    def _beat(self) -> None:
        """Do what is due."""
        now = time.monotonic()
        for slot in [slot for slot, until in self._frozen.items() if now > until]:
            self._thaw(slot)
        for stranger in list(self._strangers):
            if now > stranger[1]:
                stranger[0].kill()
            if not stranger[0].is_alive():
                self._strangers.remove(stranger)
        for slot, process in list(self._clients.items()):
            if not process.is_alive() and not self.board.driver[b.STOP]:
                self.stuck.append(f"client {slot} ended by itself, with exit code {process.exitcode}")
                self._start_client(slot)
        if self.lives.number and not self.lives.running() and self.board.driver[b.UP]:
            self.say("the server ended by itself")

    def _pause(self, seconds: float) -> None:
        """Wait."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._beat()
            time.sleep(min(left, 0.05))

    def _until(self, met: Any, seconds: float) -> bool:
        """Wait until a condition is met, for so long at most."""
        deadline = time.monotonic() + seconds
        while not met():
            if time.monotonic() > deadline:
                return False
            self._beat()
            time.sleep(0.005)
        return True

    def _quiet(self, *, calm: bool = False) -> None:
        """Let everybody be still, and record what the server holds.

        calm: the server has dropped all avatars that nobody uses.
        """
        for slot in list(self._frozen):
            self._thaw(slot)
        self._until(lambda: not self._strangers, 15.0)
        self._until(lambda: all(row[b.RIGHT_AT] > self._born[s] for s, row in self._rows()), READY_SECONDS)
        self.board.driver[b.PAUSE] = 1
        if self._until(lambda: all(row[b.IDLE] for _, row in self._rows()), 15.0):
            self._pause(2.0)
            self.lives.look(calm=calm)
        else:
            self.done["no quiet point"] += 1
        self.board.driver[b.PAUSE] = 0

    def _rows(self) -> list[tuple[int, Any]]:
        return [(slot, self._client_row(slot)) for slot in self._clients]

    def _end(self) -> None:
        """End everybody, the server by SIGTERM, while the clients ask."""
        for slot in list(self._frozen):
            self._thaw(slot)
        self.lives.terminate()
        self.board.driver[b.STOP] = 1
        for process in [*self._clients.values(), *(stranger for stranger, _ in self._strangers)]:
            process.join(10.0)
            process.kill()
            process.join()
