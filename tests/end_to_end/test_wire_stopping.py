"""Test a server that stops, by itself or by a signal: it answers accepted requests within its time."""

import signal
import threading
from contextlib import ExitStack

import numpy as np
import pytest
import zenoh
from fake_server import FloorScene
from floor import DEADLINE, PATH, POINTS, TRUTH, eventually, heights, joined, server_process
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.encoding import encode
from solidcloud.schemas.wire.requests import CollideRequest
from solidcloud.server.client import Client
from solidcloud.server.zenoh_common.zenoh_settings import session_config
from solidcloud.server.zenoh_server.serve_loop import serve, serving
from solidcloud.server.zenoh_server.server_config import ServerConfig


def test_a_server_that_stops_finishes_the_paths_it_accepted(scene, endpoint):
    with Client(endpoint, scene="floor", timeout=DEADLINE) as client:
        with serving([scene], ServerConfig(listen=endpoint, stop_seconds=DEADLINE)):
            client.add_avatar("al", POINTS, 0.125)
            eventually(lambda: client.collide("al", heights([-1.0])).verdict.tolist() == [Verdict.CONTACT])
            client.add_avatar("wait", POINTS, 0.125)
            path = client.path("wait", PATH)
            first = next(path)
            threading.Timer(0.2, scene.gate.set).start()
        assert np.array_equal(joined([first, *path]), TRUTH)


def test_a_server_that_stops_gives_up_what_takes_too_long(endpoint):
    """Test an endless path and a queue behind a slow answer: both are cut short, and no thread remains."""
    scene = FloorScene(delay=0.2)
    before = set(threading.enumerate())  # excludes threads of scenes that other tests share
    with Client(endpoint, scene="floor", timeout=DEADLINE) as client, ExitStack() as stack:
        with serving([scene], ServerConfig(listen=endpoint, stop_seconds=0.1)):
            client.add_avatar("al", POINTS, 0.125)
            eventually(lambda: client.collide("al", heights([-1.0])).verdict.tolist() == [Verdict.CONTACT])
            path = client.path("al", np.tile(PATH, (100, 1, 1)))
            first = next(path)
            asked = [threading.Thread(target=client.collide, args=("al", PATH)) for _ in range(60)]
            for thread in asked:
                thread.start()
                stack.callback(thread.join)
            eventually(lambda: scene.at_work > 3)
        left = [thread.name for thread in threading.enumerate() if thread not in before]
        assert [name for name in left if name.startswith("solidcloud-")] == []
        verdicts = joined([first, *path])
        assert len(verdicts) == 100 * len(PATH) and verdicts[-1] == Verdict.UNKNOWN
        assert scene.parts < 40 and scene.at_work < 60


@pytest.mark.parametrize("delay, count", [(0.005, 60), (0.015, 50)])
def test_terminated_server_answers_what_it_accepted_and_exits_0(endpoint, delay, count):
    """Test requests of more than 10 ms, each of which is handed to a separate thread."""
    with server_process(endpoint, "--delay", str(delay), "--stop-seconds", str(DEADLINE)) as process:
        with (
            Client(endpoint, scene="floor") as client,
            zenoh.open(session_config(connect=endpoint)) as session,
        ):
            client.add_avatar("al", POINTS, 0.1)
            payload = encode(CollideRequest("al", heights([-1.0])))
            key = f"solidcloud/1/scene/floor/{client._connection.client_id}/collide"
            asked = [session.get(key, payload=payload, timeout=DEADLINE) for _ in range(count)]
            # The other worker answered this query, which was sent after the others on the same
            # link: all have arrived.
            assert next(iter(session.get("solidcloud/1/scene/floor/other/info"))).ok
            process.send_signal(signal.SIGTERM)
            replies = [reply for handler in asked for reply in handler]
        assert process.wait(DEADLINE) == 0
    assert len(replies) == count and all(reply.ok for reply in replies)


def test_interrupted_server_exits_0(endpoint):
    with server_process(endpoint) as process:
        process.send_signal(signal.SIGINT)
        assert process.wait(DEADLINE) == 0


def test_a_signal_that_another_thread_takes_stops_the_server(scene, endpoint):
    stopped, in_time = threading.Event(), []

    def signal_this_thread():
        with Client(endpoint, scene="floor") as client:
            client.add_avatar("al", POINTS)
            eventually(lambda: client.collide("al", heights([1.0])).verdict[0] == Verdict.CLEAR)
        signal.pthread_kill(threading.get_ident(), signal.SIGTERM)
        in_time.append(stopped.wait(DEADLINE))
        if not in_time[0]:
            signal.pthread_kill(threading.main_thread().ident, signal.SIGTERM)

    thread = threading.Thread(target=signal_this_thread)
    before = signal.getsignal(signal.SIGTERM)
    thread.start()
    serve([scene], ServerConfig(listen=endpoint))
    stopped.set()
    thread.join(DEADLINE)
    assert in_time == [True]
    assert signal.getsignal(signal.SIGTERM) == before
