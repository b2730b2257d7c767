"""Test `solidcloud scene new` and `scene check`: file, table, one-line errors, exit codes."""

import errno
import json
import os
import re
import shutil
from pathlib import Path

import pytest
from solidcloud.schemas.runtime.new_file import is_temporary
from solidcloud.schemas.scene.scene_file import parse_scene, read_scene
from solidcloud.server.cli.main import run
from solidcloud.server.cli.scene_files import scene_new

pytestmark = pytest.mark.interpreted

GOLDEN = Path(__file__).resolve().parents[4] / "golden"
TOP = 'format = 1\n[[archives]]\npath = "scans/hall"\n'
VISITOR = '[[avatars]]\nname = "visitor"\nfile = "visitor.xyz"\n'
STOP = '[[effects]]\neffect = "stop"\n'


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with an archive and an avatar; the working directory is another."""
    shutil.copytree(GOLDEN / "archive-3", tmp_path / "scans/hall")
    (tmp_path / "visitor.xyz").write_text("0 0 0\n0.1 0 0\n0 0.1 0.5\n")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    return tmp_path


@pytest.fixture(autouse=True)
def no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Find no spawn: a search takes minutes with interpreted kernels (test_spawn_search.py)."""
    monkeypatch.setattr(scene_new, "find_spawn", lambda *_: None)


def new(folder: Path, *arguments: str) -> int:
    return run(["scene", "new", str(folder / "scans/hall"), "-o", str(folder / "hall.toml"), *arguments])


def check(folder: Path, text: str, *arguments: str) -> int:
    (folder / "hall.toml").write_text(text)
    return run(["scene", "check", str(folder / "hall.toml"), *arguments])


def one_error(capsys: pytest.CaptureFixture[str]) -> str:
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: "), lines
    return lines[0]


def test_a_new_scene_is_the_archive_and_stop(folder: Path) -> None:
    assert new(folder) == 0
    found = read_scene(folder / "hall.toml")
    assert found == parse_scene(f"{TOP}{STOP}".encode(), "expected")
    assert run(["scene", "check", str(folder / "hall.toml")]) == 0


def test_a_new_scene_has_what_was_asked_for(folder: Path) -> None:
    shutil.copytree(GOLDEN / "archive-2", folder / "scans/tower")
    arguments = [
        "--avatar",
        str(folder / "visitor.xyz"),
        "--name",
        "both",
        "--effects",
        "stop, slide,sweep,proximity",
    ]
    assert new(folder, str(folder / "scans/tower"), *arguments) == 0
    found = read_scene(folder / "hall.toml")
    assert [item.path for item in found.archives] == ["scans/hall", "scans/tower"]
    assert [(item.name, item.file) for item in found.avatars] == [("visitor", "visitor.xyz")]
    assert found.name == "both"
    assert {type(effect).__name__ for effect in found.effects} == {"Stop", "Slide", "Sweep", "Proximity"}


@pytest.mark.parametrize("avatar", [True, False])
def test_every_line_that_is_commented_out_may_be_put_in(folder: Path, avatar: bool) -> None:
    assert new(folder, *(["--avatar", str(folder / "visitor.xyz")] if avatar else [])) == 0
    text = (folder / "hall.toml").read_text()
    found = parse_scene(re.sub(r"^#(?! )", "", text, flags=re.M).encode(), "hall.toml")
    assert len(found.effects) == 11 and found.objects and found.spawn and found.name == "hall"
    assert found.radius_model == "border"


def test_what_is_there_is_replaced_only_with_overwrite(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "hall.toml").write_text("mine")
    assert new(folder) == 2
    assert "hall.toml exists: give another -o, or --overwrite" in one_error(capsys)
    assert (folder / "hall.toml").read_text() == "mine"
    assert new(folder, "--overwrite") == 0
    assert read_scene(folder / "hall.toml").format == 1


@pytest.mark.parametrize("overwrite", [True, False])
def test_a_scene_file_that_cannot_be_written_leaves_what_was_there(
    overwrite: bool, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = folder / "hall.toml"
    if overwrite:
        path.write_text("mine")

    def full(_: int) -> None:
        assert path.exists() == overwrite and is_temporary(next(folder.glob("hall.toml.*")))
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        assert new(folder, *["--overwrite"] * overwrite) == 1
    assert "hall.toml: cannot be written: no space left on the disk: make room" in one_error(capsys)
    assert [p.read_text() for p in folder.glob("hall.toml*")] == ["mine"] * overwrite


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (
            "{archive} -o {folder}/new.toml --effects slid",
            2,
            "--effects slid: expected one or more of stop, sweep, slide",
        ),
        ("{archive} -o {folder}/new.toml --effects slide", 2, "`slide` requires `stop`"),
        ("{archive} -o {folder}/new.toml --effects stop,stop", 0, ""),
        ("{archive} -o {folder}/new.txt", 2, "new.txt: expected a name that ends in .toml"),
        ("{archive} -o {folder}/no/new.toml", 1, "no/new.toml: cannot be written: there is no folder"),
        ("{folder}/scans -o {folder}/new.toml", 3, "scans: no archive here"),
        ("{archive} -o {folder}/new.toml --avatar {folder}/no.ply", 2, "no.ply: no such file"),
        ("{archive} -o {folder}/new.toml --name a/b", 2, "--name 'a/b': expected 1 to 64 of A-Z"),
        (
            "{archive} -o {folder}/new.toml --avatar {folder}/visitor.xyz --avatar {folder}/scans/visitor.obj",
            2,
            "scans/visitor.obj: its avatar would have the name visitor, as that of",
        ),
        ("{archive} -o {folder}/new.toml --effects step", 2, "new.toml (not written): line"),
        ("-o {folder}/new.toml", 2, "Missing argument 'archives'"),
    ],
)
def test_what_cannot_be_written_is_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: str, code: int, said: str
) -> None:
    archive = folder / "scans/hall"
    (folder / "scans/visitor.obj").write_text("v 0 0 0\n")
    assert run(["scene", "new", *arguments.format(folder=folder, archive=archive).split()]) == code
    if code:
        assert said in one_error(capsys)
    assert (folder / "new.toml").exists() == (code == 0)


