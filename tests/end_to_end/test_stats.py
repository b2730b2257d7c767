"""Test `stats` over zenoh, as Prometheus text and in `solidcloud top`, against the queries made."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import archive_cases
import msgspec
import numpy as np
import pytest
import synthetic_scans
from solidcloud.schemas.errors import BadRequestError, BusyError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.encoding import JSON, MSGPACK, decode_answer, encode
from solidcloud.schemas.wire.key_expressions import public_id, query_key
from solidcloud.schemas.wire.scene_messages import ErrorReply
from solidcloud.schemas.wire.stats import StatsAnswer, StatsRequest
from solidcloud.schemas.wire.warming_parts import READY_LINE
from solidcloud.server.cli.main import run
from solidcloud.server.client import Client
from solidcloud.server.report.walk.server_process import free_port
from solidcloud.server.scene import Scene
from solidcloud.server.zenoh_client.server_connection import scenes_at
from solidcloud.server.zenoh_server.request_dispatcher import RequestDispatcher
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig

sys.path.insert(0, str(Path(__file__).parent))
from fake_server import FloorScene

BODY = np.array([[0.0, 0, 0], [0.15, 0, 0], [0.0, 0.1, 0.2]])
RADIUS = 0.03
DEADLINE = 60.0
KEY = query_key("floor", "c", "stats")


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build an archive of several voxels."""
    points = np.vstack([synthetic_scans.make_scan("plane", 1, 500), [[0, 0, 0], [9, 9, 9]]])
    return archive_cases.build(tmp_path_factory.mktemp("stats"), points).archive


@pytest.fixture
def endpoint() -> str:
    """Return a free port on loopback."""
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture
def service() -> RequestDispatcher:
    return RequestDispatcher([FloorScene()], ServerConfig())


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
def test_stats_name_voxels_only_where_asked(service: RequestDispatcher, encoding: str) -> None:
    for payload, keys in (
        (b"", None),
        (encode(StatsRequest(), encoding), None),
        (encode(StatsRequest(keys=True), encoding), [3, 5]),
    ):
        answer = service.answer(KEY, payload, encoding)
        assert not isinstance(answer, Iterator) and answer.ok
        found = decode_answer(StatsAnswer, answer.payload, encoding)
        assert (found.scene, found.keys) == ("floor", keys)


@pytest.mark.parametrize("payload", [{"key": True}, {"keys": 1}, []])
def test_a_request_that_is_none_is_refused(service: RequestDispatcher, payload: object) -> None:
    answer = service.answer(KEY, msgspec.msgpack.encode(payload), MSGPACK)
    assert not isinstance(answer, Iterator) and not answer.ok
    assert decode_answer(ErrorReply, answer.payload).code == "bad_request"


def test_a_client_asks_and_is_told_where_nobody_answers(endpoint: str) -> None:
    with Client(endpoint, scene="floor") as client:
        with pytest.raises(BusyError, match="no server of scene 'floor'"):
            client.stats()
        with pytest.raises(BusyError, match="no server answered at"):
            scenes_at(endpoint)
    with serving([FloorScene(), FloorScene("attic")], ServerConfig(listen=endpoint)):
        assert scenes_at(endpoint) == ["attic", "floor"]
        with Client(endpoint, scene="floor") as client:
            assert client.stats() == StatsAnswer(scene="floor")
            assert client.stats(keys=True).keys == [3, 5]
    with pytest.raises(BadRequestError, match="endpoint 'nonsense'"):
        scenes_at("nonsense")


def test_a_server_says_what_was_asked_of_it(archive: Path, endpoint: str) -> None:
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, :3, 3] = [[0.1 * i, 0.5, 0] for i in range(6)]
    with (
        Scene.open(archive, "hall", budget_bytes=64 << 20, policy="lru") as scene,
        serving([scene], ServerConfig(listen=endpoint)),
        Client(endpoint, scene="hall") as client,
    ):
        before = client.stats()
        assert (before.scene, before.policy, before.budget_bytes) == ("hall", "lru", 64 << 20)
        assert (before.requests, before.users, before.keys) == (0, [], None)
        client.add_avatar("al", BODY, RADIUS)
        answers = [client.collide("al", poses), client.distance("al", poses[:2], 0.5)]
        parts = list(client.path("al", poses))
        now = client.stats(keys=True)
        asked = [*answers, *parts]
        (user,) = now.users
        assert (user.client, user.avatar, user.requests) == (
            public_id(client._connection.client_id),
            "al",
            len(asked),
        )
        assert now.requests == user.requests and now.answers == user.answers == 6 + 2 + 6
        assert now.unknown == sum((answer.verdict == Verdict.UNKNOWN).sum() for answer in asked) == 0
        assert user.hits == sum(answer.hits for answer in asked) > 0
        assert (now.hits - before.hits, now.misses - before.misses) == (user.hits, user.misses)
        assert now.stall_seconds.count == now.engine_seconds.count == len(asked)
        assert now.engine_seconds.sum >= sum(answer.engine_seconds for answer in asked) * 0.999
        assert now.resident > 0 and now.resident_bytes > 0 and now.voxels == client.info().voxels
        assert 0 <= user.silent_seconds < DEADLINE
        known = scene.residency.where[:, 0] >= 0
        with Scene.open(archive, budget_bytes=64 << 20) as other:
            index = other._data.keys
        assert now.keys == sorted(index[known].tolist()) and len(now.keys) == now.resident
        assert now.load_seconds.count == sum(now.load_seconds.buckets) >= now.resident > 0
        assert 0 < now.load_seconds.p50 <= now.load_seconds.p99 <= now.load_seconds.max


