"""What viewers ask over zenoh: overview, voxels, tiles, and changes of what is resident, as users walk."""

import json
import threading
import time
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import archive_cases
import msgspec
import numpy as np
import pytest
import zenoh
from floor import DEADLINE, eventually
from solidcloud.schemas.errors import BadRequestError, BusyError, TooLargeError
from solidcloud.schemas.wire import key_expressions
from solidcloud.schemas.wire.encoding import JSON, decode_answer
from solidcloud.schemas.wire.overview_messages import OverviewAnswer
from solidcloud.schemas.wire.residency_messages import Residency, ResidencyChanges
from solidcloud.schemas.wire.scene_messages import ErrorReply
from solidcloud.schemas.wire.tile_messages import TileAnswer, VoxelsAnswer
from solidcloud.server.client import Client
from solidcloud.server.scene import Scene
from solidcloud.server.zenoh_common.zenoh_settings import session_config
from solidcloud.server.zenoh_server import request_dispatcher, residency_streams
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig

AVATAR = np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0]])


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build an archive of forty voxels, along a corridor."""
    places = np.random.default_rng(2).uniform((0, 0, 0), (10, 1, 0.2), (20_000, 3))
    return archive_cases.build(tmp_path_factory.mktemp("viewer"), places, voxel=0.5).archive


@pytest.fixture
def scene(archive: Path) -> Iterator[Scene]:
    """Return a scene whose cache holds a fifth of the archive."""
    with Scene.open(archive, "hall") as whole, whole.archives[0].take() as generation:
        budget = int(generation.store.sizes.sum()) // 5
    with Scene.open(archive, "hall", budget_bytes=budget, policy="lru+prefetch") as scene:
        yield scene


@pytest.fixture
def client(scene: Scene, endpoint: str) -> Iterator[Client]:
    """Return a client of the scene."""
    with serving([scene], ServerConfig(listen=endpoint)), Client(endpoint, scene="hall") as client:
        yield client


def assert_same(one: msgspec.Struct, other: msgspec.Struct) -> None:
    """Assert that two messages are equal."""
    for name in one.__struct_fields__:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)


def test_answers_over_the_wire_are_those_of_the_scene(client: Client, scene: Scene) -> None:
    assert_same(client.overview(500), scene.overview(500))
    listed = client.voxels((1.0, 0.5, 0.1), 3.0, 10)
    assert_same(listed, scene.voxels((1.0, 0.5, 0.1), 3.0, 10))
    assert len(listed.voxel) == 10 < listed.total
    for level in (None, 2):
        voxel = listed.voxel[3].tolist()
        assert_same(client.tile(0, voxel, 1, level), scene.tile(0, voxel, 1, level))
    with pytest.raises(BadRequestError, match="no points"):
        client.tile(0, (99, 0, 0))


def resident(client: Client) -> set[tuple[int, ...]]:
    """Return the resident voxels, from the list of voxels."""
    listed = client.voxels((0, 0, 0))
    return {tuple(voxel) for voxel in listed.voxel[listed.resident].tolist()}


class Known:
    """What a viewer knows to be resident: from the list of voxels, and from changes."""

    def __init__(self, client: Client, other: Client) -> None:
        self.voxels: set[tuple[int, ...]] = set()
        self.lists = self.messages = 0
        self.counts = dict.fromkeys(Residency, 0)
        self.failed: list[BaseException] = []
        self._other = other
        self._stream = client.residency_changes()
        self._thread = threading.Thread(target=self._read)

    def __enter__(self) -> "Known":
        self._stream.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()
        self._thread.join(DEADLINE)
        assert not self._thread.is_alive() and not self.failed

    def _read(self) -> None:
        try:
            for message in self._stream.changes(DEADLINE):
                self.messages += 1
                if message.lost:
                    self.lists += 1
                    self.voxels = resident(self._other)
                for voxel, state in zip(message.voxel.tolist(), message.state.tolist(), strict=True):
                    self.counts[Residency(state)] += 1
                    if state in (Residency.LOADED, Residency.PREFETCHED):
                        self.voxels.add(tuple(voxel))
                    else:
                        self.voxels.discard(tuple(voxel))
        except BaseException as error:
            self.failed.append(error)


def test_changes_arrive_as_a_user_walks(client: Client, scene: Scene) -> None:
    client.add_avatar("al", AVATAR, 0.01)
    with Known(client, client) as known, client.session("al") as session:
        eventually(lambda: known.lists == 1)
        pose = np.eye(4)
        pose[:3, 3] = 0.2, 0.5, 0.4
        session.wait(session.wish(pose), DEADLINE)
        begun = time.monotonic()

        def enough() -> bool:
            gone = known.counts[Residency.EVICTED] + known.counts[Residency.WASTED]
            return gone > 5 and known.counts[Residency.LOADED] + known.counts[Residency.PREFETCHED] > 10

        def walked() -> bool:
            # As fast as a person runs, to and fro: what is loaded ahead follows the clock.
            pose[0, 3] = 0.2 + abs((4.0 * (time.monotonic() - begun)) % 18.0 - 9.0)
            session.wait(session.wish(pose), DEADLINE)
            return enough()

        eventually(walked)
        eventually(lambda: known.voxels == resident(client))
        assert known.lists == 1, "nothing was lost"
    eventually(lambda: not scene.residency.stats.logs)


def test_two_clients_follow_and_one_ends(client: Client, scene: Scene, endpoint: str) -> None:
    with Client(endpoint, scene="hall") as other, Known(client, client) as one:
        with Known(other, other) as two:
            eventually(lambda: one.lists == two.lists == 1)
        before = one.messages
        eventually(lambda: one.messages > before + 1)
        assert len(scene.residency.stats.logs) == 1, "one log for all clients"


def test_a_restarted_server_is_followed(scene: Scene, endpoint: str) -> None:
    config = ServerConfig(listen=endpoint)
    with Client(endpoint, scene="hall") as client:
        with serving([scene], config):
            known = Known(client, client).__enter__()
            eventually(lambda: known.lists == 1)
        with serving([scene], config):
            eventually(lambda: known.lists >= 2)
            before = known.messages
            eventually(lambda: known.messages > before + 1)
            known.__exit__()


def test_there_is_room_for_a_number_of_queries(
    client: Client, endpoint: str, monkeypatch: pytest.MonkeyPatch, scene: Scene, free_endpoint
) -> None:
    monkeypatch.setattr(residency_streams, "_STREAMS", 1)
    endpoint = free_endpoint()
    with (
        serving([scene], ServerConfig(listen=endpoint)),
        Client(endpoint, scene="hall") as one,
        Client(endpoint, scene="hall") as two,
        Known(one, one) as known,
    ):
        eventually(lambda: known.lists == 1)
        with two.residency_changes() as changes, pytest.raises(BusyError, match="changes"):
            next(iter(changes))


class Raw:
    """A client with zenoh alone that speaks JSON."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session

    def ask(self, operation: str, text: str) -> tuple[bool, bytes]:
        """Return whether the reply is an answer, and its payload."""
        key = key_expressions.query_key("hall", "raw", operation)
        (reply,) = self.session.get(key, payload=text, encoding=JSON, timeout=DEADLINE)
        return reply.ok is not None, (reply.ok or reply.err).payload.to_bytes()


