"""A new file has its name only when it is complete; temporary files can be recognised and removed."""

from pathlib import Path

import pytest
import solidcloud.schemas.runtime.new_file as new_file_module
from solidcloud.schemas.runtime.new_file import is_temporary, new_file, new_path, remove_temporaries


def test_a_file_has_its_name_only_when_it_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.run"
    synced: list[bool] = []
    monkeypatch.setattr(new_file_module.os, "fsync", lambda _: synced.append(path.exists()))
    with new_file(path) as file:
        file.write(b"one")
        assert not path.exists()
        with new_file(path) as other:  # the same unit, somewhere else: neither sees the other's
            other.write(b"other")
        assert path.read_bytes() == b"other"
    assert path.read_bytes() == b"one"
    assert synced == [False, True, True, True]  # the file before it has its name, the folder after
    with pytest.raises(KeyboardInterrupt), new_file(path) as file:
        file.write(b"half")
        raise KeyboardInterrupt
    assert [p.name for p in tmp_path.iterdir()] == ["a.run"]
    assert path.read_bytes() == b"one"


def test_a_folder_has_its_name_only_when_it_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "stations"
    synced: list[str] = []
    sync = new_file_module.sync_path
    monkeypatch.setattr(
        new_file_module, "sync_path", lambda synced_path: synced.append(synced_path.name) or sync(synced_path)
    )
    with new_path(path) as temporary:
        assert is_temporary(temporary)
        temporary.mkdir()
        (temporary / "a.laz").write_bytes(b"one")
        assert not path.exists()
    assert (path / "a.laz").read_bytes() == b"one"
    assert synced == ["a.laz", temporary.name, tmp_path.name]  # its files before it has its name
    with pytest.raises(KeyboardInterrupt), new_path(tmp_path / "other") as temporary:
        temporary.mkdir()
        (temporary / "a.laz").write_bytes(b"half")
        raise KeyboardInterrupt
    with pytest.raises(OSError, match="not empty"), new_path(path) as temporary:
        temporary.mkdir()
    assert [p.name for p in tmp_path.iterdir()] == ["stations"]


def test_what_has_no_name_is_removed(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    for name in ("a.tmp", "deep/b.h5.tmp", "deep/c.h5"):
        (tmp_path / name).write_bytes(b"")
    remove_temporaries(tmp_path)
    assert [p.name for p in sorted(tmp_path.rglob("*"))] == ["deep", "c.h5"]
