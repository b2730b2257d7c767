"""What `add_avatar` takes: arrays, files and meshes, in Scene and Client alike."""

import struct
import sys
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import pytest
import synthetic_scans
import trimesh
from msgspec import structs
from solidcloud.builder.synthetic.figure import figure_points, write_figure
from solidcloud.schemas.errors import BadRequestError, ScanError, TooLargeError
from solidcloud.server.avatars.avatar_shape import avatar_shape
from solidcloud.server.client import Client
from solidcloud.server.scene import Scene

BOX = trimesh.creation.box((0.5, 0.5, 0.5))
POINTS = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.0, 0.2, 0]])


class Mesh:
    """A mesh of any library."""

    def __init__(self, vertices: Any, faces: Any = None) -> None:
        self.vertices = vertices
        if faces is not None:
            self.faces = faces


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """A scene of one point at the origin."""
    return Scene.open(archive_cases.build(tmp_path, np.zeros((1, 3)), radius=0.01).archive, "dot")


def at(x: float) -> np.ndarray:
    """A pose (1, 4, 4) at x."""
    pose = np.eye(4)[None].copy()
    pose[0, 0, 3] = x
    return pose


def test_an_array_is_taken_as_it_is() -> None:
    assert avatar_shape(POINTS, 0.1).points is POINTS
    assert avatar_shape(POINTS.tolist()) == (POINTS.tolist(), None, 0, "")
    shape = avatar_shape(BOX, 0.1)
    assert avatar_shape(shape).points is shape.points
    with pytest.raises(BadRequestError, match="up and units for an avatar that is no file"):
        avatar_shape(BOX, 0.1, up="y")


@pytest.mark.parametrize("kind", ["stl", "ascii.stl", "obj", "ply", "glb"])
def test_a_mesh_file_is_solid(scene: Scene, tmp_path: Path, kind: str) -> None:
    file = tmp_path / f"box.{kind}"
    file_type = "stl_ascii" if kind == "ascii.stl" else kind
    file.write_bytes(data if isinstance(data := BOX.export(file_type=file_type), bytes) else data.encode())
    for name, given in (("text", str(file)), ("path", file)):
        info = scene.add_avatar(name, given)
        assert info.points > 5_000 and info.radius == pytest.approx(np.sqrt(1.5) / 100, abs=1e-6)
        # The scan's point lies on the middle of a side, far from any corner of the box.
        verdicts = scene.collide(name, np.concatenate([at(0.25), at(0.25 + 0.03), at(0.0)])).verdict
        assert verdicts.tolist() == [1, 0, 1], "the box, and what is inside"
        hollow = scene.add_avatar(f"hollow {name}", given, hollow=True)
        assert scene.collide(hollow.name, at(0.0)).verdict.tolist() == [0], "a surface, and nothing inside"
        assert hollow.points == info.points - info.inner_points and hollow.inner_points == 0
    assert np.array_equal(avatar_shape(file, 0.1).points, avatar_shape(BOX, 0.1).points)


@pytest.mark.parametrize("scale", [1.02, 0.001, 1000.0])
def test_a_scaled_avatar_is_the_one_whose_points_were_multiplied(tmp_path: Path, scale: float) -> None:
    BOX.export(tmp_path / "box.stl")
    np.savetxt(tmp_path / "body.xyz", POINTS)
    vertices, faces = BOX.vertices * scale, BOX.faces
    for source, by_hand in (
        (POINTS, POINTS * scale),
        (avatar_shape(POINTS, 0.1), avatar_shape(POINTS * scale, 0.1 * scale)),
        (tmp_path / "body.xyz", POINTS * scale),
        (BOX, Mesh(vertices, faces)),
        (tmp_path / "box.stl", Mesh(vertices, faces)),
        (trimesh.PointCloud(POINTS), POINTS * scale),
    ):
        found, expected = avatar_shape(source, 0.1, scale=scale), avatar_shape(by_hand, 0.1 * scale)
        assert np.array_equal(found.points, expected.points)
        assert found.radius == expected.radius and found.inner_points == expected.inner_points
    assert avatar_shape(POINTS, scale=scale).radius is None, "measured on the scaled points"


@pytest.mark.parametrize("scale", [0.0, -1.0, 0.0009, 1001.0, np.nan, np.inf])
def test_a_scale_out_of_range_is_refused(scale: float) -> None:
    with pytest.raises(BadRequestError, match=r"avatar scale .*: expected 0\.001 to 1000"):
        avatar_shape(POINTS, 0.1, scale=scale)


