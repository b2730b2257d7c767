"""Test each way in which a file, a scan or a point is left out: no place of a point may become clear (issue 35)."""

import contextlib
import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from broken_scans import SEEDS, with_checksums, write_seeds
from intact_points import Damaged, Field, Whole, describe, las_boxes
from scan_formats import cartesian, glb_document, glb_vertices, write_e57, write_glb
from small_builds import build
from solidcloud.builder.edit.edit_archive import add_scans
from solidcloud.builder.passes.survey_pass import hash_file, join_ranges, ranges, survey_range
from solidcloud.builder.sources.scan_files import (
    find_scan_files,
    header_bounds,
    inspect_scans,
    open_input_files,
    open_scans,
)
from solidcloud.builder.sources.scan_list import write_scan_list
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import ScanError
from synthetic_scans import write_xyz

XYZ = np.random.default_rng(3).uniform(-4, 4, (12, 3)).round(2)


def read(path: Path, spacing: float | None = None) -> int:
    """Return the number of points of a file."""
    return sum(len(b.xyz) for scan in open_scans(path, spacing=spacing) for b in scan.blocks())


@pytest.fixture(scope="module")
def wholes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Whole]:
    folder = tmp_path_factory.mktemp("seeds")
    return {name: describe(name, folder / name) for name in write_seeds(folder)}


