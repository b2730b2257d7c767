"""Test sessions over zenoh while clients freeze or die, and servers stop and restart."""

import os
import signal
import subprocess
import sys
import threading
from contextlib import contextmanager

import numpy as np
from fake_server import floor_simulation
from floor import DEADLINE, POINTS, eventually, server_process
from frozen_processes import freeze
from solidcloud.schemas.wire import key_expressions
from solidcloud.schemas.wire.encoding import encode
from solidcloud.schemas.wire.motion_messages import Wish
from solidcloud.server.client import Client
from solidcloud.server.simulation.replay import Replayed, replay
from solidcloud.server.simulation.replay_log import read_log
from walkers import pose_at, walking

CLIENT = """
import sys, threading, numpy as np
from solidcloud.server.client import Client
points = np.array([[0.0, 0.0, 0.5], [0.25, 0.0, 1.0], [0.0, 0.25, 1.5]])
with Client(sys.argv[1], scene="floor") as client:
    client.add_avatar("large", points, 0.125)
    with client.session("large") as session:
        session.wait(session.wish(np.eye(4)), 20.0)
        print("there", flush=True)
        while True:
            session.wish(np.eye(4))
            threading.Event().wait(1 / 60)
"""


@contextmanager
def other_client(endpoint):
    """Run a client with a session in a separate process; its states are large."""
    command = [sys.executable, "-P", "-c", CLIENT, endpoint]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == "there\n"
            yield process
        finally:
            process.kill()


def test_a_frozen_client_stops_nobody(served, endpoint):
    """Send 20 MB of states to a frozen client, more than sockets and queues hold.

    Its query asks for replies that wait for room.
    """
    with other_client(endpoint) as other, walking(endpoint) as session:
        (frozen,) = [user for user in served.users if user.avatar == "large"]
        key, stranger = key_expressions.command_key("floor", frozen), session._session
        freeze(other.pid)
        try:
            for number in range(250):
                wish = Wish(seq=10**6 + number, time=1.0, pose=pose_at(0.0, 1.0)[None])
                stranger.put(key, encode(wish))
                state = session.wait(session.wish(pose_at(number / 1000, 1.0)), DEADLINE)
                assert state.pose[0, 0, 3] == number / 1000
            assert frozen in served.users, "no state waited for it: after 200 ms its link would be closed"
        finally:
            os.kill(other.pid, signal.SIGCONT)


def test_a_killed_client_leaves_the_scene(served, endpoint):
    with other_client(endpoint) as other:
        assert [user.avatar for user in served.users] == ["large"]
        other.kill()
        eventually(lambda: not served.users)
    (client,) = served.scene.gone
    assert client != "*warm" and not served.scene.avatars


def test_a_session_goes_on_with_a_server_that_was_restarted(endpoint):
    with Client(endpoint, scene="floor", timeout=1.0) as client:
        client.add_avatar("al", POINTS, 0.125)
        with client.session("al") as session:
            for restart in range(3):
                with server_process(endpoint, "--walked") as process:
                    last = keep_wishing(session, lambda: session.wish(velocity=(0.0, 1.0, 0.0)), restart == 0)
                    # One more state, from the new server.
                    assert last.pose[0, 1, 3] > 0.001 * restart
                    process.kill()
                # Messages under way may still arrive, but nothing after them.
                eventually(lambda: session.latest().age > 0.5)
    assert last.pose[0, 0, 3] == 0.25, "from where the first server had left it"


def keep_wishing(session, wish, first):
    """Send motion commands until the server replies, as a viewer does; the very first gives a pose."""
    before = session.latest().seq if session.latest() else 0
    found = []

    def answered():
        session.wish(pose_at(0.25, 1.0)) if first and not found else wish()
        latest = session.latest()
        if latest is not None and latest.seq > before:
            found.append(latest)
        return len(found) > 5

    eventually(answered)
    return found[-1]


def test_a_server_that_stops_ends_its_sessions(endpoint):
    with server_process(endpoint, "--walked") as process, walking(endpoint) as session:
        session.wait(session.wish(pose_at(0.0, 1.0)), DEADLINE)
        ended = threading.Event()

        def wish():
            while not ended.is_set():
                session.wish(pose_at(0.0, 1.0))
                ended.wait(1 / 200)

        thread = threading.Thread(target=wish)
        thread.start()
        try:
            process.send_signal(signal.SIGTERM)
            assert process.wait(DEADLINE) == 0
        finally:
            ended.set()
            thread.join(DEADLINE)


def test_a_killed_server_leaves_a_log_that_replays(endpoint, tmp_path):
    log = tmp_path / "frames.log"
    with server_process(endpoint, "--walked", "--log", str(log)) as process, walking(endpoint) as session:
        rng = np.random.default_rng(4)
        for number in range(200):
            pose = pose_at(*rng.normal(size=2))
            seq = (
                session.wish(pose) if number % 3 == 0 else session.wish(velocity=rng.normal(size=3), turn=1.0)
            )
            session.wait(seq, DEADLINE)
        process.kill()
    frames = list(read_log(log)[1])
    assert replay(floor_simulation(), frames) == Replayed(200, 200)
    assert frames[-1].turns[0].pose == session.latest().pose[0].tolist()
