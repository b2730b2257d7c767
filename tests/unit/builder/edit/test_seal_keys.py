"""Keys of seals: new ones, files of keys, and the commands that take them."""

import shutil
import stat
from pathlib import Path

import pytest
from forged_archives import forge
from sealed_archives import key_file
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


@pytest.mark.parametrize(("size", "match"), [(0, "0 bytes"), (31, "31 bytes"), (4097, "over 4096 bytes")])
def test_a_key_of_the_wrong_size_is_refused(size: int, match: str, tmp_path: Path) -> None:
    with pytest.raises(BadRequestError, match=f"{match}, expected 32 to 4096"):
        read_archive_key(key_file(tmp_path, bytes(size)))


def test_a_key_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadRequestError, match="No such file"):
        read_archive_key(tmp_path / "a.key")


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


def test_validate_compares_digests_without_a_key(copy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from solidcloud.server.cli.main import run

    forge(copy, lambda columns: columns["record_digest"].__setitem__((0, 1), 0))
    assert run(["validate", str(copy)]) == 3
    assert "points that are not those sealed" in capsys.readouterr().err
