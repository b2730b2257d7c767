"""Replays: the same wishes give the same poses; what differs is named by its frame and user."""

import json
import zlib

import msgspec
import numpy as np
import pytest
from fake_server import floor_simulation
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.scene.effect_table import MOTION_VERSION
from solidcloud.schemas.wire.key_expressions import User
from solidcloud.schemas.wire.motion_messages import Moved, Wish
from solidcloud.server.scene_interface import FrameCommand
from solidcloud.server.simulation.replay import Replayed, check_same, replay
from solidcloud.server.simulation.replay_log import FrameLog, LoggedFrame, LogHead, read_log

pytestmark = pytest.mark.interpreted

AL, BO, CY = User("a", "al"), User("b", "bo"), User("a", "cy")
HEAD = LogHead("floor", "", b"", [], MOTION_VERSION)
POINTS = np.array([[0.0, 0.0, 0.5], [0.0, 0.25, 1.0]])


class Drifting:
    """Stands in for effects whose outcome depends on all frames before it."""

    bodies = None

    def __init__(self):
        self.total, self.reloads = 0.0, 0

    def run(self, body, wish, seconds, budget=None):
        self.total += float(wish[0, 3]) * seconds + len(body.avatar.points)
        body.pose = wish.copy()
        body.pose[1, 3] = self.total
        body.generations = (self.reloads, 0)
        return Moved(pose=body.pose[None].copy())


def simulated():
    simulation = floor_simulation(users=3)
    simulation._pipeline = Drifting()
    return simulation


@pytest.fixture
def log(tmp_path):
    """A log of 60 frames: users come and go, are refused, are timed out, change their avatars."""
    rng = np.random.default_rng(8)
    simulation, path = simulated(), tmp_path / "log"
    for user in (AL, BO, CY):
        simulation.scene.add_avatar(user.avatar, POINTS, 0.125, client=user.client)
    users = [AL, BO, CY, User("d", "unknown")]
    with FrameLog(path, HEAD) as frames:
        simulation.record(frames)
        for number in range(60):
            turns = []
            for user in rng.permutation(len(users))[: rng.integers(1, 5)]:
                pose = np.eye(4)[None].copy()
                pose[0, :3, 3] = rng.normal(size=3)
                pose[0, 3, 3] = 1.0 + (rng.random() < 0.05)  # some that are none
                turns.append(FrameCommand(users[user], Wish(seq=number, time=0.02 * number, pose=pose)))
            simulation.step(turns, now=0.02 * number + 40.0 * (number > 30))
            if number == 20:
                simulation.end(CY)
            if number == 40:
                simulation.drop_client("a")
            if number == 45:
                simulation.scene.add_avatar("al", np.vstack([POINTS, POINTS]), 0.125, client="a")
        simulation.record(None)
    return path


def frames_of(path):
    return list(read_log(path)[1])


def test_the_same_wishes_give_the_same_poses(log):
    frames = frames_of(log)
    assert sum(len(frame.avatars) for frame in frames) == 2
    found = replay(simulated(), frames)
    assert found == Replayed(60, sum(len(frame.turns) for frame in frames))
    codes = {turn.error for frame in frames for turn in frame.turns}
    assert codes == {"", "bad_transform", "unknown_avatar", "busy"}


def test_one_bit_of_one_pose_is_found_and_named(log):
    frames = frames_of(log)
    moved = [frame for frame in frames if frame.turns[0].pose]
    frame = moved[len(moved) // 2]
    turn = frame.turns[0]
    pose = [list(row) for row in turn.pose]
    pose[0][0] = float(np.nextafter(1.0, 2.0))
    frame.turns[0] = msgspec.structs.replace(turn, pose=pose)
    found = replay(simulated(), frames)
    assert (found.frames, found.different) == (60, 1)
    assert found.first == (
        f"frame {frame.number}, avatar {turn.user.avatar} of client {turn.user.client}: "
        f"pose[0, 0] logged {pose[0][0]!r}, replayed 1.0"
    )


def test_the_sign_of_a_zero_is_found(log):
    frames = frames_of(log)
    turn = frames[8].turns[0]
    assert turn.pose[0][1] == 0.0
    pose = [list(row) for row in turn.pose]
    pose[0][1] = -0.0
    frames[8].turns[0] = msgspec.structs.replace(turn, pose=pose)
    assert "pose[0, 1] logged -0.0, replayed 0.0" in replay(simulated(), frames).first


def test_a_wish_that_was_another_changes_what_comes_after(log, tmp_path):
    """An edit whose checksum was made to fit is found all the same, where it first tells."""
    lines = log.read_bytes().splitlines()
    frame = json.loads(lines[10][9:])  # frame 9, whose first command is not refused
    frame["turns"][0]["wish"]["pose"][0][0][3] += 1e-9
    body = json.dumps(frame).encode()
    lines[10] = b"%08x %s" % (zlib.crc32(body), body)
    (tmp_path / "edited").write_bytes(b"\n".join([*lines, b""]))
    found = replay(simulated(), frames_of(tmp_path / "edited"))
    assert found.frames == 60 and found.different >= 1 and found.first.startswith("frame 9, ")


def test_a_refusal_that_is_none_now_is_a_difference(log):
    simulation = simulated()
    simulation.scene.add_avatar("unknown", POINTS, 0.125, client="d")
    found = replay(simulation, frames_of(log))
    assert found.different > 0
    assert "avatar unknown of client d: logged error unknown_avatar, replayed a pose at" in found.first


def test_a_replay_ends_where_the_scene_was_reloaded(tmp_path):
    simulation, path = simulated(), tmp_path / "log"
    simulation.scene.add_avatar("al", POINTS, 0.125, client="a")
    with FrameLog(path, HEAD) as frames:
        simulation.record(frames)
        for number in range(4):
            simulation._pipeline.reloads = int(number == 3)
            wish = Wish(seq=number, time=float(number), pose=np.eye(4)[None])
            simulation.step([FrameCommand(AL, wish)])
    assert replay(simulated(), frames_of(path)) == Replayed(3, 3, reloaded=4)


def test_an_avatar_that_is_not_in_the_log_is_an_error():
    with pytest.raises(BadRequestError, match="avatar 'al': its points are not in the log"):
        replay(simulated(), [LoggedFrame(entered=[(AL, "?")])])


def test_a_log_of_other_rules_of_motion_is_not_replayed(tmp_path):
    head = msgspec.structs.replace(HEAD, motion=MOTION_VERSION - 1)
    with pytest.raises(BadRequestError, match=f"rules of motion: expected {MOTION_VERSION}"):
        check_same(head, simulated(), tmp_path)
