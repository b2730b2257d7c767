"""One builder at a time writes an archive; the second is refused before anything slow is loaded."""

import errno
import fcntl
from pathlib import Path

import pytest
from solidcloud.builder.resume.lock import check_free, lock_path, locked
from solidcloud.schemas.errors import BadRequestError


def test_one_at_a_time(tmp_path: Path) -> None:
    target = tmp_path / "hall"
    check_free(target)
    with locked(target):
        assert lock_path(target).exists()
        with (
            pytest.raises(BadRequestError, match="another build, add or remove is writing it"),
            locked(target),
        ):
            pytest.fail("two builders")
        with pytest.raises(BadRequestError, match="another build, add or remove is writing it"):
            check_free(target)
    check_free(target)
    assert not list(tmp_path.iterdir())
    with locked(target):
        pass


def test_asking_whether_it_is_free_keeps_nobody_off(tmp_path: Path) -> None:
    target = tmp_path / "hall"
    lock_path(target).write_bytes(b"")  # of a builder that was killed
    check_free(target)
    assert lock_path(target).exists()
    with locked(target):
        pass


def test_a_file_system_without_locks_is_not_another_build(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fault = OSError(errno.ENOLCK, "No locks available")
    monkeypatch.setattr(fcntl, "flock", lambda *_: (_ for _ in ()).throw(fault))
    with pytest.raises(OSError, match="No locks available") as caught, locked(tmp_path / "hall"):
        pytest.fail("locked")
    assert caught.value.filename == str(lock_path(tmp_path / "hall"))
