"""Test commands without answers: exit code 1, and one line that says where, what and what to do."""

import json
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_server import FloorScene, floor_simulation
from solidcloud.schemas.runtime.own_command import own_command
from solidcloud.schemas.wire.answers import CollideAnswers, Verdict
from solidcloud.schemas.wire.motion_messages import Moved
from solidcloud.server import client as client_module
from solidcloud.server.cli.main import run
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig

OPS = [
    "collide",
    "distance",
    "contacts",
    "sweep",
    "raycast",
    "within",
    "objects",
    "move",
    "path",
    "path collide",
    "path distance",
    "path contacts",
    "path sweep",
]


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Any]:
    """Write the input files of each query.

    They hold six poses from low to high, which are five motions, and two rays, points and objects.
    """
    (tmp_path / "ball.xyz").write_text("0 0 0\n")
    rows = "".join(f"{t},0,0,{t - 1},1,0,0,0\n" for t in range(6))
    (tmp_path / "poses.csv").write_text("t,x,y,z,qw,qx,qy,qz\n" + rows)
    (tmp_path / "rays.csv").write_text("x,y,z,dx,dy,dz\n0,0,1,0,0,-2\n0,0,1,0,0,1\n")
    (tmp_path / "loose.xyz").write_text("0 0 0.25\n0.5 0.5 3\n")
    objects = "ball.xyz,0,0,1,1,0,0,0,1,0xffffffff\nball.xyz,0,0,2,1,0,0,0,1,0xffffffff\n"
    (tmp_path / "objects.csv").write_text("avatar,x,y,z,qw,qx,qy,qz,group,mask\n" + objects)
    ball = ["--avatar", f"{tmp_path}/ball.xyz", "--poses", f"{tmp_path}/poses.csv", "--radius", "0.05"]
    reach = {"distance": ["--reach", "1"]}
    given = {op: [*ball, *reach.get(op.split()[-1], [])] for op in OPS}
    given["raycast"] = ["--rays", f"{tmp_path}/rays.csv", "--reach", "2"]
    given["within"] = ["--points", f"{tmp_path}/loose.xyz", "--reach", "1"]
    given["objects"] = ["--objects", f"{tmp_path}/objects.csv", "--radius", "0.05"]
    return given


def query(endpoint: str, op: str, options: list[str]) -> list[str]:
    """Return the arguments of a query; `op` as in OPS."""
    name, _, along = op.partition(" ")
    arguments = ["query", "--connect", endpoint, "--scene", "floor", "--op", name, *options]
    return [*arguments, "--along", along] if along else arguments


@pytest.mark.parametrize("op", OPS)
def test_a_question_that_nobody_answers_fails(
    endpoint: str, files: dict[str, Any], op: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*query(endpoint, op, files[op]), *(["--json"] if op == "collide" else [])]) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    (line,) = shown.err.splitlines()
    assert line == (
        f"error: no server of scene 'floor' at {endpoint}, expected one that answers {op.split()[0]!r}: "
        f"start one with: {own_command()} serve ARCHIVE --name floor --listen {endpoint}"
    )


@pytest.mark.parametrize(
    "verb",
    [
        "reload --scene floor",
        "reload --scene floor --json",
        "top --scene floor",
        "top --scene floor --once",
        "top --scene floor --json",
        "top",
        "top --once",
        "top --json",
    ],
)
def test_every_other_verb_that_asks_a_server_fails(
    endpoint: str, verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run([*verb.split(), "--connect", endpoint]) == 1
    shown = capsys.readouterr()
    assert shown.out.strip() == ""
    (line,) = shown.err.splitlines()
    assert line.startswith("error: no server ") and endpoint in line
    assert f"start one with: {own_command()} serve ARCHIVE" in line


@pytest.mark.parametrize("verb", ["query", "reload", "top"])
def test_the_command_itself_exits_with_1(endpoint: str, files: dict[str, Any], verb: str) -> None:
    arguments = (
        query(endpoint, "collide", files["collide"]) if verb == "query" else [verb, "--scene", "floor"]
    )
    command = [sys.executable, "-P", "-m", "solidcloud.server.cli.main", *arguments]
    command += [] if verb == "query" else ["--connect", endpoint]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout.strip(), len(done.stderr.splitlines())) == (1, "", 1)
    assert "start one with" in done.stderr


class Stalls(FloorScene):
    """Scene that answers two poses at once, and the others when the gate opens."""

    def __init__(self) -> None:
        super().__init__()
        self.may = threading.Event()

    def collide(self, name: str, poses: Any, *what: Any, **effort: Any) -> Any:
        if any(asked[0] == "collide" for asked in self.asked):
            self.may.wait(60)
        return super().collide(name, poses, *what, **effort)


