"""Mailboxes: the latest wish wins, what is dropped is counted. Frames: states go to who wished, errors too."""

import threading

import numpy as np
import pytest
from fake_server import floor_simulation
from solidcloud.schemas.errors import BusyError
from solidcloud.schemas.wire.encoding import JSON, MSGPACK, decode_answer, encode
from solidcloud.schemas.wire.key_expressions import User
from solidcloud.schemas.wire.motion_messages import State, Wish
from solidcloud.schemas.wire.scene_messages import ErrorReply
from solidcloud.server.zenoh_server.command_mailboxes import FrameLoop, Mailboxes

pytestmark = pytest.mark.interpreted

AL, BO, CY = User("a", "al"), User("b", "bo"), User("a", "cy")
POINTS = np.array([[0.0, 0.0, 0.5], [0.0, 0.25, 1.0]])
DEADLINE = 20.0


def wish(seq, z=0.0, **fields):
    pose = np.eye(4)[None].copy()
    pose[0, 2, 3] = z
    return Wish(seq=seq, time=float(seq), pose=pose, **fields)


def taken(boxes):
    post = boxes.take()
    return [(turn.user, turn.wish.seq, turn.late) for turn in post.turns]


def test_the_latest_wish_wins_and_the_rest_are_counted():
    boxes = Mailboxes(8)
    for seq in (1, 2, 5):
        boxes.put(AL, wish(seq))
    assert taken(boxes) == [(AL, 5, 2)]
    boxes.put(AL, wish(6))
    assert taken(boxes) == [(AL, 6, 2)]


def test_a_wish_no_newer_than_the_latest_is_dropped():
    boxes = Mailboxes(8)
    assert not boxes.put(AL, wish(5))
    assert boxes.put(AL, wish(5, z=1.0)), "the same once more"
    assert not boxes.put(AL, wish(4))
    post = boxes.take()
    assert [(turn.wish.seq, turn.wish.pose[0, 2, 3], turn.late) for turn in post.turns] == [(5, 0.0, 1)]
    assert boxes.put(AL, wish(5))
    boxes.put(BO, wish(1))
    assert taken(boxes) == [(BO, 1, 0)], "one that was taken already is dropped too"


def test_users_take_their_turns_in_the_order_their_wishes_came():
    boxes = Mailboxes(8)
    boxes.put(BO, wish(1))
    boxes.put(AL, wish(1))
    boxes.put(BO, wish(2))
    boxes.put(CY, wish(9))
    assert taken(boxes) == [(BO, 2, 1), (AL, 1, 0), (CY, 9, 0)]


def test_there_is_a_bound_and_who_left_makes_room():
    boxes = Mailboxes(2)
    boxes.put(AL, wish(1))
    boxes.put(BO, wish(1))
    with pytest.raises(BusyError, match="2 users"):
        boxes.put(CY, wish(1))
    boxes.take()
    boxes.keep([BO])
    assert len(boxes) == 1
    boxes.put(CY, wish(1))
    with pytest.raises(BusyError):
        boxes.put(AL, wish(2))
    boxes.keep([])
    assert taken(boxes) == [(CY, 1, 0)], "a wish that waits is kept"


def test_a_client_of_many_avatars_leaves_room_for_others():
    boxes = Mailboxes(6)
    for number in range(9):
        try:
            boxes.put(User("a", str(number)), wish(1))
        except BusyError as error:
            assert number >= 3 and "3 of this client" in str(error)
    boxes.put(BO, wish(1))
    assert taken(boxes) == [(User("a", str(number)), 1, 0) for number in range(3)] + [(BO, 1, 0)]


def test_all_clients_without_a_token_leave_room_for_others():
    boxes = Mailboxes(4, lambda client: client if client == "b" else "")
    for number in range(2):
        boxes.put(User(f"invented-{number}", "al"), wish(1))
    with pytest.raises(BusyError, match="2 of this client"):
        boxes.put(User("invented-2", "al"), wish(1))
    boxes.put(BO, wish(1))


def test_who_leaves_has_its_wishes_dropped_and_may_count_from_the_start_again():
    boxes = Mailboxes(8)
    for user in (AL, BO, CY):
        boxes.put(user, wish(7))
    boxes.leave(AL)
    boxes.put(AL, wish(1))
    post = boxes.take()
    assert post.left == [AL]
    assert [(turn.user, turn.wish.seq) for turn in post.turns] == [(BO, 7), (CY, 7), (AL, 1)]
    boxes.put(AL, wish(2))
    boxes.put(BO, wish(8))
    boxes.leave_client("a")
    post = boxes.take()
    assert set(post.left) == {AL, CY} and [turn.user for turn in post.turns] == [BO]
    assert len(boxes) == 1


