"""Test that heavy requests of some clients do not starve others: a light client keeps right answers."""

import hashlib
import threading
import time
from contextlib import ExitStack, contextmanager

import numpy as np
import zenoh
from floor import DEADLINE, POINTS, eventually, heights
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.encoding import decode_answer, encode
from solidcloud.schemas.wire.requests import CollideRequest
from solidcloud.schemas.wire.scene_messages import ErrorReply
from solidcloud.server.client import Client
from solidcloud.server.zenoh_common.zenoh_settings import session_config
from solidcloud.server.zenoh_server import request_lanes as lanes_module
from solidcloud.server.zenoh_server.request_dispatcher import RequestDispatcher
from solidcloud.server.zenoh_server.request_lanes import take_waiting
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig
from solidcloud.server.zenoh_server.transport import Transport

ASKED = 50
_WORK = bytes(1 << 20)
TRUTH = [int(Verdict.CONTACT), int(Verdict.CLEAR)]


class Light:
    """A client with small requests."""

    def __init__(self, endpoint):
        self.client = Client(endpoint, scene="floor", timeout=DEADLINE)

    def __enter__(self):
        self.client.__enter__()
        self.client.add_avatar("al", POINTS, 0.125)
        return self

    def __exit__(self, *error):
        self.client.__exit__(*error)

    def is_answered(self):
        """Repeat a query; fail if an answer is wrong, `busy` or missing."""
        for _ in range(ASKED):
            assert self.client.collide("al", heights([-1.0, 1.0])).verdict.tolist() == TRUTH


class StoppableService(RequestDispatcher):
    """Service whose `info` replies when the request is stopped or the gate is opened.

    began: number of requests that began.  reasons: of each stop.
    """

    def __init__(self, scene, config):
        super().__init__([scene], config)
        self.gate = threading.Event()
        self.began, self.reasons = 0, []

    def answer(self, key, payload, encoding, stop):
        if key.endswith("/info"):
            self.began += 1
            deadline = time.monotonic() + DEADLINE
            while not (stop or self.gate.is_set()) and time.monotonic() < deadline:
                hashlib.sha256(_WORK)  # simulates computing while other threads get the interpreter
            self.reasons.append(stop.reason)
        return super().answer(key, payload, encoding, stop)


@contextmanager
def stoppable(scene, config):
    """Serve a StoppableService."""
    service = StoppableService(scene, config)
    with Transport(["floor"], service, config) as transport:
        service.in_flight = lambda: len(transport._lanes[0]._queues)
        yield service


@contextmanager
def blocked(stack, endpoint, number, name="wait"):
    """Start clients whose requests are not answered until the gate opens."""
    threads, answers = [], []
    for _ in range(number):
        client = stack.enter_context(Client(endpoint, scene="floor", timeout=DEADLINE))
        client.add_avatar(name, POINTS, 0.125)

        def ask(client=client):
            answers.append(client.collide(name, heights([-1.0])).verdict.tolist())

        threads.append(threading.Thread(target=ask))
        threads[-1].start()
    try:
        yield answers
    finally:
        for thread in threads:
            thread.join(DEADLINE)


def test_slow_requests_of_several_clients_hold_nobody_up(scene, endpoint):
    """Test the maximum number of slow requests at a time, which is larger than the number of workers."""
    config = ServerConfig(listen=endpoint, workers=2, max_slow=4, max_request_seconds=DEADLINE)
    with serving([scene], config), ExitStack() as stack:
        light = stack.enter_context(Light(endpoint))
        with blocked(stack, endpoint, 4) as answers:
            try:
                eventually(lambda: scene.at_work == 4)
                light.is_answered()
                assert not answers
            finally:
                scene.gate.set()
        assert answers == [[Verdict.CONTACT]] * 4


