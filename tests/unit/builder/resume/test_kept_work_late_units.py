"""Units that a cluster runs late find no folder in a build that started over, and change nothing in a resumed one."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import solidcloud.builder.pipeline as pipeline
from interrupted_builds import build, content, two_scans
from solidcloud.builder.resume.kept_work import _Journalled, building_folder
from solidcloud.builder.run.executor import ProcessExecutor


@pytest.fixture
def scans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Two scans, one of which is read in three ranges; two shards are made of them."""
    return two_scans(tmp_path, monkeypatch)


class HandedOut:
    """Records what a build hands out: calling it does it once more, as a worker that was taken for dead may."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.work: list[Callable[[], Any]] = []
        run = ProcessExecutor.map

        def recorded(executor: ProcessExecutor, function: Any, units: Any, *more: Any) -> Any:
            if isinstance(function, _Journalled):
                self.work += [partial(function, unit) for unit in units]
            return run(executor, function, units, *more)

        patch.setattr(ProcessExecutor, "map", recorded)

    def late(self) -> list[type[Exception] | None]:
        """Does all of it, and says how each ended."""
        ends: list[type[Exception] | None] = []
        for unit in self.work:
            try:
                unit()
                ends.append(None)
            except Exception as error:
                ends.append(type(error))
        return ends


def late_in(patch: pytest.MonkeyPatch, stage: str, work: HandedOut, ends: list[Any], folder: Path) -> None:
    """Let all of `work` be done once more when a build comes to a stage; it may change no file in `folder`."""
    function = getattr(pipeline, stage)

    def after(*arguments: Any) -> Any:
        before = content(folder)
        ends.append(work.late())
        assert content(folder) == before
        return function(*arguments)

    patch.setattr(pipeline, stage, after)


@pytest.mark.parametrize("stage", ["spool_scans", "build_shards", "_read_back"])
def test_late_units_of_a_build_that_was_given_up_find_no_folder(
    stage: str, scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, ends = tmp_path / "hall", []
    with monkeypatch.context() as patch:
        work = HandedOut(patch)
        patch.setattr(pipeline, "_read_back", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            build(target, scans, thin=0.01, resolution=0.002)
    with monkeypatch.context() as patch:
        late_in(patch, stage, work, ends, building_folder(target))
        build(target, scans, thin=0.02, fresh=True)
    assert len(work.work) > 12
    assert ends == [[FileNotFoundError] * len(work.work)]
    build(tmp_path / "judge", scans, thin=0.02)
    assert content(target) == content(tmp_path / "judge")
    assert not building_folder(target).exists()
