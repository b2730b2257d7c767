"""Test the parts of scripts/bench_build: memory, stages, limits and sizes. Nothing is timed."""

import dataclasses
import hashlib
import sys
from pathlib import Path

import numpy as np
import pytest
from bench_build_cases import build_limits, build_picture, build_rates, build_runs, build_sizes, build_watch
from bench_build_cases.build_watch import Sample, Watched
from picture_checks import alike_in_grey, covered, drawn_figures, overlaps
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.plan.rates import StageRate
from solidcloud.server.report.common.bench_results import Part

ROLLUP = """55b859773000-7ffce90ef000 ---p 00000000 00:00 0                          [rollup]
Rss:                1672 kB
Pss:                 321 kB
Pss_Dirty:           112 kB
Pss_Anon:            112 kB
Anonymous:           110 kB
Swap:                  7 kB
"""


def built(points: int, seconds: float, stages: dict[str, float], samples: list[Sample]) -> build_runs.Built:
    summary = {"stages": stages, "points": points, "voxels": 2, "shards": 1}
    return build_runs.Built(
        points, summary, Watched(seconds, 2 * seconds, 0.0, samples), 1e-4, 3 * points, points
    )


def test_memory_of_a_process_is_its_share_of_pages_and_what_is_anonymous() -> None:
    assert build_watch.parse_rollup(ROLLUP) == (321 * 1024, 110 * 1024)


def test_a_parent_is_found_behind_any_name() -> None:
    assert build_watch.parse_parent("71 (a) b (c)) S 42 71 0 0") == 42


def test_a_family_is_all_that_descend_from_its_root() -> None:
    assert sorted(build_watch.family(5, {5: 1, 6: 5, 7: 6, 8: 1, 9: 8, 10: 7})) == [5, 6, 7, 10]


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="the system does not say")
def test_memory_of_a_child_of_the_command_is_seen() -> None:
    child = "x = bytearray(1 << 26); import time; time.sleep(1.2)"
    parent = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}]); print('done')"
    seen = build_watch.watch([sys.executable, "-c", parent])
    assert seen.code == 0 and seen.out == "done\n"
    assert seen.peak is not None and seen.peak > 1 << 26
    assert seen.peak_anonymous is not None and 1 << 26 < seen.peak_anonymous <= seen.peak
    assert max(s.processes for s in seen.samples) >= 2


def test_what_a_command_says_and_its_exit_code_are_kept() -> None:
    seen = build_watch.watch([sys.executable, "-c", "import sys; print('a'); sys.exit('why')"])
    assert (seen.out, seen.err, seen.code) == ("a\n", "why\n", 1)


@pytest.mark.parametrize("before", ["", "a line {\nanother\n"])
def test_json_is_found_behind_other_lines(before: str) -> None:
    assert build_watch.last_json(before + '{\n "a": 1\n}\n') == {"a": 1}


def test_stages_and_the_rest_are_the_whole_time() -> None:
    run = built(10, 8.0, {"survey": 1.0, "build": 4.0}, [])
    assert run.stages == {"survey": 1.0, "build": 4.0, build_runs.REST: 3.0}
    assert run.bytes_a_point == 3.0


def test_memory_is_put_to_the_stage_it_was_seen_in() -> None:
    samples = [Sample(0.5, 9, 0, 1), Sample(1.5, 5, 0, 1), Sample(2.9, 7, 0, 1), Sample(4.0, 6, 0, 1)]
    stages = {"survey": 1.0, "build": 2.0, build_runs.REST: 1.0}
    assert build_runs.stage_peaks(stages, samples, 4.0) == {"survey": 5, "build": 7, build_runs.REST: 9}


def test_linearity_is_time_a_point_over_that_of_the_size_before() -> None:
    runs = {
        1000: [built(1000, 4.0, {}, [])],
        100: [built(100, s, {}, []) for s in (9.0, 0.5, 0.4)],
        10_000: [built(10_000, 20.0, {}, [])],
    }
    assert build_runs.linearity(runs) == {(100, 1000): pytest.approx(0.8), (1000, 10_000): pytest.approx(0.5)}
    assert build_runs.median_run(runs[100]).seconds == 0.5


def test_a_failed_build_says_why(tmp_path: Path) -> None:
    with pytest.raises(build_runs.BuildError, match=r"(?s)exit code 3.*no\.las"):
        build_runs.build(tmp_path / "no.las", tmp_path / "archive", memory="1GB", jobs=1)


def test_a_stage_is_found_again_in_the_times_it_would_take() -> None:
    stage = StageRate(0.3, 5e-7, 1e-8, 2e-7)
    found = build_rates.fit_stage({(n, jobs): stage.seconds(n, jobs) for n, jobs in build_rates.SIZES})
    assert found == pytest.approx(stage, rel=0.05)


def rate_builds(others: float, slower: float) -> dict[tuple[int, int], list[build_runs.Built]]:
    """Return builds of one stage: 1 s and 1 µs a point, shared among jobs.

    Processor times are those without other load.
    """
    found = {}
    for n, jobs in build_rates.SIZES:
        alone = 1.0 + 1e-6 * n / jobs
        run = built(n, slower * alone, {"build": slower * alone}, [])
        seen = Watched(slower * alone, jobs * alone, others, [Sample(0.0, (100 + 20 * jobs) << 20, 0, 1)])
        found[n, jobs] = [dataclasses.replace(run, watched=seen)]
    return found