@pytest.fixture
def raw(client: Client, endpoint: str) -> Iterator[Raw]:
    """Return a client with zenoh alone."""
    with zenoh.open(session_config(connect=endpoint)) as session:
        yield Raw(session)


def test_every_operation_speaks_json(raw: Raw, client: Client) -> None:
    voxel = client.voxels((0, 0, 0)).voxel[0].tolist()
    for operation, text, kind in (
        ("overview", '{"limit": 50}', OverviewAnswer),
        ("voxels", '{"place": [0, 0, 0]}', VoxelsAnswer),
        ("tile", json.dumps({"archive": 0, "voxel": voxel}), TileAnswer),
    ):
        ok, payload = raw.ask(operation, text)
        assert ok, payload
        decode_answer(kind, payload, JSON)
    key = key_expressions.residency_key("hall", "raw")
    replies = raw.session.get(
        key, encoding=JSON, timeout=DEADLINE, consolidation=zenoh.ConsolidationMode.NONE
    )
    for number, reply in enumerate(islice(replies, 3)):
        message = decode_answer(ResidencyChanges, reply.ok.payload.to_bytes(), JSON)
        assert message.lost == (number == 0)


@pytest.mark.parametrize(
    "operation, text",
    [
        ("overview", '{"limit": 0}'),
        ("overview", '{"limit": 200001}'),
        ("overview", '{"limit": 1e300}'),
        ("overview", "[]"),
        ("overview", ""),
        ("voxels", "{}"),
        ("voxels", '{"place": [0, 0]}'),
        ("voxels", '{"place": [0, 0, null]}'),
        ("voxels", '{"place": [0, 0, 1e999]}'),
        ("voxels", '{"place": [0, 0, 0], "reach": -1}'),
        ("voxels", '{"place": [0, 0, 0], "limit": 65537}'),
        ("voxels", '{"place": [0, 0, 0], "limit": 0}'),
        ("voxels", '{"place": [0, 0, 0], "radius": 1}'),
        ("tile", '{"archive": 0}'),
        ("tile", '{"archive": 1, "voxel": [0, 0, 0]}'),
        ("tile", '{"archive": -1, "voxel": [0, 0, 0]}'),
        ("tile", '{"archive": 0, "voxel": [0, 0, 9000000000000000000000]}'),
        ("tile", '{"archive": 0, "voxel": [0, 0, 2147483648]}'),
        ("tile", '{"archive": 0, "voxel": [0, 0, 0.5]}'),
        ("tile", '{"archive": 0, "voxel": [0, 0, 0], "detail": 9}'),
        ("tile", '{"archive": 0, "voxel": [0, 0, 0], "level": 80}'),
        ("tile", '{"archive": 0, "voxel": [0, 0, 0], "level": -1}'),
    ],
)
def test_a_malformed_request_is_refused(raw: Raw, operation: str, text: str) -> None:
    ok, payload = raw.ask(operation, text)
    assert not ok and decode_answer(ErrorReply, payload, JSON).code == "bad_request"


def test_malformed_queries_for_changes_are_refused(raw: Raw) -> None:
    key = key_expressions.residency_key("hall", "raw")
    for text, encoding in (("[]", JSON), ('{"follow": 3}', JSON), ("{}", "text/plain"), ("\x00", "")):
        (reply,) = raw.session.get(key, payload=text, encoding=encoding, timeout=DEADLINE)
        assert reply.err is not None, text
    for wrong, text in ((key, "x" * 5000), (key_expressions.residency_key("hall", "a") + "/b", "")):
        assert not list(raw.session.get(wrong, payload=text, encoding=JSON, timeout=DEADLINE))
    assert not list(raw.session.get("solidcloud/1/residency/hall/*", timeout=DEADLINE)), "of nobody"


def test_an_answer_beyond_a_message_is_too_large(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(request_dispatcher, "MAX_MESSAGE_BYTES", (1 << 16) + 1000)
    with pytest.raises(TooLargeError, match="answer takes"):
        client.overview()
