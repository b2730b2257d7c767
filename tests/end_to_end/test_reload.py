"""Test a reload during queries over zenoh: no query is lost, and each answer is of one generation."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from frozen_processes import freeze
from numpy.typing import NDArray
from solidcloud.schemas.errors import BusyError, FormatError, UnknownSceneError
from solidcloud.schemas.runtime.own_command import own_command
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.scene_messages import ReloadAnswer
from solidcloud.schemas.wire.warming_parts import READY_LINE
from solidcloud.server.cli.main import run
from solidcloud.server.client import Client
from solidcloud.server.scene import Scene
from solidcloud.server.zenoh_client.client_identity import OPEN_SECONDS
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig

sys.path.insert(0, str(Path(__file__).parent))
from fake_server import FloorScene

BODY = np.array([[0.0, 0, 0], [0.15, 0, 0], [0.0, 0.1, 0.2]])
RADIUS = 0.03
DEADLINE = 60.0


class Generations(NamedTuple):
    """Two archives of one folder name.

    poses: (k, 4, 4). verdicts: (2, k), true for each, by brute force.
    """

    archives: tuple[Path, Path]
    poses: NDArray[np.float64]
    verdicts: NDArray[np.uint8]


@pytest.fixture(scope="module")
def generations(tmp_path_factory: pytest.TempPathFactory) -> Generations:
    """Build two archives that touch at different poses."""
    folder = tmp_path_factory.mktemp("generations")
    rng = np.random.default_rng(5)
    # Both contain the same corners, which makes their lattice the same.
    shared = np.vstack([synthetic_scans.make_scan("plane", 1, 500), [[0, 0, 0], [2, 2, 2]]])
    built = [
        archive_cases.build(folder, np.vstack([shared, synthetic_scans.make_scan("noise", n, 500)]))
        for n in (2, 3)
    ]
    poses = archive_cases.near_poses(rng, built[0].points, BODY, 300, 0.2)
    verdicts = np.array([case.judge(BODY, RADIUS, poses) for case in built]).astype(np.uint8)
    assert (verdicts[0] != verdicts[1]).sum() > 50 and (verdicts[0] == verdicts[1]).sum() > 50
    return Generations((built[0].archive, built[1].archive), poses, verdicts)


@pytest.fixture
def endpoint() -> str:
    """Return a free port on loopback."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{free.getsockname()[1]}"


def put(archive: Path, place: Path) -> None:
    """Replace a folder as `build --overwrite` does."""
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(archive, place)


def which(generations: Generations, verdicts: NDArray[np.uint8]) -> set[int]:
    """Return the generations for which the verdicts of all poses are right."""
    return {n for n in (0, 1) if np.array_equal(verdicts, generations.verdicts[n])}


class Asking:
    """Threads, one client each, that query without pause.

    found: time of the query, time of the answer, generations for which it is right.
    """

    def __init__(self, generations: Generations, endpoint: str) -> None:
        self._generations, self._endpoint = generations, endpoint
        self._stop = threading.Event()
        self.found: list[tuple[float, float, set[int]]] = []
        self.faults: list[str] = []
        self._threads = [threading.Thread(target=self._run, args=(path,)) for path in (False, False, True)]

    def __enter__(self) -> "Asking":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join(DEADLINE)

    def _run(self, path: bool) -> None:
        try:
            with Client(self._endpoint, scene="hall") as client:
                client.add_avatar("al", BODY, RADIUS)
                while not self._stop.is_set():
                    asked = time.monotonic()
                    if path:
                        parts = list(client.path("al", self._generations.poses))
                        verdicts = np.concatenate([part.verdict for part in parts])
                    else:
                        verdicts = client.collide("al", self._generations.poses).verdict
                    right = which(self._generations, verdicts)
                    self.found.append((asked, time.monotonic(), right))
        except Exception as error:
            self.faults.append(repr(error))

    def wait_for_more(self, count: int) -> None:
        """Wait until this many more answers came."""
        goal, deadline = len(self.found) + count, time.monotonic() + DEADLINE
        while len(self.found) < goal and not self.faults:
            assert time.monotonic() < deadline, "no answers"
            time.sleep(0.005)


def test_no_question_is_lost_and_each_is_answered_of_one_generation(
    generations: Generations, endpoint: str, tmp_path: Path
) -> None:
    place = tmp_path / "hall"
    put(generations.archives[0], place)
    # Times of request and answer of each reload, and the generation served since then.
    swaps: list[tuple[float, float, int]] = []
    with (
        Scene.open(place) as scene,
        serving([scene], ServerConfig(listen=endpoint)),
        Client(endpoint, scene="hall") as operator,
        Asking(generations, endpoint) as asking,
    ):
        asking.wait_for_more(20)
        for number in range(1, 9):
            put(generations.archives[number % 2], place)
            asked = time.monotonic()
            answer = operator.reload()
            swaps.append((asked, time.monotonic(), number % 2))
            assert isinstance(answer, ReloadAnswer) and answer.points == 1002
            asking.wait_for_more(10)
    assert not asking.faults
    assert len(asking.found) > 100
    for begin, end, right in asking.found:
        before = [now for _, done, now in swaps if done <= begin]
        meanwhile = [now for asked, done, now in swaps if asked < end and done > begin]
        assert right & {*(before[-1:] or [0]), *meanwhile}, (
            "of neither generation, of one that was gone, or unknown"
        )


