"""Test that exported points are the archive's in the box, bit for bit where the format permits."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import plyfile
import pytest
import solidcloud.builder.export.export_archive as export
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.export.export_archive import export_archive, lattice_box
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.archive_writer import write_index
from solidcloud.schemas.archive.index import Header
from solidcloud.schemas.archive.voxel_grid import Lattice
from solidcloud.schemas.archive.vtkhdf import read_points
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.runtime.new_file import is_temporary
from solidcloud.server.cli.main import run
from synthetic_scans import make_scan, write_las, write_ply

UTM = np.array([512_345.25, 5_612_000.5, 87.125])
WKT = 'PROJCS["ETRS89 / UTM zone 32N",GEOGCS["ETRS89"],UNIT["metre",1]]'
FORMATS = ("laz", "las", "ply", "vtkhdf")


def build(
    folder: Path, clouds: list[np.ndarray], intensities: list[np.ndarray] | None, **options: Any
) -> Path:
    """An archive of some clouds, in several voxels of several cells, with scan and intensity if there are any."""
    for i, xyz in enumerate(clouds):
        write_ply(folder / f"{i}.ply", xyz, intensities[i] if intensities else None)
    kept = frozenset(("scan", "intensity")) if intensities else frozenset()
    config = {"voxel": 1.1, "cell_points": 50, "resolution": 0.001, "keep": kept, "jobs": 1, **options}
    build_archive([folder], folder / "archive", BuildConfig(**config))
    return folder / "archive"


@pytest.fixture(scope="module")
def georeferenced(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An archive far from its coordinates' origin, with whole intensities. Not to be changed."""
    clouds = [make_scan("noise", 1, 700) + UTM, make_scan("duplicates", 2, 300) + UTM]
    whole = [np.arange(700, dtype=np.float32) * 7, np.full(300, 65535, np.float32)]
    return build(tmp_path_factory.mktemp("utm"), clouds, whole)


Rows = list[tuple[float, float, float, int, float]]


def stored(folder: Path) -> Rows:
    """All points of an archive by the plain decoder: x, y, z [m], scan and intensity, 0 where not stored; sorted."""
    rows: Rows = []
    with Archive(folder) as archive:
        lattice = archive.header.lattice
        for row, corner in enumerate(archive.coordinates * lattice.voxel_steps):
            voxel, links = archive.read_voxel(row)
            for node in np.flatnonzero(links.is_leaf).tolist():
                begin, held = int(links.first[node]), int(voxel.nodes.count[node])
                low = corner + voxel.cells.low[links.cell[node]] + voxel.nodes.block_low[node]
                world = lattice.to_world(voxel.points[begin : begin + held] + low).tolist()
                for i, (x, y, z) in enumerate(world, begin):
                    scan = 0 if voxel.scan_index is None else int(voxel.scan_index[i])
                    intensity = 0.0 if voxel.intensity is None else float(voxel.intensity[i])
                    rows.append((x, y, z, scan, intensity))
    return sorted(rows)


def rows_of(xyz: np.ndarray, scan: np.ndarray | None, intensity: np.ndarray | None) -> Rows:
    """The same of columns."""
    n = len(xyz)
    scan = np.zeros(n, int) if scan is None else scan
    intensity = np.zeros(n) if intensity is None else intensity
    return sorted((*p, int(s), float(i)) for p, s, i in zip(xyz.tolist(), scan, intensity, strict=True))


def read_back(path: Path) -> Rows:
    """What a file holds, read by a library that did not write it, where there is one."""
    if path.suffix == ".ply":
        vertices = plyfile.PlyData.read(path)["vertex"].data
        names = vertices.dtype.names
        xyz = np.stack([vertices[axis] for axis in "xyz"], axis=1)
        assert xyz.dtype == np.float64
        return rows_of(xyz, *(vertices[n] if n in names else None for n in ("scan", "intensity")))
    if path.suffix == ".vtkhdf":
        found = read_points(path)
        return rows_of(found.points, found.columns.get("scan"), found.columns.get("intensity"))
    las = laspy.read(path)
    raw = np.stack([las.X, las.Y, las.Z], axis=1).astype(np.int64)
    exact = "intensity_float" in las.point_format.dimension_names
    intensity = las["intensity_float"] if exact else las.intensity
    return rows_of(raw * las.header.scales + las.header.offsets, las.point_source_id, intensity)


