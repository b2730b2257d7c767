"""The same points in every format give the same archive: its shards byte for byte, its index but for the sources.

Coordinates are whole numbers of 1/1024 m within 8 m, which float32, float64, decimal text and scaled integers of that
step all hold exactly: nothing is left of the formats' own rounding. What is, at millimetres, the last test says.
"""

from collections.abc import Callable
from pathlib import Path

import h5py
import hdf5plugin  # noqa: F401  the index's chunks are compressed by what it registers
import numpy as np
import plyfile
import pytest
from scan_formats import (
    cartesian,
    glb_document,
    glb_vertices,
    ptx_scan,
    text_rows,
    write_e57,
    write_glb,
    write_pcd,
    write_pts,
)
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.archive.archive import Archive
from synthetic_scans import write_las

STEP = 2.0**-10
# Where the index speaks of scans; all else of it must be the same.
OF_SOURCES = {"texts", "source_pose", "source_count"}
TURN = np.array([[0.0, -1, 0, 2], [1, 0, 0, -1], [0, 0, 1, 3], [0, 0, 0, 1]])  # exact, and so is its inverse


def made(step: float) -> tuple[np.ndarray, np.ndarray]:
    """A thousand points on a lattice, some of them twice, none at the origin, and whole intensities."""
    rng = np.random.default_rng(77)
    raw = rng.integers(-4000, 4000, (1000, 3))
    raw[-50:] = raw[:50]
    return raw * step, rng.integers(0, 256, 1000).astype(np.float64)


def as_las(path: Path, xyz: np.ndarray, light: np.ndarray, step: float = STEP, point_format: int = 7) -> None:
    raw, intensity = np.rint(xyz / step), light.astype(np.uint16)
    write_las(path, raw, scale=step, intensity=intensity, point_format=point_format)


def columns(xyz: np.ndarray, light: np.ndarray, real: type = np.float64) -> dict[str, np.ndarray]:
    return {**cartesian(xyz, real), "intensity": light}


def scaled(step: float) -> dict[str, tuple[float, float]]:
    return {f"cartesian{axis}": (step, 0.0) for axis in "XYZ"}


def write_ply(path: Path, xyz: np.ndarray, light: np.ndarray, real: str, text: bool, order: str) -> None:
    vertex = np.zeros(len(xyz), [("intensity", "f4"), ("x", real), ("y", real), ("z", real)])
    vertex["x"], vertex["y"], vertex["z"] = xyz.T
    vertex["intensity"] = light
    element = plyfile.PlyElement.describe(vertex, "vertex")
    plyfile.PlyData([element], text=text, byte_order=order).write(path)


