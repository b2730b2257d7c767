"""Test keys of seals, and the commands that take them."""

import shutil
import stat
from pathlib import Path

import pytest
from solidcloud.schemas.archive.seal import read_archive_key, write_new_key
from solidcloud.schemas.errors import BadRequestError


def test_a_new_key_is_random_and_private(tmp_path: Path) -> None:
    write_new_key(tmp_path / "a.key")
    write_new_key(tmp_path / "b.key")
    assert stat.S_IMODE((tmp_path / "a.key").stat().st_mode) == 0o600
    first, second = (read_archive_key(tmp_path / name) for name in ("a.key", "b.key"))
    assert len(first) == 32 and first != second
    with pytest.raises(BadRequestError, match="exists, expected a new file"):
        write_new_key(tmp_path / "a.key")
    assert read_archive_key(tmp_path / "a.key") == first


def test_the_commands_seal_and_validate(
    plain: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from solidcloud.server.cli.main import run

    copy = Path(shutil.copytree(plain, tmp_path / "archive"))
    keys = [str(tmp_path / "a.key"), str(tmp_path / "b.key")]
    for key in keys:
        assert run(["seal", "--new-key", key]) == 0
    assert run(["validate", str(copy), "--archive-key", keys[0]]) != 0
    assert "not found, expected the seal" in capsys.readouterr().err
    assert run(["seal", str(copy), "--key", keys[0]]) == 0
    assert "sealed" in capsys.readouterr().out
    assert run(["validate", str(copy), "--archive-key", keys[0]]) == 0
    assert run(["validate", str(copy)]) == 0
    assert run(["validate", str(copy), "--archive-key", keys[1]]) != 0
    for wrong in ([str(copy)], ["--key", keys[0]], [str(copy), "--new-key", str(tmp_path / "c.key")], []):
        assert run(["seal", *wrong]) != 0
    assert not (tmp_path / "c.key").exists()
