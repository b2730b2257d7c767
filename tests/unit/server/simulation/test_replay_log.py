"""The log of frames: whatever is cut off its end, what is before it reads; whatever bit is changed, it is named."""

import errno

import numpy as np
import pytest
from fake_server import floor_simulation
from solidcloud.schemas.errors import BadRequestError, CorruptError, FormatError
from solidcloud.schemas.wire.encoding import JSON, decode_request
from solidcloud.schemas.wire.key_expressions import User
from solidcloud.schemas.wire.motion_messages import Wish
from solidcloud.schemas.wire.requests import AddAvatarRequest
from solidcloud.server.scene_interface import FrameCommand
from solidcloud.server.simulation.replay_log import MAGIC, FrameLog, LogHead, read_log

pytestmark = pytest.mark.interpreted

AL, BO, NOBODY = User("a", "al"), User("b", "bo"), User("c", "nobody")
POINTS = np.array([[0.0, 0.0, 0.5], [0.0, 0.25, 1.0]])
HEAD = LogHead("floor", "/scans/floor", b"format = 1", [("ab" * 16, 3)], 5)


def wish(seq, z):
    pose = np.eye(4)[None].copy()
    pose[0, 2, 3] = z
    return Wish(seq=seq, time=float(seq), pose=pose)


def write(path):
    """A log of three frames of users with the same body, one who leaves, and a client that is dropped."""
    simulation = floor_simulation()
    for user in (AL, BO):
        simulation.scene.add_avatar(user.avatar, POINTS, 0.125, client=user.client)
    with FrameLog(path, HEAD) as log:
        simulation.record(log)
        simulation.step([FrameCommand(AL, wish(1, 0.5)), FrameCommand(BO, wish(1, 0.25))])
        simulation.end(BO)
        simulation.step([FrameCommand(AL, wish(2, -9.0)), FrameCommand(NOBODY, wish(1, 0.0))])
        simulation.drop_client("a")
        simulation.step([FrameCommand(BO, wish(3, 0.5))])
        simulation.record(None)


def records_of(path):
    head, frames = read_log(path)
    return [head, *frames]


def test_all_that_decides_is_in_it_in_order_and_points_once(tmp_path):
    write(tmp_path / "log")
    head, first, second, third = records_of(tmp_path / "log")
    assert head == HEAD and [frame.number for frame in (first, second, third)] == [1, 2, 3]
    ((digest, encoded),) = first.avatars.items()
    added = decode_request(AddAvatarRequest, encoded)
    assert added.points.tobytes() == POINTS.tobytes() and added.radius == 0.125
    assert first.entered == [(AL, digest), (BO, digest)] and [turn.user for turn in first.turns] == [AL, BO]
    assert [turn.pose[2][3] for turn in first.turns] == [0.5, 0.25]
    assert decode_request(Wish, bytes(first.turns[1].wish), JSON).pose[0, 2, 3] == 0.25
    assert second.ended == [BO] and not second.entered and not second.avatars
    assert [(turn.error, turn.pose is None) for turn in second.turns] == [
        ("", False),
        ("unknown_avatar", True),
    ]
    assert third.ended == [AL] and third.dropped == ["a"] and third.entered == [(BO, digest)]


def test_another_radius_is_another_avatar(tmp_path):
    simulation = floor_simulation()
    simulation.scene.add_avatar("al", POINTS, 0.125, client="a")
    simulation.scene.add_avatar("bo", POINTS, 0.25, client="b")
    with FrameLog(tmp_path / "log", HEAD) as log:
        simulation.record(log)
        simulation.step([FrameCommand(AL, wish(1, 0.5)), FrameCommand(BO, wish(1, 0.5))])
    avatars = records_of(tmp_path / "log")[1].avatars.values()
    assert [decode_request(AddAvatarRequest, each).radius for each in avatars] == [0.125, 0.25]


def test_what_is_cut_off_anywhere_leaves_the_records_before(tmp_path, caplog):
    write(tmp_path / "log")
    whole = (tmp_path / "log").read_bytes()
    records = records_of(tmp_path / "log")
    assert not caplog.text
    found = []
    for length in range(len(MAGIC), len(whole), 3):
        (tmp_path / "cut").write_bytes(whole[:length])
        try:
            read = records_of(tmp_path / "cut")
        except FormatError as error:
            assert "cut off: expected a complete first record" in str(error)
            read = []
        assert read == records[: len(read)]
        found.append(len(read))
    assert found == sorted(found) and set(found) == set(range(len(records)))
    assert "cut: line 5 is cut off: only the frames before it are read" in caplog.text


def test_a_changed_bit_is_named_with_its_line(tmp_path):
    write(tmp_path / "log")
    whole = (tmp_path / "log").read_bytes()
    rng = np.random.default_rng(5)
    for at in rng.choice(np.arange(len(MAGIC), len(whole) - 1), 100).tolist():
        changed = bytearray(whole)
        changed[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "changed").write_bytes(changed)
        with pytest.raises(CorruptError, match=r"changed: line \d: its checksum is .* unaltered file"):
            records_of(tmp_path / "changed")


def test_what_is_no_log_is_refused(tmp_path):
    (tmp_path / "other").write_bytes(b"t,x,y,z\n")
    with pytest.raises(FormatError, match="expected a log"):
        read_log(tmp_path / "other")
    with pytest.raises(FormatError, match="No such file"):
        read_log(tmp_path / "none")


def test_a_log_is_not_written_over(tmp_path):
    write(tmp_path / "log")
    before = (tmp_path / "log").read_bytes()
    with pytest.raises(BadRequestError, match="exists"):
        FrameLog(tmp_path / "log", HEAD)
    assert (tmp_path / "log").read_bytes() == before
    with pytest.raises(BadRequestError, match="cannot be written"):
        FrameLog(tmp_path / "no" / "log", HEAD)


def test_a_log_that_can_grow_no_more_stops_nobody(tmp_path, caplog):
    simulation = floor_simulation()
    simulation.scene.add_avatar("al", POINTS, 0.125, client="a")
    log = FrameLog(tmp_path / "log", HEAD)
    simulation.record(log)
    simulation.step([FrameCommand(AL, wish(1, 0.5))])

    class Full:
        def write(self, data):
            raise OSError(errno.ENOSPC, "No space left on device")

        def close(self):
            pass

    log._file.close()
    log._file = Full()
    for seq in (2, 3):
        ((_, state, _),) = simulation.step([FrameCommand(AL, wish(seq, 0.5))])
        assert state.seq == seq
    assert caplog.text.count("No space left on device") == 1
    assert len(records_of(tmp_path / "log")) == 2
