"""Test users who walk in a scene with effects, over zenoh: obstacles, memory, and replay of the log."""

import json
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import pytest
from floor import DEADLINE, eventually
from solidcloud.schemas.scene.effect_table import Contacts, Crowd, Ground, Proximity, Slide, Step, Stop, Sweep
from solidcloud.schemas.scene.scene_file import SceneFile, scene_of
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.key_expressions import User
from solidcloud.schemas.wire.motion_messages import Wish
from solidcloud.server.cli.main import run
from solidcloud.server.client import Client
from solidcloud.server.report.walk.server_process import served
from solidcloud.server.scene import Scene
from solidcloud.server.scene_interface import FrameCommand
from solidcloud.server.simulation.replay import Replayed, recorded, replay
from solidcloud.server.simulation.replay_log import read_log
from solidcloud.server.simulation.simulation import make_simulation
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig

# A body 1.5 m high, of three spheres.
BODY = np.array([[0.0, 0.0, 0.3], [0.0, 0.0, 0.8], [0.0, 0.0, 1.3]])
RADIUS = 0.25
STEP = 1 / 60


def room() -> np.ndarray:
    """Return a floor at z = 0, four metres square, with a wall at x = 1.5 (n, 3) [m]."""
    x, y = np.meshgrid(np.arange(-2, 2, 0.05), np.arange(-2, 2, 0.05))
    floor = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    y, z = np.meshgrid(np.arange(-2, 2, 0.05), np.arange(0.05, 2, 0.05))
    return np.vstack([floor, np.column_stack([np.full(y.size, 1.5), y.ravel(), z.ravel()])])


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the room's archive."""
    return archive_cases.build(tmp_path_factory.mktemp("room"), room(), voxel=2.0).archive


@pytest.fixture(scope="module")
def scene(archive: Path) -> Iterator[Scene]:
    with Scene.open(archive, "room") as scene:
        yield scene


def pose_at(x: float, y: float = 0.0, z: float = 0.05) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def walk(session: Any, x: float, y: float = 0.0, frames: int = 40) -> np.ndarray:
    """Send a motion command to a place in each frame; return where the avatar arrived."""
    for _ in range(frames):
        state = session.wait(session.wish(pose_at(x, y)), DEADLINE)
    place: np.ndarray = state.pose[0, :3, 3]
    return place


def test_move_is_one_frame_here_and_over_zenoh(scene: Scene, endpoint: str) -> None:
    poses = [pose_at(0.0)[None], pose_at(1.4)[None]]
    scene.add_avatar("body", BODY, RADIUS)
    here = [scene.move("body", a, b, STEP) for a, b in zip(poses, poses[::-1], strict=True)]
    with serving([scene], ServerConfig(listen=endpoint)), Client(endpoint, scene="room") as client:
        client.add_avatar("body", BODY, RADIUS)
        there = [client.move("body", a, b, STEP) for a, b in zip(poses, poses[::-1], strict=True)]
    for one, other in zip(here, there, strict=True):
        assert one.pose.tobytes() == other.pose.tobytes()
        assert (one.verdict, one.left, one.touched) == (other.verdict, other.left, other.touched)
    assert here[0].simulated == ["stop"] and here[0].left > 1.0 and here[0].verdict == Verdict.CLEAR
    assert here[0].touched[0].place[0] == pytest.approx(1.5)


def test_nobody_answers_and_the_avatar_goes_nowhere(endpoint: str) -> None:
    with Client(endpoint, scene="room", timeout=0.5) as client:
        client.add_avatar("body", BODY, RADIUS)
        moved = client.move("body", pose_at(0.0)[None], pose_at(0.5)[None])
    assert moved.verdict == Verdict.UNKNOWN and moved.left == 0.5 and not moved.simulated
    assert np.array_equal(moved.pose[0], pose_at(0.0))


def test_users_block_one_another_until_one_of_them_leaves(
    archive: Path, tmp_path: Path, endpoint: str
) -> None:
    effects = "".join(f'[[effects]]\neffect = "{name}"\n' for name in ("stop", "sweep", "crowd"))
    (tmp_path / "room.toml").write_text(f'format = 1\n[[archives]]\npath = "{archive}"\n{effects}')
    with (
        Scene.open(tmp_path / "room.toml") as scene,
        serving([scene], ServerConfig(listen=endpoint)),
        Client(endpoint, scene="room") as one,
        Client(endpoint, scene="room") as two,
    ):
        for client in (one, two):
            client.add_avatar("body", BODY, RADIUS)
        with two.session("body") as walker:
            with one.session("body") as standing:
                standing.wait(standing.wish(pose_at(0.0)), DEADLINE)
                walker.wait(walker.wish(pose_at(-1.5)), DEADLINE)
                assert walk(walker, 1.0)[0] == pytest.approx(-2 * RADIUS, abs=0.01)
                assert walker.latest().crowd.met == 1
                assert walker.latest().touched[0].what.endswith("/body")
                assert walk(standing, 0.5)[0] == 0.5, "who is met may go on"
                assert walk(walker, 1.0)[0] == pytest.approx(0.5 - 2 * RADIUS, abs=0.01)
            one.close()
            eventually(lambda: len(scene.simulation.users) == 1)
            assert walk(walker, 1.0)[0] == 1.0