def test_users_go_with_their_client_and_still_count_in_all(archive: Path, endpoint: str) -> None:
    with (
        Scene.open(archive, "hall", budget_bytes=64 << 20) as scene,
        serving([scene], ServerConfig(listen=endpoint)),
        Client(endpoint, scene="hall") as operator,
    ):
        with Client(endpoint, scene="hall") as client:
            client.add_avatar("al", BODY, RADIUS)
            client.collide("al", np.eye(4)[None])
            assert len(operator.stats().users) == 1
        deadline = time.monotonic() + DEADLINE
        while operator.stats().users:
            assert time.monotonic() < deadline, "never forgotten"
        assert operator.stats().requests == 1


@contextmanager
def server(archive: Path, endpoint: str, *options: str) -> Iterator[subprocess.Popen[str]]:
    """Run `solidcloud serve` in a separate process until the block ends; yield when it is ready."""
    command = [sys.executable, "-P", "-m", "solidcloud.server.cli.main", "serve", str(archive)]
    options = ("--name", "hall", "--listen", endpoint, *options)
    with subprocess.Popen(
        [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("serving hall"), process.communicate()[1]
            assert process.stdout.readline().strip() == READY_LINE
            yield process
        finally:
            process.kill()


@contextmanager
def taken_port() -> Iterator[int]:
    """Return a port on which a process listens."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        yield taken.getsockname()[1]


def wait_for(stream: IO[str], pattern: str) -> str:
    """Return the first line that matches."""
    for line in stream:
        if re.search(pattern, line):
            return line
    raise AssertionError(f"it ended without {pattern}")


def test_the_command_serves_metrics_and_top_shows_them(
    archive: Path, endpoint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    port = free_port()
    where = f"http://127.0.0.1:{port}/metrics"
    with (
        server(archive, endpoint, "--metrics-port", str(port), "--policy", "lru") as process,
        Client(endpoint, scene="hall") as client,
    ):
        client.add_avatar("al", BODY, RADIUS)
        for _ in range(3):
            client.collide("al", np.eye(4)[None])
        with urllib.request.urlopen(where, timeout=DEADLINE) as reply:
            text = reply.read().decode()
        assert 'solidcloud_requests_total{scene="hall"} 3.0' in text
        assert 'solidcloud_scene_info{policy="lru",scene="hall"} 1.0' in text
        assert (
            f'client="{public_id(client._connection.client_id)}"' in text
            and client._connection.client_id not in text
        )
        # All scenes served, one by name, and as JSON.
        for more in ([], ["--scene", "hall"]):
            assert run(["top", "--connect", endpoint, "--once", *more]) == 0
            shown = capsys.readouterr().out
            assert (
                "hall, policy lru" in shown and f"{public_id(client._connection.client_id)[:6]} al" in shown
            )
            assert re.search(r"^requests +3 ", shown, re.MULTILINE)
        assert run(["top", "--connect", endpoint, "--json"]) == 0
        (told,) = json.loads(capsys.readouterr().out)
        assert (told["requests"], told["users"][0]["avatar"]) == (3, "al")
        watch_until_interrupted(endpoint)
        watch_until_the_server_goes(endpoint, process)
    assert run(["top", "--connect", endpoint, "--once"]) == 1
    assert capsys.readouterr().err.startswith(
        f"error: no server answered at {endpoint} within 5 s: start one"
    )


def top(endpoint: str) -> "subprocess.Popen[str]":
    """Run `solidcloud top` in a separate process; return when it has printed its first table."""
    command = [sys.executable, "-P", "-m", "solidcloud.server.cli.main", "top", "--connect", endpoint]
    process = subprocess.Popen(
        [*command, "--interval", "0.2"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    wait_for(process.stdout, "^requests ")
    return process


def watch_until_interrupted(endpoint: str) -> None:
    """Check that Ctrl-C ends it."""
    process = top(endpoint)
    os.kill(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=DEADLINE)
    assert (process.returncode, errors) == (0, "")


def watch_until_the_server_goes(endpoint: str, serving: "subprocess.Popen[str]") -> None:
    """Check that it reports a stopped server in one line."""
    process = top(endpoint)
    os.kill(serving.pid, signal.SIGTERM)
    _, errors = process.communicate(timeout=DEADLINE)
    assert process.returncode == 1
    assert re.fullmatch(
        r"error: (the|no) server of scene 'hall' .*start one with: \S*solidcloud serve .*\n", errors
    )
    assert serving.wait(DEADLINE) == 0


@pytest.mark.parametrize(
    ("options", "code", "said"),
    [
        (["serve", "{archive}", "--metrics-port", "70000"], 2, "--metrics-port 70000"),
        (["serve", "{archive}", "--policy", "random"], 2, "policy 'random'"),
        (["top", "--interval", "0"], 2, "--interval"),
        (["top", "--interval", "nan"], 2, "--interval"),
    ],
)
def test_what_cannot_be_is_refused(
    archive: Path, capsys: pytest.CaptureFixture[str], options: list[str], code: int, said: str
) -> None:
    assert run([option.format(archive=archive) for option in options]) == code
    assert said in capsys.readouterr().err


def test_a_metrics_port_that_is_taken_is_said_at_once(
    archive: Path, endpoint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with taken_port() as port:
        assert run(["serve", str(archive), "--listen", endpoint, "--metrics-port", str(port)]) == 1
    assert f"--metrics-port {port}: cannot listen on 127.0.0.1" in capsys.readouterr().err
