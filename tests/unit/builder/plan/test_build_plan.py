"""Estimates follow from rates and a scene; a look at scans finds surface and voxels. Nothing is timed."""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import synthetic_scans
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.plan import build_plan as plans
from solidcloud.builder.plan import scan_sample as sample
from solidcloud.builder.plan.build_plan import estimate, hypothetical_scene
from solidcloud.builder.plan.measure_rates import POINTS, measure_rates, room
from solidcloud.builder.plan.rates import Rates, StageRate, dump_rates, load_rates
from solidcloud.builder.plan.scan_sample import estimate_distinct, plan_build, sample_scene
from solidcloud.builder.sources.scan_files import InputFile, open_input_files
from solidcloud.schemas.errors import BadRequestError, CorruptError, ScanError
from synthetic_scans import write_xyz

RATES = Rates(
    machine="m", cores=2, rests_on="r", workers=1.0, passes=2, process=1e8, worker=5e7, point=10.0, disk=1e8,
    density=400.0, crossed=0.5,
    stages={"survey": StageRate(0.5, 0.0, 1e-8, 2e-8), "spool": StageRate(0.0, 0.0, 0.0, 1e-7),
            "radius": StageRate(0.2, 8e-7, 0.0, 0.0)},
    read={"las": 1e-8, "laz": 3e-7, "text": 1e-6},
    archive=[(10.0, 2.0), (1000.0, 4.0)],
)  # fmt: skip
ONE = BuildConfig(jobs=1)


def write_las(path: Path, xyz: np.ndarray) -> None:
    """Points on a lattice of 0.1 mm."""
    synthetic_scans.write_las(path, np.rint(xyz * 1e4).astype(np.int64), scale=1e-4)


def test_a_stage_is_its_start_and_so_much_a_point_shared_among_jobs() -> None:
    assert StageRate(1.0, 0.0, 0.25, 0.5).seconds(4, 1) == 4.0
    assert StageRate(1.0, 0.0, 0.25, 0.5).seconds(4, 2) == 3.0
    assert StageRate(1.0, 2e-6, 0.0, 0.0).seconds(5e5, 1) == 2.0
    assert StageRate(1.0, 2e-6, 0.0, 0.0).seconds(1e9, 2) == 2.0


def test_bytes_a_point_are_linear_in_bits_of_the_pitch() -> None:
    found = [RATES.bytes_a_point(ratio) for ratio in (10, 100, 1000, 10_000, 1e-9)]
    assert found == pytest.approx([2, 3, 4, 5, 1])


def test_rates_come_back_as_they_were_written() -> None:
    assert load_rates(dump_rates(RATES)) == RATES


def test_the_rates_of_the_package_can_be_read_and_speak_of_every_stage_of_a_build(tmp_path: Path) -> None:
    rates = load_rates()
    write_las(tmp_path / "a.las", room(2000))
    summary = build_archive([tmp_path / "a.las"], tmp_path / "archive", ONE)
    assert set(summary.stages) <= set(rates.stages)
    assert {"las", "laz", "e57", "ply", "text"} <= set(rates.read)
    assert [at for at, _ in rates.archive] == sorted(at for at, _ in rates.archive)
    assert not any(word in dump_rates(rates) for word in ("/tmp", "/home", "/work", "20:", "host"))


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"version": 2}',
        dump_rates(replace(RATES, archive=[])),
        dump_rates(replace(RATES, read={})),
    ],
)
def test_rates_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(CorruptError, match=r"rates\.json: .*measure again"):
        load_rates(text)


def test_an_imagined_scene_is_as_dense_as_asked() -> None:
    usual, dense = (
        hypothetical_scene(10**9, RATES),
        hypothetical_scene(10**9, RATES, density=4000.0, scans=10),
    )
    assert (usual.area, usual.scans) == (10**9 / 400, 714)
    assert (dense.area, dense.scans, dense.largest) == (10**9 / 4000, 10, 10**8)
    assert "as in a façade" in usual.assumed[0] and "given" in dense.assumed[0]


def test_an_estimate_adds_up() -> None:
    scene = hypothetical_scene(10**6, RATES, scans=4)
    found = estimate(scene, ONE, RATES)
    pitch = math.sqrt(1 / 400) / 1e-4
    voxels = round(0.5 * scene.area / 64)
    assert found.voxels == voxels
    assert found.archive_bytes == round(10**6 * RATES.bytes_a_point(pitch) + 1130 * voxels) + 7500
    assert found.preview_bytes == 125_000 * 6
    assert found.spool_bytes == 12 * 10**6
    assert found.disk_bytes == found.archive_bytes + found.spool_bytes
    assert found.stages == pytest.approx({"survey": 0.53, "spool": 0.1, "radius": 1.0})
    assert found.seconds == pytest.approx(1.63)
    assert found.memory_bytes == pytest.approx(1e8 + 1e7, rel=0.01)
    assert not any(limit.binds for limit in found.limits)
    assert json.loads(json.dumps(found.as_json()))["limits"][0]["binds"] is False


