"""A simulation, with a stand-in for its effects: whose frame it is, who is there, what is remembered."""

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
from solidcloud.schemas.scene.effect_table import Ground, Stop
from solidcloud.schemas.scene.scene_file import SceneFile, Spawn, scene_of
from solidcloud.schemas.wire.key_expressions import User, public_id
from solidcloud.schemas.wire.motion_messages import FRAME_SECONDS, Moved, State, Wish
from solidcloud.server.scene_interface import EVERYBODY, FrameCommand
from solidcloud.server.simulation import simulation as simulation_module
from solidcloud.server.simulation.simulation import SILENT_SECONDS, Simulation

pytestmark = pytest.mark.interpreted

AL, BO = User("a", "al"), User("b", "bo")
POINTS = np.array([[0.0, 0.0, 0.5], [0.0, 0.25, 1.0]])


def pose_at(z, x=0.0):
    pose = np.eye(4)[None].copy()
    pose[0, [0, 2], 3] = x, z
    return pose


def wish(seq, z=None, velocity=None, time=None, **fields):
    pose = np.empty((0, 4, 4)) if z is None else pose_at(z)
    return Wish(seq=seq, time=float(seq if time is None else time), pose=pose, velocity=velocity, **fields)


@pytest.fixture
def floor():
    simulation = floor_simulation()
    for user in (AL, BO):
        simulation.scene.add_avatar(user.avatar, POINTS, 0.125, client=user.client)
    return simulation


def test_a_frame_goes_on_from_where_the_last_one_ended(floor):
    ((_, first, _),) = floor.step([FrameCommand(AL, wish(1, 0.5))])
    assert isinstance(first, State) and np.array_equal(first.pose, pose_at(0.5))
    ((user, second, _),) = floor.step(
        [FrameCommand(AL, wish(2, velocity=(2.0, 0.0, -1.0), time=1.0625), late=7)]
    )
    assert user == AL and np.array_equal(second.pose, pose_at(0.4375, 0.125))
    assert (second.seq, second.time, second.frame, second.late) == (2, 1.0625, 2, 7)
    ((_, third, _),) = floor.step([FrameCommand(AL, wish(3, velocity=(0.0, 0.0, -1e3), time=1.125))])
    assert third.pose[0, 2, 3] == np.nextafter(-0.375, 1.0), "stopped by the floor"
    ((_, fourth, _),) = floor.step([FrameCommand(AL, wish(4, velocity=(1.0, 0.0, 0.0), time=1.25))])
    assert fourth.pose[0, 2, 3] == third.pose[0, 2, 3], "from where it was stopped"


def test_users_begin_at_the_spawn():
    simulation = floor_simulation(spawn=Spawn(position=(3.0, 4.0, 5.0)))
    simulation.scene.add_avatar("al", POINTS, 0.125, client="a")
    ((_, state, _),) = simulation.step([FrameCommand(AL, wish(1, velocity=(3.0, 0.0, 0.0)))])
    assert np.array_equal(state.pose[0, :3, 3], [3.0 + 3.0 * FRAME_SECONDS, 4.0, 5.0])


@pytest.mark.parametrize("rate", [2, 5, 7.5, 30, 90])
def test_slow_clients_walk_as_far_as_fast_ones(floor, rate):
    """Issue 35: frames were cut at 0.1 s, so that a client at 5 frames a second walked at half speed."""
    floor.step([FrameCommand(AL, wish(1, 0.5, time=0.0))])
    for n in range(1, round(2 * rate) + 1):
        ((_, state, _),) = floor.step(
            [FrameCommand(AL, wish(n + 1, velocity=(1.4, 0.0, -0.1), time=n / rate))]
        )
    assert np.allclose(state.pose[0, :3, 3], [2.8, 0.0, 0.3], atol=1e-12)
    assert state.frame == round(2 * rate) + 1, "a motion command is one frame of the scene"


def test_a_motion_command_that_fails_in_a_later_frame_changes_nothing(floor):
    floor.step([FrameCommand(AL, wish(1, 0.5, time=0.0))])
    run, calls = floor._pipeline.run, []

    def fail(*rest, **more):
        calls.append(1)
        if len(calls) == 2:
            raise BadRequestError("no")
        return run(*rest, **more)

    floor._pipeline.run = fail
    ((_, state, _),) = floor.step([FrameCommand(AL, wish(2, velocity=(1.0, 0.0, 0.0), time=0.2))])
    assert isinstance(state, BadRequestError) and len(calls) == 2
    ((_, state, _),) = floor.step([FrameCommand(AL, wish(3, velocity=(0.0, 0.0, 0.0), time=0.01))])
    assert np.array_equal(state.pose, pose_at(0.5))


def test_everybody_who_wished_has_one_frame_in_the_order_given(floor):
    order = []
    run = floor._pipeline.run
    floor._pipeline.run = lambda body, *rest, **more: [order.append(body.name), run(body, *rest, **more)][1]
    outcomes = floor.step([FrameCommand(BO, wish(1, 0.25)), FrameCommand(AL, wish(1, 0.5))])
    assert [outcome.user for outcome in outcomes] == [BO, AL] and order == [
        f"{public_id('b')}/bo",
        f"{public_id('a')}/al",
    ]
    assert {outcome.state.frame for outcome in outcomes} == {1}
    assert floor.step([]) == [] and floor.step([FrameCommand(AL, wish(2, 0.5))])[0].state.frame == 3


