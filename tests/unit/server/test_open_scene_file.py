"""What a scene file says, opened: archives, budgets, radius model, avatars for everybody, faults with their place."""

import os
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from solidcloud.schemas.errors import (
    BadRequestError,
    FormatError,
    ScanError,
    UnknownAvatarError,
)
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.encoding import JSON, MSGPACK, decode_answer, encode
from solidcloud.schemas.wire.scene_messages import AvatarInfo, ObjectInfo, SceneInfo, SpawnInfo
from solidcloud.server import open_scene_file
from solidcloud.server import scene as scene_module
from solidcloud.server.archives.placed_archive import PlacedArchive
from solidcloud.server.cli.main import run
from solidcloud.server.cli.scene_files.scene_check import check_scene_file
from solidcloud.server.scene import Scene

pytestmark = pytest.mark.interpreted

TOP = 'format = 1\n[[archives]]\npath = "floor"\n'
BALL = '[[avatars]]\nname = "ball"\nfile = "ball.xyz"\nradius = 0.05\n'
STOP = '[[effects]]\neffect = "stop"\n'


def at(*places: tuple[float, float, float]) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    return poses


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A level floor at z = 0 from -0.5 to 0.5, and a ball."""
    folder = tmp_path_factory.mktemp("scene")
    x, y = np.meshgrid(np.arange(-0.5, 0.55, 0.1), np.arange(-0.5, 0.55, 0.1))
    np.savetxt(folder / "floor.xyz", np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]), fmt="%.4f")
    assert (
        run(["build", str(folder / "floor.xyz"), "-o", str(folder / "floor"), "--voxel", "2", "--jobs", "1"])
        == 0
    )
    (folder / "ball.xyz").write_text("0 0 0\n")
    return folder


Write = Callable[[str], Path]


@pytest.fixture
def write(folder: Path) -> Write:
    def written(text: str) -> Path:
        (folder / "hall.toml").write_text(text)
        return folder / "hall.toml"

    return written


def test_an_archive_is_itself_and_stop(folder: Path) -> None:
    with Scene.open(folder / "floor") as scene:
        assert isinstance(scene, Scene) and scene.name == "floor"
        info = scene.info()
        assert info.effects == ["stop"] and info.avatars == [] and info.spawn is None and info.up == (0, 0, 1)
    with Scene.open(folder / "floor", name="hall") as scene:
        assert scene.name == "hall"


def test_a_scene_has_its_name_its_avatars_and_says_so(write: Write) -> None:
    text = (
        'format = 1\nup = [0, 0, 9]\nradius_model = "fixed:0.02"\n' + TOP[11:] + BALL + STOP
        + '[[objects]]\nname = "b"\navatar = "ball"\nkind = "pushed"\npose = [[1, 0, 0, 5], [0, 1, 0, 5], [0, 0, 1, 5],'
        ' [0, 0, 0, 1]]\n[[effects]]\neffect = "objects"\n[spawn]\nposition = [0, 0, 2]\nheading = 90\n'
    )  # fmt: skip
    with Scene.open(write(text)) as scene:
        assert scene.name == "hall"
        info = scene.info()
        assert info.scene == "hall" and info.effects == ["objects", "stop"] and info.up == (0, 0, 1)
        said = "points: a surface, with nothing inside; z up, unit m"
        assert info.avatars == [AvatarInfo("ball", 1, 0.05, info.avatars[0].bounding_radius, 0, said)]
        assert info.avatars[0].bounding_radius == pytest.approx(0.05, abs=1e-5)
        assert info.spawn == SpawnInfo((0.0, 0.0, 2.0), 90.0) and info.default_radius_model == "fixed:0.02"
        assert info.objects == [ObjectInfo("b", "ball", at((5, 5, 5))[0].tolist(), "pushed")]
        for encoding in (JSON, MSGPACK):
            assert decode_answer(SceneInfo, encode(info, encoding), encoding) == info
        # Of the scan 0.02 m and of the ball 0.05 m, for every client, who need not add it.
        poses = at((0, 0, 0.06), (0, 0, 0.08))
        for client in ("one", "two"):
            answers = scene.collide("ball", poses, client=client)
            assert answers.verdict.tolist() == [Verdict.CONTACT, Verdict.CLEAR]
            mean = scene.collide("ball", poses, client=client, radius_model="mean")
            assert mean.verdict.tolist() == [Verdict.CONTACT, Verdict.CONTACT]
            assert scene.distance("ball", poses[1:], 1.0, client=client).signed_distance == pytest.approx(
                [0.01]
            )
        with pytest.raises(UnknownAvatarError):
            scene.collide("other", poses, client="one")
        (part,) = scene.path("ball", poses, client="one")
        assert part.verdict.tolist() == [Verdict.CONTACT, Verdict.CLEAR]
        same = scene.add_avatar("ball", [[0, 0, 0]], 0.05, client="one")
        assert same == structs.replace(info.avatars[0], description="")
        with pytest.raises(BadRequestError, match="'ball' exists with other points or another radius"):
            scene.add_avatar("ball", [[0, 0, 1]], 0.05, client="one")
        scene.drop_client("one")
        assert scene.collide("ball", poses[1:], client="one").verdict.tolist() == [Verdict.CLEAR]


@pytest.mark.parametrize(
    "second", ["", "pose = [[0, -1, 0, 10], [1, 0, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]\n"]
)
def test_several_archives_answer_as_one(write: Write, second: str) -> None:
    text = TOP + '[[archives]]\npath = "floor"\n' + second + BALL + STOP
    with Scene.open(write(text), budget_bytes=64 << 20) as scene:
        info = scene.info()
        assert (info.points, info.scene, info.effects) == (242, "hall", ["stop"])
        answers = scene.collide("ball", at((0.5, 0.5, 0.05), (9.5, 0.5, 2.05)), client="any")
        assert answers.verdict.tolist() == [Verdict.CONTACT, Verdict.CONTACT if second else Verdict.CLEAR]
        assert 0 < scene.stats().budget_bytes <= 64 << 20


def test_what_is_passed_through_lies_in_the_world_for_each_archive(write: Write) -> None:
    """The second floor stands upright behind the first, which has points at the same places of its own frame."""
    second = (
        '[[archives]]\npath = "floor"\npose = [[1, 0, 0, 0], [0, 0, -1, 5], [0, 1, 0, 1], [0, 0, 0, 1]]\n'
    )
    through = (
        '[[effects]]\neffect = "through"\nboxes = [{name = "hatch", low = [-0.25, 4, 0.75], high = [0.25, 6, 1.25]}, '
        '{name = "drain", low = [0.25, 0.25, -1], high = [1, 1, 1]}]\n'
    )
    spawn = "[spawn]\nposition = [0, 5, 1.5]\n"
    file = write(TOP + second + BALL + STOP + through + spawn)
    places = at((0, 5, 1), (0.4, 5, 1), (0, 0, 0), (0.4, 0.4, 0))
    with Scene.open(file, policy="lru+prefetch") as scene:
        expected = [Verdict.CLEAR, Verdict.CONTACT, Verdict.CONTACT, Verdict.CLEAR]
        assert scene.collide("ball", places, client="any").verdict.tolist() == expected
        assert scene.stats().policy == "lru+prefetch"
    # 25 points of the one, 9 of the other; users begin within what is scanned, but for two metres more.
    checked = check_scene_file(file)
    assert checked.left_out == 25 + 9 and not [note for note in checked.notes if "spawn" in note]
    outside = check_scene_file(write(file.read_text().replace("5, 1.5]", "7, 1.5]")))
    assert [note for note in outside.notes if "spawn lies outside the bounds" in note]


@pytest.mark.parametrize(
    ("text", "kind", "said"),
    [
        (TOP.replace("floor", "wall"), FormatError, "$.archives[0].path: {}/wall: no archive here"),
        (TOP + BALL.replace(".xyz", ".ply"), ScanError, "$.avatars[0].file: {}/ball.ply: no such file"),
        (TOP + BALL.replace("radius = 0.05", ""), BadRequestError, "$.avatars[0]: avatar of a single distinct point"),
        (
            'format = 1\nradius_model = "local"\n' + TOP[11:], BadRequestError,
            "$.radius_model: {}/floor: radius model 'local': this archive stores mean",
        ),
        (
            TOP + BALL.replace("0.05", "4.5") + STOP + '[[effects]]\neffect = "crowd"\n', BadRequestError,
            "$.avatars[0]: avatar radius 4.5 m: expected at most 4 m with the effect `objects` or `crowd`, under which "
            "avatars collide with others",
        ),
        (TOP + '[[archives]]\npath = "ball.xyz"\n', FormatError, "$.archives[1].path: {}/ball.xyz"),
    ],
)  # fmt: skip
def test_a_fault_of_what_is_named_has_the_file_and_the_place(
    folder: Path, write: Write, text: str, kind: type[Exception], said: str
) -> None:
    file = write(text)
    with pytest.raises(kind) as found, Scene.open(file):
        pass
    assert str(found.value).startswith(f"{file}: {said.format(folder)}")
    with pytest.raises(kind) as checked:
        check_scene_file(file)
    assert str(checked.value) == str(found.value)


def test_too_small_a_cache_is_told(write: Write) -> None:
    with (
        pytest.raises(
            BadRequestError, match=r"hall.toml: \$.archives\[0\]: cache of 10 bytes: the largest voxel"
        ),
        Scene.open(write(TOP), budget_bytes=10),
    ):
        pass
    two = write(TOP + '[[archives]]\npath = "floor"\n')
    with (
        pytest.raises(
            BadRequestError, match=r"hall.toml: \$.archives: cache of 10 bytes: the largest voxels of 2"
        ),
        Scene.open(two, budget_bytes=10),
    ):
        pass


@pytest.mark.parametrize(
    "fails", ["store_opener", "make_simulation", "share_budget", "PlacedArchive.__init__", "Scene.__init__"]
)
def test_what_fails_half_way_leaves_no_file_open(
    write: Write, monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    through = '[[effects]]\neffect = "through"\nboxes = [{name = "hole", low = [-0.25, -9, -1], high = [0.25, 9, 1]}]\n'
    file = write(TOP + '[[archives]]\npath = "floor"\n' + BALL + STOP + through)
    with Scene.open(file):  # what it imports opens files
        pass
    calls: list[int] = []
    place, _, method = fails.partition(".")
    places = {"Scene": Scene, "PlacedArchive": PlacedArchive, "make_simulation": scene_module}
    at_fault: Any = places.get(place, open_scene_file)
    name = method or place
    right = getattr(at_fault, name)

    def fault(*what: Any, **options: Any) -> Any:
        calls.append(1)
        if len(calls) == 2 or place not in ("store_opener", "PlacedArchive"):
            raise BadRequestError("no")
        return right(*what, **options)

    monkeypatch.setattr(at_fault, name, fault)
    before, threads = os.listdir("/proc/self/fd"), set(threading.enumerate())
    with (
        pytest.raises(BadRequestError, match=r"hall.toml: \$.*no"),
        Scene.open(file, policy="lru+prefetch"),
    ):
        pass
    assert calls and len(os.listdir("/proc/self/fd")) == len(before)
    assert set(threading.enumerate()) <= threads


def test_a_reload_finds_where_a_link_points_then(folder: Path, tmp_path: Path) -> None:
    """As it does of an archive that is served without a file; and the working directory may change meanwhile."""
    (tmp_path / "one/deep").mkdir(parents=True)
    shutil.copytree(folder / "floor", tmp_path / "first")
    (tmp_path / "more.xyz").write_text("0 0 0\n0.1 0 0\n0 0.1 0\n")
    build = [
        "build",
        str(tmp_path / "more.xyz"),
        "-o",
        str(tmp_path / "second"),
        "--voxel",
        "2",
        "--jobs",
        "1",
    ]
    assert run(build) == 0
    (tmp_path / "current").symlink_to("first")
    (tmp_path / "linked").symlink_to("one/deep")
    (tmp_path / "one/deep/hall.toml").write_text('format = 1\n[[archives]]\npath = "./../../current/"\n')
    with Scene.open(tmp_path / "linked/hall.toml") as scene:
        assert scene.info().points == 121
        (tmp_path / "current").unlink()
        (tmp_path / "current").symlink_to("second")
        assert scene.reload().points == scene.info().points == 3