def test_more_jobs_take_less_time_and_more_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plans.os, "cpu_count", lambda: 4)
    scene = hypothetical_scene(10**8, RATES)
    one, four, eight = (estimate(scene, BuildConfig(jobs=jobs), RATES) for jobs in (1, 4, 8))
    assert four.stages["survey"] == pytest.approx(0.5 + 1.0 + 0.5) and one.stages["survey"] == pytest.approx(
        3.5
    )
    assert "workers" not in one.stages and four.stages["workers"] == 1.0
    assert eight.stages == four.stages, "there are four cores"
    assert one.memory_bytes < four.memory_bytes < eight.memory_bytes
    assert eight.memory_bytes < (2 << 30) + 10**6


def test_memory_is_bounded_but_for_what_grows_with_voxels() -> None:
    scene = hypothetical_scene(10**9, RATES)
    found = estimate(scene, replace(ONE, memory_bytes=1 << 30), RATES)
    assert (1 << 30) + found.index_bytes < found.memory_bytes < 1.1 * (1 << 30)


def test_formats_that_are_slow_to_read_add_to_both_passes() -> None:
    scene = hypothetical_scene(10**6, RATES, scans=1)
    las, laz, text, other = (
        estimate(replace(scene, formats={name: 10**6}), ONE, RATES).stages
        for name in ("las", "laz", "text", "new")
    )
    assert laz["survey"] - las["survey"] == pytest.approx(0.29) == laz["spool"] - las["spool"]
    assert text["survey"] - las["survey"] == pytest.approx(0.99)
    assert other == las


def test_one_large_scan_that_can_seek_is_read_by_all_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plans.os, "cpu_count", lambda: 4)
    scene = hypothetical_scene(10**8, RATES, scans=1)
    las, laz, text = (
        estimate(replace(scene, formats={name: 10**8}), replace(ONE, jobs=4), RATES).stages
        for name in ("las", "laz", "text")
    )
    assert laz["survey"] - las["survey"] == pytest.approx(29.0 / 4)
    assert text["survey"] - las["survey"] == pytest.approx(99.0)


def test_a_slow_disk_is_waited_for() -> None:
    scene = hypothetical_scene(10**6, RATES)
    slow = estimate(scene, ONE, replace(RATES, disk=1e6))
    assert slow.seconds == pytest.approx((slow.archive_bytes + slow.spool_bytes) / 1e6)


def test_a_radius_that_is_given_is_not_measured() -> None:
    assert "radius" not in estimate(hypothetical_scene(10**6, RATES), replace(ONE, radius=0.01), RATES).stages


def test_limits_that_bind_are_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def binding(points: float, density: float | None = None, **options: object) -> set[str]:
        found = estimate(
            hypothetical_scene(int(points), RATES, density),
            BuildConfig(jobs=1, **options),
            RATES,
            tmp_path / "no" / "archive",
        )
        return {limit.what.split(",")[0] for limit in found.limits if limit.binds}

    monkeypatch.setattr(plans.shutil, "disk_usage", lambda path: SimpleNamespace(free=10**12))
    assert binding(1e9) == set()
    assert binding(1e12, memory_bytes=1 << 30) == {
        "room on the disk", "index", "directories of runs", "files of the spool in one folder"
    }  # fmt: skip
    assert binding(1e9, voxel=0.001, resolution=1e-5) >= {"voxels along an axis"}
    assert binding(1e6, voxel=300.0) == set()
    assert binding(1e12, keep=frozenset({"scan"})) >= {"scans"}
    assert binding(1e12, 1e5, voxel=200.0) >= {"the densest voxel"}


# --- a look at scans ------------------------------------------------------------------------------------


def test_keys_not_seen_are_guessed_from_those_seen_once_and_twice(rng: np.random.Generator) -> None:
    assert estimate_distinct([]) == 0
    assert estimate_distinct([np.array([1, 2]), np.array([1, 2])]) == 2
    looks = [np.unique(rng.integers(0, 1000, 60)) for _ in range(12)]
    seen = len(np.unique(np.concatenate(looks)))
    assert seen < 600 and 800 < estimate_distinct(looks) < 1250


def looked(path: Path, config: BuildConfig = ONE) -> sample.SceneStats:
    return sample_scene(open_input_files([path]), config)


def test_a_small_scan_is_seen_as_it_is(tmp_path: Path) -> None:
    xyz = room(20_000)
    write_las(tmp_path / "a.las", xyz)
    scene = looked(tmp_path / "a.las")
    expected = len(np.unique(np.floor((xyz - xyz.min(axis=0)) / 8), axis=0))
    assert (scene.points, scene.scans, scene.formats) == (20_000, 1, {"las": 20_000})
    assert scene.voxels is not None and scene.voxels[1] == pytest.approx(expected, rel=0.1)
    assert scene.input_bytes == (tmp_path / "a.las").stat().st_size
    assert scene.extent == pytest.approx(30.0, abs=0.05)


