"""One builder at a time, and the second is told before anything that takes time is loaded."""

import fcntl
import subprocess
import sys
from pathlib import Path

import pytest
from solidcloud.builder.resume.lock import check_free, lock_path, locked
from solidcloud.schemas.errors import BadRequestError


def test_one_at_a_time(tmp_path: Path) -> None:
    target = tmp_path / "hall"
    check_free(target)
    with locked(target):
        assert lock_path(target).exists()
        with pytest.raises(BadRequestError, match="another build is writing it"), locked(target):
            pytest.fail("two builders")
        with pytest.raises(BadRequestError, match="another build is writing it"):
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


def test_a_second_builder_loads_no_numpy(tmp_path: Path) -> None:
    code = (
        "import sys; from solidcloud.server.cli.main import run; code = run(sys.argv[1:]); "
        "sys.exit(code + 100 * ('numpy' in sys.modules))"
    )
    with open(lock_path(tmp_path / "hall"), "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        done = subprocess.run(
            [sys.executable, "-P", "-c", code, "build", "a.las", "-o", str(tmp_path / "hall")],
            capture_output=True,
            text=True,
            check=False,
        )
    assert done.returncode == 2, done.stderr
    expected = "another build is writing it, or add or remove: wait for it (a build may be given another -o)"
    assert f"hall: {expected}" in done.stderr
