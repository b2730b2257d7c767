"""Sessions in this process: a command is a frame, its state is there at once; the methods of a client's session."""

import numpy as np
import pytest
from fake_server import floor_simulation
from solidcloud.schemas.errors import (
    BadRequestError,
    BadTransformError,
    BusyError,
    InternalError,
    UnknownAvatarError,
)
from solidcloud.schemas.wire.key_expressions import User
from solidcloud.schemas.wire.motion_messages import State, Wish
from solidcloud.server.scene_interface import FrameCommand

pytestmark = pytest.mark.interpreted

POINTS = np.array([[0.0, 0.0, 0.5], [0.0, 0.25, 1.0]])
AL = User("a", "al")


def pose_at(z, x=0.0):
    pose = np.eye(4)[None].copy()
    pose[0, [0, 2], 3] = x, z
    return pose


@pytest.fixture
def scene():
    scene = floor_simulation().scene
    for name in ("al", "crash"):
        scene.add_avatar(name, POINTS, 0.125)
    return scene


def test_each_command_is_a_frame_and_its_state_is_there(scene):
    with scene.session("al") as session:
        assert session.latest() is None
        first = session.wait(session.wish(pose_at(0.5)))
        assert np.array_equal(first.pose, pose_at(0.5)) and (first.seq, first.frame) == (1, 1)
        seq = session.wish(velocity=(1.0, 0.0, -4.0), time=first.time + 0.0625)
        second = session.latest()
        assert (seq, second.seq) == (2, 2) and 0.0 <= second.age < 60.0
        assert isinstance(second, State)
        assert np.array_equal(second.pose, pose_at(0.25, 0.0625))
        assert [state.seq for state in session.states(0.0)] == [1, 2]
        assert scene.simulation.users == [User("", "al")]
        newer = session.wait(1)
        for name in State.__struct_fields__:
            assert getattr(newer, name) is getattr(second, name), name
    assert scene.simulation.users == [], "it left"


def test_users_of_a_server_and_of_this_process_walk_one_scene(scene):
    scene.add_avatar("al", POINTS, 0.125, client="a")
    with scene.session("al") as session:
        session.wish(pose_at(0.5))
        scene.simulation.step([FrameCommand(AL, Wish(seq=1, time=0.0, pose=pose_at(0.5)))])
        assert scene.simulation.users == [User("", "al"), AL]
        session.wish(pose_at(0.25))
        assert session.latest().frame == 3


def test_what_is_refused_is_raised_once_where_it_is_asked_for(scene):
    with scene.session("al") as session:
        session.wish(pose_at(0.5))
        seq = session.wish(pose_at(0.5) * [[2.0], [1.0], [1.0], [1.0]])
        with pytest.raises(BadTransformError, match="not rigid"):
            session.wait(seq)
        assert session.latest().seq == 1
        with pytest.raises(BusyError, match=f"no state of wish {seq}"):
            session.wait(seq, 0.0)
        said = session.states(0.0)
        assert next(said).seq == 1
        with pytest.raises(BadTransformError):
            next(said)
    with scene.session("nobody") as session:
        session.wish(pose_at(0.5))
        with pytest.raises(UnknownAvatarError):
            session.latest()
    with scene.session("crash") as session:
        session.wish(pose_at(0.5))
        with pytest.raises(InternalError):
            session.latest()


@pytest.mark.parametrize(
    "command",
    [
        {},
        {"pose": np.eye(3)},
        {"pose": np.tile(np.eye(4), (2, 1, 1))},
        {"velocity": (1.0, 2.0)},
        {"velocity": (0, 0, np.nan)},
        {"velocity": (0, 0, 1), "objects": {"door": np.eye(3)}},
    ],
)
def test_what_is_no_command_is_refused(scene, command):
    with scene.session("al") as session, pytest.raises(BadRequestError):
        session.wish(**command)


def test_a_session_may_be_closed_and_begun_again(scene):
    session = scene.session("al")
    with pytest.raises(BadRequestError, match="closed"):
        session.wish(pose_at(0.5))
    with session:
        session.wish(pose_at(0.5))
        session.close()
        session.close()
        assert scene.simulation.users == []
        with pytest.raises(BadRequestError, match="closed"):
            session.wish(pose_at(0.5))
        assert [state.seq for state in session.states()] == [1]
    with session:
        assert session.wait(session.wish(pose_at(0.25))).seq == 2
