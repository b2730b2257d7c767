"""Test that the viewer's page and the project read each other's files of walks, and how it records.

The page's modules run in Node.js.
"""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from solidcloud.server import viewer
from solidcloud.server.cli.input.pose_file import read_poses, read_tum_poses, write_poses
from solidcloud.server.viewer.page.view_frame import ViewFrame

NODE = shutil.which("node")
pytestmark = pytest.mark.skipif(NODE is None, reason="no node in PATH: apt-get install nodejs")

ASSETS = Path(viewer.__file__).parent / "assets" / "walk"


@pytest.fixture
def node(tmp_path: Path) -> Any:
    """Return a function that runs a program with the page's modules in `tmp_path`."""
    for name in ("pose_text.js", "recorder.js"):
        shutil.copy(ASSETS / name, tmp_path / name)
    (tmp_path / "package.json").write_text('{"type": "module"}')

    def run(program: str, **values: Any) -> Any:
        (tmp_path / "program.js").write_text(
            'import { readFileSync, writeFileSync } from "node:fs";\n'
            'import { csvText, parseWalk, tumText } from "./pose_text.js";\n'
            'import { Recorder } from "./recorder.js";\n'
            "const values = JSON.parse(process.argv[2]);\n"
            f"const result = (() => {{ {program} }})();\n"
            "console.log(JSON.stringify(result ?? null));\n"
        )
        done = subprocess.run(
            [str(NODE), "program.js", json.dumps(values)],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run


def random_poses(count: int, rng: np.random.Generator) -> np.ndarray:
    poses = np.tile(np.eye(4), (count, 1, 1))
    turns, _ = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    poses[:, :3, :3] = turns * np.linalg.det(turns)[:, None, None]
    poses[:, :3, 3] = rng.normal(size=(count, 3)) * 10 + [4.3e5, 5.4e6, 30.0]
    return poses


def test_files_pass_through_the_page_unchanged(node: Any, tmp_path: Path, rng: np.random.Generator) -> None:
    times, poses = np.cumsum(rng.uniform(0.01, 0.1, 40)), random_poses(40, rng)
    times -= times[0]
    write_poses(tmp_path / "given.csv", times, poses)
    node(
        'const walk = parseWalk("given.csv", readFileSync("given.csv", "utf8"));'
        'writeFileSync("walk.csv", csvText(walk)); writeFileSync("walk.tum", tumText(walk));'
        'const again = parseWalk("walk.tum", readFileSync("walk.tum", "utf8"));'
        'writeFileSync("again.csv", csvText(again));'
    )
    for name, read in (("walk.csv", read_poses), ("walk.tum", read_tum_poses), ("again.csv", read_poses)):
        found_times, found = read(tmp_path / name)
        assert np.array_equal(found_times, times)
        assert np.array_equal(found[:, :3, 3], poses[:, :3, 3])
        assert np.allclose(found[:, :3, :3], poses[:, :3, :3], atol=1e-14)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.csv", "t,x,y\n", "line 1: columns t,x,y"),
        ("a.csv", "t,x,y,z,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n", "1 poses"),
        ("a.csv", "t,x,y,z,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n1,,0,0,1,0,0,0\n", "line 3: expected finite"),
        ("a.csv", "t,x,y,z,qw,qx,qy,qz\n0,0,0,0,1.01,0,0,0\n", "line 2: quaternion of length 1.01"),
        ("a.tum", "# comment\n0 0 0 0 1 0 0\n", "line 2: 7 values"),
    ],
)
def test_invalid_file_is_refused_with_its_line(node: Any, name: str, text: str, message: str) -> None:
    said = node(
        "try { parseWalk(values.name, values.text); } catch (error) { return error.message; }",
        name=name,
        text=text,
    )
    assert said.startswith(name)
    assert message in said


def test_recording_is_in_the_world_and_stands_still_in_a_pause(node: Any, rng: np.random.Generator) -> None:
    frame = ViewFrame([[4e5, 5e6, 0], [4e5 + 30, 5e6 + 20, 10]], up=(0.2, 0.9, 0.1))
    world = random_poses(3, rng) - np.array([[0, 0, 0, 3e4], [0, 0, 0, 4e5], [0] * 4, [0] * 4])
    states = [
        {"time": 100 + time, "pose": frame.pose(pose).tolist()}
        for time, pose in zip((0.0, 0.1, 2.0), world, strict=True)
    ]
    walk = node(
        "const recorder = new Recorder(() => {}); recorder.start();"
        "for (const state of values.states) recorder.take(state, values.origin, values.axes);"
        # A second state of one command.
        "recorder.take(values.states.at(-1), values.origin, values.axes);"
        'writeFileSync("walk.csv", csvText(recorder.samples)); return recorder.stop();',
        states=states,
        **frame.description(),
    )
    assert np.allclose([each["time"] for each in walk], [0, 0.1, 2 - 1 / 30, 2])
    assert np.allclose([each["place"] for each in walk], world[[0, 1, 1, 2], :3, 3], atol=1e-6)
