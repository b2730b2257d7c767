"""Test an impostor at the endpoint of a dead server: clients reject replies without the server's key."""

import os
import struct
import threading
import time

import numpy as np
import pytest
import zenoh
from floor import DEADLINE, PATH, POINTS, TRUTH, eventually, heights, joined, server_process
from rogue_cases.rogue_attacks import Impostor
from solidcloud.schemas.errors import BadRequestError, BusyError
from solidcloud.schemas.wire import key_expressions
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.encoding import MSGPACK, encode
from solidcloud.schemas.wire.motion_messages import State
from solidcloud.schemas.wire.scene_messages import ErrorReply
from solidcloud.server.client import Client
from solidcloud.server.zenoh_client.server_connection import scenes_at
from solidcloud.server.zenoh_common.key_files import find_key, key_paths
from solidcloud.server.zenoh_common.sealed_replies import Sealer, hash_of
from solidcloud.server.zenoh_common.zenoh_settings import session_config
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig
from walkers import pose_at

POSES = heights([-1.0, -2.0])
CONTACTS = [Verdict.CONTACT] * 2
COUNT = 5


def seals_seen(seals):
    """Return a seal function that replays a seal of the true server."""
    return lambda query, payload: seals[0]


def garbage(query, payload):
    """Return a seal of the right length, made with another key."""
    return Sealer(
        os.urandom(32), query.attachment.to_bytes(), str(query.key_expr), hash_of(query.payload.to_bytes())
    ).seal(0, True, MSGPACK, payload)


def asked_of(client, impostor):
    """Send all kinds of queries to the impostor; return all verdicts that are not unknown."""
    found = []
    for _ in range(COUNT):
        eventually(lambda: client.collide("al", POSES) is not None and "collide" in impostor.asked)
        found += [verdict for verdict in client.collide("al", POSES).verdict if verdict != Verdict.UNKNOWN]
        for part in client.path("al", PATH):
            found += [verdict for verdict in part.verdict if verdict != Verdict.UNKNOWN]
    assert {"collide", "path"} <= set(impostor.asked), "it was asked"
    return found


@pytest.mark.parametrize("seal", ["none", "garbage", "replayed"])
def test_a_rogue_at_a_dead_servers_port_is_never_believed(endpoint, seal, caplog):
    with Client(endpoint, scene="floor", timeout=1.0) as client:
        client.add_avatar("al", POINTS, 0.125)
        with server_process(endpoint, "--walked") as process, client.session("al") as session:
            eventually(lambda: client.collide("al", POSES).verdict.tolist() == CONTACTS)
            assert session.wait(session.wish(pose_at(0.0, 1.0)), DEADLINE).pose[0, 2, 3] == 1.0
            seals = [seal_of_the_server(client)]
            process.kill()
            process.wait(DEADLINE)
            make = {"none": None, "garbage": garbage, "replayed": seals_seen(seals)}[seal]
            with Impostor(endpoint, make) as impostor:
                assert asked_of(client, impostor) == []
                # A query for states may have been lost; the client repeats it after a motion
                # command without a state.
                eventually(lambda: session.wish(pose_at(0.0, 2.0)) and "state" in impostor.asked)
                for _ in range(COUNT):
                    with pytest.raises(BusyError, match="no state"):
                        session.wait(session.wish(pose_at(0.0, 2.0)), 0.1)
                assert session.latest().pose[0, 2, 3] == 1.0
                with Client(endpoint, scene="floor", timeout=1.0) as another:
                    another.add_avatar("al", POINTS, 0.125)
                    assert asked_of(another, impostor) == [], "the file is still there"
                with pytest.raises(BusyError):
                    scenes_at(endpoint, timeout=1.0)
        said = [record.getMessage() for record in caplog.records if "not sealed" in record.getMessage()]
        assert len(said) == 3, "once for each client"
        # A new server has another key, which is in the file.
        with server_process(endpoint, "--walked"):
            eventually(lambda: client.collide("al", POSES).verdict.tolist() == CONTACTS)
            assert np.array_equal(joined(list(client.path("al", PATH))), TRUTH)


