"""Test sessions over zenoh: motion commands, states, and faults of clients and servers."""

import threading

import numpy as np
import pytest
from fake_server import floor_simulation
from floor import DEADLINE, POINTS, eventually
from solidcloud.schemas.errors import (
    BadRequestError,
    BadTransformError,
    BusyError,
    InternalError,
    UnknownAvatarError,
)
from solidcloud.schemas.wire import key_expressions
from solidcloud.server.client import Client
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig
from walkers import REST, outcome, pose_at, walking


def walk(client, name, count, found):
    """Send motion commands 60 times a second, as a viewer does; store the states received."""
    rng = np.random.default_rng(len(found))
    client.add_avatar(name, POINTS, 0.125)
    with client.session(name) as session:
        for _ in range(count):
            pose = pose_at(*rng.normal(scale=0.5, size=2))
            seq = session.wish(pose)
            threading.Event().wait(1 / 60)
        last = session.wait(seq, DEADLINE)
        found[name] = ([state for state in session.states(0.0)], pose, last, seq)


def test_eight_users_at_sixty_frames_a_second(served, endpoint):
    found = {}
    with Client(endpoint, scene="floor") as one, Client(endpoint, scene="floor") as two:
        threads = [
            threading.Thread(target=walk, args=((one, two)[number % 2], f"user-{number}", 150, found))
            for number in range(8)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60.0)
    assert sorted(found) == [f"user-{number}" for number in range(8)]
    for states, pose, last, seq in found.values():
        numbers = [state.seq for state in states]
        assert numbers == sorted(set(numbers)) and numbers[-1] == last.seq == seq
        frames = [state.frame for state in states]
        assert frames == sorted(set(frames))
        assert np.array_equal(last.pose[0], outcome(pose))
        # States for which a link has no room are dropped without being counted.
        assert 10 < len(states) <= seq - last.late
    eventually(lambda: not served.users)


def test_what_is_not_simulated_in_time_is_dropped_and_counted(served, endpoint):
    gate, entered = holding(served)
    with walking(endpoint) as session:
        session.wish(pose_at(0.0, 1.0))
        assert entered.wait(DEADLINE)
        for number in range(50):
            seq = session.wish(pose_at(0.0, 1.0 + number))
        with pytest.raises(BusyError, match="no state of wish"):
            session.wait(seq, 0.0)
        assert session.latest() is None
        gate.set()
        # If a link has no room for a state, it is dropped, even the last. The client therefore
        # repeats its motion command.
        for _ in range(100):
            try:
                last = session.wait(seq, DEADLINE / 100)
                break
            except BusyError:
                seq = session.wish(pose_at(0.0, 50.0))
        states = list(session.states(0.0))
    assert last.pose[0, 2, 3] == 50.0 and states[0].seq == 1
    assert len(states) <= seq - last.late and last.late > 0


def test_a_velocity_goes_on_from_where_it_was(served, endpoint):
    with walking(endpoint) as session:
        session.wait(session.wish(pose_at(0.0, 0.5), time=1.0), DEADLINE)
        seq = session.wish(velocity=(1.0, 0.0, -100.0), turn=np.pi, time=1.0625)
        pose = session.wait(seq, DEADLINE).pose[0]
    assert np.allclose(pose[:3, 3], [0.0625, 0.0, REST], atol=1e-15)
    assert np.isclose(pose[1, 0], np.sin(np.pi / 16))


def test_a_velocity_that_took_the_place_of_the_first_pose_is_no_error(served, endpoint):
    gate, entered = holding(served)
    with walking(endpoint, "other") as other, walking(endpoint) as session:
        other.wish(pose_at(0.0, 1.0))
        assert entered.wait(DEADLINE), "no frame comes meanwhile: of what follows the last is seen"
        session.wish(pose_at(0.25, 0.5), time=1.0)
        for number in range(3):
            seq = session.wish(velocity=(0.0, 1.0, 0.0), time=1.0 + number / 16)
        gate.set()
        state = session.wait(seq, DEADLINE)
    assert state.pose[0, 0, 3] == 0.25 and state.pose[0, 2, 3] == 0.5


def holding(simulation):
    """Make frames wait.

    Returns an event that lets them continue, and one that is set when the first waits.
    """
    gate, entered = threading.Event(), threading.Event()
    run = simulation._pipeline.run

    def held(body, aim, seconds, budget):
        entered.set()
        assert gate.wait(DEADLINE)
        return run(body, aim, seconds, budget)

    simulation._pipeline.run = held
    return gate, entered


def test_users_leave_with_their_session_and_with_their_client(served, endpoint):
    with Client(endpoint, scene="floor") as client:
        client.add_avatar("al", POINTS, 0.125)
        client.add_avatar("bo", POINTS, 0.125)
        with client.session("al") as one, client.session("bo") as two:
            two.wait(two.wish(pose_at(0.0, 1.0)), DEADLINE)
            one.wait(one.wish(pose_at(0.0, 1.0)), DEADLINE)
            assert len(served.users) == 2
            one.close()
            one.close()
            eventually(lambda: [user.avatar for user in served.users] == ["bo"])
            with pytest.raises(BadRequestError, match="closed"):
                one.wish(pose_at(0.0, 1.0))
            client.close()
        eventually(lambda: not served.users)
    with pytest.raises(BadRequestError, match="closed"):
        client.session("al")


