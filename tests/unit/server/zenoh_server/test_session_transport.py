"""The thread that takes wishes, without a network."""

from collections import deque
from types import SimpleNamespace

import zenoh
from solidcloud.server.zenoh_server.fair_queues import LivelinessTokens
from solidcloud.server.zenoh_server.session_transport import SceneSessions


class Payload:
    """What was sent. read: how often it was copied."""

    def __init__(self, size):
        self.size, self.read = size, 0

    def __len__(self):
        return self.size

    def to_bytes(self):
        self.read += 1
        return b"w" * self.size


class Channel:
    """Samples that are there already; then the channel ends."""

    def __init__(self, samples):
        self.samples = deque(samples)

    def __iter__(self):
        while self.samples:
            yield self.samples.popleft()

    def try_recv(self):
        return self.samples.popleft() if self.samples else None


class Frames:
    """Notes what it is told, in order."""

    most_users = 2

    def __init__(self):
        self.told = []

    def fits(self, user, size, encoding):
        if size > 1000:
            self.told.append(("refused", user.client))
        return size <= 1000

    def wish(self, user, payload, encoding):
        if user.client == "crash":
            raise RuntimeError("of this wish alone")
        self.told.append(("wish", user.client))
        return False

    def leave(self, user):
        self.told.append(("left", user.client))

    def close(self):
        self.told.append("closed")


def sample(client, size=10, kind=zenoh.SampleKind.PUT):
    key = f"solidcloud/1/wish/hall/{client}/al"
    return SimpleNamespace(key_expr=key, kind=kind, payload=Payload(size), encoding="msgpack")


def taken(samples, *known):
    frames, tokens = Frames(), LivelinessTokens(8)
    for client in known:
        tokens.here(client)
    service = SimpleNamespace(frames=lambda *_: None)
    sessions = SceneSessions(None, "hall", service, None, None, tokens)
    sessions._take_wishes(Channel(samples), frames)
    return frames.told


def test_wishes_of_one_client_do_not_keep_others_waiting():
    samples = [sample("many") for _ in range(100)] + [sample("few")]
    told = taken(samples, "many", "few")
    assert told.index(("wish", "few")) <= 2 and len(told) == 102 and told[-1] == "closed"


def test_a_wish_that_is_too_large_is_not_read():
    large = sample("a", 1001)
    assert taken([sample("a"), large, sample("a", 1000)]) == [
        ("wish", "a"),
        ("refused", "a"),
        ("wish", "a"),
        "closed",
    ]
    assert not large.payload.read


def test_what_is_no_wish_stops_nobody(caplog):
    nobody = sample("a")
    nobody.key_expr = "solidcloud/1/wish/hall/*/al"
    told = taken(
        [nobody, sample("crash"), sample("a"), sample("a", 0, zenoh.SampleKind.DELETE)], "a", "crash"
    )
    assert told == [("wish", "a"), ("left", "a"), "closed"]
    assert "a motion command failed" in caplog.text