@pytest.mark.parametrize("name", [name for name in SEEDS if Path(name).suffix not in (".las", ".laz")])
def test_no_count_that_is_too_small_hides_points(name: str, wholes: dict[str, Whole], tmp_path: Path) -> None:
    whole = wholes[name]
    for group in whole.counts:
        for value in (0, 1, lambda old: old - 1, lambda old: old // 2):
            broken = Damaged(whole, np.random.default_rng(1))
            for field in sorted(group, key=lambda f: f.span, reverse=True):
                broken.field(field, changed(whole, field, value))
            data = bytes(broken.data)
            (tmp_path / name).write_bytes(with_checksums(data) if name.endswith(".e57") else data)
            with contextlib.suppress(ScanError):
                assert read(tmp_path / name) >= len(whole.points), (group, value)


def changed(whole: Whole, field: Field, value: int | Callable[[int], int]) -> int:
    """Return the number to write into a field."""
    raw = whole.data[slice(*field.span)]
    return value(int(raw) if not field.form else int.from_bytes(raw, "little")) if callable(value) else value


@pytest.mark.parametrize("value", [0, 1, lambda old: max(0, old - 1), lambda old: 3 * old])
@pytest.mark.parametrize("name", ["plain.las", "new.las", "old.laz", "layered.laz", "variable.laz"])
def test_a_box_that_a_later_point_contradicts_is_not_believed(
    name: str, value: int | Callable[[int], int], wholes: dict[str, Whole], tmp_path: Path
) -> None:
    """The box holds the first point alone, and the count is wrong, so that not all points are read."""
    whole = wholes[name]
    path = tmp_path / name
    regions = []
    for corners in (las_boxes(whole.points), las_boxes(np.add(whole.points[:1], [[-0.1] * 3, [0.1] * 3]))):
        broken = Damaged(whole, np.random.default_rng(1))
        for field, number in zip(whole.boxes, corners, strict=True):
            broken.field(field, number)
        for field in whole.counts[0]:
            broken.field(field, changed(whole, field, value))
        path.write_bytes(broken.data)
        (item,) = open_input_files([path])
        surveys = [
            join_ranges(s, [survey_range(u) for u in ranges(s, 9)], hash_file(path)) for s in item.scans
        ]
        assert item.fault or surveys[0].fault
        regions.append(surveys[0].region if surveys else item.region)
    assert regions[0] is not None
    assert regions[1] is None


def test_a_vertex_count_before_faces_of_any_kind_is_checked(tmp_path: Path) -> None:
    """Faces may have lists of any type, several, and values beside them."""
    rows = np.arange(30, dtype="<f4").tobytes()
    face = b"".join(
        bytes([n]) + np.arange(n, dtype="<i4").tobytes() + b"c" + np.int32(1).tobytes() + b"\7\7"
        for n in (3, 4, 3)
    )
    head = (
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\n"
        "property float x\nproperty float y\nproperty float z\n"
        "element face 3\nproperty list uchar int vertex_indices\nproperty char flag\nproperty list int short more\n"
        "element end 1\nproperty double w\nend_header\n"
    )
    path = tmp_path / "a.ply"
    path.write_bytes(head.format(10).encode() + rows + face + bytes(8) + b"\n\0\0")
    assert read(path) == 10
    for count in (0, 5, 9):
        path.write_bytes(head.format(count).encode() + rows + face + bytes(8))
        with pytest.raises(ScanError, match=r"its header (is|may be) damaged"):
            read(path)


LOST: dict[str, Callable[[dict], object]] = {
    "mesh": lambda d: d["nodes"][0].update(mesi=d["nodes"][0].pop("mesh")),
    "nodes of a scene": lambda d: d["scenes"][0].update(nodds=d["scenes"][0].pop("nodes")),
    "children": lambda d: d.update(nodes=[{"chiLdren": [1]}, {"mesh": 0}]),
    "positions": lambda d: d["meshes"][0]["primitives"][0].update(attributes={"POSITIOM": 0}),
    "a move": lambda d: d["nodes"][0].update(translatiom=[1, 2, 3]),
    "an offset": lambda d: d["accessors"][0].update(byteOffseT=4),
    "several letters": lambda d: d.update(nodes=[{"ch\ufffd5:en": [1]}, {"mesh": 0}, {"mesh": 0}]),
    "all meshes": lambda d: d["scenes"][0].update(nodes=[]),
    "a scene": lambda d: d.update(scenf=d.pop("scene")),
    "attributes": lambda d: (
        d["accessors"].append({**d["accessors"][0], "count": 3}),
        d["meshes"][0]["primitives"][0]["attributes"].update(NORMAL=2),
    ),
}


@pytest.mark.parametrize("lost", LOST)
def test_a_damaged_name_in_a_glb_loses_no_mesh(lost: str, tmp_path: Path) -> None:
    document = glb_document(4)
    assert read(write_glb(tmp_path / "whole.glb", document, glb_vertices(XYZ[:4]))) == 4
    LOST[lost](document)
    with pytest.raises(ScanError, match="expected"):
        read(write_glb(tmp_path / "a.glb", document, glb_vertices(XYZ[:4])))


def test_names_of_other_programs_in_a_glb_are_ignored(tmp_path: Path) -> None:
    document = glb_document(4)
    document["notes"] = "beside 'nodes'"
    document["nodes"][0].update(layer="roof", visible=True, skip=False, game=1)
    document["meshes"][0]["primitives"][0]["attributes"].update(BATCHID=0)
    assert read(write_glb(tmp_path / "a.glb", document, glb_vertices(XYZ[:4]))) == 4


def test_pictures_and_shared_views_of_a_glb_are_no_vertices_left_out(tmp_path: Path) -> None:
    """Two meshes share a view; a picture follows in a view that no accessor uses."""
    document = json.loads(json.dumps(glb_document(4)))
    document["accessors"] = [
        {"bufferView": 0, "componentType": 5126, "count": 2, "type": "VEC3"},
        {"bufferView": 0, "componentType": 5126, "count": 2, "type": "VEC3", "byteOffset": 32},
    ]
    document["bufferViews"][1] = {"buffer": 0, "byteOffset": 64, "byteLength": 40}
    document["meshes"].append({"primitives": [{"attributes": {"POSITION": 1}}]})
    document["nodes"].append({"mesh": 1})
    document["scenes"][0]["nodes"] = [0, 1]
    path = write_glb(tmp_path / "a.glb", document, glb_vertices(XYZ[:4]) + b"p" * 40)
    assert read(path) == 4
    document["accessors"][1]["count"] = 1
    with pytest.raises(ScanError, match="further vertices, which nothing uses, behind 1"):
        read(write_glb(path, document, glb_vertices(XYZ[:4]) + b"p" * 40))


def test_bounds_of_an_e57_are_believed_only_with_its_checksums(tmp_path: Path) -> None:
    path = write_e57(tmp_path / "a.e57", [{"columns": cartesian(XYZ), "bounds": [[-4] * 3, [4.5] * 3]}])
    assert np.array_equal(header_bounds(path), [[-4] * 3, [4.5] * 3])
    path.write_bytes(path.read_bytes().replace(b"4.5", b"0.5", 1))
    with pytest.raises(ScanError, match="checksum"):
        open_scans(path)
    assert header_bounds(path) is None


def test_triangles_that_are_all_left_out_were_somewhere(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 nan\nf 1 2 3\n")
    (scan,) = open_scans(path, spacing=0.1)
    survey = join_ranges(scan, [survey_range(unit) for unit in ranges(scan, 0)], hash_file(path))
    assert survey.fault and (survey.empty, survey.region) == (False, None)


@pytest.mark.parametrize("face", ["f 1 2", "f", "f 1 2 0", "f 1,2,3", "f 1 2 x"])
def test_a_broken_face_is_refused_and_not_left_out(face: str, tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 2/1 3//1\nf 1 2 \\\n3\n{face}\n")
    with pytest.raises(ScanError):
        read(path, spacing=0.1)
    assert read(path) == 3


def test_a_folder_that_cannot_be_listed_is_not_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_xyz(tmp_path / "a.xyz", XYZ)
    (tmp_path / "closed").mkdir()
    scandir = os.scandir

    def refused(path: str) -> object:
        if str(path).endswith("closed"):
            raise PermissionError(13, "Permission denied", str(path))
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refused)
    with pytest.raises(ScanError, match=r"closed: a folder that cannot be listed \(Permission denied\)"):
        find_scan_files([tmp_path])


def test_a_file_whose_name_alone_is_that_of_a_companion_is_a_scan(tmp_path: Path) -> None:
    write_xyz(tmp_path / "._a.xyz", XYZ)
    (tmp_path / "._b.xyz").write_bytes(b"\x00\x05\x16\x07 attributes")
    assert [path.name for path in find_scan_files([tmp_path])] == ["._a.xyz"]


def test_a_scan_that_its_file_has_lost_is_not_where_the_others_are(tmp_path: Path) -> None:
    path = write_e57(tmp_path / "a.e57", [{"columns": cartesian(XYZ), "bounds": [[-4] * 3, [4] * 3]}] * 2)
    write_scan_list(tmp_path / "a.toml", inspect_scans([path]))
    write_e57(path, [{"columns": cartesian(XYZ), "bounds": [[-4] * 3, [4] * 3]}])
    (item,) = open_input_files([tmp_path / "a.toml"])
    assert "holds 1 scans, expected one of index 1" in item.fault
    assert item.region is None


def test_a_file_stays_unknown_until_all_its_scans_are_added(tmp_path: Path) -> None:
    path = write_e57(tmp_path / "two.e57", [{"columns": cartesian(XYZ)}, {"columns": cartesian(XYZ + 20)}])
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])
    target = tmp_path / "x"
    build([write_xyz(tmp_path / "a.xyz", XYZ + 50), path], target, skip_bad=True)
    path.write_bytes(whole)
    for index, everywhere in ((0, True), (1, False)):
        write_scan_list(tmp_path / "one.toml", [e for e in inspect_scans([path]) if e.index == index])
        add_scans(target, [tmp_path / "one.toml"], jobs=1)
        with Archive(target) as archive:
            assert archive.header.unknown_everywhere is everywhere
