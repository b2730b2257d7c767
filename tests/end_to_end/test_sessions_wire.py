"""Test the messages of sessions: plain zenoh clients, large numbers, and messages that are lost."""

import threading

import msgspec
import numpy as np
import pytest
import zenoh
from floor import DEADLINE, POINTS, eventually
from solidcloud.schemas.wire import key_expressions
from solidcloud.schemas.wire.encoding import JSON, MSGPACK, decode_answer, encode
from solidcloud.schemas.wire.motion_messages import State, Wish
from solidcloud.schemas.wire.scene_messages import ErrorReply
from solidcloud.server.client import Client
from solidcloud.server.zenoh_common.zenoh_settings import session_config
from solidcloud.server.zenoh_server import state_streams
from walkers import outcome, pose_at, walking


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
def test_plain_zenoh_is_enough_to_walk(served, endpoint, encoding):
    user, heard, ended = key_expressions.User("me", "al"), [], threading.Event()
    served.scene.add_avatar("al", POINTS, 0.125, client="me")
    with zenoh.open(session_config(connect=endpoint)) as session:
        session.get(
            key_expressions.state_key("floor", user),
            zenoh.handlers.Callback(heard.append, ended.set),
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=600.0,
        )
        wish = Wish(seq=7, time=1.0, pose=pose_at(0.0, -2.0)[None])
        key = key_expressions.command_key("floor", user)
        session.put(key, encode(wish, encoding), encoding=encoding)
        eventually(lambda: len(heard) == 1)
        sample = heard[0].ok
        state = decode_answer(State, sample.payload.to_bytes(), encoding)
        assert str(sample.encoding) == encoding and str(sample.key_expr) == key_expressions.state_key(
            "floor", user
        )
        assert (state.seq, state.frame) == (7, 1) and np.array_equal(state.pose[0], outcome(wish.pose[0]))
        for number, payload in enumerate((b"\xc1", b"{}", b"", b"\x80")):
            session.put(key, payload, encoding=encoding)
            eventually(lambda number=number: len(heard) == 2 + number)
            error = decode_answer(ErrorReply, heard[-1].err.payload.to_bytes(), encoding)
            assert error.code == "bad_request"
        session.put(key, encode(wish), encoding="text/plain")
        eventually(lambda: len(heard) == 6)
        assert decode_answer(ErrorReply, heard[-1].err.payload.to_bytes(), MSGPACK).code == "bad_request"
        session.put("solidcloud/1/wish/floor/me/*", b"")  # without an owner: no answer, and nothing fails
        assert served.users == [user]
        session.delete(key)
        eventually(lambda: not served.users)
        assert not ended.is_set()
        session.get(key_expressions.state_key("floor", user))
        assert ended.wait(DEADLINE), "a second query takes the place of the first"
        assert not list(session.get("solidcloud/1/state/floor/me/*", timeout=DEADLINE)), "of nobody"


def test_a_state_that_comes_before_its_query_is_kept_for_it(served, endpoint):
    user, heard = key_expressions.User("me", "al"), []
    served.scene.add_avatar("al", POINTS, 0.125, client="me")
    with zenoh.open(session_config(connect=endpoint)) as session:
        wish = Wish(seq=7, time=1.0, pose=pose_at(0.0, 2.0)[None])
        session.put(key_expressions.command_key("floor", user), encode(wish))
        eventually(lambda: served.users)
        session.get(
            key_expressions.state_key("floor", user),
            heard.append,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=600.0,
        )
        eventually(lambda: len(heard) == 1)
        assert decode_answer(State, heard[0].ok.payload.to_bytes()).seq == 7


def test_a_large_number_locks_nobody_out(served, endpoint):
    """Test a large command number from a foreign program in the name of the same client.

    The number is forgotten when states are queried again.
    """
    with Client(endpoint, scene="floor", timeout=DEADLINE) as client:
        client.add_avatar("al", POINTS, 0.125)
        with client.session("al") as session:
            session.wait(session.wish(pose_at(0.0, 1.0)), DEADLINE)
            (user,) = served.users
            far = Wish(seq=10**9, time=1.0, pose=pose_at(0.0, 5.0)[None])
            client._connection.session.put(key_expressions.command_key("floor", user), encode(far))
            session.wait(10**9, DEADLINE)
            # The session continues counting above the number that it received.
            seq = session.wish(pose_at(0.0, 2.0))
            assert seq > 10**9 and session.wait(seq, DEADLINE).pose[0, 2, 3] == 2.0
            client._connection.session.put(
                key_expressions.command_key("floor", user), encode(msgspec.structs.replace(far, seq=2**62))
            )
            eventually(lambda: session.latest().seq == 2**62)
        client._numbers.clear()
        with client.session("al") as session:
            state = session.wait(session.wish(pose_at(0.0, 3.0)), DEADLINE)
            assert (state.seq, state.pose[0, 2, 3]) == (1, 3.0)


@pytest.mark.parametrize("lost", [1, 2])
def test_a_state_that_was_dropped_is_sent_once_more(served, endpoint, monkeypatch, lost):
    sent = []

    def dropping(*arguments):
        sent.append(arguments)
        return True if len(sent) <= lost else send_reply(*arguments)

    send_reply = state_streams.send_reply
    monkeypatch.setattr(state_streams, "send_reply", dropping)
    with walking(endpoint) as session:
        state = session.wait(session.wish(pose_at(0.0, 1.0)), DEADLINE)
        assert state.late == 0 and len(sent) > lost
        assert [each.seq for each in session.states(0.0)] == [state.seq]
        assert session.wait(session.wish(pose_at(0.0, 2.0)), DEADLINE).frame == 2, "it was simulated once"


def test_a_wish_that_was_dropped_is_sent_once_more(served, endpoint):
    class Dropping:
        """Publisher whose first sample is lost."""

        def __init__(self, publisher):
            self.publisher, self.lost = publisher, []

        def put(self, payload):
            self.publisher.put(payload) if self.lost else self.lost.append(payload)

        def delete(self):
            self.publisher.delete()

        def undeclare(self):
            self.publisher.undeclare()

    with walking(endpoint) as session:
        session._publisher = publisher = Dropping(session._publisher)
        state = session.wait(session.wish(pose_at(0.0, 1.0)), DEADLINE)
        assert (state.pose[0, 2, 3], state.frame, len(publisher.lost)) == (1.0, 1, 1)
