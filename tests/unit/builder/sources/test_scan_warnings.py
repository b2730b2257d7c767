"""Test the warnings about scans that are probably a mistake, and that sound scans get none."""

import json
import re
import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scan_formats import cartesian, glb_document, glb_vertices, ptx_scan, write_e57, write_glb, write_pcd
from solidcloud.builder.sources.scan_files import inspect_scans, open_scans
from solidcloud.builder.sources.scan_warnings import radius_warning
from solidcloud.server.cli.main import run

MILLIMETRES, GAP, AVATAR, RADIUS = "probably in millimetres", "away from all other", "a mesh of", "--radius"
UNLIKE = "one radius does not fit both"


def room(size: tuple[float, float, float] = (5.0, 4.0, 2.5), spacing: float = 0.1) -> NDArray[np.float64]:
    """Return points (n, 3) on the floor, the ceiling and two walls of a room [m]."""
    x, y, z = (np.arange(0.0, length + spacing / 2, spacing) for length in size)
    floor = np.stack(np.meshgrid(x, y, [0.0, size[2]], indexing="ij"), -1).reshape(-1, 3)
    walls = np.stack(np.meshgrid(x, [0.0, size[1]], z, indexing="ij"), -1).reshape(-1, 3)
    return np.concatenate([floor, walls])


def moved(points: NDArray[np.float64], x: float, y: float, z: float) -> NDArray[np.float64]:
    return points + np.array([x, y, z])


def write_xyz(path: Path, points: NDArray[np.float64]) -> Path:
    np.savetxt(path, points, fmt="%.4f")
    return path


