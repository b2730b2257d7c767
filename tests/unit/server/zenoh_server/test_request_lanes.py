"""The threads of a lane, without zenoh: queries come from a queue; queries and dispatcher are fakes."""

import queue
import threading
import time
from contextlib import contextmanager, suppress

from solidcloud.schemas.wire.encoding import MSGPACK
from solidcloud.server.runtime.threads import start_thread
from solidcloud.server.scene_interface import EncodedReply, LimitReached
from solidcloud.server.zenoh_server import request_lanes as lanes_module
from solidcloud.server.zenoh_server.fair_queues import LivelinessTokens
from solidcloud.server.zenoh_server.request_lanes import Lane
from solidcloud.server.zenoh_server.server_config import ServerConfig

DEADLINE = 20.0
ANSWER = EncodedReply(b"", MSGPACK, True)


def eventually(condition):
    deadline = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < deadline, "never came true"
        time.sleep(0.002)


class Query:
    """A query of a client. replies: what was said, in order.  ended: whether no more will come."""

    def __init__(self, client, operation="collide"):
        self.key_expr, self.payload = f"solidcloud/1/scene/hall/{client}/{operation}", None
        self.client, self.operation = client, operation
        self.encoding = self.attachment = None
        self.replies, self.ended = [], threading.Event()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.ended.set()

    def reply(self, key, payload, encoding, attachment):
        self.replies.append(payload)


class Fake:
    """A dispatcher that answers with what `answers` makes of a query. busy: what there was no room for, in order."""

    def __init__(self, answers):
        self.answers, self.full, self.unused = answers, [], []

    def answer(self, key, payload, encoding, stop):
        _, _, _, _, client, operation = key.split("/")
        return self.answers(client, operation, stop)

    def busy(self, encoding, full):
        self.full.append(full)
        return ANSWER

    def client_gone(self, scene, client):
        pass

    def drop_unused(self, scene, alive):
        self.unused.append(alive)


class Channel(queue.SimpleQueue):
    """Queries; None, once for each worker, ends them."""

    def __iter__(self):
        return iter(self.get, None)

    def try_recv(self):
        with suppress(queue.Empty):
            query = self.get_nowait()
            if query is not None:
                return query
            self.put(None)
        return None


class Hall:
    """A lane that takes what is put into `queries`."""

    def __init__(self, answers, start=start_thread, **config):
        self.queries, self.threads, self.service = Channel(), [], Fake(answers)
        self.tokens = LivelinessTokens(64)

        def started(name, run, *arguments):
            self.threads.append(start(name, run, *arguments))

        config = ServerConfig(**config)
        self.lane = Lane(self.service, "hall", config, self.queries, started, b"", self.tokens)

    def ask(self, client, operation="collide"):
        self.queries.put(query := Query(client, operation))
        return query

    @contextmanager
    def running(self):
        self.lane.start()
        try:
            yield self
        finally:
            for _ in range(64):
                self.queries.put(None)
            eventually(lambda: not self.lane.in_flight and not any(t.is_alive() for t in self.threads))
            self.lane.close()


def test_a_newcomer_does_not_wait_for_all_that_came_before_it(monkeypatch):
    """One client has many queries in the channel, none of them slow; another has one behind them."""
    monkeypatch.setattr(lanes_module, "_EMPTY_SECONDS", 0.0)
    order = []

    def answers(client, operation, stop):
        order.append(client)
        return ANSWER

    hall = Hall(answers, workers=1)
    for client in ("many", "new"):
        hall.tokens.here(client)
    asked = [hall.ask("many") for _ in range(40)]
    asked.append(hall.ask("new"))
    with hall.running():
        assert all(query.ended.wait(DEADLINE) for query in asked)
    assert order.index("new") == 2 and len(order) == 41
    assert not hall.service.full


def test_a_query_that_cannot_be_read_stops_nobody(monkeypatch, caplog):
    monkeypatch.setattr(lanes_module, "_EMPTY_SECONDS", 0.0)
    hall = Hall(lambda *_: ANSWER, workers=1)
    asked = [hall.ask("a")]
    hall.queries.put(object())
    asked += [hall.ask("a"), hall.ask("b")]
    with hall.running():
        assert all(query.ended.wait(DEADLINE) for query in asked)
    assert "a query of scene hall" in caplog.text


def paths(gate):
    """Answers in two parts, the second once the gate is open."""

    def answers(client, operation, stop):
        def parts():
            yield ANSWER
            while not (stop or gate.wait(0.01)):
                pass
            yield ANSWER

        return parts()

    return answers


def test_all_clients_without_a_token_have_half_of_the_paths_together():
    gate = threading.Event()
    hall = Hall(paths(gate), max_paths=4)
    hall.tokens.here("known")
    with hall.running():
        try:
            invented = [hall.ask(f"invented-{number}", "path") for number in range(2)]
            eventually(lambda: all(query.replies for query in invented))
            refused = hall.ask("invented-3", "path")
            assert refused.ended.wait(DEADLINE)
            assert hall.service.full == [LimitReached.PATHS]
            known = hall.ask("known", "path")
            eventually(lambda: known.replies)
            assert not known.ended.is_set() and len(hall.service.full) == 1
        finally:
            gate.set()
        assert all(query.ended.wait(DEADLINE) for query in [*invented, known])
    assert [len(query.replies) for query in [*invented, known]] == [2, 2, 2]


def test_a_path_of_a_client_without_a_token_ends_after_a_while():
    """It may be gone, which nothing tells."""
    gate = threading.Event()
    hall = Hall(paths(gate), avatar_seconds=0.2)
    hall.tokens.here("known")
    with hall.running():
        known, stranger = hall.ask("known", "path"), hall.ask("stranger", "path")
        assert stranger.ended.wait(DEADLINE)
        assert not known.ended.is_set()
        gate.set()
        assert known.ended.wait(DEADLINE)
