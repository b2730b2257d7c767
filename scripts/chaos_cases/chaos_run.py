"""The driver of a chaos run: starts a server and its clients, and injects one fault after another.

The faults are chosen by one seed. Their timing, and therefore the answers, are not reproducible.
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

from kill_cases.system_call_stops import has_strace
from solidcloud.schemas.archive.index import INDEX_NAME
from solidcloud.schemas.errors import SolidcloudError
from solidcloud.server.client import Client

from . import checking_clients, rogue_clients
from . import scoreboard as b
from .fixtures import GENERATIONS, SCENE, Fixture
from .server_restarts import ServerRuns

CLIENTS = 16
# Share of a run in which servers are killed.
DEADLY = 0.35
# The last SEVERAL clients have IDS ids each.
SEVERAL, IDS = 2, 6
QUIET_EVERY = 15.0
# A server is idle if it uses at most this share of a processor in this time [s]; how long to wait for that [s].
IDLE_SHARE, IDLE_WINDOW, IDLE_SECONDS = 0.03, 1.0, 30.0
READY_SECONDS = 60.0
RIGHT_SECONDS = 20.0
# Faults and their frequencies; SERVER_FAULTS only in the part of a run in which servers are killed.
SERVER_FAULTS = {"kill server": 3, "terminate server": 2}
FAULTS = {
    "kill client": 4, "freeze client": 4, "rogue": 4, "flood": 3, "heavy": 2, "invented": 2, "reload": 4, "hang up": 3,
    "flip bytes": 4, "flip index": 2, "truncate": 3, "read errors": 2,
}  # fmt: skip


# Faults that leave avatars behind, which the server keeps for a minute. At the end of a run, none is
# injected for so long that the server has dropped them all [s].
LEAVES_AVATARS = ("invented", "heavy")
CALM = 75.0


def _forking() -> Any:
    """Return a context that forks processes with their imports done: 16 separate imports take a minute."""
    from multiprocessing import forkserver

    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["chaos_cases.checking_clients", "chaos_cases.rogue_clients"])
    # The process that forks does not inherit sys.path, and does not report failed imports.
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = str(Path(__file__).resolve().parents[1])
    try:
        forkserver.ensure_running()
    finally:
        del os.environ["PYTHONPATH"]
        if before is not None:
            os.environ["PYTHONPATH"] = before
    return context


class ChaosRun:
    """One chaos run."""

    def __init__(
        self,
        folder: Path,
        fixture: Fixture,
        endpoint: str,
        seed: int,
        without: Sequence[str],
        say: Any,
        clients: int = CLIENTS,
    ) -> None:
        self.folder, self.fixture, self.endpoint, self.seed, self.say = folder, fixture, endpoint, seed, say
        self.clients = clients
        self.random = random.Random(seed)
        self.scoreboard = b.Scoreboard(folder / "board", clients)
        self.server_runs = ServerRuns(fixture, endpoint, self.scoreboard, folder / "server.log")
        self.done: Counter[str] = Counter()
        # How long each client waited for a right answer [s]: after a restart, and with a server running.
        self.recovery: list[float] = []
        self.waits: list[float] = []
        self.stuck: list[str] = []
        self.generation = 0
        self._context = _forking()
        self._clients: dict[int, Any] = {}
        self._born: dict[int, float] = {}
        self._frozen: dict[int, float] = {}
        self._rogues: list[tuple[Any, float]] = []
        self._faults = dict(FAULTS)
        for kind in [*without, *(() if has_strace() else ("read errors",))]:
            self._faults.pop(kind, None)

    @property
    def ids(self) -> int:
        """Return the number of ids of all clients."""
        return self.clients - SEVERAL + SEVERAL * IDS

    def run(self, seconds: float) -> None:
        """Inject faults for `seconds`; servers are killed in the first DEADLY of it."""
        self.scoreboard.driver[b.HEARTBEAT] = time.monotonic()
        threading.Thread(target=self._send_heartbeats, daemon=True).start()
        self._serve(0)
        self.server_runs.start()
        try:
            for slot in range(self.clients):
                self._start_client(slot)
            self._until(
                lambda: all(self._client_row(slot)[b.RIGHT_AT] > 0 for slot in self._clients), READY_SECONDS
            )
            begin = time.monotonic()
            quiet_at = begin + QUIET_EVERY
            while (now := time.monotonic()) < begin + seconds:
                deadly = now < begin + DEADLY * seconds
                calm = now > begin + seconds - CALM
                kinds = self._faults | (SERVER_FAULTS if deadly else {})
                kinds = {
                    kind: often for kind, often in kinds.items() if not (calm and kind in LEAVES_AVATARS)
                }
                kind = self.random.choices(list(kinds), list(kinds.values()))[0]
                self.say(f"{now - begin:6.1f} s  {kind}")
                self._inject(kind)
                self._pause(self.random.uniform(0.2, 1.2))
                if time.monotonic() > quiet_at or time.monotonic() > begin + seconds:
                    self._record_quiet_point()
                    quiet_at = time.monotonic() + QUIET_EVERY
            self._heal()
            self._record_waits(self.waits, time.monotonic(), self._surviving())
        finally:
            self._end()

    def _inject(self, kind: str) -> None:
        """Inject one fault."""
        self.done[kind] += 1
        if kind in rogue_clients.ROGUE_CLIENTS:
            self._start_rogue(kind)
        elif kind == "kill server":
            self._record_waits(self.waits, time.monotonic(), self._surviving())
            self._kill_server()
        elif kind == "terminate server":
            self._record_waits(self.waits, time.monotonic(), self._surviving())
            self.server_runs.terminate()
            self._pause(self.random.uniform(0.0, 1.0))
            self._restart()
        elif kind == "kill client":
            slot = self.random.randrange(self.clients)
            self._thaw(slot)
            process = self._clients.pop(slot)
            process.kill()
            process.join()
            self._start_client(slot)
        elif kind == "freeze client":
            slots = (
                range(self.clients - SEVERAL, self.clients)
                if self.random.random() < 0.5
                else range(self.clients)
            )
            slot = self.random.choice(slots)
            os.kill(self._clients[slot].pid, signal.SIGSTOP)
            self._frozen[slot] = time.monotonic() + self.random.uniform(2.0, 5.0)
        elif kind in ("reload", "hang up"):
            self._switch(hang_up=kind == "hang up")
        else:
            self._damage(kind)

    def _kill_server(self) -> None:
        """Kill the server, sometimes during a reload, sometimes with a usurper at its endpoint; restart it."""
        if self.random.random() < 0.3:
            self._offer((self.generation + 1) % GENERATIONS)
            self.server_runs.hang_up()
            self._pause(self.random.uniform(0.0, 0.3))
        self.server_runs.kill()
        if self.random.random() < 0.5:
            self.done["usurper"] += 1
            args = ("usurper", self.folder, self.endpoint, 0, 60.0)
            process = self._context.Process(target=rogue_clients.main, args=args, daemon=True)
            process.start()
            self._pause(self.random.uniform(1.0, 3.0))
            process.kill()
            process.join()
        self._pause(self.random.uniform(0.0, 2.0))
        self._restart()

    def _restart(self) -> None:
        """Start another server, and measure when its clients receive right answers again."""
        surviving = self._surviving()
        self.server_runs.start()
        self._serve(self.generation)
        self._record_waits(self.recovery, self.server_runs.serving_at, surviving)

    def _surviving(self) -> list[int]:
        """Return the slots of the clients that are not frozen and have received a right answer."""
        return [
            slot for slot in self._clients
            if self._client_row(slot)[b.RIGHT_AT] > self._born[slot] and slot not in self._frozen
        ]  # fmt: skip

    def _record_waits(self, waits: list[float], since: float, slots: list[int]) -> None:
        """Add to `waits` how long after `since` each client received its first right answer [s]."""
        self._until(lambda: all(self._client_row(slot)[b.RIGHT_AT] > since for slot in slots), RIGHT_SECONDS)
        took: list[float] = []
        for slot in slots:
            at = float(self._client_row(slot)[b.RIGHT_AT])
            took.append(at - since if at > since else RIGHT_SECONDS)
            if at <= since:
                self.stuck.append(f"client {slot}: no right answer within {RIGHT_SECONDS:g} s of {since:.1f}")
        self.say(
            "         right answers after " + " ".join(f"{seconds:.1f}" for seconds in sorted(took)) + " s"
        )
        waits += took

    # Generations

    def _serve(self, generation: int) -> None:
        """Record that this generation, and no other, is served."""
        self.generation = generation
        self.scoreboard.serve(1 << generation)

    def _offer(self, generation: int) -> None:
        """Put a generation into the folder, which may be served from now on."""
        self.scoreboard.serve(1 << generation | 1 << self.generation)
        self.fixture.put(generation)
        self.generation = generation

    def _switch(self, *, hang_up: bool) -> None:
        """Have the server serve the other generation."""
        self._offer((self.generation + 1) % GENERATIONS)
        self._reload(hang_up=hang_up)

    def _reload(self, *, hang_up: bool = False) -> bool:
        """Make the server serve the content of the folder; return False if it does not confirm that."""
        deadline = time.monotonic() + READY_SECONDS
        if hang_up:
            self.server_runs.hang_up()
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
        """Damage the server's files, and restore them soon after."""
        if kind == "read errors":
            self._read_errors()
        elif kind == "flip index":
            self._flip(self.fixture.live / INDEX_NAME, 3)
            with suppress(SolidcloudError), Client(self.endpoint, scene=SCENE) as client:
                client.reload()
            self.fixture.put(self.generation)
        else:
            for path in self.fixture.shards():
                if kind == "flip bytes":
                    self._flip(path, 40)
                else:
                    os.truncate(path, int(path.stat().st_size * self.random.uniform(0.2, 0.9)))
            self._pause(self.random.uniform(1.0, 2.5))
        self._heal()

    def _heal(self) -> None:
        """Restore all files, and make the server reload."""
        self.fixture.mend()
        self.fixture.put(self.generation)
        self._reload()

    def _flip(self, path: Path, count: int) -> None:
        """Flip `count` bits of a file, in place."""
        size = path.stat().st_size
        with path.open("r+b") as file:
            for _ in range(count):
                place = self.random.randrange(size)
                file.seek(place)
                byte = file.read(1)[0] ^ (1 << self.random.randrange(8))
                file.seek(place)
                file.write(bytes([byte]))

    def _read_errors(self) -> None:
        """Make every read of the server's files fail for a moment, as a failing disk does."""
        command = ["strace", "-f", "-p", str(self.server_runs.pid), "-o", os.devnull]
        command += ["-e", "trace=pread64", "-e", "inject=pread64:error=EIO"]
        with subprocess.Popen(command, stderr=subprocess.DEVNULL) as tracer:
            self._pause(self.random.uniform(0.5, 1.5))
            tracer.terminate()

    # Processes

    def _start_client(self, slot: int) -> None:
        """Start the client of a slot."""
        ids = IDS if slot >= self.clients - SEVERAL else 1
        seed = self.random.randrange(1 << 32)
        process = self._context.Process(
            target=checking_clients.main, args=(self.folder, slot, self.endpoint, seed, ids), daemon=True
        )
        process.start()
        self._clients[slot], self._born[slot] = process, time.monotonic()

    def _thaw(self, slot: int) -> None:
        """Resume a frozen client."""
        if self._frozen.pop(slot, None) is not None:
            os.kill(self._clients[slot].pid, signal.SIGCONT)

    def _start_rogue(self, kind: str) -> None:
        """Start a rogue client for a few seconds."""
        seconds = self.random.uniform(1.0, 4.0)
        args = (kind, self.folder, self.endpoint, self.random.randrange(1 << 32), seconds)
        process = self._context.Process(target=rogue_clients.main, args=args, daemon=True)
        process.start()
        self._rogues.append((process, time.monotonic() + seconds + 5.0))

    def _client_row(self, slot: int) -> Any:
        return self.scoreboard.client(slot)

    # Time

    def _send_heartbeats(self) -> None:
        """Send the driver's heartbeat until this process ends."""
        while True:
            self.scoreboard.driver[b.HEARTBEAT] = time.monotonic()
            time.sleep(1.0)

    def _beat(self) -> None:
        """Do the periodic work: thaw clients, end rogues, restart clients that ended."""
        now = time.monotonic()
        for slot in [slot for slot, until in self._frozen.items() if now > until]:
            self._thaw(slot)
        for rogue in list(self._rogues):
            if now > rogue[1]:
                rogue[0].kill()
            if not rogue[0].is_alive():
                self._rogues.remove(rogue)
        for slot, process in list(self._clients.items()):
            if not process.is_alive() and not self.scoreboard.driver[b.STOP]:
                self.stuck.append(f"client {slot} ended by itself, with exit code {process.exitcode}")
                self._start_client(slot)
        if self.server_runs.number and not self.server_runs.running() and self.scoreboard.driver[b.UP]:
            self.say("the server ended by itself")

    def _pause(self, seconds: float) -> None:
        """Wait for some seconds, with periodic work."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._beat()
            time.sleep(min(left, 0.05))

    def _until(self, met: Any, seconds: float) -> bool:
        """Wait until a condition is met, for at most `seconds`; return whether it is."""
        deadline = time.monotonic() + seconds
        while not met():
            if time.monotonic() > deadline:
                return False
            self._beat()
            time.sleep(0.005)
        return True

    def _record_quiet_point(self) -> None:
        """Pause all clients, and record the server's resources."""
        for slot in list(self._frozen):
            self._thaw(slot)
        self._until(lambda: not self._rogues, 15.0)
        self._until(lambda: all(row[b.RIGHT_AT] > self._born[s] for s, row in self._rows()), READY_SECONDS)
        self.scoreboard.driver[b.PAUSE] = 1
        idle = self._until(lambda: all(row[b.IDLE] for _, row in self._rows()), 15.0)
        try:
            recorded = idle and self._until_server_idle()
            if recorded:
                self.server_runs.record_quiet_point()
        except (SolidcloudError, OSError):  # the server does not answer, or has ended
            recorded = False
        self.done["no quiet point"] += not recorded
        self.scoreboard.driver[b.PAUSE] = 0

    def _until_server_idle(self) -> bool:
        """Wait until the server uses no processor time; return whether it does.

        It may still add a large avatar for a client that has ended.
        """
        before, deadline = self.server_runs.cpu_seconds(), time.monotonic() + IDLE_SECONDS
        while time.monotonic() < deadline:
            self._pause(IDLE_WINDOW)
            now = self.server_runs.cpu_seconds()
            if now - before <= IDLE_SHARE * IDLE_WINDOW:
                return True
            before = now
        return False

    def _rows(self) -> list[tuple[int, Any]]:
        return [(slot, self._client_row(slot)) for slot in self._clients]

    def _end(self) -> None:
        """End all processes, the server first, by SIGTERM, while the clients send queries."""
        for slot in list(self._frozen):
            self._thaw(slot)
        self.server_runs.terminate()
        self.scoreboard.driver[b.STOP] = 1
        for process in [*self._clients.values(), *(rogue for rogue, _ in self._rogues)]:
            process.join(10.0)
            process.kill()
            process.join()
