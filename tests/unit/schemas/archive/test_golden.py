"""Test that existing archives stay readable: each committed one has the content of its JSON, bit for bit."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import naive_classes
import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.edit.edit_archive import add_scans, remove_scans
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.radius_model import RADIUS_CLASSES, RIM_BIT
from solidcloud.schemas.archive.voxel import LeafCells, Nodes

GOLDEN = Path(__file__).resolve().parents[3] / "golden"


# The archives of each format version, and how many of the scans went into them.
SCANS = {"archive": 2, "archive-2": 3, "archive-3": 3, "archive-5": 4}


@pytest.fixture(params=SCANS)
def name(request: pytest.FixtureRequest) -> str:
    """Of each golden archive."""
    return request.param


@pytest.fixture
def expected(name: str) -> dict[str, Any]:
    """The committed values."""
    return json.loads((GOLDEN / f"{name}.json").read_text())


@pytest.mark.interpreted
def test_the_golden_archive_holds_what_is_written_beside_it(name: str, expected: dict[str, Any]) -> None:
    assert verify_archive(GOLDEN / name, deep=True).faults == ()
    with Archive(GOLDEN / name) as archive:
        header = archive.header
        assert header.format_version == expected.get("format_version", 1)
        assert list(header.models) == expected.get("models", ["mean"])
        assert header.radius_counts.tolist() == expected.get("radius_counts", [0] * RADIUS_CLASSES)
        assert header.radius_capped == expected.get("radius_capped", 0)
        now = header.radius_now
        assert header.generation == expected.get("generation", 0)
        assert (
            [now.radius.hex(), now.error.hex(), now.sample] == expected["radius_now"]
            if now
            else ("radius_now" not in expected)
        )
        assert [shard for shard, _ in archive.shards()] == expected.get("shards", ["0-000000.h5"])
        assert header.archive_id.hex() == expected["archive_id"]
        assert [value.hex() for value in header.lattice.origin] == expected["origin"]
        assert header.lattice.step.hex() == expected["step"]
        assert header.lattice.voxel_steps == expected["voxel_steps"]
        assert header.points == expected["points"]
        assert [header.low.tolist(), header.high.tolist()] == expected["bounds"]
        assert header.radius.hex() == expected["radius"]
        assert header.radius_sample == expected["radius_sample"]
        assert header.moved_max.hex() == expected["moved_max"]
        assert [[s.path, s.index, s.format, s.sha256, s.count] for s in header.sources] == expected["sources"]
        assert len(archive.voxels) == len(expected["voxels"]) > 1
        for row, voxel in enumerate(expected["voxels"]):
            entry = archive.voxels[row]
            data, links = archive.read_voxel(row)
            assert archive.coordinates[row].tolist() == voxel["coordinate"]
            assert entry["rows"].tolist() == voxel["rows"]
            assert int(entry["leaves"]) == voxel["leaves"]
            assert [entry["low"].tolist(), entry["high"].tolist()] == [voxel["low"], voxel["high"]]
            assert links.height == voxel["height"]
            cells = np.column_stack([data.cells.low, data.cells.log2_size])
            assert cells.tolist() == voxel["cells"]
            assert (None if data.rgb is None else data.rgb.tolist()) == voxel.get("rgb")
            assert (None if data.classification is None else data.classification.tolist()) == voxel.get(
                "classes"
            )


def golden_points(folder: Path) -> np.ndarray:
    """Lattice point, scan and intensity of every point of an archive, (n, 5), in an order of their own.

    With colours, these and the class follow, (n, 9).
    """
    rows = []
    with Archive(folder) as archive:
        for row in range(len(archive.voxels)):
            voxel, links = archive.read_voxel(row)
            local = voxel_points(voxel, links)
            lattice = local + archive.coordinates[row] * archive.header.lattice.voxel_steps
            more = [c for c in (voxel.rgb, voxel.classification) if c is not None]
            rows.append(np.column_stack([lattice, voxel.scan_index, voxel.intensity, *more]))
    table = np.concatenate(rows)
    return table[np.lexsort(table.T)]


def golden_classes(folder: Path) -> dict[tuple[int, ...], int]:
    """The radius class of each place of an archive that has some."""
    classes: dict[tuple[int, ...], int] = {}
    with Archive(folder) as archive:
        for row in range(len(archive.voxels)):
            voxel, links = archive.read_voxel(row)
            assert voxel.radius_class is not None
            lattice = (
                voxel_points(voxel, links) + archive.coordinates[row] * archive.header.lattice.voxel_steps
            )
            for point, found in zip(lattice.tolist(), voxel.radius_class.tolist(), strict=True):
                assert classes.setdefault(tuple(point), found) == found
    return classes


@pytest.mark.parametrize("name", ["archive-2", "archive-3"])
def test_the_golden_archive_holds_the_radius_classes_of_its_points(name: str) -> None:
    classes = golden_classes(GOLDEN / name)
    judged = naive_classes.judge(np.array(list(classes)), "0.001")
    assert classes == {point: found.local + RIM_BIT * found.rim for point, found in judged.items()}


def test_the_golden_archive_holds_the_points_of_its_scans(name: str, expected: dict[str, Any]) -> None:
    built = 2 if name == "archive-3" else SCANS[name]  # before any was added: they make the origin
    tables, lows = [], []
    assert len(expected["sources"]) == SCANS[name]
    for number, (path, *_, count) in enumerate(expected["sources"]):
        rows = np.loadtxt(GOLDEN / path, skiprows=1)
        # Millimetres from UTM 512345, 5612345 and -0.25 m: the numbers the scans were made of.
        steps = np.rint((rows[:, :3] - [512345, 5612345, -0.25]) * 1000)
        lows.append(steps.min(axis=0))
        if count:  # not removed
            more = np.zeros((len(rows), 4 if name == "archive-5" else 0))
            if rows.shape[1] == 8:
                more = rows[:, 4:]
            tables.append(np.column_stack([steps, np.full(len(rows), number), rows[:, 3], more]))
    table = np.concatenate(tables)
    table[:, :3] -= np.min(lows[:built], axis=0)
    assert np.array_equal(golden_points(GOLDEN / name), table[np.lexsort(table.T)])


def test_a_build_today_gives_the_golden_points_and_cells(
    name: str, expected: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(GOLDEN)  # the archive keeps paths as given
    config = BuildConfig(
        voxel=1.0, resolution=0.001, leaf=8, degree=3, cell_points=40, keep=frozenset({"scan", "intensity"}), jobs=1,
        models=frozenset(expected.get("models", ["mean"])),
    )  # fmt: skip
    if name == "archive-5":
        config = replace(config, keep=config.keep | {"rgb", "classification"})
    scans = [Path(f"scan-{number}.xyz") for number in range(SCANS[name])]
    if name == "archive-3":
        build_archive(scans[1::-1], tmp_path / "a", config)
        add_scans(tmp_path / "a", scans[2:], jobs=1)
        remove_scans(tmp_path / "a", ["scan-1.xyz"], jobs=1)
    else:
        build_archive(scans[::-1], tmp_path / "a", config)
    assert np.array_equal(golden_points(tmp_path / "a"), golden_points(GOLDEN / name))
    if name in ("archive-2", "archive-3"):
        assert golden_classes(tmp_path / "a") == golden_classes(GOLDEN / name)
    with Archive(tmp_path / "a") as new, Archive(GOLDEN / name) as golden:
        assert repr(new.header) == repr(golden.header)
        assert new.header.archive_id.hex() == expected["archive_id"]
        for row in range(len(golden.voxels)):
            a, b = new.read_voxel(row)[0], golden.read_voxel(row)[0]
            assert rows_of(a.cells) == rows_of(b.cells)
            if name not in ("archive", "archive-2"):  # which hold the bounds of an older builder
                assert rows_of(a.nodes) == rows_of(b.nodes), "bounds are these to the bit"


def rows_of(part: LeafCells | Nodes) -> list[tuple[Any, ...]]:
    """Return the rows of columns, sorted: in what order they stand below one node of the top hierarchy is free."""
    return sorted(zip(*(column.tolist() for column in part), strict=True))