def test_a_session_may_be_begun_again(served, endpoint):
    with Client(endpoint, scene="floor") as client:
        client.add_avatar("al", POINTS, 0.125)
        seen = []
        for _ in range(3):
            with client.session("al") as session:
                seen.append(session.wait(session.wish(pose_at(0.0, 1.0)), DEADLINE).seq)
    assert seen == [1, 2, 3]


def test_the_avatar_is_added_to_a_server_that_does_not_know_it(served, endpoint):
    with walking(endpoint) as session:
        session.wait(session.wish(pose_at(0.5, 1.0)), DEADLINE)
        (user,) = served.users
        served.drop_client(user.client)
        # The command is refused, the avatar is added, and the session repeats the command by
        # itself.
        state = session.wait(session.wish(velocity=(0.0, 0.0, 0.0)), DEADLINE)
        assert state.pose[0, 0, 3] == 0.5, "from where it was"
        assert served.users == [user]


def test_what_is_refused_is_raised_where_it_is_waited_for(served, endpoint):
    with walking(endpoint) as session:
        session.wait(session.wish(pose_at(0.0, 1.0)), DEADLINE)
        seq = session.wish(2 * pose_at(0.0, 1.0))
        with pytest.raises(BadTransformError):
            session.wait(seq, DEADLINE)
        states = session.states(0.0)
        assert next(states).seq == 1
        with pytest.raises(BadTransformError):
            next(states)
        state = session.wait(session.wish(pose_at(0.0, 2.0)), DEADLINE)
        assert state.pose[0, 2, 3] == 2.0 and session.latest().frame == state.frame
        session.wish(velocity=(0.0, 0.0, 0.0), objects={"door": np.eye(4).tolist()})
        eventually_raises(session.latest, BadRequestError)
        assert session.latest().frame == state.frame, "said once"


def eventually_raises(ask, kind):
    """Call until it raises an error of this kind."""

    def raised():
        try:
            ask()
        except kind:
            return True
        return False

    eventually(raised)


def test_an_avatar_that_nobody_knows_is_said_to_be_unknown(served, endpoint):
    with Client(endpoint, scene="floor") as client:
        with client.session("nobody") as session:
            seq = session.wish(pose_at(0.0, 1.0))
            with pytest.raises(UnknownAvatarError):
                session.wait(seq, DEADLINE)
        client.add_avatar("al", POINTS, 0.125)
        with client.session("al") as session:
            seq = session.wish(velocity=(0.0, 0.0, 1.0))
            with pytest.raises(UnknownAvatarError, match="begin with a pose"):
                session.wait(seq, DEADLINE)
            assert session.wait(session.wish(pose_at(0.0, 1.0)), DEADLINE).pose[0, 2, 3] == 1.0
        with pytest.raises(BadRequestError, match="expected 1 to 64"):
            client.session("a b")


def test_an_effect_that_fails_is_an_error_of_the_servers(served, endpoint):
    with walking(endpoint, "crash") as session:
        seq = session.wish(pose_at(0.0, 1.0))
        with pytest.raises(InternalError, match="see the server's log"):
            session.wait(seq, DEADLINE)


@pytest.mark.parametrize(
    "wish", [{}, {"pose": np.eye(3)}, {"velocity": (1.0, 2.0)}, {"velocity": (0, 0, np.nan)}]
)
def test_what_is_no_wish_is_refused_before_it_is_sent(served, endpoint, wish):
    with walking(endpoint) as session, pytest.raises((BadRequestError, ValueError)):
        session.wish(**wish)


def test_a_full_scene_says_so(endpoint):
    with (
        serving([floor_simulation(users=1).scene], ServerConfig(listen=endpoint)),
        walking(endpoint) as one,
        walking(endpoint) as two,
    ):
        one.wait(one.wish(pose_at(0.0, 1.0)), DEADLINE)
        seq = two.wish(pose_at(0.0, 1.0))
        with pytest.raises(BusyError, match="limits"):
            two.wait(seq, DEADLINE)
        one.close()
        eventually(lambda: reached(two))


def reached(session):
    """Return whether a motion command gets a state now."""
    try:
        session.wait(session.wish(pose_at(0.0, 1.0)), DEADLINE)
    except BusyError:
        return False
    return True


def test_a_user_who_comes_again_hears_nothing_of_before(served, endpoint):
    with Client(endpoint, scene="floor", timeout=DEADLINE) as client:
        client.add_avatar("al", POINTS, 0.125)
        for z in (1.0, 2.0):
            client._numbers.clear()
            with client.session("al") as session:
                assert session.latest() is None
                state = session.wait(session.wish(pose_at(0.0, z)), DEADLINE)
                assert (state.seq, state.pose[0, 2, 3]) == (1, z)
            eventually(lambda: not served.users)


def test_others_are_told_of_by_another_name_than_their_id(served, endpoint):
    """Test that states hide the ids of other clients: an id permits queries and commands in its name."""
    with walking(endpoint) as session:
        session.wait(session.wish(pose_at(0.0, 1.0)), DEADLINE)
        ((user, body),) = served._present.items()
        assert body.name == f"{key_expressions.public_id(user.client)}/al"
        assert body.user == user