def test_a_refused_wish_is_its_users_alone_and_changes_nothing(floor):
    floor.scene.add_avatar("crash", POINTS, 0.125, client="a")
    floor.step([FrameCommand(AL, wish(1, 0.5))])
    crash, nobody = User("a", "crash"), User("a", "nobody")
    sheared = wish(2, 0.25)
    sheared.pose[0, 0, 1] = 0.5
    outcomes = floor.step(
        [
            FrameCommand(AL, sheared),
            FrameCommand(crash, wish(1, 0.5)),
            FrameCommand(nobody, wish(1, 0.5)),
            FrameCommand(BO, wish(1, 0.25)),
        ]
    )
    kinds = [type(outcome.state) for outcome in outcomes]
    assert kinds == [BadTransformError, InternalError, UnknownAvatarError, State]
    assert "secret" not in str(outcomes[1].state)
    assert floor.users == [AL, BO], "who was refused at first is not there"
    ((_, state, _),) = floor.step([FrameCommand(AL, wish(3, velocity=(0.0, 0.0, 1.0), time=1.0625))])
    assert np.array_equal(state.pose, pose_at(0.5625)), "its clock and its pose are as before"


def test_there_is_room_for_so_many_users_and_who_leaves_makes_room():
    simulation = floor_simulation(users=1)
    for user in (AL, BO):
        simulation.scene.add_avatar(user.avatar, POINTS, 0.125, client=user.client)
    outcomes = simulation.step([FrameCommand(AL, wish(1, 0.5)), FrameCommand(BO, wish(1, 0.5))])
    assert isinstance(outcomes[0].state, State) and isinstance(outcomes[1].state, BusyError)
    simulation.end(AL)
    simulation.end(AL)
    assert isinstance(simulation.step([FrameCommand(BO, wish(1, 0.5))])[0].state, State)
    assert simulation.users == [BO]
    simulation.drop_client("b")
    assert simulation.users == [] and simulation.scene.gone == ["b"]
    assert isinstance(simulation.step([FrameCommand(BO, wish(2, 0.5))])[0].state, UnknownAvatarError)


def test_who_wishes_nothing_for_long_has_left(floor):
    floor.step([FrameCommand(AL, wish(1, 0.5)), FrameCommand(BO, wish(1, 0.5))], now=100.0)
    floor.step([FrameCommand(BO, wish(2, 0.5))], now=100.0 + SILENT_SECONDS)
    assert floor.users == [AL, BO]
    floor.step([FrameCommand(BO, wish(3, 0.5))], now=100.5 + SILENT_SECONDS)
    assert floor.users == [BO]
    floor.step([], now=100.0 + 2 * SILENT_SECONDS)
    assert floor.users == [BO], "half a second short of it"


def test_a_frame_that_takes_long_removes_no_user_whose_command_waited(floor, monkeypatch):
    clock = iter([0.0, 1.0 + SILENT_SECONDS, 100.0, 100.0])  # the first frame compiles
    monkeypatch.setattr(simulation_module.time, "monotonic", lambda: next(clock, 100.0))
    floor.step([FrameCommand(AL, wish(1, 0.5)), FrameCommand(BO, wish(1, 0.5))], now=100.0)
    turns = [FrameCommand(AL, wish(2, velocity=(0.0, 0.0, 0.0)))]
    (moved,) = floor.step(turns, now=102.0 + SILENT_SECONDS)
    assert np.array_equal(moved.state.pose, pose_at(0.5)), "goes on where it was, not at the spawn"
    assert floor.users == [AL, BO]
    floor.step([], now=101.5 + 2 * SILENT_SECONDS)
    assert floor.users == [AL]


def test_a_move_is_remembered_by_nobody(floor):
    floor.step([FrameCommand(AL, wish(1, 0.5))])
    moved = floor.move("al", pose_at(0.0), pose_at(-1.0), 0.25, client="a")
    assert type(moved) is Moved and moved.pose[0, 2, 3] == np.nextafter(-0.375, 1.0)
    ((_, state, _),) = floor.step([FrameCommand(AL, wish(2, velocity=(0.0, 0.0, 0.0)))])
    assert np.array_equal(state.pose, pose_at(0.5)) and state.frame == 2
    poses = pose_at(0.0)
    assert floor.move("al", poses, poses, client="a").pose is not poses


def test_a_move_that_is_none_is_refused(floor):
    good, bad = pose_at(0.0), 2 * pose_at(0.0)
    for pose_from, pose_to in ((bad, good), (good, bad)):
        with pytest.raises(BadTransformError, match="pose_"):
            floor.move("al", pose_from, pose_to, client="a")
    for pose_to, seconds in ((np.tile(good, (2, 1, 1)), 0.1), (good, -1.0), (np.full((1, 4, 4), "x"), 0.1)):
        with pytest.raises(BadRequestError):
            floor.move("al", good, pose_to, seconds, client="a")
    with pytest.raises(UnknownAvatarError):
        floor.move("al", good, good, client="b")


def test_wishes_for_objects_where_there_are_none_are_refused(floor):
    objects = {"door": np.eye(4).tolist()}
    ((_, error, _),) = floor.step([FrameCommand(AL, wish(1, 0.5, objects=objects))])
    assert isinstance(error, BadRequestError) and "objects" in str(error)


def test_the_scenes_own_avatars_are_everybodys():
    stand_in = floor_simulation()
    own = stand_in.scene.add_avatar("guide", POINTS, 0.125, client=EVERYBODY)
    file = SceneFile(format=1, archives=scene_of("floor").archives, effects=[Ground(), Stop()])
    simulation = Simulation(stand_in.scene, file, stand_in._pipeline)
    guides = [User("a", "guide"), User("b", "guide")]
    outcomes = simulation.step([FrameCommand(user, wish(1, 0.5)) for user in guides])
    assert all(isinstance(outcome.state, State) for outcome in outcomes)
    assert simulation.scene.add_avatar("guide", POINTS, 0.125, client="c") == own
    with pytest.raises(BadRequestError):
        simulation.scene.add_avatar("guide", POINTS + 1, 0.125, client="c")
