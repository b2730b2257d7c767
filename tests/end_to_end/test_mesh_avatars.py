"""Test meshes as avatars over zenoh and on the command line, issue 35: filled, turned, scaled."""

import json
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import trimesh
from solidcloud.server.cli.main import run
from solidcloud.server.client import Client
from solidcloud.server.report.walk.server_process import served

# Poses of a hull of 1.2 m over a post: around it, with a side on it, and beside it.
PLACES = (0.0, 0.6, 1.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An archive of a post, 0.8 m high, a hull that lies along y in millimetres, and poses."""
    folder = tmp_path_factory.mktemp("post")
    angle, height = np.meshgrid(np.arange(0, 6.28, 0.2), np.arange(0.2, 1.0, 0.02))
    post = np.stack([0.05 * np.cos(angle), 0.05 * np.sin(angle), height], axis=-1).reshape(-1, 3)
    archive_cases.build(folder, post, resolution=1e-4, radius=0.005).archive.rename(folder / "post")
    hull = trimesh.creation.box((1200, 1500, 1200)).apply_translation([0, 750, 0])
    (folder / "hull.stl").write_bytes(hull.export(file_type="stl"))
    hull.apply_scale(1e-3)
    (folder / "hull.glb").write_bytes(hull.export(file_type="glb"))
    rows = "".join(f"{t},{x},0,0,1,0,0,0\n" for t, x in enumerate(PLACES))
    (folder / "poses.csv").write_text("t,x,y,z,qw,qx,qy,qz\n" + rows)
    return folder


def test_a_hull_that_swallows_a_post_touches_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ask = ["query", "--scene", "post", "--poses", str(folder / "poses.csv"), "--json"]
    of_stl = ["--avatar", str(folder / "hull.stl"), "--avatar-up", "y", "--avatar-units", "mm"]
    poses = np.tile(np.eye(4), (len(PLACES), 1, 1))
    poses[:, 0, 3] = PLACES
    with served(folder / "post", "post") as endpoint:
        for options, said, verdicts in (
            (of_stl, "closed mesh, filled; y up, unit mm", ["contact", "contact", "clear"]),
            ([*of_stl, "--avatar-hollow"], "mesh, hollow: a surface", ["clear", "contact", "clear"]),
            (
                ["--avatar", str(folder / "hull.glb")],
                "closed mesh, filled; y up (glTF), unit m",
                ["contact", "contact", "clear"],
            ),
        ):
            assert run([*ask, "--connect", endpoint, *options]) == 0
            found = capsys.readouterr()
            assert [answer["verdict"] for answer in json.loads(found.out)["answers"]] == verdicts
            assert f"avatar {Path(options[1]).name}: " in found.err and said in found.err
        with Client(endpoint, scene="post") as client:
            info = client.add_avatar("hull", folder / "hull.glb")
            assert info.inner_points > 10_000 and info.description.startswith("closed mesh, filled")
            assert client.collide("hull", poses).verdict.tolist() == [1, 1, 0]
            hollow = client.add_avatar("hollow", folder / "hull.glb", hollow=True)
            assert hollow.points == info.points - info.inner_points
            assert client.distance("hull", poses).signed_distance[0] < 0
            with client.session("hull") as session:
                state = session.wait(session.wish(pose=poses[2]), 20.0)
                assert state is not None and state.pose[0, 0, 3] == 1.0


def test_a_new_scene_file_keeps_the_axes_and_unit(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = folder / "scene.toml"
    new = ["scene", "new", str(folder / "post"), "-o", str(file), "--avatar", str(folder / "hull.stl")]
    assert run([*new, "--avatar-up", "y", "--avatar-units", "mm", "--avatar-hollow"]) == 0
    assert 'up = "y"\nunits = "mm"\nhollow = true\n' in file.read_text()
    capsys.readouterr()
    assert run(["scene", "check", str(file), "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)["avatars"]
    assert found["description"] == "mesh, hollow: a surface, with nothing inside; y up, unit mm"
    assert run([*new, "--overwrite", "--avatar-units", "mm"]) == 0
    assert run(["scene", "check", str(file)]) == 0
    assert "closed mesh, filled; z up, unit mm" in " ".join(capsys.readouterr().out.split())
    assert run([*new, "--overwrite", "--avatar-up", "w"]) != 0
    assert "expected" in capsys.readouterr().err
