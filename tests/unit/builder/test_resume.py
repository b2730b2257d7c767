"""A build that was interrupted goes on: killed anywhere, it ends in the same bytes, and only as what it was."""

import gc
import json
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import solidcloud.builder.config as config
import solidcloud.builder.memory as memory
import solidcloud.builder.passes as passes
import solidcloud.builder.pipeline as pipeline
import solidcloud.builder.survey as survey
from scans import make_scan, write_las, write_xyz
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.executor import ProcessExecutor
from solidcloud.builder.journal import _Noting
from solidcloud.builder.partition import SpoolUnit
from solidcloud.builder.pipeline import BuildSummary, build_archive
from solidcloud.builder.resume import check_same, described
from solidcloud.builder.scan_list import Input, inputs, inspect, write_scan_list
from solidcloud.builder.software import software
from solidcloud.builder.sources import Scan
from solidcloud.builder.sources.scan import library_errors
from solidcloud.builder.workplace import building_folder
from solidcloud.schemas.errors import BadRequestError, CorruptError, ScanError, SolidcloudError
from solidcloud.server.cli import run


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


def build(target: Path, scans: list[Path], **options: Any) -> BuildSummary:
    """Build in this process."""
    given = {"voxel": 0.9, "cell_points": 60, "leaf": 16, "degree": 4, "jobs": 1, "radius": 0.001, **options}
    return build_archive(scans, target, BuildConfig(**given))


def content(archive: Path) -> dict[str, bytes]:
    """Every file of an archive."""
    return {str(p.relative_to(archive)): p.read_bytes() for p in sorted(archive.rglob("*")) if p.is_file()}


def done_folder(target: Path) -> Path:
    """Where all is that a build has done that was interrupted."""
    (folder,) = (path for path in building_folder(target).iterdir() if path.is_dir())
    return folder