def test_who_takes_waits_until_something_came_or_all_is_over():
    boxes, got = Mailboxes(8), []
    thread = threading.Thread(target=lambda: [got.append(taken(boxes)), got.append(boxes.take())])
    thread.start()
    boxes.put(AL, wish(1))
    while not got:
        thread.join(0.01)
    boxes.close()
    thread.join(DEADLINE)
    assert got == [[(AL, 1, 0)], None]


@pytest.fixture
def floor():
    simulation = floor_simulation(users=2)
    for user in (AL, BO, CY):
        simulation.scene.add_avatar(user.avatar, POINTS, 0.1, client=user.client)
    return simulation


def run(frames):
    """Simulate all that came, and end."""
    frames.close()
    frames.run()


def said(answer):
    return decode_answer(State if answer.ok else ErrorReply, answer.payload, answer.encoding)


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
def test_a_state_goes_to_who_wished_in_the_encoding_of_the_wish(floor, encoding):
    sent = []
    frames = FrameLoop(floor, lambda user, answer: sent.append((user, answer)))
    frames.wish(AL, encode(wish(1, -0.25), encoding), encoding)
    frames.wish(AL, encode(wish(2, -1.0), encoding), encoding)
    run(frames)
    ((user, answer),) = sent
    assert user == AL and answer.ok and answer.encoding == encoding
    state = said(answer)
    assert (state.seq, state.time, state.frame, state.late, state.simulated) == (2, 2.0, 1, 1, ["stop"])
    assert -0.4 < state.pose[0, 2, 3] < -0.399 and state.left > 0.5 and len(state.touched) == 1


def test_what_is_no_wish_is_refused_and_changes_nothing(floor):
    sent = []
    frames = FrameLoop(floor, lambda user, answer: sent.append((user, answer)))
    frames.wish(AL, b"\xc1", None)
    frames.wish(AL, encode(wish(1)), "text/plain")
    frames.wish(BO, encode(wish(1), JSON), JSON)
    frames.wish(BO, b"{}", JSON)
    run(frames)
    assert [(user, answer.ok, answer.encoding) for user, answer in sent] == [
        (AL, False, MSGPACK), (AL, False, MSGPACK), (BO, False, JSON), (BO, True, JSON),
    ]  # fmt: skip
    assert [said(answer).code for _, answer in sent[:3]] == ["bad_request"] * 3
    assert floor.users == [BO]


def test_a_user_too_many_is_busy_and_the_others_go_on(floor):
    sent = []
    frames = FrameLoop(floor, lambda user, answer: sent.append((user, answer)))
    for user in (AL, BO, CY):
        frames.wish(user, encode(wish(1)), None)
    run(frames)
    assert [(user, answer.ok) for user, answer in sent] == [(AL, True), (BO, True), (CY, False)]
    assert said(sent[2][1]).code == "busy"


def test_who_leaves_ends_before_the_frame(floor):
    sent = []
    frames = FrameLoop(floor, lambda user, answer: sent.append((user, said(answer))))
    for user in (AL, BO):
        frames.wish(user, encode(wish(1)), None)
    thread = threading.Thread(target=frames.run)
    thread.start()
    while len(sent) < 2:
        thread.join(0.01)
    frames.leave(AL)
    frames.client_gone("b")
    frames.wish(CY, encode(wish(1)), None)
    frames.close()
    thread.join(DEADLINE)
    assert floor.users == [CY] and isinstance(sent[-1][1], State)


def test_a_state_that_cannot_be_sent_stops_nobody(floor, caplog):
    sent = []

    def publish(user, answer):
        if user == AL:
            raise OSError("the link is gone")
        sent.append(user)

    frames = FrameLoop(floor, publish)
    frames.wish(AL, encode(wish(1)), None)
    frames.wish(BO, encode(wish(1)), None)
    run(frames)
    assert sent == [BO] and "the link is gone" in caplog.text


def test_whatever_bytes_come_each_is_answered(floor, caplog):
    sent = []
    frames = FrameLoop(floor, lambda user, answer: sent.append(answer))
    rng = np.random.default_rng(11)
    whole = encode(wish(1, 0.5, objects={"door": np.eye(4).tolist()}))
    for seq in range(3000):
        payload = bytearray(whole)
        for _ in range(rng.integers(1, 4)):
            payload[rng.integers(len(payload))] ^= 1 << rng.integers(8)
        frames.wish(User("a", f"al-{seq}"), bytes(payload[: rng.integers(len(payload) + 1)]), None)
        frames._boxes.keep([])
    run(frames)
    assert 2000 < len(sent) <= 3000 and not any(answer.ok for answer in sent)
    assert {said(answer).code for answer in sent} <= {"bad_request", "busy", "unknown_avatar"}
    assert not caplog.records
