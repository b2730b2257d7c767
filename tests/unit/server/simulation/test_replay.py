"""Replays: the same wishes give the same poses; what differs is named by its frame and user."""

import struct
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
from solidcloud.server.simulation.replay import replay
from solidcloud.server.simulation.replay_log import (
    AvatarPoints,
    Begin,
    Entered,
    FrameLog,
    FrameRecord,
    Record,
    read_log,
)

pytestmark = pytest.mark.interpreted

AL, BO, CY = User("a", "al"), User("b", "bo"), User("a", "cy")
BEGIN = Begin("floor", "", b"", [], MOTION_VERSION)
POINTS = np.array([[0.0, 0.0, 0.5], [0.0, 0.25, 1.0]])


class Drifting:
    """Stands in for effects whose outcome depends on all frames before it."""

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
    with FrameLog(path, BEGIN) as frames:
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


def test_the_same_wishes_give_the_same_poses(log):
    records = list(read_log(log))
    assert sum(isinstance(record, AvatarPoints) for record in records) == 2
    found = replay(simulated(), records)
    turns = sum(len(record.turns) for record in records if isinstance(record, FrameRecord))
    assert found == (60, turns, 0, None, None, 0)
    codes = {said.error for record in records if isinstance(record, FrameRecord) for said in record.said}
    assert codes == {"", "bad_transform", "unknown_avatar", "busy"}


def changed(records, number, edit):
    """Records with one turn's outcome in one frame edited."""
    for record in records:
        if isinstance(record, FrameRecord) and record.number == number:
            said = [edit(record.said[0]), *record.said[1:]]
            yield msgspec.structs.replace(record, said=said)
        else:
            yield record


def test_one_bit_of_one_pose_is_found_and_named(log):
    records = list(read_log(log))
    frames = [record for record in records if isinstance(record, FrameRecord) and record.said[0].pose]
    frame = frames[len(frames) // 2]
    user = User(*frame.turns[0][0])

    def flip(said):
        return msgspec.structs.replace(said, pose=bytes([said.pose[0] ^ 1]) + said.pose[1:])

    found = replay(simulated(), changed(records, frame.number, flip))
    assert (found.frames, found.different) == (60, 1)
    assert found.first.frame == frame.number and found.first.user == user
    logged, replayed = float(np.nextafter(1.0, 2.0)), 1.0
    assert str(found.first) == (
        f"frame {frame.number}, avatar {user.avatar} of client {user.client}: "
        f"pose[0, 0] logged {logged!r}, replayed {replayed!r}"
    )


def test_a_wish_that_was_another_changes_what_comes_after(log, tmp_path):
    """An edit whose checksum was made to fit is found all the same, where it first tells."""
    whole = bytearray(log.read_bytes())
    at = whole.index(b"\xa5frame")
    for _ in range(8):  # to frame 9, whose first command is not refused
        at = whole.index(b"\xa5frame", at + 1)
    pose = whole.index(b"\xa4pose\xc4\x80", at) + 7
    whole[pose + 3 * 8] ^= 1  # the last bit of x
    start = len(b"solidcloud frames 1\n")
    while True:
        (length,) = struct.unpack_from("<I", whole, start)
        if start + 12 + length > pose:
            break
        start += 12 + length
    struct.pack_into("<I", whole, start + 8, zlib.crc32(bytes(whole[start + 12 : start + 12 + length])))
    (tmp_path / "edited").write_bytes(whole)
    found = replay(simulated(), read_log(tmp_path / "edited"))
    assert found.frames == 60 and found.different >= 1 and found.first.frame == 9


def test_a_refusal_that_is_none_now_is_a_difference(log):
    simulation = simulated()
    simulation.scene.add_avatar("unknown", POINTS, 0.125, client="d")
    found = replay(simulation, read_log(log))
    assert found.different > 0 and found.first.user == User("d", "unknown")
    assert "logged error unknown_avatar, replayed a pose at" in str(found.first)


def test_a_replay_ends_where_the_scene_was_reloaded(tmp_path):
    simulation, path = simulated(), tmp_path / "log"
    simulation.scene.add_avatar("al", POINTS, 0.125, client="a")
    with FrameLog(path, BEGIN) as frames:
        simulation.record(frames)
        for number in range(4):
            simulation._pipeline.reloads = int(number == 3)
            wish = Wish(seq=number, time=float(number), pose=np.eye(4)[None])
            simulation.step([FrameCommand(AL, wish)])
            if number == 1:
                simulation.scene.reload()
    assert replay(simulated(), read_log(path)) == (3, 3, 0, None, 4, 0)


def test_an_avatar_that_is_not_in_the_log_is_an_error():
    records: list[Record] = [BEGIN, Entered(AL, b"?")]
    with pytest.raises(BadRequestError, match="avatar 'al': its points are not in the log"):
        replay(simulated(), records)


def test_a_log_of_other_rules_of_motion_is_not_replayed(log):
    """A log of the first version has no field `motion`; its poses would not come out again."""
    old = b"\x85\xa4type\xa5begin\xa5scene\xa5floor\xa4path\xa0\xa4file\xc4\x00\xa8archives\x90"
    begin = msgspec.msgpack.decode(old, type=Begin)
    assert begin.motion == 1
    records = [begin, *list(read_log(log))[1:]]
    with pytest.raises(
        BadRequestError, match=f"under version 1 of the rules of motion: expected {MOTION_VERSION}"
    ):
        replay(simulated(), records)