def compiled() -> dict[str, int]:
    """Return the number of compiled versions of each kernel; empty if interpreted."""
    return {
        f"{name}.{key}": len(kernel.signatures)
        for name, module in sorted(sys.modules.items())
        if name.startswith("solidcloud.") and "kernels" in name
        for key, kernel in vars(module).items()
        if not isinstance(kernel, type) and hasattr(kernel, "signatures")
    }


ALL = [Stop(), Sweep(), Slide(), Step(), Ground(), Proximity(), Contacts(), Crowd()]


def test_who_walks_after_warming_waits_for_no_compiler(archive: Path) -> None:
    with Scene.open(archive) as scene:
        file = SceneFile(format=1, archives=scene_of("room").archives, effects=ALL)
        simulation = make_simulation(scene, file)
        simulation.warm()
        before = compiled()
        scene.add_avatar("body", BODY, RADIUS)
        scene.add_avatar("other", BODY + 0.01, RADIUS)
        poses = [
            pose_at(0.0, z=0.3),
            pose_at(1.4),
            pose_at(1.4, 1.0),
            pose_at(0.0, -1.0),
            pose_at(0.0, 0.0, -0.5),
        ]
        for name in ("body", "other"):
            for a in poses:
                for b in poses:
                    simulation.move(name, a[None], b[None], STEP)
        assert compiled() == before


SCENE = """format = 1
archives = [{{ path = "{archive}" }}]
effects = [
    {{ effect = "stop" }}, {{ effect = "sweep" }}, {{ effect = "slide" }}, {{ effect = "ground" }},
    {{ effect = "crowd" }}, {{ effect = "proximity" }},
]
limits = {{ users = 4 }}
"""