def with_no_returns(xyz: np.ndarray, light: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same with ten rows 0 0 0 between, as a scanner writes where it saw nothing."""
    at = np.arange(0, 1000, 100)
    return np.insert(xyz, at, 0, axis=0), np.insert(light, at, 0)


def turned_back(xyz: np.ndarray) -> np.ndarray:
    """The points in the frame of a scanner that stands at TURN."""
    moved = xyz - TURN[:3, 3]
    return np.column_stack([moved[:, 1], -moved[:, 0], moved[:, 2]])


def write_half_turned(path: Path, xyz: np.ndarray, light: np.ndarray) -> None:
    """At a pose that float64 holds exactly: half a turn about z."""
    local = (xyz - [2.0, -1.0, 3.0]) * [-1, -1, 1]
    write_e57(
        path, [{"columns": columns(local, light), "translation": [2.0, -1, 3], "rotation": [0.0, 0, 0, 1]}]
    )


def write_quarter_turned(path: Path, xyz: np.ndarray, light: np.ndarray) -> None:
    """At a pose whose quaternion is rounded: a quarter of a turn about z has sqrt(1/2) in it."""
    half = np.sqrt(0.5)
    scan = {
        "columns": columns(turned_back(xyz), light),
        "translation": TURN[:3, 3],
        "rotation": [half, 0, 0, half],
    }
    write_e57(path, [scan])


WRITERS: dict[str, Callable[[Path, np.ndarray, np.ndarray], object]] = {
    "plain.las": as_las,
    "old.las": lambda p, xyz, light: as_las(p, xyz, light, point_format=3),
    "layered.laz": as_las,
    "old.laz": lambda p, xyz, light: as_las(p, xyz, light, point_format=3),
    "double.e57": lambda p, xyz, light: write_e57(p, [{"columns": columns(xyz, light)}]),
    "single.e57": lambda p, xyz, light: write_e57(p, [{"columns": columns(xyz, light, np.float32)}]),
    "scaled.e57": lambda p, xyz, light: write_e57(
        p, [{"columns": columns(xyz, light), "scaled": scaled(STEP)}]
    ),
    "posed.e57": lambda p, xyz, light: write_half_turned(p, xyz, light),
    "double.ply": lambda p, xyz, light: write_ply(p, xyz, light, "f8", False, "<"),
    "single.ply": lambda p, xyz, light: write_ply(p, xyz, light, "f4", False, ">"),
    "text.ply": lambda p, xyz, light: write_ply(p, xyz, light, "f8", True, "="),
    "rows.csv": lambda p, xyz, light: p.write_text("x y z intensity\n" + text_rows(xyz, light)),
    "comma.xyz": lambda p, xyz, light: p.write_text(
        "intensity,x,y,z\n" + text_rows(light, xyz).replace(" ", ",")
    ),
    "two.pts": lambda p, xyz, light: write_pts(p, [(xyz[:400], light[:400]), (xyz[400:], light[400:])]),
    "plain.ptx": lambda p, xyz, light: p.write_text(ptx_scan(*with_no_returns(xyz, light), columns=10)),
    "turned.ptx": lambda p, xyz, light: p.write_text(ptx_scan(turned_back(xyz), light, TURN)),
    "text.pcd": lambda p, xyz, light: write_pcd(p, xyz, light, "ascii"),
    "binary.pcd": lambda p, xyz, light: write_pcd(p, xyz, light, "binary", real="<f4"),
    "packed.pcd": lambda p, xyz, light: write_pcd(p, xyz, light, "binary_compressed"),
}
# Formats without intensities. glTF has y up: its x, y, z are the world's x, z, -y.
BARE: dict[str, Callable[[Path, np.ndarray], object]] = {
    "plain.las": lambda p, xyz: as_las(p, xyz, np.zeros(1000)),
    "mesh.obj": lambda p, xyz: p.write_text("".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in xyz.tolist())),
    "mesh.glb": lambda p, xyz: write_glb(
        p, glb_document(1000), glb_vertices(np.column_stack([xyz[:, 0], xyz[:, 2], -xyz[:, 1]]))
    ),
}


def build(path: Path, target: Path, step: float = STEP, keep: str = "intensity") -> Path:
    options = {"voxel": 4096 * step, "cell_points": 100, "leaf": 16, "resolution": step}
    config = BuildConfig(**options, jobs=1, keep=frozenset(filter(None, [keep])))
    return build_archive([path], target, config).archive


def apart_from_sources(archive: Path) -> tuple[dict[str, bytes], dict[str, bytes]]:
    """Every file but the index, and every dataset of the index but those of the sources."""
    files = {str(p.relative_to(archive)): p.read_bytes() for p in archive.rglob("*") if p.is_file()}
    files.pop("index.h5")
    datasets: dict[str, bytes] = {}

    def take(name: str, node: object) -> None:
        if isinstance(node, h5py.Dataset) and name not in OF_SOURCES:
            datasets[name] = node[()].tobytes()

    with h5py.File(archive / "index.h5") as file:
        file.visititems(take)
    return files, datasets


@pytest.fixture(scope="module")
def judge(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, bytes], dict[str, bytes]]:
    """What all must be: of the points as LAS."""
    folder = tmp_path_factory.mktemp("judge")
    as_las(folder / "a.las", *made(STEP))
    return apart_from_sources(build(folder / "a.las", folder / "a"))


@pytest.mark.parametrize("name", WRITERS)
def test_every_format_gives_the_same_shards(
    name: str, judge: tuple[dict[str, bytes], dict[str, bytes]], tmp_path: Path
) -> None:
    xyz, light = made(STEP)
    WRITERS[name](tmp_path / name, xyz, light)
    files, datasets = apart_from_sources(build(tmp_path / name, tmp_path / "a"))
    assert any("shard" in file for file in files)
    assert files == judge[0]
    assert {"origin", "voxels", "points"} <= set(datasets) and datasets.keys() == judge[1].keys()
    assert [field for field in datasets if datasets[field] != judge[1][field]] == []


def test_formats_without_intensity_give_the_same_shards_too(tmp_path: Path) -> None:
    found = []
    for name, write in BARE.items():
        write(tmp_path / name, made(STEP)[0])
        found.append(apart_from_sources(build(tmp_path / name, tmp_path / f"{name}.archive", keep="")))
    assert found[0] == found[1] == found[2]


def records(archive: Path) -> tuple[list[tuple[int, bytes, bytes]], np.ndarray]:
    """Key, nodes and points of each voxel as stored, all of a record but the archive's id; and the origin."""
    with Archive(archive) as opened:
        rows = [(int(r["key"]), *opened.read_frames(i)[1:]) for i, r in enumerate(opened.voxels)]
        return rows, np.array(opened.header.lattice.origin)


def test_at_millimetres_the_lattice_takes_the_formats_rounding_away(tmp_path: Path) -> None:
    """0.001 is no float64, and n * 0.001 not always the one that the decimal "n.nnn" is read as: points differ by one
    part in 2^52 between LAS, text and scaled integers, by one in 2^24 in float32, and by the turn's rounding at a pose.
    The origin, which is one of them, differs by as much, and with it the archive's id; the integers of every record,
    from that origin, do not.
    """
    xyz, light = made(0.001)
    text = "".join(f"{x:.3f} {y:.3f} {z:.3f} {i:.0f}\n" for (x, y, z), i in zip(xyz, light, strict=True))
    (tmp_path / "a.csv").write_text("x y z intensity\n" + text)
    as_las(tmp_path / "b.las", xyz, light, 0.001)
    write_e57(tmp_path / "c.e57", [{"columns": columns(xyz, light), "scaled": scaled(0.001)}])
    write_ply(tmp_path / "d.ply", xyz, light, "f4", False, "<")
    write_quarter_turned(tmp_path / "e.e57", xyz, light)
    found = [
        records(build(tmp_path / name, tmp_path / f"{name}.archive", 0.001))
        for name in ("a.csv", "b.las", "c.e57", "d.ply", "e.e57")
    ]
    for rows, origin in found[1:]:
        assert rows == found[0][0]
        assert np.abs(origin - found[0][1]).max() <= 4 * 2.0**-24
