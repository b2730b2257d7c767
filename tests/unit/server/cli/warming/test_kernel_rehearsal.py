"""Test the trial of compiled kernels after a start that did not complete."""

import os
import pickle
import signal
from pathlib import Path
from typing import Any

import pytest
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.runtime.compiling import kernel_files
from solidcloud.schemas.runtime.kernel_files import KernelFiles
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.cli.warming.kernel_rehearsal import check_answers, rehearse
from solidcloud.server.scene import Scene

ARCHIVE = Path(__file__).parents[4] / "golden" / "archive"
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
        archive.read_voxel(0)  # its kernels are compiled or loaded: stored now
    files = KernelFiles(tmp_path / "solidcloud-kernels")
    for path in kernel_files().folder.glob("*.link_rows-*"):
        files.write(path.name, pickle.dumps(Crash()))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    rehearse(ARCHIVE, files)
    assert list(files.folder.glob("*.kernel")) == []
    (said,) = (record.getMessage() for record in caplog.records)
    assert "SIGSEGV" in said and str(files.folder) in said


@pytest.mark.parametrize("lie", list(Verdict))
def test_wrong_answers_are_noticed(lie: Verdict) -> None:
    class Lying(Scene):
        def collide(self, *what: Any, **parameters: Any) -> Any:
            answers = super().collide(*what, **parameters)
            answers.verdict[:] = lie
            return answers

    with Lying.open(ARCHIVE) as scene, pytest.raises(AssertionError):
        check_answers(scene)