def seal_of_the_server(client):
    """Return a seal that the server gave for another query."""
    replies = client._connection.session.get(
        key_expressions.query_key("floor", client._connection.client_id, "info"),
        attachment=bytes(16),
        encoding=MSGPACK,
    )
    return next(iter(replies)).ok.attachment.to_bytes()


def test_without_a_key_replies_are_taken_as_they_come_and_that_is_said_once(
    endpoint, caplog, monkeypatch, tmp_path
):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "nowhere"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "nowhere"))
    with Impostor(endpoint) as impostor, Client(endpoint, scene="floor", timeout=1.0) as client:
        client.add_avatar("al", POINTS, 0.125)
        assert Verdict.CLEAR in asked_of(client, impostor), "the impostor is one"
        with client.session("al") as session:
            # It stores no state for a query that comes after the motion command.
            eventually(lambda: session.wish(pose_at(0.0, 1.0)) and session.latest() is not None)
            assert session.latest().pose[0, 2, 3] == 9.0
    said = [record.getMessage() for record in caplog.records if "no key of the server" in record.getMessage()]
    assert len(said) == 1


def test_a_key_that_is_found_later_is_demanded_from_then_on(scene, endpoint):
    with Client(endpoint, scene="floor", timeout=1.0) as client:
        client.add_avatar("al", POINTS, 0.125)
        assert client.collide("al", POSES).verdict.tolist() == [Verdict.UNKNOWN] * 2
        with serving([scene], ServerConfig(listen=endpoint)):
            eventually(lambda: client.collide("al", POSES).verdict.tolist() == CONTACTS)
        assert not key_paths(endpoint)[0].exists(), "it goes with the server"
        with Impostor(endpoint) as impostor:
            assert asked_of(client, impostor) == []


def test_a_key_may_be_handed_out(scene, endpoint, tmp_path, monkeypatch):
    ours, theirs = tmp_path / "ours", tmp_path / "theirs"
    for path, key in ((ours, "ab" * 32), (theirs, "cd" * 32)):
        path.write_text(key)
        path.chmod(0o600)
    with serving([scene], ServerConfig(listen=endpoint, key_file=ours)):
        assert find_key(endpoint).key == b"\xab" * 32
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "nowhere"))
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "nowhere"))
        with Client(endpoint, scene="floor", key_file=ours) as client:
            client.add_avatar("al", POINTS, 0.125)
            assert client.collide("al", POSES).verdict.tolist() == CONTACTS
            with pytest.raises(BadRequestError, match="names none"):
                error_of(client)
        with Client(endpoint, scene="floor", key_file=theirs, timeout=1.0) as client:
            client.add_avatar("al", POINTS, 0.125)
            assert client.collide("al", POSES).verdict.tolist() == [Verdict.UNKNOWN] * 2
        assert scenes_at(endpoint, key_file=ours) == ["floor"]
    with pytest.raises(BadRequestError, match="No such file"):
        Client(endpoint, scene="floor", key_file=tmp_path / "none")


def error_of(client):
    """Provoke an error reply, which is sealed, too, and raise its error."""
    try:
        client._connection.ask("collide", b"\xc1")
    except BadRequestError as error:
        raise BadRequestError("names none") from error


def settled(queries):
    """Return whether some queries for states came, and then none for a while.

    A query that ends because a server starts or stops is repeated.
    """
    count = len(queries)
    time.sleep(0.5)
    return 0 < count == len(queries)


def send_state(query, sealer, number):
    """Reply to a query with a sealed state that has this number."""
    payload = encode(State(pose=pose_at(0.0, number)[None], seq=number, time=0.0, frame=1))
    seal = sealer.seal(number, True, MSGPACK, payload)
    query.reply(query.key_expr, payload, encoding=MSGPACK, attachment=seal)


def send_until_received(query, sealer, walker, number):
    """Send states from `number` on until the walker receives one; return its number.

    zenoh may drop replies if the receiving process does not run for a while.
    """
    deadline = time.monotonic() + DEADLINE
    while True:
        send_state(query, sealer, number)
        try:
            return walker.wait(number, 1.0).seq
        except BusyError as error:
            assert "no state of wish" in str(error) and time.monotonic() < deadline, error
        number += 1


