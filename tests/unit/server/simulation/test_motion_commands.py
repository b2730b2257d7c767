"""What a wish asks of a frame: poses are checked, velocities last for the frame, nobody jumps after a pause."""

import math
import re

import msgspec
import numpy as np
import pytest
from solidcloud.schemas.archive.rigid_pose import check_rigid
from solidcloud.schemas.errors import BadRequestError, BadTransformError, UnknownAvatarError
from solidcloud.schemas.scene.scene_file import Spawn
from solidcloud.schemas.wire.encoding import MSGPACK, decode_request
from solidcloud.schemas.wire.motion_messages import FRAME_SECONDS, MoveRequest, Wish
from solidcloud.server.simulation.simulation import (
    LONGEST_FRAME,
    LONGEST_PAUSE,
    first_pose,
    frame_durations,
    target_pose,
)
from solidcloud.server.simulation.world.frame import rotation_matrix

pytestmark = pytest.mark.interpreted

UP = np.array([0.0, 0.0, 1.0])


def pose_at(x, y, z, heading=0.0):
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrix(UP, heading)
    pose[:3, 3] = x, y, z
    return pose


def wish(pose=None, velocity=None, turn=0.0, time=0.0, seq=0):
    array = np.empty((0, 4, 4)) if pose is None else pose[None]
    return Wish(seq=seq, time=time, pose=array, velocity=velocity, turn=turn)


def test_a_velocity_lasts_for_the_frame():
    begin = pose_at(1.0, 2.0, 3.0, 0.5)
    there = target_pose(wish(velocity=(1.0, -2.0, 4.0)), begin, 0.25, UP)
    assert np.array_equal(there[:3, 3], [1.25, 1.5, 4.0])
    assert np.array_equal(there[:3, :3], begin[:3, :3]), "not turned: the very same rotation"
    assert np.array_equal(begin, pose_at(1.0, 2.0, 3.0, 0.5)), "where it began is not written to"


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.6, 0.0, 0.8)])
def test_a_turn_is_about_up_and_at_the_avatars_origin(up):
    axis = np.array(up)
    begin = np.eye(4)
    begin[:3, 3] = 7.0, 8.0, 9.0
    there = target_pose(wish(velocity=(0.0, 0.0, 0.0), turn=math.pi), begin, 0.5, axis)
    assert np.array_equal(there[:3, 3], begin[:3, 3])
    assert np.allclose(there[:3, :3] @ axis, axis, atol=1e-15)
    assert math.isclose(np.trace(there[:3, :3]), 1.0, abs_tol=1e-14), "a quarter turn"


def test_a_pose_turned_for_long_stays_rigid():
    pose = np.eye(4)
    for _ in range(3000):
        pose = target_pose(wish(velocity=(0.0, 0.0, 0.0), turn=1.7), pose, 0.1, np.array([0.6, 0.0, 0.8]))
        check_rigid(pose, "pose")
    assert np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() < 1e-15


def test_frames_last_as_the_clients_clock_says_within_bounds():
    def durations(before):
        return frame_durations(wish(pose_at(0, 0, 0), time=5.0), before)

    assert durations(None) == [FRAME_SECONDS]
    assert durations(4.984375) == [0.015625]
    assert durations(5.0) == [0.0]
    assert durations(9.0) == [0.0], "a clock that went back"
    assert durations(5.0 - LONGEST_FRAME * (1 + 1e-12)) == [LONGEST_FRAME], (
        "no second frame for what a clock rounds"
    )
    assert durations(4.75) == [0.25 / 3] * 3
    assert durations(5.0 - LONGEST_PAUSE) == [LONGEST_FRAME] * 5
    assert durations(1.0) == [LONGEST_FRAME]


def test_users_begin_at_the_spawn_or_where_they_say():
    spawn = Spawn(position=(1.0, 2.0, 3.0), heading=90.0)
    elsewhere = wish(pose_at(9.0, 9.0, 9.0))
    pose = first_pose(elsewhere, spawn, UP)
    assert np.array_equal(pose[:3, 3], [1.0, 2.0, 3.0])
    assert np.allclose(pose[:3, :3] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    assert np.array_equal(first_pose(wish(velocity=(1.0, 0.0, 0.0)), spawn, UP), pose)
    first = first_pose(elsewhere, None, UP)
    assert np.array_equal(first, elsewhere.pose[0]) and first is not elsewhere.pose[0]
    with pytest.raises(UnknownAvatarError, match="begin with a pose"):
        first_pose(wish(velocity=(1.0, 0.0, 0.0)), None, UP)


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda pose: pose.__setitem__((3, 0), 1.0), "last row"),
        (lambda pose: pose.__setitem__((slice(3), slice(3)), 2 * np.eye(3)), "not rigid"),
        (lambda pose: pose.__setitem__((0, 1), 1e-8), "not rigid"),
        (lambda pose: pose.__setitem__((2, 2), -1.0), "mirrors"),
        (lambda pose: pose.__setitem__((slice(3), slice(3)), 0.0), "not rigid"),
    ],
)
def test_what_is_not_rigid_is_refused(change, said):
    pose = pose_at(1.0, 2.0, 3.0)
    check_rigid(pose, "pose")
    change(pose)
    with pytest.raises(BadTransformError, match=said):
        check_rigid(pose, "pose")
    with pytest.raises(BadTransformError, match=said):
        target_pose(wish(pose), np.eye(4), 0.1, UP)


def test_a_pose_of_nan_is_not_rigid():
    pose = pose_at(1.0, 2.0, 3.0)
    pose[1, 1] = np.nan
    with pytest.raises(BadTransformError, match="off by nan"):
        check_rigid(pose, "pose")


@pytest.mark.parametrize("place", [(1, 1), (0, 3), (3, 3)])
@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_poses_of_a_frame_are_finite_in_this_process_as_over_the_wire(place, number):
    """A pose has the same error as when it is decoded."""
    pose = pose_at(1.0, 2.0, 3.0)[None]
    good = pose.copy()
    pose[0, *place] = number
    said = re.escape(f"[0, {place[0]}, {place[1]}] is {number}, expected finite numbers")
    with pytest.raises(BadRequestError, match="pose" + said):
        Wish(seq=0, time=0.0, pose=pose)
    with pytest.raises(BadRequestError, match="pose_to" + said):
        MoveRequest(avatar="al", pose_from=good, pose_to=pose)
    raw = msgspec.msgpack.encode({"seq": 0, "time": 0.0, "pose": pose.tobytes()})
    with pytest.raises(BadRequestError, match="pose" + said):
        decode_request(Wish, raw, MSGPACK)


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"pose": np.eye(4)[None], "velocity": (0.0, 0.0, 0.0)},
        {"pose": np.tile(np.eye(4), (2, 1, 1))},
        {"velocity": (0.0, math.nan, 0.0)},
        {"velocity": (0.0, 0.0, 0.0), "turn": math.inf},
        {"velocity": (0.0, 0.0, 0.0), "objects": {"door": [[1.0]]}},
        {"velocity": (0.0, 0.0, 0.0), "objects": {"door": [[math.nan] * 4] * 4}},
    ],
)
def test_what_is_no_wish_is_refused(fields):
    with pytest.raises(BadRequestError):
        Wish(seq=0, time=0.0, **fields)