def test_where_some_answers_do_not_come_the_others_are_printed(
    endpoint: str,
    files: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(client_module, "BATCH_POSES", 2)
    scene = Stalls()
    with serving([scene], ServerConfig(listen=endpoint)):
        try:
            code = run([*query(endpoint, "collide", files["collide"]), "--json"])
        finally:
            scene.may.set()
    shown = capsys.readouterr()
    assert code == 1
    verdicts = [answer["verdict"] for answer in json.loads(shown.out)["answers"]]
    assert verdicts == ["contact", "contact", *["unknown"] * 4]
    (line,) = [line for line in shown.err.splitlines() if line.startswith("error: ")]
    assert line.startswith(
        f"error: 4 of 6 poses were not answered: the server of scene 'floor' at {endpoint} is gone"
    )
    assert f"within 5 s: try again, or start one with: {own_command()} serve ARCHIVE" in line


class Doubts(FloorScene):
    """Scene that returns unknown for the first two poses and for the end of frames."""

    def __init__(self, fault: str) -> None:
        super().__init__()
        self.fault = fault

    def collide(self, name: str, poses: Any, *what: Any, **effort: Any) -> Any:
        found = super().collide(name, poses, *what, **effort)
        found.verdict[:2] = Verdict.UNKNOWN
        columns = {
            field: getattr(found, field)
            for field in CollideAnswers.__struct_fields__
            if field not in ("faults", "stopped")
        }
        why = {"stopped": self.fault} if "server time" in self.fault else {"faults": (self.fault,)}
        return CollideAnswers(**columns, **(why if self.fault else {}))

    def move(self, name: str, pose_from: Any, pose_to: Any, *what: Any, **fields: Any) -> Any:
        super().move(name, pose_from, pose_to, *what, **fields)
        return Moved(pose=pose_to, verdict=int(Verdict.UNKNOWN), simulated=["stop"])


@pytest.mark.parametrize(
    ("fault", "why"),
    [
        ("hall.h5: voxel 3 is broken", "hall.h5: voxel 3 is broken"),
        ("2 s of server time are over", "2 s of server time are over"),
        ("", "the budget was spent, or a scan that the build left out is in reach"),
    ],
)
def test_what_the_server_itself_does_not_know_is_said(
    endpoint: str, files: dict[str, Any], fault: str, why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving([Doubts(fault)], ServerConfig(listen=endpoint)):
        assert run(query(endpoint, "collide", files["collide"])) == 0
        shown = capsys.readouterr()
        assert "6 poses: 4 clear, 0 contact, 2 unknown" in shown.out
        (line,) = [line for line in shown.err.splitlines() if "unknown" in line]
        assert line == f"warning: 2 of 6 poses are unknown: {why}"
        assert run(query(endpoint, "move", files["move"])) == 0
        shown = capsys.readouterr()
        assert len(shown.out.splitlines()) == 5
        (line,) = [line for line in shown.err.splitlines() if "unknown" in line]
        assert line == "warning: 5 of 5 motions are unknown: data in reach could not be read"


def test_a_path_that_stops_after_its_first_part(
    endpoint: str, tmp_path: Path, files: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    """Test a path cut short: the parts that arrived are printed, the others are unknown and counted."""
    count = 45
    rows = "".join(f"{t},0,0,1,1,0,0,0\n" for t in range(count))
    (tmp_path / "poses.csv").write_text("t,x,y,z,qw,qx,qy,qz\n" + rows)

    class Waits(FloorScene):
        def path(self, name: str, *what: Any, client: str = "", **parameters: Any) -> Any:
            # Another avatar name: the floor waits after the first part of a path of "wait".
            self.avatars[client, "wait"] = self.avatars[client, name]
            return super().path("wait", *what, client=client, **parameters)

    scene = Waits()
    with serving([scene], ServerConfig(listen=endpoint)):
        try:
            code = run(query(endpoint, "path", files["path"]))
        finally:
            scene.gate.set()
    shown = capsys.readouterr()
    assert code == 1
    unknown = int(np.array(shown.out.splitlines()[-1].split(", ")[2].split()[0], int))
    assert 0 < unknown < count
    assert f"error: {unknown} of {count} poses were not answered" in shown.err


def test_frames_that_are_answered(endpoint: str, files: dict[str, Any], capsys: Any) -> None:
    """Test answered frames with any verdict: they are not taken for unanswered ones."""
    with serving([floor_simulation().scene], ServerConfig(listen=endpoint)):
        assert run(query(endpoint, "move", files["move"])) == 0
    assert len(capsys.readouterr().out.splitlines()) == 5
