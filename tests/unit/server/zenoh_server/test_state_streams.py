"""The open queries of one scene: their room, and what is kept for one that is still to come."""

import pytest
from solidcloud.schemas.wire.key_expressions import User
from solidcloud.server.scene_interface import EncodedReply
from solidcloud.server.zenoh_server import state_streams
from solidcloud.server.zenoh_server.state_streams import IDLE_SECONDS, StateStreams


class Query:
    """A query for states. replies: payloads sent.  ended: whether no more come.  gone: whether its client is."""

    key_expr = "solidcloud/1/state/hall/a/al"

    def __init__(self):
        self.replies, self.ended, self.gone = [], False, False

    def drop(self):
        self.ended = True


@pytest.fixture
def clock(monkeypatch):
    """The time that streams see, as the only element of a list."""
    now = [1000.0]
    monkeypatch.setattr(state_streams.time, "monotonic", lambda: now[0])

    def reply(query, key, answer, sealer, number):
        assert number == len(query.replies)
        query.replies.append(answer.payload)
        return not query.gone

    monkeypatch.setattr(state_streams, "send_reply", reply)
    return now


def said(text):
    return EncodedReply(text.encode(), "msgpack", True)


def opened(streams, client, avatar="al"):
    query = Query()
    return query, streams.open(User(client, avatar), query, None)


def test_a_turn_ends_its_oldest_query_for_a_new_one(clock):
    streams = StateStreams(4)
    first, second, third = (opened(streams, "a", str(number))[0] for number in range(3))
    assert [query.ended for query in (first, second, third)] == [True, False, False]
    other, there_was_room = opened(streams, "b")
    assert there_was_room and not (second.ended or third.ended or other.ended)


def test_all_clients_without_a_token_have_half_of_the_room_together(clock):
    streams = StateStreams(4, lambda client: client if client == "known" else "")
    invented = [opened(streams, f"invented-{number}")[0] for number in range(4)]
    assert [query.ended for query in invented] == [True, True, False, False]
    for number in range(2):
        assert opened(streams, "known", str(number))[1]
    assert [query.ended for query in invented] == [True, True, False, False]


def test_one_that_is_idle_makes_room_and_no_other(clock):
    streams = StateStreams(2)
    first, _ = opened(streams, "a")
    second, _ = opened(streams, "b")
    clock[0] += IDLE_SECONDS - 1
    streams.send(User("a", "al"), said("here"))
    assert not opened(streams, "c")[1], "nobody was idle for so long"
    clock[0] += 1
    assert opened(streams, "c")[1] and second.ended and not first.ended
    assert first.replies == [b"here"]


def test_a_state_waits_for_its_query_for_a_while(clock):
    streams = StateStreams(2)
    streams.send(User("a", "al"), said("old"))
    streams.send(User("a", "al"), said("new"))
    clock[0] += 4.9
    query, _ = opened(streams, "a")
    assert query.replies == [b"new"]
    streams.send(User("b", "al"), said("late"))
    clock[0] += 5.1
    assert opened(streams, "b")[0].replies == []


def test_a_query_of_the_same_user_takes_the_place_of_the_one_before(clock):
    streams = StateStreams(2)
    first, _ = opened(streams, "a")
    streams.send(User("a", "al"), said("1"))
    second, _ = opened(streams, "a")
    assert first.ended and second.replies == []
    streams.send_again(User("a", "al"))
    assert second.replies == [b"1"]
    streams.forget(User("a", "al"))
    streams.send_again(User("a", "al"))
    assert second.replies == [b"1"]


def test_who_is_gone_is_sent_no_more(clock):
    streams = StateStreams(4)
    first, _ = opened(streams, "a")
    second, _ = opened(streams, "b")
    first.gone = True
    streams.send(User("a", "al"), said("1"))
    assert first.ended
    streams.end_client("b")
    assert second.ended
    third, _ = opened(streams, "c")
    streams.close()
    assert third.ended and not opened(streams, "d")[1]
