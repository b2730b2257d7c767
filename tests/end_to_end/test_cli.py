"""Test the command `solidcloud`: its verbs on a small scan, its exit codes, and one-line errors."""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cli_floor import build_floor, errors, floor
from solidcloud.server.cli.commands.command_options import parse_bytes
from solidcloud.server.cli.main import run
from solidcloud.server.report.walk.server_process import free_port

VERBS = [
    "build",
    "info",
    "validate",
    "serve",
    "query",
    "accuracy",
    "loadtest",
    "add",
    "remove",
    "reload",
    "top",
    "replay",
    "make",
    "doctor",
]
NESTED = [
    "make facade",
    "make town",
    "make office",
    "make figure",
    "make walk",
    "scene",
    "scene new",
    "scene check",
]


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    path = tmp_path / "floor.xyz"
    np.savetxt(path, floor(), fmt="%.4f")
    return path


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_floor(tmp_path_factory.mktemp("floor"))


def test_help_loads_no_numpy() -> None:
    verbs = ["", *VERBS, *NESTED]
    code = f"""
import sys
from solidcloud.server.cli.main import run
for verb in {verbs!r}:
    code = run([*verb.split(), "--help"])
    loaded = {{"pydantic", "numpy", "numba", "h5py", "zenoh", "rich"}} & {{*sys.modules}}
    assert code == 0 and not loaded, (verb, code, loaded)
"""
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("Usage: solidcloud") == len(verbs)


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        ("biuld", 2, "biuld"),
        ("build", 2, "solidcloud build --help"),
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
            "--op collide needs --avatar: it takes --avatar, --poses, --radius, --avatar-up,",
        ),
        (
            "query --scene hall --avatar {scan} --poses {scan} --reach 1",
            2,
            "--reach is not an option of --op collide",
        ),
        ("query --scene hall --op within --points {scan}", 2, "--op within needs --reach"),
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
        ("make office -o {out}.laz", 2, "one file for two scans"),
        (
            "view --cache 64MB --no-browser",
            2,
            "--cache and --up belong to a server that this command starts",
        ),
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
    level = {path for path in (target / "level").rglob("*") if path.is_file()}
    stored = [path for path in target.rglob("*") if path.is_file() and path != preview and path not in level]
    assert made["bytes"] == sum(path.stat().st_size for path in stored)
    assert made["level_bytes"] == sum(path.stat().st_size for path in level) > 0
    assert made["preview_bytes"] == preview.stat().st_size
    assert made["radius"] == pytest.approx(0.05, rel=1e-9)
    assert run(["build", str(scan), "-o", str(target)]) == 2
    assert "--overwrite" in errors(capsys)[0]
    assert run(["build", str(scan), "-o", str(target), "--overwrite", "--jobs", "1"]) == 0
    shown = capsys.readouterr()
    assert "points/s" in shown.out and "bytes per point" in shown.out
    assert re.search(r"preview +preview\.vtkhdf for ParaView, \d", shown.out)
    assert re.search(r"level +level of detail, \d", shown.out)


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
