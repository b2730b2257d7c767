"""The command: its verbs on a small scan, its exit codes, and one line for every error."""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from solidcloud.server.cli.commands.command_options import parse_bytes
from solidcloud.server.cli.main import run
from solidcloud.server.report.walk.server_process import free_port, served

VERBS = [
    "build",
    "info",
    "validate",
    "serve",
    "query",
    "accuracy",
    "add",
    "remove",
    "reload",
    "top",
    "replay",
    "make",
]
NESTED = ["make facade", "make town", "make figure", "make walk", "scene", "scene new", "scene check"]
RADIUS = 0.05


def floor(half: float = 2.0, step: float = 0.1) -> np.ndarray:
    """A level floor at z = 0, (n, 3) [m]."""
    x, y = np.meshgrid(np.arange(-half, half, step), np.arange(-half, half, step))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    path = tmp_path / "floor.xyz"
    np.savetxt(path, floor(), fmt="%.4f")
    return path


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("floor")
    np.savetxt(folder / "floor.xyz", floor(), fmt="%.4f")
    code = run(
        ["build", str(folder / "floor.xyz"), "-o", str(folder / "hall"), "--voxel", "2", "--jobs", "1"]
    )
    assert code == 0
    return folder / "hall"


def errors(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]


@pytest.mark.parametrize("verb", ["", *VERBS, *NESTED])
def test_help_loads_no_numpy(verb: str) -> None:
    code = (
        f"import sys; from solidcloud.server.cli.main import run; code = run({[*verb.split(), '--help']!r})"
    )
    heavy = ["pydantic", "numpy", "numba", "h5py", "zenoh", "rich"]
    check = f"sys.exit(code or ','.join(name for name in {heavy!r} if name in sys.modules) or 0)"
    done = subprocess.run(
        [sys.executable, "-P", "-c", f"{code}; {check}"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "Usage: solidcloud" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ("biuld", 2, "biuld"),
        ("build", 2, "see solidcloud build --help"),
        ("make", 2, "Missing command"),
        ("build {scan} -o {out} --degree many", 2, "--degree"),
        ("build {scan} -o {out} --degree 99", 2, "--degree 99"),
        ("build {scan} -o {out} --memory plenty", 2, "--memory 'plenty'"),
        ("build {scan} -o {out} --keep colour", 2, "colour"),
        ("build {scan} -o {out} --radius huge", 2, "--radius 'huge': expected mean, local, border"),
        ("build {scan} -o {out} --radius fixed:9", 2, "--radius 9.0: expected 0 to 8.0 m"),
        ("build {out}/nowhere.las -o {out}", 3, "nowhere.las: no such file"),
        ("info {out}", 3, "no archive here"),
        ("validate {out}", 3, "no archive here"),
        ("serve {out}", 3, "no archive here"),
        ("serve {out} --listen tcp/0.0.0.0:7447", 2, "--insecure"),
        ("query --scene hall --avatar {scan} --poses {scan}", 2, "line 1: columns"),
        ("query --scene hall --avatar {scan} --poses {out}", 3, "expected a CSV file"),
        ("query --scene hall --op hop", 2, "--op hop: expected one of collide, distance"),
        (
            "query --scene hall",
            2,
            "--op collide needs --avatar: it takes --avatar, --poses, --radius, --margin",
        ),
        (
            "query --scene hall --avatar {scan} --poses {scan} --reach 1",
            2,
            "--reach is not an option of --op collide",
        ),
        ("query --scene hall --op distance --avatar {scan} --poses {scan}", 2, "--op distance needs --reach"),
        (
            "query --scene hall --op raycast --reach 1 --poses {scan}",
            2,
            "--poses is not an option of --op raycast",
        ),
        (
            "query --scene hall --op path --along raycast --reach 1",
            2,
            "--along raycast: expected one of collide",
        ),
        (
            "query --scene hall --op path --along sweep --avatar {scan} --poses {scan} --limit 3",
            2,
            "--limit is not an option",
        ),
        ("query --scene hall --op raycast --reach 1 --rays {scan}", 2, "expected x,y,z,dx,dy,dz"),
        (
            "query --scene hall --op objects --objects {scan}",
            2,
            "expected avatar,x,y,z,qw,qx,qy,qz,group,mask",
        ),
        (
            "query --scene hall --op move --avatar {scan}",
            2,
            "--op move needs --poses: it takes --avatar, --poses",
        ),
        ("query --scene hall --op path --along move", 2, "--along move: expected one of collide"),
        ("replay {out}", 3, "expected a log written by serve --log"),
        ("replay {scan}", 3, "expected a log written by serve --log"),
        ("make facade -o {out}.obj", 2, "cannot write '.obj'"),
    ],
)
def test_error_is_one_line_with_its_exit_code(
    arguments: str, code: int, said: str, scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = sorted(tmp_path.rglob("*"))
    assert run([word.format(scan=scan, out=tmp_path / "out") for word in arguments.split()]) == code
    found = errors(capsys)
    assert len(found) == 1 and said in found[0]
    assert sorted(tmp_path.rglob("*")) == before


def test_command_is_installed_and_exits_without_a_traceback() -> None:
    command = [str(Path(sys.executable).with_name("solidcloud")), "info", "nowhere"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 3
    assert re.fullmatch(r"error: nowhere: .*\n", done.stderr) and not done.stdout


def test_build_says_what_it_made(scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "hall"
    assert run(["build", str(scan), "-o", str(target), "--voxel", "2", "--jobs", "1", "--json"]) == 0
    made = json.loads(capsys.readouterr().out)
    assert made["points"] == len(floor()) and made["archive"] == str(target)
    preview = target / "preview.vtkhdf"
    stored = [path for path in target.rglob("*") if path.is_file() and path != preview]
    assert made["bytes"] == sum(path.stat().st_size for path in stored)
    assert made["preview_bytes"] == preview.stat().st_size
    assert made["radius"] == pytest.approx(0.05, rel=1e-9)
    assert run(["build", str(scan), "-o", str(target)]) == 2
    assert "--overwrite" in errors(capsys)[0]
    assert run(["build", str(scan), "-o", str(target), "--overwrite", "--jobs", "1"]) == 0
    shown = capsys.readouterr()
    assert "points/s" in shown.out and "bytes per point" in shown.out
    assert re.search(r"preview +preview\.vtkhdf for ParaView, \d", shown.out)


def test_broken_scan_stops_the_build_unless_it_is_skipped(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = tmp_path / "broken.las"
    broken.write_bytes(b"LASF but no more")
    target = tmp_path / "hall"
    build = ["build", str(scan), str(broken), "-o", str(target), "--jobs", "1"]
    assert run(build) == 3
    assert "broken.las" in errors(capsys)[0] and not target.exists()
    assert run([*build, "--skip-bad"]) == 0
    assert "left out" in capsys.readouterr().err
    assert run(["info", str(target), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert len(told["skipped"]) == 1 and "broken.las" in told["skipped"][0]


def test_info_tells_counts_and_bounds(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["info", str(archive), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["points"] == len(floor()) and told["scene"] == "hall"
    assert np.allclose(told["bounds"], [floor().min(axis=0), floor().max(axis=0)], atol=told["lattice_step"])
    assert run(["info", str(archive)]) == 0
    assert f"{len(floor()):,} in" in capsys.readouterr().out


def test_radius_models_are_stored_and_told(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    build = ["build", str(scan), "--voxel", "2", "--jobs", "1", "-o"]
    for radius, figure, model, models in (
        ("mean", 0.05, "mean", ["mean"]),
        ("0.02", 0.02, "given", ["mean"]),
        ("fixed:0.02", 0.02, "given", ["mean"]),
        ("mean,local,border", 0.05, "mean", ["mean", "local", "border"]),
        ("fixed:0.03,local", 0.03, "given", ["mean", "local"]),
    ):
        target = tmp_path / radius
        assert run([*build, str(target), "--radius", radius]) == 0
        capsys.readouterr()
        assert run(["info", str(target), "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert told["radius"] == pytest.approx(figure, rel=1e-9)
        assert (told["radius_model"], told["radius_models"]) == (model, models)
        assert told["format_version"] == (1 if models == ["mean"] else 2)
        classes = told["radius_classes"]
        assert (classes is None) == (models == ["mean"])
        assert run(["info", str(target)]) == 0
        shown = capsys.readouterr().out
        assert ("local" in shown, "on the rim" in shown) == ("local" in models, "border" in models)
        if classes:
            assert sum(held["points"] for held in classes["local"]) == len(floor())
            assert classes["capped"] == 0
            assert (classes["rim"] is None) == ("border" not in models)
            for held in classes["local"]:
                assert f"{held['radius'] * 1e3:.4g} mm" in shown and f"{held['points']:,}" in shown


def test_validate_names_the_record_with_a_flipped_byte(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    target = tmp_path / "hall"
    assert run(["build", str(scan), "-o", str(target), "--jobs", "1"]) == 0
    assert run(["validate", str(target), "--deep"]) == 0
    assert ", 0 faults" in capsys.readouterr().out
    assert run(["validate", str(target), "--exact", "--sample", "5"]) == 0
    assert re.search(r" points, 5 of \d+ bounds proved, 0 faults", capsys.readouterr().out)
    assert run(["validate", str(target), "--sample", "5"]) == 2
    capsys.readouterr()
    shard = next(target.rglob("shards/*.h5"))
    content = bytearray(shard.read_bytes())
    content[content.rindex(b"\x28\xb5\x2f\xfd") + 20] ^= 0x10
    shard.write_bytes(content)
    assert run(["validate", str(target), "--json"]) == 3
    shown = capsys.readouterr()
    assert shard.name in json.loads(shown.out)["faults"][0]
    assert [line for line in shown.err.splitlines() if line.startswith("error: ") and shard.name in line]


@pytest.mark.interpreted
def test_query_agrees_with_the_floor(
    archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    heights = [0.3, 0.0999, 0.1001, 0.02, 5.0]
    # One point over a scanned one; both radii are 0.05 m.
    (tmp_path / "ball.xyz").write_text("0 0 0\n")
    rows = "".join(f"{t},0,0,{z},1,0,0,0\n" for t, z in enumerate(heights))
    (tmp_path / "poses.csv").write_text("t,x,y,z,qw,qx,qy,qz\n" + rows)
    ask = ["query", "--avatar", str(tmp_path / "ball.xyz"), "--poses", str(tmp_path / "poses.csv")]
    ask += ["--radius", str(RADIUS)]
    with served(archive, "hall", "--cache", "64MB") as endpoint:
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
    """What is asked of the floor, by a ball of 0.05 m; every point of it too is a ball of 0.05 m."""
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
        "distance": [*ball, "--reach", "1"],
        "contacts": [*ball, "--limit", "5"],
        "sweep": [*ball, "--tolerance", "0.001"],
        "raycast": ["--rays", str(folder / "rays.csv"), "--reach", "2"],
        "within": ["--points", str(folder / "loose.xyz"), "--reach", "1"],
        "objects": ["--objects", str(folder / "objects.csv"), "--radius", str(RADIUS)],
        "path": [*ball, "--along", "distance", "--reach", "1"],
    }


# A line each of what is said: verdict and figure. One pair in contact at 0.09 m: the point below, 0.01 m deep.
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
    archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asks = ask_all(tmp_path)
    with served(archive, "hall", "--cache", "64MB") as endpoint:
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


# What each question is asked about, and which of these lie outside the floor: 4 m wide, at a height of 0.
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
    """What is asked of the floor, 0.3 m above its plane, at two places: x = first, and x = 9 m, which is beside it."""
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
    archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with served(archive, "hall", "--cache", "64MB") as endpoint:
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
    archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "ball.xyz").write_text("0 0 0\n")
    places = np.random.default_rng(7).uniform(-1.9, 1.8, (40, 2)) * 1000
    rows = "".join(f"{t},{x},{y},50,1,0,0,0\n" for t, (x, y) in enumerate(places))
    (tmp_path / "poses.csv").write_text("t,x,y,z,qw,qx,qy,qz\n" + rows)
    ask = ["query", "--avatar", str(tmp_path / "ball.xyz"), "--poses", str(tmp_path / "poses.csv")]
    with served(archive, "hall", "--cache", "64MB") as endpoint:
        assert run([*ask, "--radius", "0.05", "--connect", endpoint, "--scene", "hall"]) == 0
    shown = capsys.readouterr()
    assert "40 of 40 poses lie outside the scan (its bounds: -2.000" in shown.err
    assert "divided by 1000 they would lie inside: expected metres, not millimetres?" in shown.err
    assert "40 poses: 40 clear, 0 contact, 0 unknown, 40 outside the scan; " in shown.out


def check_json(op: str, told: dict[str, Any]) -> None:
    """Figures of the JSON that the text does not have."""
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


def test_serve_stops_when_told_to(archive: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    command = [
        sys.executable,
        "-P",
        "-m",
        "solidcloud.server.cli.main",
        "serve",
        str(archive),
        "--listen",
        endpoint,
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout and process.stdout.readline() == f"serving hall at {endpoint}\n"
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0


def test_make_gives_an_avatar_a_scan_and_a_walk(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    figure, facade, walk = tmp_path / "al.obj", tmp_path / "facade.laz", tmp_path / "walk.csv"
    assert run(["make", "figure", "-o", str(figure), "--points", "200"]) == 0
    assert figure.read_text().count("\nv ") == 200
    assert run(["make", "facade", "-o", str(facade), "--points", "2000"]) == 0
    assert "2,000 points" in capsys.readouterr().out
    assert run(["make", "walk", str(tmp_path / "facade.truth.json"), "-o", str(walk), "--frames", "60"]) == 0
    assert len(walk.read_text().splitlines()) == 61


@pytest.mark.parametrize(
    ("text", "size"),
    [("64MB", 64 << 20), ("2GB", 2 << 30), ("1.5 GiB", 3 << 29), ("4096", 4096), ("8k", 8192)],
)
def test_sizes_are_in_steps_of_1024(text: str, size: int) -> None:
    assert parse_bytes(text, "--cache") == size