def test_points_of_a_file_are_taken_as_they_are(tmp_path: Path) -> None:
    figure = figure_points(200)
    for name in ("figure.obj", "figure.ply"):
        write_figure(tmp_path / name, figure)
        assert np.array_equal(avatar_shape(tmp_path / name).points, figure), "vertices without faces"
        assert avatar_shape(tmp_path / name, 0.1).radius == 0.1
    synthetic_scans.write_las(tmp_path / "body.laz", np.rint(POINTS * 1000).astype(np.int32))
    assert np.allclose(avatar_shape(tmp_path / "body.laz").points, POINTS, atol=1e-3)
    (tmp_path / "body.xyz").write_text("0 0 0\n1 2 3\n")
    assert np.array_equal(avatar_shape(tmp_path / "body.xyz").points, [[0, 0, 0], [1, 2, 3]])


def lying(kind: str, folder: Path) -> Path:
    """A file of a person of 1.75 m who lies along y, in millimetres."""
    person = trimesh.creation.box((500.0, 1750.0, 300.0)).apply_translation([0.0, 875.0, 0.0])
    file = folder / f"person.{kind}"
    corners = np.asarray(person.vertices)
    if kind in ("stl", "obj", "ply", "glb"):
        person.export(file)
    elif kind == "laz":
        synthetic_scans.write_las(file, np.rint(corners * 1000).astype(np.int32))
    else:
        np.savetxt(file, corners)
    return file


@pytest.mark.parametrize("kind", ["stl", "obj", "ply", "glb", "xyz", "laz"])
def test_the_up_axis_and_unit_of_any_file_are_taken_issue_35(tmp_path: Path, kind: str) -> None:
    file = lying(kind, tmp_path)
    shape = avatar_shape(file, 0.05, up="y", units="mm")
    assert np.allclose(np.ptp(shape.surface, axis=0), [0.5, 0.3, 1.75], atol=1e-6)
    assert np.allclose(shape.surface.min(axis=0), [-0.25, -0.15, 0.0], atol=1e-6)
    assert shape.description.endswith("; y up, unit mm")
    plain = avatar_shape(file, 50.0)
    assert np.argmax(np.ptp(plain.surface, axis=0)) == (2 if kind == "glb" else 1)
    assert plain.description.endswith("; y up (glTF), unit m" if kind == "glb" else "; z up, unit m")
    if kind == "glb":
        assert np.argmax(np.ptp(avatar_shape(file, 50.0, up="z").surface, axis=0)) == 1
    for word in ({"up": "w"}, {"units": "feet"}):
        with pytest.raises(
            BadRequestError, match=r"person.* expected one of (z, y, x|m, mm, cm, dm, km, in, ft)"
        ):
            avatar_shape(file, **word)


def test_a_trimesh_object_or_anything_like_it_is_solid(scene: Scene) -> None:
    info = scene.add_avatar("box", BOX, 0.02)
    assert info.radius == 0.02 and info.points > 1_000
    assert scene.add_avatar("box", Mesh(BOX.vertices.tolist(), BOX.faces.tolist()), 0.02) == info
    assert scene.add_avatar("box", trimesh.Scene(BOX), 0.02) == info
    both = trimesh.Scene([BOX, BOX.copy().apply_translation([3.0, 0, 0])])
    two = scene.add_avatar("two", both, 0.02)
    assert two.points - two.inner_points == 2 * (info.points - info.inner_points)
    assert two.inner_points == pytest.approx(2 * info.inner_points, rel=0.02), "each on a common lattice"
    assert scene.add_avatar("cloud", trimesh.PointCloud(POINTS), 0.02).points == len(POINTS)
    assert scene.add_avatar("vertices", Mesh(POINTS), 0.02).points == len(POINTS)


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (Mesh(POINTS, [[0, 1, 3]]), "mesh with a face of vertex 3: expected rows of its 3 vertices"),
        (Mesh(POINTS, [[0, 1, -1]]), "mesh with a face of vertex -1"),
        (
            Mesh(POINTS, [[0, 1, 2, 0]]),
            r"faces of shape \(1, 4\) .*: expected \(n, 3\) integers: triangulate it",
        ),
        (Mesh(POINTS, [[0.0, 1.0, 2.0]]), "type float64: expected"),
        (Mesh(POINTS * np.nan, [[0, 1, 2]]), "vertices of the mesh.* is nan, expected finite numbers"),
        (Mesh(POINTS[:, :2], [[0, 1, 2]]), r"vertices of the mesh of shape \(3, 2\): expected \(n, 3\)"),
    ],
)
def test_a_mesh_that_is_none_is_refused(scene: Scene, mesh: Mesh, message: str) -> None:
    with pytest.raises(BadRequestError, match=message):
        scene.add_avatar("al", mesh)


