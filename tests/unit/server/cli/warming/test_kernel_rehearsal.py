"""Test the trial of compiled kernels after a start that did not complete."""

import os
import pickle
import shutil
import signal
import tempfile
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
import pytest
from numba.core.serialize import dumps
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.kernels import record_rows
from solidcloud.schemas.kernels.compiling import kernel_files
from solidcloud.schemas.kernels.kernel_files import KernelFiles
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.cli.warming.kernel_rehearsal import check_answers, rehearse
from solidcloud.server.scene import Scene

ARCHIVE = Path(__file__).parents[4] / "golden" / "archive"
# Marks of processes that share the folder at this moment.
MARKS = shutil.ignore_patterns("*.starting", "*.compiling", "*.tmp")
compiled = pytest.mark.skipif(
    os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="interpreted kernels are not kept"
)


class Crash:
    """Object that crashes when it is unpickled. Its digest is right, because it is stored as written."""

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, (f"import os; os.kill(os.getpid(), {int(signal.SIGSEGV)})",)


@compiled
def test_kernels_that_crash_are_wiped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with Archive(ARCHIVE) as archive:
        assert len(archive.coordinates)  # its kernel is compiled or loaded: stored now
    files = KernelFiles(tmp_path / "solidcloud-kernels")
    for path in kernel_files().folder.glob("*.morton_decode-*"):
        files.write(path.name, pickle.dumps(Crash()))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    rehearse(ARCHIVE, files)
    assert list(files.folder.iterdir()) == []
    (said,) = (record.getMessage() for record in caplog.records)
    assert "SIGSEGV" in said and str(files.folder) in said


@compiled
def test_a_trial_that_hangs_is_one_that_failed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    files = KernelFiles(tmp_path)
    files.write("a.kernel", b"")
    rehearse(ARCHIVE, files, seconds=0.01)
    assert list(tmp_path.iterdir()) == []
    assert "did not finish within 0.01 s" in caplog.records[0].getMessage()


@compiled
@pytest.mark.timeout(900)  # alone, with an empty cache, it compiles every kernel of the server
def test_kernels_that_are_right_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with Scene.open(ARCHIVE) as scene:
        scene.warm()
        check_answers(scene)
    shutil.copytree(kernel_files().folder, tmp_path / "solidcloud-kernels", ignore=MARKS)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    files = KernelFiles(tmp_path / "solidcloud-kernels")
    before = set(os.listdir(files.folder))
    rehearse(ARCHIVE, files)
    assert caplog.records == []
    assert before <= set(os.listdir(files.folder))  # the trial simulates frames, too


@compiled
@pytest.mark.timeout(900)  # alone, with an empty cache, it compiles every kernel of the server
def test_a_fault_of_a_record_that_a_wrong_kernel_finds_is_the_kernels_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with Archive(ARCHIVE) as archive:
        archive.open_tree(0)  # compiled or loaded: stored now
    stored = kernel_files()
    shutil.copytree(stored.folder, tmp_path / "solidcloud-kernels", ignore=MARKS)
    files = KernelFiles(tmp_path / "solidcloud-kernels")
    for path in stored.folder.glob("*.link_rows-*"):
        files.write(path.name, no_tree(stored.read(path.name) or b""))
    # The kernels that a child compiles are replaced by those of this process, to save time.
    monkeypatch.setattr(
        tempfile, "TemporaryDirectory", partial(nullcontext, str(stored.folder.resolve().parent))
    )
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    rehearse(ARCHIVE, files)
    assert list(files.folder.iterdir()) == []
    (said,) = (record.getMessage() for record in caplog.records)
    assert "found a fault that newly compiled ones do not find" in said and "do not form a tree" in said


def no_tree(payload: bytes) -> bytes:
    """Return the kernel `link_rows`, compiled for the same signature, with a wrong result."""
    signature, _ = pickle.loads(payload)

    def link_rows(
        count: Any, cell_nodes: Any, cell_points: Any, first: Any, is_leaf: Any, cell_of: Any
    ) -> Any:
        return -1

    # A child finds the module of compiled code by its name.
    wrong = FunctionType(link_rows.__code__, vars(record_rows), "link_rows")
    wrong.__module__ = record_rows.__name__
    kernel = numba.njit(nogil=True)(wrong)
    kernel.compile(signature)
    (result,) = kernel.overloads.values()
    return bytes(dumps((signature, result._reduce())))


@compiled
@pytest.mark.timeout(900)  # alone, with an empty cache, it compiles every kernel of the server
def test_a_record_that_is_damaged_is_not_the_kernels_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    shutil.copytree(ARCHIVE, tmp_path / "archive")
    with Archive(tmp_path / "archive") as archive:
        for entry in archive.voxels:
            with open(archive.shard_path(int(entry["shard"])), "r+b") as file:
                file.seek(int(entry["frame_offset"][1]) + int(entry["frame_bytes"][1]) // 2)
                (byte,) = file.read(1)
                file.seek(-1, os.SEEK_CUR)
                file.write(bytes([byte ^ 255]))
    files = kernel_files()
    monkeypatch.setattr(
        tempfile, "TemporaryDirectory", partial(nullcontext, str(files.folder.resolve().parent))
    )
    rehearse(tmp_path / "archive", files)
    assert caplog.records == []
    assert list(files.folder.glob("*.kernel"))


@compiled
def test_an_archive_that_is_none_is_not_the_kernels_fault(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    files = KernelFiles(tmp_path)
    files.write("a.kernel", b"")
    rehearse(tmp_path / "nothing", files)
    assert files.read("a.kernel") == b""
    assert caplog.records == []


@pytest.mark.parametrize("lie", list(Verdict))
def test_wrong_answers_are_noticed(lie: Verdict) -> None:
    class Lying(Scene):
        def collide(self, *what: Any, **parameters: Any) -> Any:
            answers = super().collide(*what, **parameters)
            answers.verdict[:] = lie
            return answers

    with Lying.open(ARCHIVE) as scene, pytest.raises(AssertionError):
        check_answers(scene)
