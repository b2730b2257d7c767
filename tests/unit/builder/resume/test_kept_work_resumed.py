"""A build that is killed anywhere and resumed ends in the same bytes."""

import gc
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import solidcloud.builder.passes.build_shards as build_shards
import solidcloud.builder.passes.spool_pass as spool_pass
import solidcloud.builder.passes.survey_pass as survey
import solidcloud.builder.pipeline as pipeline
from interrupted_builds import build, content, done_folder
from sample_sizes import sample
from solidcloud.builder.resume.kept_work import building_folder
from solidcloud.builder.sources.common.scan import Scan, library_errors
from solidcloud.builder.sources.scan_files import open_input_files
from solidcloud.schemas.errors import CorruptError, ScanError, SolidcloudError
from synthetic_scans import write_las

# The pass that each work unit belongs to.
PASS_OF = {
    "survey_range": survey,
    "hash_file": survey,
    "spool_range": spool_pass,
    "build_shard": build_shards,
}


class Killed(BaseException):
    """The process is gone."""


# What changes the names on a disk. All else is done to files that have none yet.
DEEDS = ("replace", "rename", "unlink", "rmdir", "mkdir")


class Reaper:
    """Lets a process do so many deeds and ends it before the next; none is done by who is dead. done: how many were."""

    def __init__(self, patch: pytest.MonkeyPatch, most: int) -> None:
        self.most, self.done, self.dead = most, 0, False
        for name in DEEDS:
            patch.setattr(os, name, self._instead(getattr(os, name)))

    def _instead(self, deed: Callable[..., Any]) -> Callable[..., Any]:
        def watched(*arguments: Any, **options: Any) -> Any:
            if self.dead or self.done == self.most:
                self.dead = True
                raise Killed
            self.done += 1
            return deed(*arguments, **options)

        return watched


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_build_killed_at_any_deed_goes_on_to_the_same_bytes(
    overwrite: bool,
    scans: list[Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    old: dict[str, bytes] = {}
    if overwrite:
        build(tmp_path / "old", scans[1:])
        old = content(tmp_path / "old")

    def killed(out: Path, most: int) -> int:
        """A build that is killed after so many deeds, or ends before; returns how many there were."""
        out.mkdir()
        if overwrite:
            shutil.copytree(tmp_path / "old", out / "hall")
        with monkeypatch.context() as patch:
            reaper = Reaper(patch, most)
            with suppress(Killed):
                build(out / "hall", scans, overwrite=overwrite)
        gc.collect()  # the lock goes with the file that holds it, and the file with the traceback
        return reaper.done

    killed(tmp_path / "first", 10**9)  # numba keeps what it compiles, in files as well
    # What is there by now need not be looked at each time: a tenth of a second.
    gc.freeze()
    request.addfinalizer(gc.unfreeze)
    deeds = killed(tmp_path / "judge", 10**9)
    expected = content(tmp_path / "judge" / "hall")
    assert len([name for name in expected if not name.startswith("level/")]) == 4
    assert deeds > 40
    # What is overwritten plays a part at the end alone. Else at most every fourth deed: scripts/kill_builds kills
    # at any.
    for most in range(deeds - 30, deeds, sample(9, 2)) if overwrite else range(0, deeds, sample(19, 4)):
        out = tmp_path / f"{most}"
        assert killed(out, most) == most
        # Nothing but a whole archive is ever under the name asked for.
        there = content(out / "hall") if (out / "hall").exists() else None
        assert there in (None, expected, old)
        build(out / "hall", scans, overwrite=overwrite and there != expected)
        assert content(out / "hall") == expected, f"killed after {most} deeds"
        assert [p.name for p in out.iterdir()] == ["hall"], f"killed after {most} deeds"


def test_what_was_done_is_not_done_again(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: list[str] = []

    def counted(name: str) -> None:
        function = getattr(PASS_OF[name], name)

        def instead(unit: Any) -> Any:
            calls.append(name)
            return function(unit)

        monkeypatch.setattr(PASS_OF[name], name, instead)

    for name in ("survey_range", "hash_file", "spool_range", "build_shard"):
        counted(name)
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "verify_archive", lambda *_, **__: (_ for _ in ()).throw(OSError(5, "lost")))
        with pytest.raises(Exception, match="does not read or write"):
            build(tmp_path / "hall", scans)
    everything = ["hash_file"] * 2 + ["survey_range"] * 4 + ["spool_range"] * 4 + ["build_shard"] * 2
    assert calls == everything
    calls.clear()
    folder = done_folder(tmp_path / "hall")
    # A run that is gone, and a shard that is not what it was, in a byte that no record has: notes are not believed.
    next((folder / "spool").glob("000001-*.run")).unlink()
    shard = folder / "archive" / "shards" / "0-000001.h5"
    data = bytearray(shard.read_bytes())
    data[-1] ^= 1
    shard.write_bytes(data)
    build(tmp_path / "hall", scans[::-1], jobs=1, memory_bytes=100 << 20)
    lost = calls.count("spool_range")
    assert 1 <= lost <= 3
    assert calls == ["spool_range"] * lost + ["build_shard"]
    build(tmp_path / "judge", scans)
    assert content(tmp_path / "hall") == content(tmp_path / "judge")


def test_a_run_that_changed_while_it_was_in_use_is_found(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def changed(spool: Any, *rest: Any) -> Any:
        run = next(spool.folder.glob("000000-*.run"))
        data = bytearray(run.read_bytes())
        data[0] ^= 1
        run.write_bytes(data)
        return after(spool, *rest)

    after = pipeline.filter_points
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "filter_points", changed)
        with pytest.raises(CorruptError, match="not those of the scans"):
            build(tmp_path / "hall", scans)
    assert not (tmp_path / "hall").exists()
    # Nobody knows which it was; the survey is believed, and all else made again.
    monkeypatch.setattr(survey, "survey_range", lambda _: pytest.fail("surveyed again"))
    build(tmp_path / "hall", scans)
    assert not building_folder(tmp_path / "hall").exists()


@pytest.mark.parametrize("stage", ["spool_range", "build_shards"])
def test_a_scan_that_changes_while_it_is_read_is_no_archive(
    stage: str, scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = spool_pass if stage == "spool_range" else pipeline
    function, raw = getattr(where, stage), np.random.default_rng(3).integers(-1500, 1500, (250, 3))

    def changed_first(*arguments: Any) -> Any:
        # As many points as before; or fewer, found out by whoever counts them.
        write_las(scans[0], raw[: 200 if stage == "spool_range" else 250])
        return function(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(where, stage, changed_first)
        with pytest.raises(ScanError, match=r"a\.las ha[sd] .*: changed while it was read.*: build again"):
            build(tmp_path / "hall", scans)
    assert not (tmp_path / "hall").exists()
    build(tmp_path / "hall", scans)  # as the message says
    build(tmp_path / "judge", scans)
    assert content(tmp_path / "hall") == content(tmp_path / "judge")


@pytest.mark.parametrize(
    ("failure", "said"),
    [
        (OSError(5, "Input/output error"), r"b\.xyz.*does not read or write.*same command again"),
        (MemoryError(), r"b\.xyz: out of memory.*fewer --jobs.*same command again"),
    ],
)
def test_a_machine_that_fails_for_a_moment_leaves_no_scan_out(
    failure: Exception, said: str, scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(scan: Scan, *_: Any) -> Any:
        with library_errors(scan.path):
            raise failure
        yield

    with monkeypatch.context() as patch:
        patch.setattr(type(open_input_files(scans)[1].scans[0]), "_read", fails)
        with pytest.raises(SolidcloudError, match=said):
            build(tmp_path / "hall", scans, skip_bad=True)
    summary = build(tmp_path / "hall", scans, skip_bad=True)
    assert (summary.points, summary.faults) == (400, ())


def test_that_memory_ran_out_is_said_and_the_same_command_goes_on(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(
            pipeline,
            "build_shards",
            lambda *_: (_ for _ in ()).throw(MemoryError("Unable to allocate 9 GiB")),
        )
        with pytest.raises(
            SolidcloudError, match=r"hall: out of memory \(Unable to.*give fewer --jobs.*resumes"
        ):
            build(tmp_path / "hall", scans)
    assert building_folder(tmp_path / "hall").exists()
    assert build(tmp_path / "hall", scans).points == 400
