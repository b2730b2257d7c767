"""The log of frames: whatever is cut off its end, what is before it reads; whatever bit is changed, it is named."""

import errno

import numpy as np
import pytest
from fake_server import floor_simulation
from solidcloud.schemas.errors import BadRequestError, CorruptError, FormatError
from solidcloud.schemas.wire.key_expressions import User
from solidcloud.schemas.wire.motion_messages import Wish
from solidcloud.server.scene_interface import FrameCommand
from solidcloud.server.simulation.replay_log import (
    MAGIC,
    AvatarPoints,
    Begin,
    Dropped,
    Ended,
    Entered,
    FrameLog,
    FrameRecord,
    Reloaded,
    read_log,
)

pytestmark = pytest.mark.interpreted

AL, BO, NOBODY = User("a", "al"), User("b", "bo"), User("c", "nobody")
POINTS = np.array([[0.0, 0.0, 0.5], [0.0, 0.25, 1.0]])
BEGIN = Begin("floor", "/scans/floor", b"format = 1", [("ab" * 16, 3)])


def wish(seq, z):
    pose = np.eye(4)[None].copy()
    pose[0, 2, 3] = z
    return Wish(seq=seq, time=float(seq), pose=pose)


def write(path):
    """A log of two frames of two users with the same body, one who leaves, a reload; the simulation."""
    simulation = floor_simulation()
    for user in (AL, BO):
        simulation.scene.add_avatar(user.avatar, POINTS, 0.125, client=user.client)
    with FrameLog(path, BEGIN) as log:
        simulation.record(log)
        simulation.step([FrameCommand(AL, wish(1, 0.5)), FrameCommand(BO, wish(1, 0.25))])
        simulation.end(BO)
        simulation.step([FrameCommand(AL, wish(2, -9.0)), FrameCommand(NOBODY, wish(1, 0.0))])
        simulation.scene.reload()
        simulation.drop_client("a")
        simulation.record(None)
    return simulation


def test_all_that_decides_is_in_it_in_order_and_points_once(tmp_path):
    write(tmp_path / "log")
    records = list(read_log(tmp_path / "log"))
    kinds = [type(record) for record in records]
    assert kinds == [
        Begin,
        AvatarPoints,
        Entered,
        Entered,
        FrameRecord,
        Ended,
        FrameRecord,
        Reloaded,
        Ended,
        Dropped,
    ]
    begin, points, first, second, frame, left, later, reloaded, _, dropped = records
    assert begin == BEGIN and points.points == POINTS.tobytes() and points.radius == 0.125
    assert (first.user, second.user) == (AL, BO) and first.digest == second.digest == points.digest
    assert frame.number == 1 and [user for user, _ in frame.turns] == [AL, BO]
    assert [np.frombuffer(said.pose)[11] for said in frame.said] == [0.5, 0.25]
    assert left.users == [BO] and reloaded.generation == 1 and dropped.client == "a"
    assert [(said.error, len(said.pose)) for said in later.said] == [("", 128), ("unknown_avatar", 0)]


def test_another_radius_is_another_avatar(tmp_path):
    simulation = floor_simulation()
    simulation.scene.add_avatar("al", POINTS, 0.125, client="a")
    simulation.scene.add_avatar("bo", POINTS, 0.25, client="b")
    with FrameLog(tmp_path / "log", BEGIN) as log:
        simulation.record(log)
        simulation.step([FrameCommand(AL, wish(1, 0.5)), FrameCommand(BO, wish(1, 0.5))])
    points = [record for record in read_log(tmp_path / "log") if isinstance(record, AvatarPoints)]
    assert [record.radius for record in points] == [0.125, 0.25] and points[0].digest != points[1].digest


def test_what_is_cut_off_anywhere_leaves_the_records_before(tmp_path):
    write(tmp_path / "log")
    whole = (tmp_path / "log").read_bytes()
    records = list(read_log(tmp_path / "log"))
    found = []
    for length in range(len(MAGIC), len(whole), 3):
        (tmp_path / "cut").write_bytes(whole[:length])
        try:
            found.append(len(list(read_log(tmp_path / "cut"))))
        except FormatError as error:
            assert "cut off: expected a complete first record" in str(error)
            found.append(0)
        assert list(read_log(tmp_path / "cut")) == records[: found[-1]] if found[-1] else True
    assert found == sorted(found) and set(found) == set(range(len(records)))


def test_a_changed_bit_is_named_with_its_record_and_place(tmp_path):
    write(tmp_path / "log")
    whole = (tmp_path / "log").read_bytes()
    rng = np.random.default_rng(5)
    for at in rng.choice(np.arange(len(MAGIC), len(whole)), 100).tolist():
        changed = bytearray(whole)
        changed[at] ^= 1 << int(rng.integers(8))
        (tmp_path / "changed").write_bytes(changed)
        with pytest.raises(CorruptError, match=r"changed: record \d+ at byte \d+: .* unaltered file"):
            list(read_log(tmp_path / "changed"))


def test_what_is_no_log_is_refused(tmp_path):
    (tmp_path / "other").write_bytes(b"t,x,y,z\n")
    with pytest.raises(FormatError, match="expected a log"):
        list(read_log(tmp_path / "other"))
    with pytest.raises(FormatError, match="No such file"):
        list(read_log(tmp_path / "none"))


def test_a_log_is_not_written_over(tmp_path):
    write(tmp_path / "log")
    before = (tmp_path / "log").read_bytes()
    with pytest.raises(BadRequestError, match="exists"):
        FrameLog(tmp_path / "log", BEGIN)
    assert (tmp_path / "log").read_bytes() == before
    with pytest.raises(BadRequestError, match="cannot be written"):
        FrameLog(tmp_path / "no" / "log", BEGIN)


def test_a_log_that_can_grow_no_more_stops_nobody(tmp_path, caplog):
    simulation = floor_simulation()
    simulation.scene.add_avatar("al", POINTS, 0.125, client="a")
    log = FrameLog(tmp_path / "log", BEGIN)
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
    assert len(list(read_log(tmp_path / "log"))) == 4