@pytest.mark.parametrize(("others", "slower"), [(0.0, 1.0), (1.5, 3.0)])
def test_other_work_does_not_make_rates_slow(others: float, slower: float) -> None:
    builds = rate_builds(others, slower)
    assert build_rates.is_busy(builds) is (others > 1)
    stages = build_rates.fit_stages(builds)
    assert stages["build"] == pytest.approx(StageRate(1.0, 0.0, 0.0, 1e-6), abs=1e-9)
    assert set(stages) == {"build", "start, end"}
    assert build_rates.fit_memory(builds) == pytest.approx((120 << 20, 10 << 20, 0.0))
    assert build_rates.fit_workers(builds, stages) == (0.0 if others < 1 else build_rates.USUAL_WORKERS)


def test_limits_do_all_of_the_work_and_leave_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build_limits, "BLOCK", 1000)
    path = tmp_path / "scan.las"
    path.write_bytes(bytes(range(250)) * 10)
    hashed: list[str] = []
    digest = hashlib.file_digest
    monkeypatch.setattr(
        hashlib, "file_digest", lambda *a: hashed.append(digest(*a).hexdigest()) or digest(*a)
    )
    assert build_limits.read_seconds(path) > 0
    assert build_limits.sha256_seconds(path) > 0
    assert hashed == [hashlib.sha256(path.read_bytes()).hexdigest()]
    written: list[int] = []
    sync = build_limits.os.fsync
    monkeypatch.setattr(
        build_limits.os, "fsync", lambda fd: written.append(build_limits.os.fstat(fd).st_size) or sync(fd)
    )
    assert build_limits.write_seconds(tmp_path, 2500) > 0
    assert written == [2500]
    assert [p.name for p in tmp_path.iterdir()] == ["scan.las"]


def cloud(path: Path, rng: np.random.Generator) -> np.ndarray:
    points = np.round(rng.uniform(0, 1, (3000, 3)), 3)
    path.write_text("\n".join(" ".join(f"{v:.3f}" for v in p) for p in points) + "\n")
    return points


def test_laz_is_made_of_the_points_of_the_archive(tmp_path: Path, rng: np.random.Generator) -> None:
    scan, archive = tmp_path / "scan.xyz", tmp_path / "archive"
    points = cloud(scan, rng)
    build_archive([scan], archive, BuildConfig(resolution=1e-3, jobs=1))
    found = build_sizes.quantised(scan, archive)
    assert np.array_equal(found, np.rint((points - points.min(axis=0)) * 1000))
    ours, laz = build_sizes.beside_laz(scan, archive, tmp_path / "laz")
    assert ours == sum(p.stat().st_size for p in archive.rglob("*.h5"))
    assert 3000 * 3 < laz < 3000 * 8, "30 random bits a point, and a header"
    assert not (tmp_path / "laz").exists()
    cloud(scan, rng)
    with open(scan, "a") as file:
        file.write("0.5 0.5 0.5\n")
    with pytest.raises(ValueError, match="not the same points"):
        build_sizes.quantised(scan, archive)


def test_first_points_become_laz_once(tmp_path: Path) -> None:
    import laspy

    las, laz = tmp_path / "a.las", tmp_path / "a.laz"
    header = laspy.LasHeader(point_format=0, version="1.2")
    record = laspy.ScaleAwarePointRecord.zeros(70, header=header)
    record["X"] = np.arange(70)
    with laspy.open(las, "w", header=header) as file:
        file.write_points(record)
    build_limits.laz_of(las, laz, 50)
    assert list(laspy.read(laz)["X"]) == list(range(50))
    before = laz.stat().st_mtime_ns
    build_limits.laz_of(las, laz, 50)
    assert laz.stat().st_mtime_ns == before
    assert build_limits.decode_seconds(laz, False)[1] == 50


def test_picture_is_drawn_of_any_sections(tmp_path: Path) -> None:
    samples = [Sample(0.1 * k, k << 20, k << 20, 1) for k in range(20)]
    runs = [built(n, 2.0, {"survey": 0.5, "build": 1.0}, samples) for n in (1000, 10_000)]
    part = Part("builds")
    part.goal("throughput", "points", 1.0, 2.0, "M/s", at_least=True)
    sizes = Part("sizes")
    sizes.add("façade", "", "archive", 3.0, "B/point")
    sizes.add("façade", "", "LAZ", 2.0, "B/point")
    for name, parts in (("a.png", [part]), ("b.png", [part, sizes])):
        limits = {1000: {"read": 0.1, "write": 0.2}}
        with drawn_figures() as figures:
            build_picture.draw(parts, {}, runs, limits, 1 << 30, "machine", tmp_path / name)
        (figure,) = figures
        assert alike_in_grey(figure) == [] and overlaps(figure) == [] and covered(figure) == []
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