def test_a_look_at_a_part_tells_of_the_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    xyz = room(200_000)
    write_las(tmp_path / "a.las", xyz)
    whole = looked(tmp_path / "a.las")
    monkeypatch.setattr(sample, "LOOKS", 64)
    monkeypatch.setattr(sample, "LOOK_POINTS", 512)
    part = looked(tmp_path / "a.las")
    assert part.points == whole.points and "a sample of 32,768 of" in part.assumed[0]
    assert part.area == pytest.approx(whole.area, rel=0.3)
    assert part.voxels is not None and whole.voxels is not None
    assert part.voxels[1] == pytest.approx(whole.voxels[1], rel=0.3)


def test_text_whose_number_of_points_nobody_says_is_guessed_by_its_length(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_xyz(tmp_path / "a.xyz", np.round(room(40_000), 6))
    monkeypatch.setattr(sample, "FIRST_POINTS", 10_000)
    scene = looked(tmp_path / "a.xyz")
    assert 25_000 < scene.points < 60_000
    assert any("do not declare their number" in line for line in scene.assumed)


def test_scans_there_is_no_time_for_are_like_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    xyz = room(20_000)
    for i in range(4):
        write_las(tmp_path / f"{i}.las", xyz[i::4])
    whole = looked(tmp_path)
    monkeypatch.setattr(sample, "SECONDS", -1.0)
    scene = looked(tmp_path)
    assert scene.points == whole.points and any("3 scans not sampled" in line for line in scene.assumed)
    assert whole.area < scene.area < 4.5 * whole.area


def test_a_broken_scan_stops_a_plan_as_it_stops_a_build(tmp_path: Path) -> None:
    write_las(tmp_path / "a.las", room(1000))
    (tmp_path / "b.las").write_bytes(b"LASF nothing")
    with pytest.raises(ScanError, match=r"b\.las.*--skip-bad"):
        looked(tmp_path)
    assert looked(tmp_path, replace(ONE, skip_bad=True)).points == 1000
    with pytest.raises(ScanError, match="no scan holds a point"):
        sample_scene([InputFile(tmp_path / "x", [])], ONE)


@pytest.mark.parametrize("name", ["b.xyz", "b.laz"])
def test_a_scan_that_breaks_where_no_look_fell_is_left_out_as_a_build_does(tmp_path: Path, name: str) -> None:
    write_las(tmp_path / "a.las", room(1000))
    xyz = room(sample.FIRST_POINTS + 30_000)
    broken = tmp_path / name
    if name == "b.xyz":
        write_xyz(broken, xyz)
        with broken.open("a") as file:
            file.write("0 0 nothing\n")
    else:
        synthetic_scans.write_las(broken, np.rint(xyz * 1e4).astype(np.int64), scale=1e-4)
        data = bytearray(broken.read_bytes())
        data[-len(data) // 3 : -len(data) // 4] = bytes(len(data) // 3 - len(data) // 4)
        broken.write_bytes(data)
    with pytest.raises(ScanError, match=name):
        looked(tmp_path)
    scene = looked(tmp_path, replace(ONE, skip_bad=True))
    assert scene.points == 1000 and scene.packed is not None
    assert any(
        line.startswith("without a scan that cannot be read: ") and name in line for line in scene.assumed
    )


@pytest.mark.parametrize("voxel", [8.0, 2.0])
def test_bytes_and_voxels_are_those_of_a_build_within_a_half(tmp_path: Path, voxel: float) -> None:
    write_las(tmp_path / "a.las", room(60_000))
    config = replace(ONE, voxel=voxel)
    plan = plan_build([tmp_path / "a.las"], config, tmp_path / "archive")
    built = build_archive([tmp_path / "a.las"], tmp_path / "archive", config)
    assert plan.points == built.points
    stored = built.bytes
    assert 1 / 1.5 < plan.archive_bytes / stored < 1.5
    assert 1 / 1.5 < plan.voxels / built.voxels < 1.5


def test_measuring_here_changes_times_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("solidcloud.builder.plan.measure_rates.POINTS", 20_000)
    monkeypatch.setattr("solidcloud.builder.plan.measure_rates.READ_POINTS", 2_000)
    rates = load_rates()
    found = measure_rates(rates)
    assert POINTS == 1_000_000
    assert found.archive == rates.archive and found.density == rates.density
    assert found.stages.keys() == rates.stages.keys() and found.stages != rates.stages
    assert set(found.read) >= {"las", "laz", "e57", "ply", "text"}
    assert "built here" in found.rests_on and rates.rests_on in found.rests_on


def test_a_config_that_cannot_be_is_refused(tmp_path: Path) -> None:
    write_las(tmp_path / "a.las", room(1000))
    with pytest.raises(BadRequestError, match="--voxel"):
        plan_build([tmp_path / "a.las"], BuildConfig(voxel=-1.0), tmp_path)