def test_a_file_that_is_none_is_refused(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "empty.obj").write_text("# nothing\n")
    (tmp_path / "box.step").write_text("ISO-10303-21;\n")
    broken = BOX.export(file_type="stl")[:-40]
    (tmp_path / "cut.stl").write_bytes(broken)
    (tmp_path / "wild.stl").write_bytes(
        bytes(80) + struct.pack("<I12fH", 1, *[0.0] * 3, *[0.0, 0, 0, 1, 0, 0, 0, float("nan"), 0], 0)
    )
    for name, error, message in (
        ("nowhere.obj", ScanError, "no such file or folder"),
        ("empty.obj", ScanError, "contains no point: expected at least one: choose another file"),
        ("box.step", ScanError, "the suffix '.step', expected one of .las"),
        ("cut.stl", ScanError, "the 12 its header declares"),
        ("wild.stl", BadRequestError, "wild.stl: a vertex that is not finite"),
    ):
        with pytest.raises(error, match=message):
            scene.add_avatar("al", tmp_path / name)


@pytest.mark.parametrize(("kind", "library"), [("obj", "trimesh"), ("ply", "plyfile"), ("laz", "lazrs")])
def test_a_missing_reader_is_named_with_the_extra_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, library: str
) -> None:
    file = tmp_path / f"body.{kind}"
    if kind == "laz":
        synthetic_scans.write_las(file, np.rint(POINTS * 1000).astype(np.int32))
    else:
        BOX.export(file)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ScanError, match=rf"library '{library}'.* pip install 'solidcloud\[readers\]'"):
        avatar_shape(file)


def refusals(add: Any) -> list[str]:
    """The messages with which invalid avatars are refused."""
    found = []
    for name, points, radius in (
        ("al", np.empty((0, 3)), None),
        ("al", np.empty((0, 3)), 0.1),
        ("", POINTS, 0.1),
        ("a" * 65, POINTS, 0.1),
        (7, POINTS, 0.1),
        ("al", POINTS, -1.0),
        ("al", POINTS, float("nan")),
        ("al", POINTS[:, :2], 0.1),
        ("al", "nowhere.obj", 0.1),
        ("al", np.zeros((1_000_001, 3)), 0.1),
    ):
        with pytest.raises((BadRequestError, ScanError, TooLargeError)) as caught:
            add(name, points, radius)
        found.append(str(caught.value))
    return found


def test_scene_and_client_refuse_the_same_avatars_with_the_same_words(scene: Scene) -> None:
    found = refusals(scene.add_avatar)
    assert found == refusals(Client(scene="dot").add_avatar), "before anything is sent"
    assert found[0].startswith("avatar 'al' has no points: expected at least one")
    assert (
        "of 0 characters: expected 1 to 64" in found[2]
        and "avatar named by a int: expected a string" in found[4]
    )


def test_a_mesh_of_a_scene_file_is_solid(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "box.stl").write_bytes(BOX.export(file_type="stl"))
    archive = next(path.parent for path in tmp_path.rglob("index.h5"))
    file = tmp_path / "hall.toml"
    top = f'format = 1\n[[archives]]\npath = "{archive}"\n'
    file.write_text(top + '[[avatars]]\nname = "al"\nfile = "box.stl"\nradius = 0.02\n')
    with Scene.open(file) as opened:
        found = opened.info().avatars[0]
        assert found.description == "closed mesh, filled; z up, unit m"
        assert structs.replace(found, description="") == structs.replace(
            scene.add_avatar("al", BOX, 0.02), description=""
        )
        assert opened.collide("al", np.concatenate([at(0.25), at(0.0)])).verdict.tolist() == [1, 1]
    file.write_text(file.read_text() + 'hollow = true\nup = "y"\nunits = "cm"\nscale = 2\n')
    with Scene.open(file) as opened:
        assert opened.info().avatars[0].description.startswith("mesh, hollow: a surface")
        assert opened.info().avatars[0].description.endswith("; y up, unit cm")


def test_a_file_of_a_scene_without_points_is_refused_with_its_place(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "empty.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    file = tmp_path / "hall.toml"
    archive = next(path.parent for path in tmp_path.rglob("index.h5"))
    file.write_text(
        f'format = 1\n[[archives]]\npath = "{archive}"\n[[avatars]]\nname = "al"\nfile = "empty.ply"\n'
    )
    with pytest.raises(ScanError, match=r"hall.toml: \$.avatars\[0\].file: .*empty.ply: contains no point"):
        Scene.open(file)