def test_requests_of_one_client_stay_in_order_behind_a_slow_one(scene, endpoint):
    with (
        serving([scene], ServerConfig(listen=endpoint)),
        zenoh.open(session_config(connect=endpoint)) as session,
    ):
        for name in ("wait", "al"):
            scene.avatars["c", name] = (POINTS, 0.125)
        key = "solidcloud/1/scene/floor/c/collide"
        with session.liveliness().declare_token("solidcloud/1/client/floor/c"):

            def ask(name):
                payload = encode(CollideRequest(name, heights([-1.0])))
                return session.get(key, payload=payload, timeout=DEADLINE)

            asked = [ask("wait")]
            eventually(lambda: scene.at_work == 1)
            asked += [ask("al"), ask("al")]
            with Light(endpoint) as light:
                light.is_answered()
            assert [name for _, (name, _), _ in scene.asked if name == "wait"] == ["wait"]
            before = len(scene.asked)
            scene.gate.set()
            assert all(next(iter(handler)).ok for handler in asked)
    assert [name for _, (name, _), _ in scene.asked[before:]] == ["al", "al"]


def arrived(asked):
    """Return the replies that have arrived since the last call, by the number of their query."""
    taken = ((number, take_waiting(handler)) for number, handler in enumerate(asked))
    return {number: reply for number, reply in taken if reply is not None}


def test_a_flood_of_one_client_is_busy_for_that_client_alone(scene, endpoint):
    config = ServerConfig(listen=endpoint, max_in_flight=40, max_in_flight_by_client=8)
    with (
        serving([scene], config),
        zenoh.open(session_config(connect=endpoint)) as session,
        Light(endpoint) as light,
    ):
        scene.avatars["c", "wait"] = (POINTS, 0.1)
        payload = encode(CollideRequest("wait", np.eye(4)[None]))
        key = "solidcloud/1/scene/floor/c/collide"
        with session.liveliness().declare_token("solidcloud/1/client/floor/c"):
            asked = [session.get(key, payload=payload, timeout=DEADLINE) for _ in range(100)]
            # Two workers take queries at once, so that not always the first eight are accepted.
            replies = {}
            eventually(lambda: replies.update(arrived(asked)) or len(replies) == 92)
            light.is_answered()
            scene.gate.set()
            accepted = [next(iter(handler)) for number, handler in enumerate(asked) if number not in replies]
    errors = [decode_answer(ErrorReply, reply.err.payload.to_bytes()) for reply in replies.values()]
    assert {error.code for error in errors} == {"busy"} and "8 requests of this client" in errors[0].message
    assert all(reply.ok for reply in accepted)


def test_clients_without_a_token_share_a_turn(scene, endpoint):
    """Test many invented client ids: together they count as one client."""
    with (
        serving([scene], ServerConfig(listen=endpoint)),
        zenoh.open(session_config(connect=endpoint)) as session,
    ):
        for client in "abc":
            scene.avatars[client, "wait"] = (POINTS, 0.1)
        payload = encode(CollideRequest("wait", np.eye(4)[None]))
        asked = [
            session.get(f"solidcloud/1/scene/floor/{client}/collide", payload=payload, timeout=DEADLINE)
            for client in "abc"
        ]
        with Light(endpoint) as light:
            light.is_answered()
        assert scene.at_work - ASKED == 1
        scene.gate.set()
        assert all(next(iter(handler)).ok for handler in asked)


def test_a_request_that_comes_before_its_clients_token_gets_its_own_turn(scene, endpoint):
    config = ServerConfig(listen=endpoint, max_request_seconds=2 * DEADLINE)
    scene.avatars["b", "al"] = (POINTS, 0.125)
    with stoppable(scene, config) as service, zenoh.open(session_config(connect=endpoint)) as session:
        session.get("solidcloud/1/scene/floor/a/info", timeout=DEADLINE)
        eventually(lambda: service.began == 1)
        payload = encode(CollideRequest("al", heights([-1.0])))
        asked = session.get("solidcloud/1/scene/floor/b/collide", payload=payload, timeout=DEADLINE)
        eventually(lambda: service.in_flight() == 2)
        with session.liveliness().declare_token("solidcloud/1/client/floor/b"):
            assert next(iter(asked)).ok, "it waited behind a request of another client"
            eventually(lambda: service.in_flight() == 1)
        service.gate.set()


