"""Wishes that wait to be read: clients in turn, each bounded."""

from solidcloud.schemas.wire.key_expressions import User
from solidcloud.server.zenoh_server import command_mailboxes as waiting_wishes
from solidcloud.server.zenoh_server.command_mailboxes import WaitingCommands


def all_of(waiting):
    taken = []
    while (found := waiting.take()) is not None:
        taken.append((found[0].client, found[1]))
    assert not waiting._sizes and waiting._size == 0
    return taken


def test_clients_take_turns():
    waiting = WaitingCommands(str)
    for number in range(3):
        waiting.put(User("a", "al"), number, 10)
    waiting.put(User("b", "bo"), 9, 10)
    assert all_of(waiting) == [("a", 0), ("b", 9), ("a", 1), ("a", 2)]


def test_the_oldest_of_a_turn_are_dropped_where_it_has_too_many_bytes():
    waiting = WaitingCommands(lambda client: client if client == "b" else "")
    for number in range(100):
        waiting.put(User(f"invented-{number}", "al"), number, 400_000)
    waiting.put(User("b", "bo"), 0, 400_000)
    assert all_of(waiting) == [("invented-98", 98), ("b", 0), ("invented-99", 99)]


def test_all_together_are_bounded_and_everybody_may_have_one(monkeypatch):
    monkeypatch.setattr(waiting_wishes, "_MAX_BYTES", 5000)
    waiting = WaitingCommands(str)
    for number in range(20):
        for client in "abc":
            waiting.put(User(client, "al"), number, 1000)
    assert waiting._size <= 5000 + 1256
    waiting.put(User("new", "al"), 0, 1000)
    taken = all_of(waiting)
    assert ("new", 0) in taken and {("a", 19), ("b", 19), ("c", 19)} <= set(taken)


def test_a_small_wish_counts_too():
    waiting = WaitingCommands(str)
    for number in range(100_000):
        waiting.put(User("a", "al"), number, 0)
    taken = all_of(waiting)
    assert len(taken) == (1 << 20) // 256 and taken[-1] == ("a", 99_999)