@pytest.mark.parametrize("form", FORMATS)
def test_all_points_come_back_to_the_last_bit(form: str, georeferenced: Path, tmp_path: Path) -> None:
    path = tmp_path / f"all.{form}"
    done = export_archive(georeferenced, path)
    expected = stored(georeferenced)
    assert read_back(path) == expected
    assert (done.points, done.format, done.bytes, done.notes) == (1000, form, path.stat().st_size, ())
    xyz = np.array([row[:3] for row in expected])
    assert (done.low, done.high) == (xyz.min(axis=0).tolist(), xyz.max(axis=0).tolist())
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("form", FORMATS)
def test_a_box_is_half_open(form: str, georeferenced: Path, tmp_path: Path) -> None:
    everything = stored(georeferenced)
    wider = np.array([0, 0.5, 0.5])
    some = np.array(everything[200][:3]), np.array(everything[800][:3])
    # Corners that are coordinates of points: those on the low faces are in, those on the high ones are not.
    low, high = np.minimum(*some) - wider, np.maximum(*some) + wider
    inside = [
        row
        for row in everything
        if all(a <= v < b for a, v, b in zip(low.tolist(), row[:3], high.tolist(), strict=True))
    ]
    assert 100 < len(inside) < 900
    assert any(row[0] == low[0] for row in inside) and not any(row[0] == high[0] for row in inside)
    assert any(row[0] == high[0] for row in everything)
    done = export_archive(georeferenced, tmp_path / f"a.{form}", box=(*low.tolist(), *high.tolist()))
    assert read_back(tmp_path / f"a.{form}") == inside
    assert done.points == len(inside)


@pytest.mark.parametrize("step", [1e-6, 0.0001, 0.001, 0.1, 1 / 3])
def test_the_lattice_points_of_a_box_are_those_whose_coordinates_are_in_it(step: float) -> None:
    rng = np.random.default_rng(4)
    for origin in ((0.0, 0.0, 0.0), tuple(UTM.tolist()), (-6.4e6, 1e9 - 1, 0.1)):
        lattice = Lattice(origin, step, 1000)
        for _ in range(40):
            steps = rng.integers(-(1 << 20), 1 << 20, (1, 3))
            nudge = rng.choice([-step / 2, -1e-9, 0, 0, 0, 1e-9, step / 3])
            corner = lattice.to_world(steps)[0] + nudge
            found = lattice_box(lattice, (*corner.tolist(), *(corner + 10 * step).tolist()))
            around = steps[0] + np.arange(-30, 31)[:, None]
            world = lattice.to_world(around)
            for k in range(3):
                inside = around[(world[:, k] >= corner[k]) & (world[:, k] < (corner + 10 * step)[k]), k]
                assert found[:, k].tolist() == [inside.min(), inside.max()]


@pytest.mark.parametrize(
    "box",
    [(0, 0, 0, 0, 1, 1), (0, 0, 2, 1, 1, 1), (0, 0, float("nan"), 1, 1, 1), (0, 0, 0, 1, float("inf"), 1)],
)
def test_a_box_that_is_none_is_refused(box: tuple[float, ...], georeferenced: Path, tmp_path: Path) -> None:
    with pytest.raises(BadRequestError, match=r"--box .* each low below its high"):
        export_archive(georeferenced, tmp_path / "a.ply", box=box)
    assert list(tmp_path.iterdir()) == []


