"""Test scripts/simulate_cache: its counts against simple replays, and one run of the script."""

import argparse
import csv
import json
import sys
from pathlib import Path
from types import ModuleType

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from project_scripts import load_script
from simulate_cache_cases.policy_replay import Loading, Outcome, Replay
from simulate_cache_cases.replay_requests import (
    NOBODY,
    SWEEP_SECONDS,
    Requests,
    Town,
    requests_of,
    with_sweeps,
)
from solidcloud.schemas.archive.voxel_grid import voxel_keys
from solidcloud.server.kernels.core.voxels_in_reach import SceneIndex
from solidcloud.server.report.load.users.user_traces import Centers, Trace, save
from solidcloud.server.residency.eviction import POLICIES
from solidcloud.server.residency.motion_prediction import PREFETCH_OPTIONS

SCRIPTS = Path(__file__).parents[3] / "scripts"
STEP, VOXEL_STEPS, EDGE = 0.01, 200, 2.0
REACH = 0.5
QUICK = Loading(per_load=0.001, per_byte=0.0)


def floor(columns: int = 60, rows: int = 4, seed: int = 1) -> Town:
    """Return a floor of 2 m voxels, each full of points, of different sizes."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    coordinates = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size, np.int64)])
    coordinates = coordinates[np.argsort(voxel_keys(coordinates))]
    low = coordinates * VOXEL_STEPS
    high = low + VOXEL_STEPS - 1
    index = SceneIndex(voxel_keys(coordinates), low, high, low.min(axis=0), high.max(axis=0))
    sizes = np.random.default_rng(seed).integers(50, 150, len(low))
    return Town(index, VOXEL_STEPS, np.zeros(3), STEP, sizes, 0.01)


TOWN = floor()


def walks(ways: list[NDArray[np.float64]], rate: float = 30.0) -> Centers:
    """Return users on paths (k, 2), with `rate` poses a second each, slightly after one another."""
    user = np.concatenate([np.full(len(way), number) for number, way in enumerate(ways)])
    time = np.concatenate([np.arange(len(way)) / rate + number * 1e-4 for number, way in enumerate(ways)])
    center = np.concatenate([np.column_stack([way, np.ones(len(way))]) for way in ways])
    order = np.lexsort((user, time))
    return Centers(
        user[order], time[order], center[order], np.full(len(user), REACH), np.zeros(len(user), bool)
    )


def along(speed: float, seconds: float, y: float = 1.0) -> NDArray[np.float64]:
    """Return a straight path along x."""
    x = 1.0 + speed * np.arange(round(seconds * 30)) / 30
    return np.column_stack([x, np.full(len(x), y)])


def strays(rng: np.random.Generator, users: int, poses: int) -> list[NDArray[np.float64]]:
    """Return users who jump within a small part of the floor."""
    return [rng.uniform([0, 0], [24, 8], (poses, 2)) for _ in range(users)]


def replay(name: str, asked: Centers, budget: int = 1 << 30, **options: object) -> tuple[Replay, Outcome]:
    """Replay once; check at every load that the resident bytes are within the budget."""
    given = {"prefetch": name != "lru", "loading": QUICK} | options
    run = Replay(TOWN, budget, name, **given)  # type: ignore[arg-type]
    load = run.load

    def watched(row: int, now: float, scan: bool) -> float:
        end = load(row, now, scan)
        assert run.bytes == sum(run.sizes[row] for row in run.resident) <= budget
        assert set(run.ready) <= run.resident and run.unused <= run.resident
        return end

    run.load = watched  # type: ignore[method-assign]
    return run, run.run(requests_of(TOWN, asked))


def test_what_a_request_needs_is_what_its_ball_touches() -> None:
    asked = walks([along(3.0, 3.0), along(3.0, 3.0, y=2.2)])
    requests = requests_of(TOWN, asked)
    center = asked.center[:, None] / STEP
    gap = np.maximum(np.maximum(TOWN.index.low - center, center - TOWN.index.high), 0)
    touched = np.sqrt((gap**2).sum(axis=2)) <= REACH / STEP + 1.0
    for rows, expected in zip(requests.rows, touched, strict=True):
        assert sorted(rows) == np.flatnonzero(expected).tolist()
    assert requests.flat.tolist() == [row for rows in requests.rows for row in rows]
    assert requests.request.tolist() == [i for i, rows in enumerate(requests.rows) for _ in rows]
    assert requests.first.sum() == 60 and requests.first[:60].all()


def naive_lru(requests: Requests, budget: int) -> tuple[int, int, int, list[float]]:
    """Return misses, frames missed, evictions and waits of LRU: lists, oldest first, loads one by one."""
    order: list[int] = []
    ready: dict[int, float] = {}
    misses = evictions = 0
    free, waits = -np.inf, []
    for rows, now in zip(requests.rows, requests.asked.time.tolist(), strict=True):
        wait = 0.0
        for row in [row for row in rows if row in order]:
            order.remove(row)
            order.append(row)
            wait = max(wait, ready[row] - now)
        for row in [row for row in rows if row not in order]:
            while sum(int(TOWN.sizes[other]) for other in [*order, row]) > budget:
                order.remove(next(other for other in order if other not in rows))
                evictions += 1
            order.append(row)
            misses += 1
            free = ready[row] = max(free, now) + QUICK.per_load
            wait = max(wait, free - now)
        waits.append(wait)
    return misses, sum(wait > 0 for wait in waits), evictions, waits


@pytest.mark.parametrize("seed", range(4))
def test_lru_counts_as_lists_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    asked, budget = walks(strays(rng, 3, 200)), 1500
    _, found = replay("lru", asked, budget)
    misses, frames, evictions, waits = naive_lru(requests_of(TOWN, asked), budget)
    assert (found.misses, found.frames_missed, found.evictions) == (misses, frames, evictions)
    assert np.allclose(found.waits, waits) and evictions > 100
    assert found.requests == 600 and found.references == len(requests_of(TOWN, asked).flat)
    assert (found.prefetched, found.vain, found.late) == (0, 0, 0)


def test_one_loader_serves_one_after_another() -> None:
    """Test three users: the second waits for the load of the first, the third, elsewhere, for both."""
    asked = walks([along(0.0, 0.1), along(0.0, 0.1), along(0.0, 0.1, y=5.0)])
    _, found = replay("lru", asked, loading=Loading(0.1, 0.0))
    assert found.misses == 2 and found.frames_missed == 9, (
        "at 30 a second three frames of each pass meanwhile"
    )
    assert np.allclose(found.waits[:3], [0.1, 0.1 - 1e-4, 0.2 - 2e-4])
    assert found.row()["wait_p50_ms"] == pytest.approx(np.median(found.waits) * 1e3)


def test_bytes_take_their_time() -> None:
    _, found = replay("lru", walks([along(0.0, 0.04)]), loading=Loading(0.001, 1e-5))
    row = requests_of(TOWN, walks([along(0.0, 0.04)])).rows[0][0]
    assert found.waits[0] == pytest.approx(0.001 + 1e-5 * TOWN.sizes[row])


@pytest.mark.parametrize("name", [name for name in POLICIES if name != "lru"])
def test_who_walks_straight_on_waits_no_more_after_the_first_second(name: str) -> None:
    asked = walks([along(3.0, 20.0), along(3.0, 20.0, y=5.0)])
    _, without = replay("lru", asked)
    _, found = replay(name, asked, budget=3000, ahead=PREFETCH_OPTIONS._replace(ring=0.0))
    assert without.misses_later >= 40
    assert found.misses_later == found.frames_missed_later == 0 < found.misses < 10
    assert found.prefetched >= 40 and found.evictions > 20
    assert found.vain <= 2, "what was ahead when the walk ended"


@pytest.mark.parametrize("name", [name for name in POLICIES if name != "lru"])
@pytest.mark.parametrize("budget", [800, 2000, 1 << 30])
def test_every_load_is_demanded_or_in_vain(name: str, budget: int) -> None:
    rng = np.random.default_rng(7)
    starts = [np.array([10.0 + 8 * user, 4.0]) for user in range(3)]
    ways = [start + np.cumsum(rng.normal(0, 0.08, (300, 2)), axis=0) for start in starts]
    run, found = replay(name, walks([np.clip(way, 0, [119, 8]) for way in ways]), budget)
    loads = found.misses - found.late + found.prefetched
    assert len(run.resident) == loads - found.evictions
    assert 0 <= found.vain <= found.prefetched and found.vain_bytes <= found.prefetched_bytes
    assert found.late <= found.misses and found.frames_missed == (found.waits > 0).sum()
    assert (budget < 1 << 30) == (found.evictions > 0)


def test_a_ring_that_nobody_goes_to_is_in_vain() -> None:
    asked = walks([along(0.0, 3.0, y=4.0)])
    _, small = replay("lru+prefetch", asked, ahead=PREFETCH_OPTIONS._replace(ring=0.0))
    _, large = replay("lru+prefetch", asked, ahead=PREFETCH_OPTIONS._replace(ring=6.0))
    assert small.prefetched == 0 < large.prefetched == large.vain
    assert large.row()["vain_share"] == 1.0 and small.row()["vain_share"] == 0.0


def test_what_comes_too_late_is_a_miss_once_and_waits_the_less() -> None:
    """Test a running user with loads of half a second: prefetches begin in time, but end too late."""
    asked = walks([along(5.0, 10.0)])
    slow = Loading(0.35, 0.0)
    _, without = replay("lru", asked, loading=slow)
    run, found = replay(
        "lru+prefetch", asked, loading=slow, ahead=PREFETCH_OPTIONS._replace(loads=0.0, least=0.1, ring=0.0)
    )
    assert found.late > 5 and found.misses >= found.late
    assert found.vain <= 1 and found.row()["wait_p50_ms"] < without.row()["wait_p50_ms"]
    assert len(run.resident) == found.misses - found.late + found.prefetched


def test_loading_ahead_takes_nothing_that_somebody_stands_in() -> None:
    """Test a standing and a running user, with room for little more than they touch."""
    asked = walks([along(0.0, 8.0, y=5.0), along(5.0, 8.0)])
    _, found = replay("lru+prefetch", asked, budget=700)
    stands = asked.user == 0
    assert (found.waits[stands][30:] == 0).all() and found.evictions > 10


def test_sweeps_come_evenly_and_ask_for_every_voxel() -> None:
    asked = walks([along(1.0, 60.0), along(1.0, 60.0, y=5.0)])
    both = with_sweeps(TOWN, asked, 2)
    swept = both.user == NOBODY
    assert (np.diff(both.time) >= 0).all() and both.scan[swept].all() and not both.scan[~swept].any()
    for ours, theirs in zip(both, asked, strict=True):
        assert np.array_equal(ours[~swept], theirs)
    rows = [rows for rows, scan in zip(requests_of(TOWN, both).rows, swept, strict=True) if scan]
    voxels = len(TOWN.sizes)
    assert rows == [[row] for row in range(voxels)] * 2
    begin = both.time[swept][[0, voxels]]
    assert np.allclose(begin, asked.time[0] + np.ptp(asked.time) * np.array([1, 2]) / 3)
    assert np.ptp(both.time[swept][:voxels]) == pytest.approx(SWEEP_SECONDS, rel=0.01)


@pytest.mark.parametrize("name", ["lru", "lru+prefetch"])
def test_sweeps_that_are_told_hurt_less_and_are_counted_apart(name: str) -> None:
    """Test users who walk to and fro, with room for little more than their path."""
    x = 6.0 + 5.0 * np.sin(np.arange(1800) / 30)
    asked = walks([np.column_stack([x, np.full(1800, y)]) for y in (1.0, 5.0)])
    swept = with_sweeps(TOWN, asked, 4)
    plain = replay(name, asked, budget=3000)[1]
    told = replay(name, swept, budget=3000)[1]
    _, hidden = replay(name, swept._replace(scan=np.zeros(len(swept.user), bool)), budget=3000)
    for found in (told, hidden):
        assert found.misses_swept > 600 and len(found.waits) == len(asked.user)
        assert found.misses_later <= found.misses - found.misses_swept

    def loads(found: Outcome) -> int:
        return found.misses - found.misses_swept + found.prefetched

    assert loads(plain) <= loads(told) < loads(hidden)


def test_what_a_sweep_asks_for_was_not_loaded_ahead_for_it() -> None:
    asked = walks([along(0.0, 30.0, y=4.0)])
    options = {"ahead": PREFETCH_OPTIONS._replace(ring=3.0)}
    _, plain = replay("lru+prefetch", asked, **options)
    _, swept = replay("lru+prefetch", with_sweeps(TOWN, asked, 1), **options)
    assert swept.prefetched == plain.prefetched == plain.vain == swept.vain > 0


def test_a_budget_below_one_request_is_refused() -> None:
    with pytest.raises(ValueError, match="a request needs"):
        replay("lru", walks([along(1.0, 1.0)]), budget=60)


@pytest.fixture(scope="module")
def script() -> ModuleType:
    """Return scripts/simulate_cache as a module."""
    return load_script("simulate_cache")


def test_counted_in_voxels_all_are_one_size_and_load_in_the_time_of_the_mean(script: ModuleType) -> None:
    whole, units = script.cases(TOWN, 1000, Loading(0.001, 1e-5))
    mean = float(TOWN.sizes.mean())
    assert whole.town is TOWN and whole.budget == 1000
    assert (units.town.sizes == 1).all() and units.budget == int(1000 / mean)
    assert units.loading.per_load == pytest.approx(0.001 + 1e-5 * mean) and units.loading.per_byte == 0.0


def test_the_optimum_is_of_the_same_references_and_never_worse(script: ModuleType) -> None:
    requests = requests_of(TOWN, walks(strays(np.random.default_rng(3), 3, 200)))
    units = script.cases(TOWN, 1500, QUICK)[1]
    best = script.run_belady(units, requests)
    for name in POLICIES:
        row = script.run(units, requests, name, False, PREFETCH_OPTIONS)
        assert row["references"] == best["references"] and row["budget"] == best["budget"]
        assert row["misses"] >= best["misses"] and row["misses_later"] >= best["misses_later"] > 0


def test_goals_are_of_voxels_and_after_the_first_second(script: ModuleType) -> None:
    def row(side: str, unit: str, later: int, vain: float) -> dict[str, object]:
        return {"side": side, "unit": unit, "misses": 999, "misses_later": later, "vain_share": vain}

    rows = [
        row("lru", "bytes", 1, 0.0), row("lru+prefetch", "bytes", 1, 0.31), row(script.BELADY, "voxels", 100, 0.0),
        row("lru", "voxels", 150, 0.0), row("lru+prefetch", "voxels", 6, 0.2),
    ]  # fmt: skip
    found = script.goals("stroll", rows)
    assert [(goal.measured, goal.word) for goal in found] == [
        (1.5, "met"), (0.06, "missed"), (31.0, "missed"), (20.0, "met"),
    ]  # fmt: skip
    assert script.goals("run", rows) == []


def test_ahead_is_read_by_name(script: ModuleType) -> None:
    read = script.read_ahead("ring=1.5,most_wanted=32")
    assert read == PREFETCH_OPTIONS._replace(ring=1.5, most_wanted=32) and type(read.most_wanted) is int
    assert script.changed(read) == "ring 1.5, most_wanted 32"
    moved = script.read_ahead("history=0.25")
    assert moved == PREFETCH_OPTIONS._replace(motion=PREFETCH_OPTIONS.motion._replace(history=0.25))
    assert script.changed(moved) == "history 0.25" and script.changed(PREFETCH_OPTIONS) == ""
    for text in ("width=3", "ring=x", "ring", "motion=1"):
        with pytest.raises(
            argparse.ArgumentTypeError, match="expected NAME=NUMBER, of loads, least, most, ring, settled"
        ):
            script.read_ahead(text)


def test_a_recorded_trace_is_replayed_against_an_archive(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    case = archive_cases.build(
        tmp_path, synthetic_scans.make_scan("noise", 5, 2000) * 4, voxel=0.5, resolution=1e-3
    )
    way = np.tile(np.eye(4), (90, 1, 1))
    way[:, :3, 3] = np.column_stack([np.linspace(0, 8, 90), np.full((90, 2), 3.0)])
    save(tmp_path / "stroll.npz", Trace(np.zeros(90, np.int64), np.arange(90) / 30, way))
    out = tmp_path / "out" / "cache.json"
    command = ["simulate_cache", str(case.archive), "--share", "0.9", "--trace", str(tmp_path / "stroll.npz")]
    monkeypatch.setattr(sys, "argv", [*command, "--ahead", "ring=0", "--json", str(out)])
    assert script.main() == 0
    report = json.loads(out.read_text())
    rows = report["kinds"]["stroll"]
    own = ["lru", "lru+prefetch", "distance, no prefetch", "distance", "s3fifo, no prefetch", "s3fifo"]
    sides = {unit: [row["side"] for row in rows if row["unit"] == unit] for unit in ("bytes", "voxels")}
    assert sides == {
        "bytes": [*own, "prefetch, ring 0"],
        "voxels": ["Belady's optimum", *own, "prefetch, ring 0"],
    }
    assert all(row["requests"] == 90 and row["misses"] > 0 for row in rows)
    assert len(report["goals"]) == 4 and all(goal["verdict"] in ("met", "missed") for goal in report["goals"])
    with open(out.with_suffix(".csv"), newline="") as file:
        assert len(list(csv.DictReader(file))) == len(rows)
    said = capsys.readouterr().out
    assert "Belady's optimum" in said and f"written: {out}" in said
