"""Test an impostor at the endpoint of a dead server: clients reject replies without the server's key."""

import os
import time

import numpy as np
import pytest
import zenoh
from floor import DEADLINE, PATH, POINTS, TRUTH, eventually, heights, joined, server_process
from rogue_cases.rogue_attacks import Impostor
from solidcloud.schemas.errors import BadRequestError, BusyError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.encoding import MSGPACK, encode
from solidcloud.schemas.wire.scene_messages import ErrorReply
from solidcloud.server.client import Client
from solidcloud.server.zenoh_client.server_connection import scenes_at
from solidcloud.server.zenoh_common.key_files import find_key
from solidcloud.server.zenoh_common.sealed_replies import Sealer, hash_of
from solidcloud.server.zenoh_common.zenoh_settings import session_config
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig
from walkers import pose_at

POSES = heights([-1.0, -2.0])
CONTACTS = [Verdict.CONTACT] * 2
COUNT = 5


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


def test_a_rogue_at_a_dead_servers_port_is_never_believed(endpoint, caplog):
    with Client(endpoint, scene="floor", timeout=1.0) as client:
        client.add_avatar("al", POINTS, 0.125)
        with server_process(endpoint, "--walked") as process, client.session("al") as session:
            eventually(lambda: client.collide("al", POSES).verdict.tolist() == CONTACTS)
            assert session.wait(session.wish(pose_at(0.0, 1.0)), DEADLINE).pose[0, 2, 3] == 1.0
            process.kill()
            process.wait(DEADLINE)
            with Impostor(endpoint, garbage) as impostor:
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


def test_errors_do_not_have_states_asked_for_faster(endpoint):
    asked = []

    def refuse(query):
        with query:
            asked.append(time.monotonic())
            query.reply_err(encode(ErrorReply("busy", "no room")), encoding=MSGPACK)

    with zenoh.open(session_config(listen=endpoint)) as session:
        session.declare_queryable("solidcloud/1/state/floor/*/*", refuse, complete=True)
        with Client(endpoint, scene="floor", timeout=0.5) as client, client.session("al"):
            eventually(lambda: len(asked) >= 2)
            time.sleep(1.0)
    # At most one every 0.2 s after the first few; without a growing pause, one every 0.02 s.
    assert len(asked) <= 25


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