def test_outputs_that_cannot_be_are_refused(georeferenced: Path, tmp_path: Path) -> None:
    for name, said in (
        ("a.txt", "format 'txt', expected laz, las, ply, vtkhdf"),
        ("none/a.ply", "no such folder"),
    ):
        with pytest.raises(BadRequestError, match=said):
            export_archive(georeferenced, tmp_path / name)
    (tmp_path / "a.ply").write_text("mine")
    with pytest.raises(BadRequestError, match="already exists"):
        export_archive(georeferenced, tmp_path / "a.ply")
    assert (tmp_path / "a.ply").read_text() == "mine"
    export_archive(georeferenced, tmp_path / "a.ply", overwrite=True, form="vtkhdf")
    assert len(read_points(tmp_path / "a.ply").points) == 1000
    (tmp_path / "folder.las").mkdir()
    with pytest.raises(BadRequestError, match="already exists"):
        export_archive(georeferenced, tmp_path / "folder.las", overwrite=True)


@pytest.mark.parametrize("form", FORMATS)
def test_a_failure_leaves_what_was_there(
    form: str, georeferenced: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"a.{form}"
    path.write_text("before")

    def full(*_: object) -> None:
        (other,) = {*tmp_path.iterdir()} - {path}
        assert is_temporary(other)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(export, "_write_points", full)
    with pytest.raises(OSError, match="No space left"):
        export_archive(georeferenced, path, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == [path.name] and path.read_text() == "before"


def test_intensities_that_16_bits_do_not_hold_are_kept_as_they_are(tmp_path: Path) -> None:
    cloud = make_scan("noise", 5, 300)
    for name, odd in (("fraction", 0.25), ("negative", -1.0), ("large", 65536.0), ("none", np.nan)):
        (tmp_path / name).mkdir()
        intensity = np.arange(300, dtype=np.float32)
        intensity[77] = odd
        archive = build(tmp_path / name, [cloud], [intensity])
        done = export_archive(archive, tmp_path / f"{name}.laz")
        assert "intensity_float" in done.notes[0]
        found = np.asarray(laspy.read(tmp_path / f"{name}.laz")["intensity_float"])
        assert np.sort(found).tobytes() == np.sort(intensity).tobytes()


def test_points_farther_apart_than_32_bits_are_moved_or_refused(tmp_path: Path) -> None:
    """1 micrometre steps: 32 bits are 4,295 m. Either side of a gap fits by itself, both together do not."""
    near = make_scan("noise", 6, 100)
    cloud = np.concatenate([near, near + np.array([6000.0, 0, 0])])
    archive = build(tmp_path, [cloud], None, resolution=1e-6, voxel=1.0)
    with pytest.raises(BadRequestError, match="more than the 32 bits of LAS hold: export a smaller --box"):
        export_archive(archive, tmp_path / "a.las")
    assert not list(tmp_path.glob("*.tmp")) and not (tmp_path / "a.las").exists()
    expected = stored(archive)
    export_archive(archive, tmp_path / "a.ply")
    assert read_back(tmp_path / "a.ply") == expected
    for box, part in (((-1, -1, -1, 10, 9, 9), expected[:100]), ((5000, -1, -1, 7000, 9, 9), expected[100:])):
        export_archive(archive, tmp_path / "part.laz", box=box, overwrite=True)
        found = read_back(tmp_path / "part.laz")
        with Archive(archive) as opened:
            lattice = opened.header.lattice
        steps = [lattice.to_lattice(np.array([row[:3] for row in rows])).tolist() for rows in (found, part)]
        assert sorted(steps[0]) == sorted(steps[1])
        if box[0] < 0:  # where the archive's own origin will do, nothing is rounded anew
            assert found == part


def set_sources(folder: Path, **changes: list[Any]) -> None:
    """Write the index anew with other words on the sources."""
    with Archive(folder) as archive:
        header, rows = archive.header, archive.voxels
        shards = [
            (archive.shard_path(n).name, archive.shard_path(n).stat().st_size)
            for n in range(archive.shard_count())
        ]
    sources = tuple(
        replace(source, **{name: values[i] for name, values in changes.items()})
        for i, source in enumerate(header.sources)
    )
    changed: Header = replace(header, sources=sources)
    write_index(folder, changed, rows, shards)


@pytest.mark.parametrize(
    ("changes", "written", "note"),
    [
        ({"crs": [WKT, WKT]}, WKT, ""),
        ({"crs": ["", ""]}, "", ""),
        ({"crs": [WKT, ""]}, "", "different coordinate systems, or some name none"),
        ({"crs": [WKT, WKT.replace("32N", "33N")]}, "", "different coordinate systems, or some name none"),
        ({"crs": ["EPSG:25832"] * 2}, "", "not given as well-known text (EPSG:25832)"),
        ({"crs": [WKT + " " * 66_000] * 2}, "", "not given as well-known text"),
        ({"crs": [WKT, WKT], "units": ["ft", "ft"]}, "", "not in metres with z up"),
        ({"crs": [WKT, WKT], "up": ["z", "y"]}, "", "not in metres with z up"),
    ],
)
def test_the_coordinate_system_that_all_scans_share_is_written(
    changes: dict[str, list[str]], written: str, note: str, tmp_path: Path
) -> None:
    archive = build(tmp_path, [make_scan("plane", i, 60) for i in (1, 2)], None)
    set_sources(archive, **changes)
    done = export_archive(archive, tmp_path / "a.laz")
    header = laspy.read(tmp_path / "a.laz").header
    found = [vlr.string for vlr in header.vlrs if vlr.record_id == 2112]
    assert found == ([written] if written else [])
    assert header.global_encoding.wkt and header.version == "1.4" and header.point_format.id == 6
    assert len(done.notes) == bool(note) and note in "".join(done.notes)


@pytest.mark.parametrize("form", ["laz", "ply"])
def test_what_is_exported_builds_the_same_shards(form: str, tmp_path: Path) -> None:
    """Out of an archive and in again: the same points on the same lattice."""
    raw = np.random.default_rng(7).integers(-5000, 5000, (400, 3))
    write_las(
        tmp_path / "a.las", raw, offset=tuple(UTM.tolist()), intensity=(raw[:, 0] % 100).astype(np.uint16)
    )
    config = BuildConfig(voxel=2.0, keep=frozenset(("intensity",)), jobs=1, resolution=0.001)
    build_archive([tmp_path / "a.las"], tmp_path / "first", config)
    export_archive(tmp_path / "first", tmp_path / f"out.{form}")
    build_archive([tmp_path / f"out.{form}"], tmp_path / "second", config)
    shards = sorted((tmp_path / "first" / "shards").iterdir())
    assert shards and [s.read_bytes() for s in shards] == [
        s.read_bytes() for s in sorted((tmp_path / "second" / "shards").iterdir())
    ]


def test_the_command_says_what_it_wrote(
    georeferenced: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    box = ["--box", *map(str, UTM.tolist()), *map(str, (UTM + 1).tolist())]
    assert run(["export", str(georeferenced), "-o", str(tmp_path / "a.laz"), *box, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (
        0 < found["points"] < 1000 and found["file"] == str(tmp_path / "a.laz") and found["format"] == "laz"
    )
    assert run(["export", str(georeferenced), "-o", str(tmp_path / "b"), "--format", "ply"]) == 0
    assert "1,000" in capsys.readouterr().out
    assert run(["export", str(georeferenced), "-o", str(tmp_path / "b"), "--format", "ply"]) == 2
    assert (
        run(
            [
                "export",
                str(georeferenced),
                "-o",
                str(tmp_path / "c.ply"),
                "--box",
                "1",
                "0",
                "0",
                "0",
                "1",
                "1",
            ]
        )
        == 2
    )
    assert run(["export", str(tmp_path / "none"), "-o", str(tmp_path / "c.ply")]) == 3
    assert "error:" in capsys.readouterr().err