def test_check_says_what_runs_in_which_order(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    effects = ["ground", "proximity", "step", "crowd", "slide", "contacts", "sweep", "stop"]
    text = TOP + VISITOR + "".join(f'[[effects]]\neffect = "{name}"\n' for name in effects)
    assert check(folder, text) == 0
    said = capsys.readouterr().out
    order = re.findall(r"^effect \d +(\w+)", said, re.M)
    assert order == ["crowd", "stop", "sweep", "slide", "step", "ground", "proximity", "contacts"]
    assert re.search(r"^effect 1 +crowd: margin 0.0", said, re.M)
    assert "444 points in 5 voxels" in " ".join(said.split()) and "3 points of 0.1183 m radius" in said
    assert not re.findall("^note ", said, re.M)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (TOP + STOP, "`stop` without `sweep`: an avatar may pass through anything thinner"),
        (
            TOP + '[[effects]]\neffect = "objects"\n',
            "the effect `objects` has nothing to do: there are no [[objects]]",
        ),
        (
            TOP + "[spawn]\nposition = [0, 0, 0]\n",
            "spawn lies outside the bounds of the archives, 512345 5.61235e+06",
        ),
        (
            TOP
            + '[[effects]]\neffect = "through"\nboxes = [{name = "a", low = [0, 0, 0], high = [1, 1, 1]}]\n',
            "no scan point lies in a box of `through`",
        ),
    ],
)
def test_what_is_perhaps_not_meant_is_noted(
    folder: Path, capsys: pytest.CaptureFixture[str], text: str, said: str
) -> None:
    assert check(folder, text, "--json") == 0
    assert any(note.startswith(said) for note in json.loads(capsys.readouterr().out)["notes"])


@pytest.mark.parametrize(
    ("text", "code", "said"),
    [
        ("format = 1\n[[archives]\n", 2, "hall.toml: not valid TOML: Expected ']]'"),
        (TOP + '[[effects]]\neffect = "slid"\n', 2, '$.effects[0].effect: "slid" is not a known effect'),
        (TOP.replace("hall", "tower"), 3, "hall.toml: $.archives[0].path: {folder}/scans/tower: no archive here"),
        (TOP + '[[archives]]\npath = "visitor.xyz"\n', 3, "hall.toml: $.archives[1].path: {folder}/visitor.xyz"),
        (
            TOP.replace("hall", "plain").replace("1\n", '1\nradius_model = "border"\n', 1), 2,
            "hall.toml: $.radius_model: {folder}/scans/plain: radius model 'border': this archive stores mean",
        ),
        (TOP + VISITOR.replace("visitor.xyz", "no.ply"), 3, "hall.toml: $.avatars[0].file: {folder}/no.ply"),
        (TOP + VISITOR.replace("visitor", "point"), 2, "hall.toml: $.avatars[0]: avatar of a single distinct point"),
        (
            TOP + '[[effects]]\neffect = "uncertainty"\nscans = {"other.las" = 0.01}\n', 2,
            "hall.toml: $.effects[0]: uncertainty: scans: 'other.las' is not a scan of hall: expected scan-",
        ),
        (
            TOP + '[[effects]]\neffect = "through"\n'
            'boxes = [{name = "all", low = [-1e8, -1e8, -1e8], high = [1e8, 1e8, 1e8]}]\n', 2,
            "hall.toml: $.archives[0].path: {folder}/scans/hall: the boxes of the effect `through` contain all of",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_is_one_line_and_an_exit_code(
    folder: Path, capsys: pytest.CaptureFixture[str], text: str, code: int, said: str
) -> None:
    shutil.copytree(GOLDEN / "archive", folder / "scans/plain")
    (folder / "point.xyz").write_text("0 0 0\n")
    assert check(folder, text) == code
    assert said.format(folder=folder) in one_error(capsys)


def test_a_broken_archive_is_told_with_the_file(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    index = folder / "scans/hall/index.h5"
    index.write_bytes(index.read_bytes()[:-100])
    assert check(folder, TOP) == 3
    assert f"hall.toml: $.archives[0].path: {index}" in one_error(capsys)


@pytest.mark.parametrize("name", ["no.toml", "hall.toml"])
def test_serve_refuses_a_scene_file_that_is_wrong(
    folder: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    (folder / "hall.toml").write_text(TOP + '[[effects]]\neffect = "slide"\n')
    assert run(["serve", str(folder / name)]) == 2
    said = "`slide` requires `stop`" if name == "hall.toml" else "No such file or directory: expected a scene"
    assert f"{name}: " in (error := one_error(capsys)) and said in error
