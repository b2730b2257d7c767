"""Test that names which hold escape sequences, markup or no UTF-8 are printed and served as texts."""

import json
import os
from pathlib import Path

import numpy as np
import pytest
from cli_floor import floor
from solidcloud.schemas.wire.encoding import JSON, MSGPACK, decode_answer, encode
from solidcloud.schemas.wire.scene_messages import SceneInfo
from solidcloud.server.cli.main import run
from solidcloud.server.scene import Scene

NAME = b"\x1b[31m[scan] [b] \xff\xe2\x80\xae\xc2\x9b.xyz"
SHOWN = r"\x1b[31m[scan] [b] \udcff\u202e\x9b.xyz"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder, the present one, with a scan of a hostile name and the archive `[/hall]` of it."""
    monkeypatch.chdir(tmp_path)
    np.savetxt("floor.xyz", floor(), fmt="%.4f")
    try:
        os.rename(b"floor.xyz", NAME)
    except OSError:
        pytest.skip("this file system has no such names")
    assert run(["build", os.fsdecode(NAME), "-o", "[/hall]", "--voxel", "2", "--jobs", "1"]) == 0
    return tmp_path


def test_commands_print_hostile_names_as_texts(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Issue 35: names of scans reached the terminal as they were."""
    scan, archive = os.fsdecode(NAME), "[/hall]"
    for command in (
        ["info", archive],
        ["inspect", scan],
        ["inspect", archive + scan],
        ["build", scan, "-o", scan + "/a"],
        ["info", archive, "--" + scan],
        ["validate", scan],
    ):
        assert (run(command) == 0) == (command == ["info", archive]), command
        said = capsys.readouterr()
        both = said.out + said.err
        assert SHOWN in both, command
        assert not {*"\x1b\x9b\u202e\udcff"} & {*both}, command
    assert run(["validate", archive]) == 0
    assert "[/hall]: " in capsys.readouterr().out
    assert run(["info", archive, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sources"][0]["path"] == scan


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
def test_server_describes_an_archive_with_a_name_that_is_no_utf8(folder: Path, encoding: str) -> None:
    """Issue 35: `info` failed in the server, so that neither clients nor the viewer could open it."""
    with Scene.open("[/hall]", name="hall") as scene:
        info = scene.info()
    found = decode_answer(SceneInfo, encode(info, encoding), encoding)
    assert found.sources[0].path == os.fsdecode(NAME).replace("\udcff", "\\udcff")
    assert found.points == info.points
