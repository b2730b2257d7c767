"""Test the folder of compiled kernels: what it refuses, removes and keeps."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from solidcloud.schemas.runtime.kernel_files import KernelFiles, default_folder

NAME = "a.b-0.kernel"
PAYLOAD = bytes(range(256)) * 8


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "kernels"


@pytest.fixture
def files(folder: Path) -> KernelFiles:
    return KernelFiles(folder)


def lines(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records]


def test_what_was_written_is_read(files: KernelFiles, folder: Path) -> None:
    assert files.read(NAME) is None
    files.write(NAME, PAYLOAD)
    files.write("empty.kernel", b"")
    assert files.read(NAME) == PAYLOAD
    assert KernelFiles(folder).read("empty.kernel") == b""
    assert sorted(path.name for path in folder.iterdir()) == [NAME, "empty.kernel"]


def test_folder_and_files_are_private(files: KernelFiles, folder: Path) -> None:
    files.write(NAME, PAYLOAD)
    assert folder.stat().st_mode & 0o777 == 0o700
    assert (folder / NAME).stat().st_mode & 0o777 == 0o600


def test_every_flipped_bit_and_every_length_is_found(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    payload = b"machine code"
    KernelFiles(folder).write(NAME, payload)
    whole = (folder / NAME).read_bytes()
    damaged = [
        whole[:i] + bytes([whole[i] ^ 1 << bit]) + whole[i + 1 :]
        for i in range(len(whole))
        for bit in range(8)
    ]
    damaged += [whole[:i] for i in range(len(whole))] + [whole + b"\0", bytes(len(whole))]
    for content in damaged:
        files = KernelFiles(folder)
        (folder / NAME).write_bytes(content)
        assert files.read(NAME) is None
        assert not (folder / NAME).exists(), "what is damaged is removed"
    assert len(lines(caplog)) == len(damaged), "one line each time"


def test_delivered_kernels_are_read_unless_damaged_or_refused(
    files: KernelFiles, folder: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    files.write(NAME, PAYLOAD)
    files.write("b.kernel", PAYLOAD)
    (folder / "b.kernel").write_bytes(b"damaged")
    delivered = folder.rename(tmp_path / "delivered")
    with_them = KernelFiles(folder, delivered)
    assert with_them.read(NAME) == PAYLOAD and list(folder.iterdir()) == []
    assert with_them.read("b.kernel") is None
    with_them.write("b.kernel", b"compiled")
    assert with_them.read("b.kernel") == b"compiled"
    (tmp_path / "file").write_bytes(b"")
    assert KernelFiles(tmp_path / "file" / "kernels", delivered).read(NAME) == PAYLOAD
    assert lines(caplog) == []
    with_them.remove_all()
    assert with_them.read(NAME) is None and KernelFiles(folder, delivered).read(NAME) is None


def test_a_file_under_another_name_is_refused(files: KernelFiles, folder: Path) -> None:
    files.write(NAME, PAYLOAD)
    os.rename(folder / NAME, folder / "c.kernel")
    assert files.read("c.kernel") is None


@pytest.mark.parametrize("mode", [0o770, 0o702])
def test_a_folder_that_others_may_write_is_refused(
    folder: Path, mode: int, caplog: pytest.LogCaptureFixture
) -> None:
    KernelFiles(folder).write(NAME, PAYLOAD)
    folder.chmod(mode)
    files = KernelFiles(folder)
    assert files.read(NAME) is None
    files.write("new.kernel", PAYLOAD)
    assert not (folder / "new.kernel").exists()
    assert len(lines(caplog)) == 1
    assert f"mode {mode:o}" in lines(caplog)[0] and "NUMBA_CACHE_DIR" in lines(caplog)[0]


def test_a_folder_that_cannot_be_made_is_said_and_done_without(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").write_bytes(b"")
    files = KernelFiles(tmp_path / "file" / "kernels")
    files.write(NAME, PAYLOAD)
    assert files.read(NAME) is None
    with files.starting() as unfinished:
        assert not unfinished
    files.remove_all()
    files.prune()
    assert len(lines(caplog)) == 1


def test_the_least_recently_used_goes(files: KernelFiles, folder: Path) -> None:
    now = time.time()
    for number in range(6):
        files.write(f"{number}.kernel", PAYLOAD)
        os.utime(folder / f"{number}.kernel", (now, now - 86_400 * 10 * number))
    size = (folder / "0.kernel").stat().st_size
    files.prune(max_days=45)
    assert sorted(path.name for path in folder.iterdir()) == [f"{n}.kernel" for n in range(5)]
    files.read("4.kernel")  # used now
    files.prune(max_bytes=2 * size)
    assert sorted(path.name for path in folder.iterdir()) == ["0.kernel", "4.kernel"]


def test_a_start_that_leaves_is_not_held_against_the_next(files: KernelFiles, folder: Path) -> None:
    with pytest.raises(ValueError), files.starting() as unfinished:
        assert not unfinished
        with KernelFiles(folder).starting() as beside:
            assert not beside, "a start that is under way is no start that failed"
        raise ValueError
    with files.starting() as unfinished:
        assert not unfinished
    assert list(folder.iterdir()) == []


def test_a_start_that_was_killed_is_noticed_once(files: KernelFiles, folder: Path) -> None:
    code = (
        "import sys, time\n"
        "from pathlib import Path\n"
        "from solidcloud.schemas.runtime.kernel_files import KernelFiles\n"
        "with KernelFiles(Path(sys.argv[1])).starting():\n"
        "    print('inside', flush=True)\n"
        "    time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-P", "-c", code, folder], stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        with files.starting() as unfinished:
            assert not unfinished
        child.send_signal(signal.SIGKILL)
    with files.starting() as unfinished:
        assert unfinished
    with files.starting() as unfinished:
        assert not unfinished


def test_the_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", "/x/cache")
    assert default_folder("/y") == Path("/y/solidcloud-kernels")
    assert default_folder("") == Path("/x/cache/solidcloud/kernels")
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", "/home/someone")
    assert default_folder("") == Path("/home/someone/.cache/solidcloud/kernels")


def test_nobody_waits_for_ever(
    files: KernelFiles, folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("solidcloud.schemas.runtime.kernel_files._CLAIM_SECONDS", 0.1)
    program = (
        "import sys, time\nfrom pathlib import Path\n"
        "from solidcloud.schemas.runtime.kernel_files import KernelFiles\n"
        "files = KernelFiles(Path(sys.argv[1]))\nassert files.read(sys.argv[2]) is None\n"
        "print('compiles', flush=True)\ntime.sleep(60)\n"
    )
    command = [sys.executable, "-P", "-c", program, str(folder), NAME]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None and other.stdout.readline() == "compiles\n"
        assert not files.has_waited
        assert files.read(NAME) is None and files.has_waited
        files.write(NAME, PAYLOAD)
        other.kill()
    assert files.read(NAME) == PAYLOAD and not caplog.records