def test_a_state_that_was_heard_before_is_ignored(endpoint, tmp_path):
    """Test that replayed states of the server are received neither twice nor out of order."""
    key = b"\xab" * 32
    (tmp_path / "key").write_text(key.hex())
    (tmp_path / "key").chmod(0o600)
    config = ServerConfig(listen=endpoint)  # only for its check
    open_queries = []
    with zenoh.open(session_config(listen=config.listen)) as session:
        session.declare_queryable("solidcloud/1/state/floor/*/*", open_queries.append, complete=True)
        with (
            Client(endpoint, scene="floor", timeout=0.2, key_file=tmp_path / "key") as client,
            client.session("al") as walker,
        ):
            eventually(lambda: settled(open_queries))
            query = open_queries[-1]
            sealer = Sealer(key, query.attachment.to_bytes(), str(query.key_expr), hash_of(b""))
            for number in (0, 1, 1, 0, 3, 2, 4):
                send_state(query, sealer, number)
            last = send_until_received(query, sealer, walker, 4)
            heard = [state.seq for state in walker.states(0.0)]
            assert heard == sorted(set(heard)) and set(heard) <= {0, 1, 3, *range(4, last + 1)}
            error = encode(ErrorReply("busy", "not from the server"))
            query.reply_err(error, encoding=MSGPACK)
            query.reply_err(error, encoding=f"{MSGPACK};{struct.pack('<Q', 9).hex()}{'00' * 32}")
            send_until_received(query, sealer, walker, last + 1)  # raises an error that was received
            open_queries.clear()
            del query


def test_replies_that_are_refused_do_not_keep_a_path_open(endpoint, tmp_path):
    (tmp_path / "key").write_text("ab" * 32)
    (tmp_path / "key").chmod(0o600)
    held, over = [], threading.Event()

    def drip(query):
        held.append(query)
        for number in range(400):
            query.reply(query.key_expr, b"\x80", encoding=MSGPACK)
            if over.wait(0.05) or number == 399:
                break

    with zenoh.open(session_config(listen=endpoint)) as session:
        session.declare_queryable("solidcloud/1/scene/floor/*/path", drip, complete=True)
        with Client(endpoint, scene="floor", timeout=0.5, key_file=tmp_path / "key") as client:
            begin = time.monotonic()
            verdicts = [part.verdict for part in client.path("al", PATH)]
            took = time.monotonic() - begin
            over.set()
    assert held and np.all(np.concatenate(verdicts) == Verdict.UNKNOWN)
    assert took < 10, "twenty seconds of replies were not waited for"


def test_errors_do_not_have_states_asked_for_faster(endpoint):
    asked = []

    def refuse(query):
        with query:
            asked.append(time.monotonic())
            query.reply_err(encode(ErrorReply("busy", "no room")), encoding=MSGPACK)

    with zenoh.open(session_config(listen=endpoint)) as session:
        session.declare_queryable("solidcloud/1/state/floor/*/*", refuse, complete=True)
        with Client(endpoint, scene="floor", timeout=0.5) as client, client.session("al"):
            eventually(lambda: len(asked) >= 1)
            time.sleep(2.0)
    # At most one every 0.2 s after the first few; without a growing pause, one every 0.02 s.
    assert 2 <= len(asked) <= 30


def test_a_session_of_a_closed_client_says_so(scene, endpoint):
    with serving([scene], ServerConfig(listen=endpoint)):
        with Client(endpoint, scene="floor") as client:
            session = client.session("al")
        with pytest.raises(BadRequestError, match="expected an open client"), session:
            pass


def test_a_query_for_the_scenes_that_fails_is_the_only_one(scene, endpoint, monkeypatch):
    with serving([scene], ServerConfig(listen=endpoint)) as service:
        with monkeypatch.context() as broken:
            broken.setattr(service, "scenes", None)
            with pytest.raises(BusyError):
                scenes_at(endpoint, timeout=0.5)
        assert scenes_at(endpoint, timeout=DEADLINE) == ["floor"]