@pytest.fixture
def scans(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Two scans, one of which is read in three ranges; two shards are made of them."""
    monkeypatch.setattr(survey, "RANGE_POINTS", (100, 100))
    monkeypatch.setattr(config, "SHARD_POINTS", 1000)
    raw = np.random.default_rng(2).integers(-1500, 1500, (250, 3))
    write_las(tmp_path / "a.las", raw)
    write_xyz(tmp_path / "b.xyz", make_scan("plane", 3, 150))
    return [tmp_path / "a.las", tmp_path / "b.xyz"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_build_killed_at_any_deed_goes_on_to_the_same_bytes(
    overwrite: bool,
    scans: list[Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    # The power stays on in this test, and fsync takes nine tenths of its time.
    monkeypatch.setattr(os, "fsync", lambda _: None)
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
    assert len(expected) == 4
    assert deeds > 40
    # What is overwritten plays a part at the end alone.
    for most in range(deeds - 30 if overwrite else 0, deeds):
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
        function = getattr(passes, name)

        def instead(unit: Any) -> Any:
            calls.append(name)
            return function(unit)

        monkeypatch.setattr(passes, name, instead)

    for name in ("survey_range", "hash_file", "spool_range", "build_shard"):
        counted(name)
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "verify_archive", lambda *_, **__: (_ for _ in ()).throw(OSError(5, "lost")))
        with pytest.raises(Exception, match="lost"):
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


def test_a_range_spooled_again_leaves_no_run_of_before(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(passes, "run_points", lambda *_: 30)
        interrupted(tmp_path / "hall", scans, monkeypatch)
    folder = done_folder(tmp_path / "hall") / "spool"
    runs = sorted(folder.glob("*.run"))
    assert len(runs) == 4 + 4 + 2 + 5
    runs[0].unlink()
    (folder / "000000-000000000000-0009.run").write_bytes(b"half")
    build(tmp_path / "hall", scans)
    build(tmp_path / "judge", scans)
    assert content(tmp_path / "hall") == content(tmp_path / "judge")


@pytest.mark.parametrize("options", [{}, {"thin": 0.01}, {"keep": frozenset({"scan", "intensity"})}])
def test_a_run_that_changed_where_it_lay_is_found(
    options: dict[str, Any], scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "filter_points", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            build(tmp_path / "hall", scans, **options)
    run = next((done_folder(tmp_path / "hall") / "spool").glob("000000-*.run"))
    data = bytearray(run.read_bytes())
    data[0] ^= 1
    run.write_bytes(data)
    with pytest.raises(CorruptError, match="not those of the scans"):
        build(tmp_path / "hall", scans, **options)
    assert not (tmp_path / "hall").exists()
    # Nobody knows which it was; the survey is believed, and all else made again.
    monkeypatch.setattr(passes, "survey_range", lambda _: pytest.fail("surveyed again"))
    build(tmp_path / "hall", scans, **options)
    assert not building_folder(tmp_path / "hall").exists()


def test_a_run_that_ends_too_soon_is_made_again(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def cut(spool: Any, *rest: Any) -> Any:
        run = next(spool.folder.glob("000000-*.run"))
        run.write_bytes(run.read_bytes()[:-1])
        return after(spool, *rest)

    after = pipeline.filter_points
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "filter_points", cut)
        with pytest.raises(CorruptError, match="give the same command again"):
            build(tmp_path / "hall", scans)
    calls: list[Any] = []
    spool = passes.spool_range
    monkeypatch.setattr(passes, "spool_range", lambda unit: calls.append(unit) or spool(unit))
    build(tmp_path / "hall", scans)
    assert len(calls) == 1


def test_a_unit_of_an_earlier_session_that_ends_late_changes_nothing(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    units: list[SpoolUnit] = []
    spool, after = passes.spool_range, pipeline.filter_points
    monkeypatch.setattr(passes, "spool_range", lambda unit: units.append(unit) or spool(unit))

    def late(*arguments: Any) -> Any:
        # It was cut otherwise, as the session had more memory, or less.
        for run_points in (30, 70):
            spool(replace(units[0], run_points=run_points))
        return after(*arguments)

    monkeypatch.setattr(pipeline, "filter_points", late)
    build(tmp_path / "hall", scans)
    monkeypatch.setattr(pipeline, "filter_points", after)
    build(tmp_path / "judge", scans)
    assert content(tmp_path / "hall") == content(tmp_path / "judge")


class HandedOut:
    """Records what a build hands out: calling it does it once more, as a worker that was taken for dead may."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.work: list[Callable[[], Any]] = []
        run = ProcessExecutor.map

        def recorded(executor: ProcessExecutor, function: Any, units: Any, *more: Any) -> Any:
            if isinstance(function, _Noting):
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


def test_late_units_of_the_same_build_write_the_same_bytes(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, ends = tmp_path / "hall", []
    with monkeypatch.context() as patch:
        work = HandedOut(patch)
        patch.setattr(pipeline, "_read_back", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            build(target, scans, thin=0.02)
    with monkeypatch.context() as patch:
        for stage in ("spool_scans", "build_shards", "_read_back"):
            late_in(patch, stage, work, ends, building_folder(target))
        build(target, scans, thin=0.02)
    assert ends == [[None] * len(work.work)] * 3
    build(tmp_path / "judge", scans, thin=0.02)
    assert content(target) == content(tmp_path / "judge")


def interrupted(target: Path, scans: list[Path], monkeypatch: pytest.MonkeyPatch, **options: Any) -> None:
    """A build that Ctrl-C stopped just before its shards."""
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "build_shards", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            build(target, scans, **options)
    assert (building_folder(target) / "build.json").exists()


def test_a_cluster_that_cannot_be_reached_costs_no_work(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreachable(*_: Any) -> Any:
        raise BadRequestError("no dask scheduler answers")

    interrupted(tmp_path / "hall", scans, monkeypatch)
    before = content(building_folder(tmp_path / "hall"))
    with monkeypatch.context() as patch:
        patch.setattr(pipeline, "make_executor", unreachable)
        with pytest.raises(BadRequestError, match="answers"):
            build(tmp_path / "hall", scans, scheduler="tcp://127.0.0.1:1")
    assert content(building_folder(tmp_path / "hall")) == before


@pytest.mark.parametrize("stage", ["spool_scans", "spool_range", "build_shards"])
def test_a_scan_that_changes_while_it_is_read_is_no_archive(
    stage: str, scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = passes if stage == "spool_range" else pipeline
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
        (OSError(5, "Input/output error"), r"Input/output error: '.*b\.xyz'.*same command again"),
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
        patch.setattr(type(inputs(scans)[1].scans[0]), "_read", fails)
        with pytest.raises(SolidcloudError, match=said):
            build(tmp_path / "hall", scans, skip_bad=True)
    summary = build(tmp_path / "hall", scans, skip_bad=True)
    assert (summary.points, summary.faults) == (400, ())


@pytest.mark.parametrize("stage", ["survey_scans", "build_shards"])
def test_that_memory_ran_out_is_said_and_the_same_command_goes_on(
    stage: str, scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(
            pipeline, stage, lambda *_: (_ for _ in ()).throw(MemoryError("Unable to allocate 9 GiB"))
        )
        with pytest.raises(
            SolidcloudError, match=r"hall: out of memory \(Unable to.*give fewer --jobs.*goes on"
        ):
            build(tmp_path / "hall", scans)
    assert building_folder(tmp_path / "hall").exists()
    assert build(tmp_path / "hall", scans).points == 400


OTHER = {
    "voxel": (4.0, "--voxel was 0.9, is 4.0: give --voxel 0.9 to go on, or --fresh to start over"),
    "resolution": (0.01, "--resolution was not given, is 0.01: give no --resolution to go on"),
    "strict": (True, "--strict was not given, is given: give no --strict to go on"),
    "thin": (0.05, "--thin was not given, is 0.05"),
    "models": (frozenset({"mean", "local"}), "--radius was not given, is mean,local"),
}


@pytest.mark.parametrize("name", OTHER)
def test_other_options_are_refused_by_name(
    name: str, scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted(tmp_path / "hall", scans, monkeypatch)
    value, expected = OTHER[name]
    before = content(building_folder(tmp_path / "hall"))
    with pytest.raises(BadRequestError) as caught:
        build(tmp_path / "hall", scans, **{name: value})
    assert expected in str(caught.value)
    assert content(building_folder(tmp_path / "hall")) == before
    build(tmp_path / "hall", scans, **{name: value, "fresh": True, "resolution": 0.01})
    assert not building_folder(tmp_path / "hall").exists()


def test_an_option_that_was_given_is_asked_for_again(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted(tmp_path / "hall", scans, monkeypatch, strict=True, keep=frozenset({"scan"}))
    with pytest.raises(BadRequestError) as caught:
        build(tmp_path / "hall", scans)
    assert "--keep was scan, is not given; --strict was given, is not given" in str(caught.value)
    assert "give --keep scan; --strict to go on" in str(caught.value)


def test_other_scans_are_refused_by_name(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted(tmp_path / "hall", scans, monkeypatch)
    more = write_xyz(tmp_path / "c.xyz", make_scan("plane", 4, 20))
    cases: list[tuple[list[Path], str]] = [
        (scans[:1], "b.xyz is missing"),
        ([*scans, more], "c.xyz was not there"),
    ]
    for paths, expected in cases:
        with pytest.raises(BadRequestError, match=expected):
            build(tmp_path / "hall", paths)
    was = scans[1].stat()
    os.utime(scans[1], ns=(was.st_atime_ns, was.st_mtime_ns + 1))
    with pytest.raises(BadRequestError, match=r"b\.xyz has another time: give the same scans as they were"):
        build(tmp_path / "hall", scans)
    scans[1].write_text("1 2 3\n")
    with pytest.raises(BadRequestError, match=rf"b\.xyz had {was.st_size} bytes, has 6"):
        build(tmp_path / "hall", scans)


def test_other_software_is_refused(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    interrupted(tmp_path / "hall", scans, monkeypatch)
    other = {**software(), "h5py": "0.1"}
    monkeypatch.setattr("solidcloud.builder.resume.software", lambda: other)
    expected = rf"begun by other software: h5py {software()['h5py']}, now 0\.1: use .*--fresh to start over"
    with pytest.raises(BadRequestError, match=expected):
        build(tmp_path / "hall", scans)


def test_many_differences_are_counted() -> None:
    was = {"software": {}, "options": {}, "inputs": []}
    now = {
        "software": {},
        "options": {},
        "inputs": [
            {"path": f"{i}.las", "scan": 0, "bytes": 1, "changed_ns": 1, "pose": []} for i in range(9)
        ],
    }
    with pytest.raises(BadRequestError, match=r"4\.las was not there; and 4 more: give the same scans"):
        check_same(Path("hall"), was, now)
    check_same(Path("hall"), now, json.loads(json.dumps(now)))


def test_a_pose_and_a_file_that_cannot_be_opened_are_part_of_what_is_built(scans: list[Path]) -> None:
    opened = inputs(scans)
    what = described(opened, BuildConfig())
    opened[0].scans[0].pose = np.diag([-1.0, -1, 1, 1])
    with pytest.raises(BadRequestError, match=r"a\.las has another pose"):
        check_same(Path("hall"), what, described(opened, BuildConfig()))
    opened[0].scans[0].pose, opened[0].scans[0].crs, opened[0].scans[0].up = np.eye(4), "EPSG:25832", "y"
    with pytest.raises(BadRequestError, match=r"a\.las has another coordinate system and direction up"):
        check_same(Path("hall"), what, described(opened, BuildConfig()))
    gone = [Input(scans[0].with_name("gone.las"), [], "no such file"), opened[1]]
    (entry, _) = described(gone, BuildConfig())["inputs"][::-1]
    assert (Path(entry["path"]).name, entry["bytes"], entry["pose"]) == ("gone.las", -1, "")


def test_the_same_command_after_success_does_nothing(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = build(tmp_path / "hall", scans)
    before = content(tmp_path / "hall")
    monkeypatch.setattr(pipeline, "_build", lambda *_: pytest.fail("built again"))
    again = build(tmp_path / "hall", scans[::-1], jobs=2, memory_bytes=100 << 20)
    assert (first.already, again.already) == (False, True)
    shared = ("archive", "points", "voxels", "shards", "bytes", "radius", "moved_max", "skipped", "faults")
    assert [getattr(again, name) for name in shared] == [getattr(first, name) for name in shared]
    assert content(tmp_path / "hall") == before


def test_an_archive_of_anything_else_is_in_the_way(scans: list[Path], tmp_path: Path) -> None:
    build(tmp_path / "hall", scans)
    with pytest.raises(BadRequestError, match="an archive is here already"):
        build(tmp_path / "hall", scans, degree=5)
    with pytest.raises(BadRequestError, match="an archive is here already"):
        build(tmp_path / "hall", scans[:1])
    raw = np.random.default_rng(3).integers(-1500, 1500, (250, 3))
    write_las(scans[0], raw)  # the same name, other points
    with pytest.raises(BadRequestError, match="an archive is here already"):
        build(tmp_path / "hall", scans)
    assert not building_folder(tmp_path / "hall").exists()


@pytest.mark.parametrize("elsewhere", [{"crs": "EPSG:25832"}, {"units": "ft"}, {"up": "y"}])
def test_an_archive_of_scans_that_stand_elsewhere_is_in_the_way(
    elsewhere: dict[str, str], scans: list[Path], tmp_path: Path
) -> None:
    entries = inspect([scans[1]])
    write_scan_list(tmp_path / "scans.toml", entries)
    build(tmp_path / "hall", [tmp_path / "scans.toml"])
    assert build(tmp_path / "hall", [tmp_path / "scans.toml"]).already
    write_scan_list(tmp_path / "scans.toml", [replace(entry, **elsewhere) for entry in entries])
    with pytest.raises(BadRequestError, match="an archive is here already"):
        build(tmp_path / "hall", [tmp_path / "scans.toml"])


def test_an_archive_that_a_stricter_build_would_refuse_is_not_what_it_asks_for(tmp_path: Path) -> None:
    xyz = make_scan("plane", 3, 150)
    xyz[3] = 2e9
    path = write_xyz(tmp_path / "a.xyz", xyz)
    build(tmp_path / "hall", [path])
    assert build(tmp_path / "hall", [path]).already
    with pytest.raises(BadRequestError, match="an archive is here already"):
        build(tmp_path / "hall", [path], strict=True)
    (tmp_path / "bad.las").write_bytes(b"no LAS")
    build(tmp_path / "yard", [path, tmp_path / "bad.las"], skip_bad=True)
    assert build(tmp_path / "yard", [path, tmp_path / "bad.las"], skip_bad=True).already
    with pytest.raises(BadRequestError, match="an archive is here already"):
        build(tmp_path / "yard", [path, tmp_path / "bad.las"])


def test_a_bad_scan_found_in_the_survey_leaves_nothing_and_later_ones_do(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(_: Any) -> None:
        raise ScanError("b.xyz: changed")

    out = tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(passes, "_check_surveys", lambda *_: fails(None))
        with pytest.raises(ScanError):
            build(out / "hall", scans)
    assert not out.exists()
    with monkeypatch.context() as patch:
        patch.setattr(passes, "spool_range", fails)
        with pytest.raises(ScanError):
            build(out / "hall", scans)
    assert sorted(p.name for p in (done_folder(out / "hall") / "survey").iterdir())
    assert not list(out.glob(".hall.lock"))


def command(capsys: pytest.CaptureFixture[str], scan: Path, target: Path, *options: str) -> tuple[int, str]:
    """`solidcloud build`: its exit code, and its error."""
    words = ["build", str(scan), "-o", str(target), "--voxel", "0.9", "--jobs", "1", *options]
    code = run(words)
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    return code, "".join(errors)


# Options and points of a request that is refused when all is read, and what its error says to give.
LATE_REFUSALS: dict[str, tuple[list[str], np.ndarray, str, list[str]]] = {
    "one point": ([], np.array([[0, 0, 0], [1e-6, 0, 0]]), "give --radius", ["--radius", "0.01"]),
    "no point": (
        ["--outliers", "0.001,5"],
        make_scan("noise", 3, 100),
        "give --thin, --outliers or --moving other figures",
        ["--outliers", "0.8,1"],
    ),
}


@pytest.mark.parametrize("name", LATE_REFUSALS)
def test_a_request_that_is_refused_late_says_what_will_be_done(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options, points, advice, instead = LATE_REFUSALS[name]
    scan = write_xyz(tmp_path / "a.xyz", points)
    for _ in range(2):
        code, said = command(capsys, scan, tmp_path / "hall", *options)
        assert code == 2
        assert advice in said
        kept = building_folder(tmp_path / "hall")
        assert f"; what is done is kept in {kept}: with other options or other scans give --fresh" in said
        assert list((done_folder(tmp_path / "hall") / "survey").iterdir())
    assert command(capsys, scan, tmp_path / "hall", *instead)[0] == 2
    assert command(capsys, scan, tmp_path / "hall", *instead, "--fresh") == (0, "")
    assert not kept.exists()


def test_a_bad_scan_found_by_a_later_command_says_what_will_be_done(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "scans"
    folder.mkdir()
    write_xyz(folder / "a.xyz", make_scan("plane", 3, 100))
    (folder / "b.xyz").write_text("1 2 3\nbroken\n")
    with monkeypatch.context() as patch:
        patch.setattr(passes, "_check_surveys", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        assert command(capsys, folder, tmp_path / "hall")[0] == 130
    code, said = command(capsys, folder, tmp_path / "hall")
    assert code == 3
    assert "--skip-bad leaves such scans out" in said and "other scans give --fresh" in said
    assert command(capsys, folder, tmp_path / "hall", "--skip-bad", "--fresh")[0] == 0


def test_a_voxel_that_does_not_fit_is_built_as_the_error_says(
    scans: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "RECORD_BYTES", 20 << 30)
    folder = scans[0].parent
    said = command(capsys, folder, tmp_path / "hall", "--memory", "1GB")[1]
    assert "to read its record back takes" in said and "a smaller --voxel and --fresh" in said
    named = said.partition("--memory ")[2].partition(" ")[0]
    monkeypatch.setattr(passes, "spool_range", lambda _: pytest.fail("spooled again"))
    assert command(capsys, folder, tmp_path / "hall", "--memory", named) == (0, "")
