"""Test `solidcloud query` on a small floor: every query, its text and JSON, and places outside the scan."""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_floor import RADIUS, build_floor, errors
from solidcloud.server.cli.main import run
from solidcloud.server.scene import Scene
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory, free_endpoint: Callable[[], str]) -> Iterator[str]:
    """Serve the floor."""
    archive, endpoint = build_floor(tmp_path_factory.mktemp("floor")), free_endpoint()
    with Scene.open(archive, "hall") as scene, serving([scene], ServerConfig(listen=endpoint)):
        yield endpoint


def test_query_agrees_with_the_floor(
    endpoint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    heights = [0.3, 0.0999, 0.1001, 0.02, 5.0]
    # The avatar is one point above a scan point; both radii are 0.05 m.
    (tmp_path / "ball.xyz").write_text("0 0 0\n")
    rows = "".join(f"{t},0,0,{z},1,0,0,0\n" for t, z in enumerate(heights))
    (tmp_path / "poses.csv").write_text("t,x,y,z,qw,qx,qy,qz\n" + rows)
    ask = ["query", "--avatar", str(tmp_path / "ball.xyz"), "--poses", str(tmp_path / "poses.csv")]
    ask += ["--radius", str(RADIUS)]
    assert run([*ask, "--connect", endpoint, "--scene", "hall", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert run([*ask, "--connect", endpoint, "--scene", "hall"]) == 0
    assert "3 clear, 2 contact, 0 unknown" in capsys.readouterr().out
    assert run([*ask, "--connect", endpoint, "--scene", "nave"]) == 1
    assert "served: hall" in errors(capsys)[0]
    verdicts = [answer["verdict"] for answer in told["answers"]]
    assert verdicts == ["contact" if z <= 2 * RADIUS else "clear" for z in heights]
    assert told["faults"] == [] and told["resident"] >= 1


def ask_all(folder: Path) -> dict[str, list[str]]:
    """Return the options of every query on the floor, with a ball of 0.05 m as avatar.

    Every point of the floor also has a radius of 0.05 m.
    """
    (folder / "ball.xyz").write_text("0 0 0\n")
    heights = [0.3, 0.09, 5.0]
    rows = "".join(f"{t},0,0,{z},1,0,0,0\n" for t, z in enumerate(heights))
    (folder / "poses.csv").write_text("t,x,y,z,qw,qx,qy,qz\n" + rows)
    (folder / "rays.csv").write_text("x,y,z,dx,dy,dz\n0,0,1,0,0,-2\n0,0,1,0,0,1\n")
    (folder / "loose.xyz").write_text("0 0 0.25\n0.5 0.5 3\n")
    objects = "ball.xyz,0,0,0.09,1,0,0,0,1,0xffffffff\nball.xyz,0,0,0.18,1,0,0,0,1,0xffffffff\n"
    (folder / "objects.csv").write_text("avatar,x,y,z,qw,qx,qy,qz,group,mask\n" + objects)
    ball = [
        "--avatar",
        str(folder / "ball.xyz"),
        "--poses",
        str(folder / "poses.csv"),
        "--radius",
        str(RADIUS),
    ]
    return {
        "distance": ball,  # up to 1 m
        "contacts": [*ball, "--limit", "5"],
        "sweep": [*ball, "--tolerance", "0.001"],
        "raycast": ["--rays", str(folder / "rays.csv"), "--reach", "2"],
        "within": ["--points", str(folder / "loose.xyz"), "--reach", "1"],
        "objects": ["--objects", str(folder / "objects.csv"), "--radius", str(RADIUS)],
        "path": [*ball, "--along", "distance"],
    }


# Expected lines of output: verdict and result. At 0.09 m one pair is in contact: the point below,
# 0.01 m deep.
LINES = {
    "distance": [
        r"0\.000 s  clear +0\.200000 m from .*",
        r"1\.000 s  contact +-0\.010000 m from 0\.0000 0\.0000 0\.0900 to 0\.0000 0\.0000 0\.0000",
        r"2\.000 s  clear +nothing within 1\.000000 m",
        r"3 poses: 2 clear, 1 contact, 0 unknown, 1 outside the scan; .*",
    ],
    "contacts": [
        r"0\.000 s  clear",
        r"1\.000 s  contact +1 pairs in 1 clusters, -0\.010000 m at 0\.0000 0\.0000 0\.0000",
        r"2\.000 s  clear",
        r"3 poses: .*",
    ],
    "sweep": [
        r"0\.000 .. +1\.000 s  contact +from 0\.9\d+ to 0\.9\d+ of the motion, at 0\.0000 0\.0000 0\.0000",
        r"1\.000 .. +2\.000 s  contact +from 0\.0+ to 0\.0+ of the motion, at .*",
        r"2 motions: 0 clear, 2 contact, 0 unknown; .*",
    ],
    "raycast": [
        r"ray 0  contact +0\.950000 m at -?0\.0000 -?0\.0000 0\.0500",
        r"ray 1  clear +nothing within 2\.000000 m",
        r"2 rays: .*",
    ],
    "within": [
        r"point 0  contact +0\.250000 m at .*",
        r"point 1  clear +nothing within 1\.000000 m",
        r"2 points: .*",
    ],
    "objects": [
        r"object 0 ball\.xyz  contact",
        r"object 1 ball\.xyz  clear",
        r"objects 0 and 1  contact",
        r"2 objects: 1 clear, 1 contact, 0 unknown, 1 outside the scan; .*",
    ],
}


LINES["path"] = LINES["distance"]


def test_every_question_from_the_command_line(
    endpoint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asks = ask_all(tmp_path)
    for op, options in asks.items():
        ask = ["query", "--connect", endpoint, "--scene", "hall", "--op", op, *options]
        assert run(ask) == 0, errors(capsys)
        lines = capsys.readouterr().out.splitlines()
        assert len(lines) == len(LINES[op]), lines
        for line, expected in zip(lines, LINES[op], strict=True):
            assert re.fullmatch(expected, line.strip()), line
        assert run([*ask, "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        words = [word for line in lines[:-1] for word in ("clear", "contact") if f"  {word}" in line]
        assert [answer["verdict"] for answer in told["answers"]] == words[: len(told["answers"])]
        assert told["faults"] == [] and told["engine_seconds"] > 0
        check_json(op, told)


# For each query: the noun for its items, and whether each lies outside the floor, which is 4 m wide
# at height 0.
OUTSIDE = {
    "collide": ("poses", [False, True]),
    "distance": ("poses", [False, True]),
    "contacts": ("poses", [False, True]),
    "sweep": ("motions", [False]),
    "path": ("poses", [False, True]),
    "move": ("motions", [False]),
    "raycast": ("rays", [False, True]),
    "within": ("points", [False, True]),
    "objects": ("objects", [False, True]),
}


def outside_files(folder: Path, first: float) -> dict[str, list[str]]:
    """Return the options of every query at two places, 0.3 m above the floor's plane.

    One place is at x = first, the other at x = 9 m, beside the floor.
    """
    here, there = f"{first},0,0.3", "9,0.5,0.3"
    (folder / "ball.xyz").write_text("0 0 0\n")
    (folder / "poses.csv").write_text(f"t,x,y,z,qw,qx,qy,qz\n0,{here},1,0,0,0\n1,{there},1,0,0,0\n")
    (folder / "rays.csv").write_text(f"x,y,z,dx,dy,dz\n{here},0,0,-1\n{there},0,0,-1\n")
    (folder / "loose.xyz").write_text(f"{here}\n{there}\n".replace(",", " "))
    columns = "avatar,x,y,z,qw,qx,qy,qz,group,mask\n"
    (folder / "objects.csv").write_text(
        f"{columns}ball.xyz,{here},1,0,0,0,1,0xffffffff\nball.xyz,{there},1,0,0,0,1,0xffffffff\n"
    )
    ball = ["--avatar", str(folder / "ball.xyz"), "--radius", str(RADIUS)]
    ball += ["--poses", str(folder / "poses.csv")]
    return {
        "collide": [*ball, "--margin", "0.2"],
        "distance": [*ball, "--reach", "0.5"],
        "contacts": [*ball, "--margin", "0.2"],
        "sweep": ball,
        "path": [*ball, "--margin", "0.2"],
        "move": ball,
        "raycast": ["--rays", str(folder / "rays.csv"), "--reach", "1"],
        "within": ["--points", str(folder / "loose.xyz"), "--reach", "0.5"],
        "objects": ["--objects", str(folder / "objects.csv"), "--radius", str(RADIUS), "--margin", "0.2"],
    }


def test_places_outside_the_scan_are_said_and_counted(
    endpoint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for first in (0.2, 12.0):
        for op, options in outside_files(tmp_path, first).items():
            word, lie = OUTSIDE[op]
            lie = lie if first < 9 else [True] * len(lie)
            ask = ["query", "--connect", endpoint, "--scene", "hall", "--op", op, *options]
            assert run(ask) == 0, (op, errors(capsys))
            shown = capsys.readouterr()
            warnings = [line for line in shown.err.splitlines() if line.startswith("warning: ")]
            counted = f"{sum(lie)} of {len(lie)} {word} lie outside the scan"
            bounds = r"\(its bounds: -2\.000 -2\.000 0\.000 \.\. 1\.900 1\.900 0\.000 m\)"
            assert len(warnings) == any(lie), (op, shown.err)
            if any(lie):
                assert re.fullmatch(f"warning: {counted} {bounds}", warnings[0]), (op, warnings)
            if op != "move":
                said = f", {sum(lie)} outside the scan; " if any(lie) else " unknown; "
                assert said in shown.out.splitlines()[-1], (op, shown.out)
            assert run([*ask, "--json"]) == 0
            told = json.loads(capsys.readouterr().out)
            rows = told if op == "move" else told["answers"]
            assert [row["outside_scan"] for row in rows] == lie, (op, first)
            assert op == "move" or told["outside_scan"] == sum(lie)


def test_poses_in_millimetres_are_called_so(
    endpoint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "ball.xyz").write_text("0 0 0\n")
    places = np.random.default_rng(7).uniform(-1.9, 1.8, (40, 2)) * 1000
    rows = "".join(f"{t},{x},{y},50,1,0,0,0\n" for t, (x, y) in enumerate(places))
    (tmp_path / "poses.csv").write_text("t,x,y,z,qw,qx,qy,qz\n" + rows)
    ask = ["query", "--avatar", str(tmp_path / "ball.xyz"), "--poses", str(tmp_path / "poses.csv")]
    assert run([*ask, "--radius", "0.05", "--connect", endpoint, "--scene", "hall"]) == 0
    shown = capsys.readouterr()
    assert "40 of 40 poses lie outside the scan (its bounds: -2.000" in shown.err
    assert "divided by 1000 they would lie inside: expected metres, not millimetres?" in shown.err
    assert "40 poses: 40 clear, 0 contact, 0 unknown, 40 outside the scan; " in shown.out


def check_json(op: str, told: dict[str, Any]) -> None:
    """Check values of the JSON that the text does not contain."""
    answers = told["answers"]
    if op in ("distance", "path"):
        assert [answer["t"] for answer in answers] == [0.0, 1.0, 2.0]
        assert answers[2]["signed_distance"] is None and answers[2]["witness_cloud"] is None
        assert answers[1]["normal"] == pytest.approx([0, 0, 1], abs=1e-3)
    if op == "contacts":
        (contact,), (cluster,) = answers[1]["contacts"], answers[1]["clusters"]
        assert contact["avatar_index"] == 0 and contact["signed_distance"] == pytest.approx(-0.01, abs=1e-6)
        assert cluster["count"] == 1 and cluster["low"] == cluster["high"] == contact["cloud_point"]
        assert answers[0]["contacts"] == answers[0]["clusters"] == []
    if op == "objects":
        assert told["pairs"] == [{"objects": [0, 1], "verdict": "contact"}] and told["pairs_tested"] == 1