def test_after_a_reload_the_new_one_alone_answers(
    generations: Generations, endpoint: str, tmp_path: Path
) -> None:
    place = tmp_path / "hall"
    put(generations.archives[0], place)
    with (
        Scene.open(place) as scene,
        serving([scene], ServerConfig(listen=endpoint)),
        Client(endpoint, scene="hall") as client,
    ):
        client.add_avatar("al", BODY, RADIUS)
        for number in (0, 1, 0, 1):
            put(generations.archives[number], place)
            client.reload()
            for _ in range(3):
                assert which(generations, client.collide("al", generations.poses).verdict) == {number}


def test_what_cannot_be_opened_is_said_and_the_old_one_served_on(
    generations: Generations, endpoint: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    place = tmp_path / "hall"
    put(generations.archives[0], place)
    with (
        Scene.open(place) as scene,
        serving([scene], ServerConfig(listen=endpoint)),
        Client(endpoint, scene="hall") as client,
    ):
        client.add_avatar("al", BODY, RADIUS)
        shutil.rmtree(place)
        with pytest.raises(FormatError, match="no archive here"):
            client.reload()
        assert "served as before" in caplog.text
        assert which(generations, client.collide("al", generations.poses).verdict) == {0}


def test_a_reload_that_nobody_answers_says_so(endpoint: str, capsys: pytest.CaptureFixture[str]) -> None:
    with Client(endpoint, scene="floor") as client, pytest.raises(BusyError) as told:
        client.reload()
    advice = f"start one with: {own_command()} serve ARCHIVE --name floor --listen {endpoint}"
    absent = f"no server of scene 'floor' at {endpoint}, expected one that answers 'reload': {advice}"
    assert str(told.value) == absent, "nobody waits for 600 s where there is nobody"
    assert run(["reload", "--scene", "floor", "--connect", endpoint]) == 1
    assert absent in capsys.readouterr().err
    with (
        serving([FloorScene()], ServerConfig(listen=endpoint)),
        pytest.raises(UnknownSceneError),
        Client(endpoint, scene="hall") as client,
    ):
        client.reload()


@pytest.fixture
def server(generations: Generations, endpoint: str, tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Run `solidcloud serve` of the first generation in a separate process."""
    put(generations.archives[0], tmp_path / "hall")
    command = [
        sys.executable,
        "-m",
        "solidcloud.server.cli.main",
        "serve",
        str(tmp_path / "hall"),
        "--listen",
        endpoint,
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("serving hall")
            assert process.stdout.readline().strip() == READY_LINE
            yield process
        finally:
            process.kill()


def test_a_server_that_is_slow_is_told_from_one_that_is_gone(
    endpoint: str, server: subprocess.Popen[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with Client(endpoint, scene="hall", timeout=1.5) as client:
        client.reload()
        monkeypatch.setitem(OPEN_SECONDS, "reload", 1.5)
        freeze(server.pid)
        with pytest.raises(BusyError) as told:
            client.reload()
        assert str(told.value) == (
            f"the server of scene 'hall' at {endpoint} has not answered 'reload' within 1.5 s: it may still be at "
            "work, and its log says when it is done: try again, or restart it"
        )
    monkeypatch.setitem(OPEN_SECONDS, "reload", DEADLINE)
    os.kill(server.pid, signal.SIGCONT)
    with Client(endpoint, scene="hall") as client:
        client.reload()
        freeze(server.pid)
        # The server dies during the queries or before them.
        killer = threading.Timer(0.3, server.kill)
        killer.start()
        with pytest.raises(BusyError) as told:
            client.reload()
        killer.join()
    assert str(told.value) == (
        f"the server of scene 'hall' at {endpoint} is gone, expected its answer to 'reload': start one with: "
        f"{own_command()} serve ARCHIVE --name hall --listen {endpoint}"
    )


def test_the_command_and_the_signal_reload(
    generations: Generations, endpoint: str, tmp_path: Path, server: subprocess.Popen[str]
) -> None:
    place = tmp_path / "hall"
    with Client(endpoint, scene="hall") as client:
        client.add_avatar("al", BODY, RADIUS)

        def now() -> set[int]:
            verdicts = client.collide("al", generations.poses).verdict
            assert not (verdicts == Verdict.UNKNOWN).any()
            return which(generations, verdicts)

        assert now() == {0}
        put(generations.archives[1], place)
        assert now() == {0}
        command = ["reload", "--scene", "hall", "--connect", endpoint]
        ran = subprocess.run(
            [sys.executable, "-m", "solidcloud.server.cli.main", *command],
            capture_output=True,
            text=True,
            check=True,
        )
        assert ran.stdout.startswith("hall: generation 0, before 0; 1,002 points")
        assert now() == {1}
        put(generations.archives[0], place)
        os.kill(server.pid, signal.SIGHUP)
        deadline = time.monotonic() + DEADLINE
        while now() != {0}:
            assert time.monotonic() < deadline, "the signal did nothing"
        # A reload that fails ends nothing, and the server still obeys a signal to stop.
        shutil.rmtree(place)
        os.kill(server.pid, signal.SIGHUP)
        assert now() == {0}
    os.kill(server.pid, signal.SIGTERM)
    _, log = server.communicate(timeout=DEADLINE)
    assert server.returncode == 0
    assert "reloaded hall" in log