def write_ply(path: Path, points: NDArray[np.float64]) -> Path:
    """Write a binary PLY file, without bounds in its header."""
    columns = "".join(f"property double {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n{columns}end_header\n"
    path.write_bytes(head.encode() + points.astype("<f8").tobytes())
    return path


def write_las(path: Path, points: NDArray[np.float64]) -> Path:
    laspy = pytest.importorskip("laspy")
    file = laspy.LasData(laspy.LasHeader(point_format=0, version="1.2"))
    file.header.scales, file.header.offsets = np.full(3, 1e-3), points.min(axis=0)
    file.xyz = points
    file.write(path)
    return path


def write_obj(path: Path, points: NDArray[np.float64]) -> Path:
    path.write_text("".join("v {:.4f} {:.4f} {:.4f}\n".format(*point) for point in points) + "f 1 2 3\n")
    return path


def write_stl(path: Path, points: NDArray[np.float64]) -> Path:
    corners = points[: len(points) // 3 * 3].reshape(-1, 9).astype("<f4")
    triangles = b"".join(bytes(12) + row.tobytes() + bytes(2) for row in corners)
    path.write_bytes(bytes(80) + struct.pack("<I", len(corners)) + triangles)
    return path


def figure() -> NDArray[np.float64]:
    """Return points (n, 3) of a body about 1.75 m high, standing at the origin."""
    rng = np.random.default_rng(5)
    return rng.uniform((-0.25, -0.15, 0.0), (0.25, 0.15, 1.75), (300, 3))


def said(paths: list[Path]) -> list[str]:
    return [warning for entry in inspect_scans(paths) for warning in entry.warnings]


@pytest.mark.parametrize("write", [write_xyz, write_ply, write_las], ids=["text", "PLY", "LAS"])
def test_a_room_in_millimetres_is_suspect_and_one_in_metres_is_not(tmp_path: Path, write) -> None:
    name = {write_xyz: "room.xyz", write_ply: "room.ply", write_las: "room.las"}[write]
    assert said([write(tmp_path / name, room())]) == []
    (warning,) = said([write(tmp_path / name, room() * 1000)])
    assert warning.startswith(f"{tmp_path / name}: 5 km long, points about 100 m apart: {MILLIMETRES}")
    assert 'units = "mm"' in warning and "\n" not in warning


def test_terrain_in_map_coordinates_is_not_in_millimetres(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    terrain = rng.uniform((0, 0, 0), (3000, 3000, 200), (20_000, 3))
    assert said([write_las(tmp_path / "tile.las", moved(terrain, 636_000, 850_000, 400))]) == []
    assert len(said([write_las(tmp_path / "tile.las", terrain)])) == 1


def test_scans_far_apart_are_named(tmp_path: Path) -> None:
    here = [write_xyz(tmp_path / f"{name}.xyz", moved(room(), 6.0 * k, 0, 0)) for k, name in enumerate("abc")]
    assert said(here) == []
    there = write_xyz(tmp_path / "d.xyz", moved(room(), 2_322_968, 4_770_131, 290))
    (warning,) = said([*here, there])
    assert warning.startswith(f"{there}: 4,770 km {GAP} scans, and no scan is longer than 5 m")
    write_xyz(there, moved(room(), 100.0, 0, 0))  # another building
    assert said([*here, there]) == []
    write_xyz(there, moved(room(), 0, 0, 700.0))
    assert GAP in said([*here, there])[0]


def test_an_avatar_beside_scans_is_named_and_alone_it_is_a_mesh(tmp_path: Path) -> None:
    scan = write_xyz(tmp_path / "room.xyz", room() - (2, 2, 0))
    for write, name in ((write_obj, "visitor.obj"), (write_stl, "visitor.stl")):
        mesh = write(tmp_path / name, figure())
        (warning,) = said([scan, mesh])
        assert warning.startswith(f"{mesh}: {AVATAR}") and "use = false" in warning
        assert said([mesh]) == []
    table = write_obj(tmp_path / "table.obj", moved(figure(), 3.0, 2.0, 0.0))
    assert said([scan, table]) == [], "in its place, not around the origin"


def test_scans_of_very_different_spacing_need_another_radius_model(tmp_path: Path) -> None:
    fine = write_ply(tmp_path / "fine.ply", room((1.0, 1.0, 0.5), 0.01))
    coarse = write_ply(tmp_path / "coarse.ply", room((40.0, 40.0, 10.0), 0.5))
    (warning,) = said([fine, coarse])
    assert warning.startswith(f"{coarse}: points about 500 mm apart") and UNLIKE in warning
    assert "mean,local" in warning
    assert said([coarse]) == said([fine]) == []


@pytest.mark.parametrize(
    ("radius", "wrong"),
    [
        (0.0, ""),
        (0.0001, "pass between"),
        (0.004, ""),
        (0.02, ""),
        (0.1, ""),
        (0.5, "grow by 500 mm"),
        (5.0, "grow by 5 m"),
    ],
)
def test_a_radius_is_compared_with_the_spacing(radius: float, wrong: str) -> None:
    text = radius_warning(radius, 0.02)
    assert wrong in text if wrong else text == ""


def test_inspect_and_build_say_the_same(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    scan = write_xyz(tmp_path / "room.xyz", room() * 1000)
    lines = []
    build = ["build", str(scan), "-o", str(tmp_path / "hall"), "--jobs", "1", "--voxel", "1000"]
    build += ["--resolution", "0.001"]
    for command in (
        ["inspect", str(scan), "-o", str(tmp_path / "scans.toml")],
        [*build, "--dry-run"],
        build,
        build,  # the archive is already complete
    ):
        assert run(command) == 0
        (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]
        lines.append(line)
    assert len(set(lines)) == 1 and MILLIMETRES in lines[0]
    # On the terminal a command has the path by which a shell finds it.
    text = re.sub(r"`\S*solidcloud ", "`solidcloud ", lines[0].removeprefix("warning: "))
    assert run(["inspect", str(scan), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)[0]["warnings"] == [text]
    assert run([*build, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["warnings"] == [text]


def test_a_small_object_in_millimetres_is_called_that(tmp_path: Path) -> None:
    """Issue 35: nothing shorter than 1 km was."""
    around = np.random.default_rng(0).normal(size=(3000, 3))
    gear = around / np.linalg.norm(around, axis=1)[:, None] * [196, 302, 320]
    (entry,) = inspect_scans([write_xyz(tmp_path / "gear.xyz", gear)])
    assert MILLIMETRES in entry.warnings[0]
    (entry,) = inspect_scans([write_xyz(tmp_path / "terrain.xyz", gear * [1, 1, 0.2])])
    assert entry.warnings == ()


def write_turnless(path: Path, points: NDArray[np.float64]) -> Path:
    """Write points with a rotation of zeros and the translation 1, 2, 3."""
    if path.suffix == ".e57":
        rows = {"columns": cartesian(points), "rotation": np.zeros(4), "translation": np.array([1.0, 2, 3])}
        write_e57(path, [rows])
    elif path.suffix == ".pcd":
        kind = path.stem
        write_pcd(path, points, points[:, 0], kind, viewpoint="1 2 3 0 0 0 0")
    elif path.suffix == ".ptx":
        lines = ptx_scan(points, points[:, 0]).splitlines()
        zeros, place = ["0 0 0 0"] * 3, "1 2 3"
        axes = ["0 0 0"] * 3 if path.stem == "axes" else ["1 0 0", "0 1 0", "0 0 1"]
        path.write_text("\n".join([*lines[:2], place, *axes, *zeros, f"{place} 1", *lines[10:]]))
    else:
        document = glb_document(len(points))
        document["nodes"] = [{"mesh": 0, "rotation": [0, 0, 0, 0], "translation": [1, 2, 3]}]
        write_glb(path, document, glb_vertices(points))
    return path


@pytest.mark.parametrize("name", ["a.e57", "binary.pcd", "axes.ptx", "a.glb"])
def test_a_rotation_of_zeros_is_no_rotation_with_a_warning(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """Issue 35: pye57 wrote 0 0 0 0 for no rotation, and other programs read it as that."""
    points = room((1.0, 1.0, 1.0), 0.25) + 1.0
    path = write_turnless(tmp_path / name, points)
    (scan,) = open_scans(path)
    found = np.concatenate([block.xyz for block in scan.blocks()])
    assert np.array_equal(found, points + np.array([1, 2, 3]))
    text = f"{path}: scan 0 has a rotation of zeros, read as no rotation: check how the scan lies"
    build = ["build", str(path), "-o", str(tmp_path / "hall"), "--jobs", "1", "--resolution", "0.001"]
    add = ["add", str(tmp_path / "hall"), str(path), "--again"]
    for command in (
        ["inspect", str(path), "-o", str(tmp_path / "scans.toml")],
        ["plan", str(path)],
        build,
        add,
    ):
        assert run(command) == 0
        assert f"warning: {text}" in capsys.readouterr().err.splitlines()
    assert run(["build", str(tmp_path / "scans.toml"), "-o", str(tmp_path / "listed"), "--jobs", "1"]) == 0
    assert f"warning: {text}" in capsys.readouterr().err.splitlines()


def test_build_warns_of_its_radius(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    scan = write_xyz(tmp_path / "room.xyz", room())
    build = ["build", str(scan), "-o", str(tmp_path / "hall"), "--jobs", "1", "--overwrite", "--radius"]
    assert run([*build, "5", "--json"]) == 0
    (warning,) = json.loads(capsys.readouterr().out)["warnings"]
    assert warning.startswith(f"{scan}: --radius 5 is 50 times the distance between points, about 100 mm")
    assert run([*build, "0.05", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["warnings"] == []


REAL = ("indoor_atrium.laz", "pumpA.e57", "cupola_las", "octomap_hall.xyz", "campus_scan_a.ply",
        "campus_scan_b.ply", "lone_star.copc.laz", "avatar/al.obj", "avatar/cesium_man.obj")  # fmt: skip


def test_real_scans_are_not_suspect(real_scans: Path) -> None:
    samples = [path for path in (real_scans / "format_samples").iterdir() if path.is_file()]
    for path in (*(real_scans / name for name in REAL), *samples):
        # Its heights are in feet, which is said and no mistake.
        in_feet = path.name == "simple_with_page.copc.laz"
        assert ["heights in US survey feet" in text for text in said([path])] == [True] * in_feet, path
    assert said([real_scans / "campus_scan_a.ply", real_scans / "campus_scan_b.ply"]) == []
    for name in REAL[:2]:
        warnings = said([real_scans / name, real_scans / "avatar" / "al.obj"])
        assert len(warnings) == 1 and AVATAR in warnings[0]