@pytest.fixture(scope="module")
def logged(archive: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return a scene file and the log of two users who walked in it."""
    folder = tmp_path_factory.mktemp("logged")
    (folder / "room.toml").write_text(SCENE.format(archive=archive))
    log = folder / "frames.log"
    rng = np.random.default_rng(3)
    with (
        served(folder / "room.toml", None, "--log", str(log)) as endpoint,
        Client(endpoint, scene="room", timeout=DEADLINE) as client,
    ):
        for name in ("one", "two"):
            client.add_avatar(name, BODY, RADIUS)
        with client.session("one") as one, client.session("two") as two:
            for session, x in ((one, -1.0), (two, 0.0)):
                session.wait(session.wish(pose_at(x, z=0.1), time=0.0), DEADLINE)
            for number in range(150):
                for session in (one, two):
                    velocity = rng.normal(size=3) * [2.0, 2.0, 0.0]
                    seq = session.wish(velocity=velocity, turn=rng.normal(), time=number * STEP)
                    session.wait(seq, DEADLINE)
    return folder / "room.toml", log


def test_a_replay_gives_the_same_poses_bit_for_bit(
    logged: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    scene, log = logged
    for arguments in ([str(log)], [str(log), str(scene)]):
        assert run(["replay", *arguments]) == 0
        assert capsys.readouterr().out == "302 frames, 302 turns: none different\n"
    moved = {str(turn.pose) for frame in read_log(log)[1] for turn in frame.turns}
    assert len(moved) > 200, "they did not just stand there"


THINGS = """format = 1
archives = [{{ path = "{archive}" }}]
avatars = [{{ name = "box", file = "box.xyz", radius = 0.2 }}]
objects = [
    {{ name = "door", avatar = "box", pose = [[1, 0, 0, 0], [0, 1, 0, 1.0], [0, 0, 1, 0.1], [0, 0, 0, 1]] }},
    {{ name = "crate", avatar = "box", kind = "pushed" }},
]
effects = [{{ effect = "stop" }}, {{ effect = "sweep" }}, {{ effect = "objects" }}, {{ effect = "crowd" }}]
"""


def test_objects_that_users_move_are_moved_the_same_in_a_replay(archive: Path, tmp_path: Path) -> None:
    (tmp_path / "things.toml").write_text(THINGS.format(archive=archive))
    np.savetxt(tmp_path / "box.xyz", [[0, 0, 0.3], [0, 0.3, 0.3], [0, 0, 0.8]], fmt="%.3f")
    path, log = tmp_path / "things.toml", tmp_path / "frames.log"
    rng = np.random.default_rng(12)
    users = [User("a", "box"), User("b", "box")]  # as an avatar of the scene
    moved = {}
    with Scene.open(path) as scene, recorded(scene, path, log):
        scene.simulation.warm()
        for number in range(60):
            turns = []
            for at, user in enumerate(users):
                pose = pose_at(-1.0 + number / 40, 0.7 * at + 0.05 * rng.normal())
                told = {"door": pose_at(0.0, 1.0 + 0.1 * rng.normal()).tolist()} if number % 7 == 3 else {}
                turns.append(
                    FrameCommand(user, Wish(seq=number, time=number * STEP, pose=pose[None], objects=told))
                )
            for outcome in scene.simulation.step(turns):
                moved.update(outcome.state.objects.poses)
    assert set(moved) == {"door", "crate"} and moved["crate"][0][3] > 0.3, "it was pushed"
    with Scene.open(path) as scene:  # not warmed: warming leaves no trace
        assert replay(scene.simulation, read_log(log)[1]) == Replayed(60, 120)


def test_a_log_with_one_bit_changed_is_not_believed(
    logged: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = logged[1].read_bytes().splitlines(keepends=True)
    frame = json.loads(lines[102][9:])  # frame 101, after the magic and the head
    row = frame["turns"][0]["pose"][0]
    row[3] = float(np.nextafter(row[3], 2.0))
    body = json.dumps(frame).encode()
    lines[102] = lines[102][:9] + body + b"\n"
    (tmp_path / "changed.log").write_bytes(b"".join(lines))
    assert run(["replay", str(tmp_path / "changed.log")]) == 3
    assert "changed.log: line 103: its checksum is" in capsys.readouterr().err
    # With a corrected checksum, the replay finds the change in the poses.
    lines[102] = b"%08x %s\n" % (zlib.crc32(body), body)
    (tmp_path / "fitting.log").write_bytes(b"".join(lines))
    assert run(["replay", str(tmp_path / "fitting.log")]) == 1
    out = capsys.readouterr().out
    assert out.startswith("302 frames, 302 turns: 1 different\nfirst: frame 101, avatar ")


def test_a_log_is_not_written_over(
    logged: tuple[Path, Path], archive: Path, endpoint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = logged[1].read_bytes()
    assert run(["serve", str(archive), "--listen", endpoint, "--log", str(logged[1])]) == 2
    assert "frames.log: exists, and a log is not overwritten" in capsys.readouterr().err
    assert logged[1].read_bytes() == before


def test_a_log_of_another_archive_is_refused(
    logged: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = archive_cases.build(tmp_path, room()[:500]).archive
    assert run(["replay", str(logged[1]), str(other)]) == 2
    assert "of generation 0: expected archive" in capsys.readouterr().err
    assert run(["replay", str(tmp_path / "none.log")]) == 3


def test_another_scene_file_is_said_and_what_comes_of_it_too(
    logged: tuple[Path, Path], archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = logged[0].read_text().replace('{ effect = "ground" },', "")
    (tmp_path / "other.toml").write_text(text)
    assert run(["replay", str(logged[1]), str(tmp_path / "other.toml")]) == 1
    captured = capsys.readouterr()
    assert "is not the scene file that was logged" in captured.err and "\nfirst: frame " in captured.out


def test_query_asks_for_moves(
    archive: Path, tmp_path: Path, endpoint: str, scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    np.savetxt(tmp_path / "body.xyz", BODY, fmt="%.3f")
    rows = "t,x,y,z,qw,qx,qy,qz\n0,0,0,0.05,1,0,0,0\n0.5,1,0,0.05,1,0,0,0\n1,1.4,0,0.05,1,0,0,0\n"
    (tmp_path / "poses.csv").write_text(rows)
    ask = ["query", "--op", "move", "--scene", "room", "--connect", endpoint, "--radius", str(RADIUS)]
    ask += ["--avatar", str(tmp_path / "body.xyz"), "--poses", str(tmp_path / "poses.csv")]
    with serving([scene], ServerConfig(listen=endpoint)):
        assert run(ask) == 0
        first, second = capsys.readouterr().out.splitlines()
        assert first.split()[-5:] == ["clear", "at", "1.0000", "0.0000", "0.0500"]
        assert "0.4000 m left, touching 1.5000 " in second
        assert run([*ask, "--json"]) == 0
        assert '"left": 0.3' in capsys.readouterr().out
        assert run([*ask, "--margin", "1"]) == 2
        assert (
            "--margin is not an option of --op move: it takes --avatar, --poses, --radius"
            in capsys.readouterr().err
        )
    assert run(ask) == 1
    captured = capsys.readouterr()
    assert captured.out == "" and "no server of scene 'room'" in captured.err