def test_a_request_over_its_time_is_stopped(scene, endpoint):
    config = ServerConfig(listen=endpoint, max_request_seconds=0.2)
    with stoppable(scene, config) as service, Client(endpoint, scene="floor", timeout=DEADLINE) as client:
        assert client.info().points == 4
    assert service.began == 1 and "0.2 s" in service.reasons[0]


def test_requests_of_a_client_that_is_gone_are_stopped_and_dropped(scene, endpoint):
    config = ServerConfig(listen=endpoint, max_request_seconds=2 * DEADLINE)
    with stoppable(scene, config) as service, zenoh.open(session_config(connect=endpoint)) as session:
        token = session.liveliness().declare_token("solidcloud/1/client/floor/c")
        key = "solidcloud/1/scene/floor/c/info"
        asked = [session.get(key, timeout=DEADLINE) for _ in range(5)]
        eventually(lambda: service.began == 1 and service.in_flight() == 5)
        token.undeclare()
        eventually(lambda: scene.gone == ["c"])
        assert sum(len(list(handler)) for handler in asked) <= 1, "of the one that was at work"
    assert service.began == 1 and service.reasons == ["its client is gone"]


def test_more_slow_requests_than_places_wait_without_a_worker(scene, endpoint):
    """Test slow requests beyond the limit: they are stopped, wait for a place and start again."""
    config = ServerConfig(listen=endpoint, workers=2, max_slow=1, max_request_seconds=2 * DEADLINE)
    with stoppable(scene, config) as service, ExitStack() as stack:
        light = stack.enter_context(Light(endpoint))
        answers = []
        clients = [stack.enter_context(Client(endpoint, scene="floor", timeout=DEADLINE)) for _ in range(3)]
        threads = [threading.Thread(target=lambda c=c: answers.append(c.info())) for c in clients]
        for thread in threads:
            thread.start()
        try:
            eventually(lambda: service.began == 3 and len(service.reasons) == 2)
            light.is_answered()
            assert not answers
        finally:
            service.gate.set()
            for thread in threads:
                thread.join(DEADLINE)
        assert len(answers) == 3
    assert service.began == 5
    assert sorted(service.reasons) == [
        "",
        "",
        "",
        *["more slow requests than the server takes at a time"] * 2,
    ]


def test_a_stop_ends_what_is_at_work(scene, endpoint):
    config = ServerConfig(listen=endpoint, stop_seconds=0.1, max_request_seconds=2 * DEADLINE)
    with zenoh.open(session_config(connect=endpoint)) as session:
        with stoppable(scene, config) as service:
            key = "solidcloud/1/scene/floor/{}/info"
            eventually(lambda: list(session.get(key.format("d").replace("info", "stats"))))
            tokens = [
                session.liveliness().declare_token(f"solidcloud/1/client/floor/{client}") for client in "abc"
            ]
            asked = [session.get(key.format(client), timeout=DEADLINE) for client in "abc"]
            eventually(lambda: service.began == 3)
        assert all(next(iter(handler)).ok for handler in asked)
        for token in tokens:
            token.undeclare()
    assert service.reasons == ["the server stops"] * 3


def test_avatars_of_clients_with_a_token_are_kept(scene, endpoint, monkeypatch):
    monkeypatch.setattr(lanes_module, "_DROP_SECONDS", 0.01)
    config = ServerConfig(listen=endpoint, avatar_seconds=3.0, max_avatar_bytes=10**6)
    with serving([scene], config):
        assert scene.limits.bytes == 10**6
        with Light(endpoint) as light:
            name = light.client._connection.client_id
            eventually(lambda: any(name in alive for alive, _ in scene.unused))
        eventually(lambda: name not in scene.unused[-1][0])
    assert {seconds for _, seconds in scene.unused} == {3.0}
