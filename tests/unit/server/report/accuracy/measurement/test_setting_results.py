"""Test the accuracy report's figures: wrong answers, Pareto fronts, and how times are taken."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.server.report.accuracy.accuracy_report import write_rows
from solidcloud.server.report.accuracy.measurement import interleaved_timing, user_errors
from solidcloud.server.report.accuracy.measurement.engine_settings import (
    engine_settings,
    length_name,
    radius_settings,
)
from solidcloud.server.report.accuracy.measurement.interleaved_timing import TimedSetting, take_times
from solidcloud.server.report.accuracy.measurement.measurement_plan import BRIEF, FULL, MeasurementPlan
from solidcloud.server.report.accuracy.measurement.setting_results import (
    BUDGET,
    COLUMNS,
    DEGREE,
    LEAF,
    NODES,
    RADIUS,
    STEP,
    TOLERANCE,
    Report,
    Row,
    compare_distances,
    compare_verdicts,
    error_of,
    mark_pareto_fronts,
)
from solidcloud.server.report.accuracy.measurement.user_errors import (
    measure_generated_doors,
    measure_user_errors,
)
from solidcloud.server.report.common.doorway import Doorway
from solidcloud.server.report.common.wall_leak import Leak


def test_early_late_and_unknown_are_told_apart() -> None:
    exact = np.array([True, True, True, False, False, False])
    contact = np.array([True, False, False, True, False, False])
    unknown = np.array([False, False, True, False, False, True])
    row = Row(TOLERANCE, "1 mm")
    compare_verdicts(row, contact, unknown, exact)
    assert (row.poses, row.early, row.late, row.unknown) == (6, 1, 1, 2)
    assert row.wrong_share == 4 / 6 and row.tangent == 0
    compare_verdicts(row, exact, np.zeros(6, bool), exact, tangent=True)
    assert (row.tangent, row.tangent_early, row.tangent_late, row.early) == (6, 0, 0, 1)


def test_a_distance_without_a_pair_is_counted_and_not_averaged() -> None:
    row = Row(TOLERANCE, "1 mm")
    compare_distances(row, np.array([0.010, math.inf, 0.5, math.inf]), np.array([0.012, 0.2, 0.5, math.inf]))
    assert row.distance_missing == 1
    assert row.distance_max_mm == pytest.approx(2.0) and row.distance_mean_mm == pytest.approx(1.0)


def test_a_ball_stopped_early_does_not_leak_and_a_wide_door_is_as_wrong_as_a_narrow_one() -> None:
    row = Row(TOLERANCE, "1 cm", leak_p99_mm=-8.0, doorway_mm=-3.0)
    assert error_of(row, "leak") == 0.0 and error_of(row, "doorway") == 3.0
    assert error_of(row, "distance") is None and error_of(row, "wrong") is None
    row.poses, row.unknown = 10, 1
    assert error_of(row, "leak") is None, "stopped by its budget, not by a wall"
    assert error_of(Row(RADIUS, "local", poses=10, early=4), "wrong") is None, "another radius is no error"


def timed(setting: str, time: float, doorway: float, knob: str = TOLERANCE) -> Row:
    return Row(knob, setting, mean_us=time, doorway_mm=doorway, poses=10)


def test_the_front_holds_what_nothing_beats() -> None:
    rows = [timed("fast", 1, 20), timed("good", 4, 5), timed("between", 2, 10), timed("beaten", 3, 15)]
    rows += [timed("as fast but worse", 1.08, 25), timed("as good but slower", 5, 5)]
    rows += [timed("another knob", 0.1, 0.0, "leaf size"), timed("does not pass", 0.5, math.inf)]
    mark_pareto_fronts(rows, (TOLERANCE,))
    assert {row.setting for row in rows if "doorway" in row.front} == {
        "fast",
        "good",
        "between",
        "does not pass",
    }
    assert not any("leak" in row.front for row in rows), "nothing was measured of the leak"


def test_two_errors_at_once_leave_more_unbeaten() -> None:
    rows = [
        Row(RADIUS, name, mean_us=time, doorway_mm=door, leak_p99_mm=leak)
        for name, time, door, leak in (
            ("thick", 4.0, 50.0, 0.0), ("thin", 4.0, 10.0, 40.0), ("local", 4.8, 24.0, -10.0), ("mean", 4.8, 25.0, 20.0)
        )
    ]  # fmt: skip
    mark_pareto_fronts(rows, (RADIUS,))
    assert [row.front for row in rows] == [
        ("leak", "doorway and leak"), ("doorway", "doorway and leak"), ("doorway and leak",), (),
    ]  # fmt: skip


def test_rows_are_written_as_json_and_csv_that_hold_every_field(tmp_path: Path) -> None:
    rows = [Row(TOLERANCE, "0", 0.0, True, mean_us=2.0), Row(STEP, "1 mm", math.inf, doorway_mm=math.inf)]
    write_rows(Report("scene", rows, {"seconds": 1.0}), tmp_path)
    found = json.loads((tmp_path / "accuracy.json").read_text())
    assert found["facts"] == {"seconds": 1.0} and [row["setting"] for row in found["rows"]] == ["0", "1 mm"]
    assert found["rows"][1]["doorway_mm"] is None and found["rows"][1]["value"] is None
    assert (
        found["rows"][1]["note"] == "value is infinite; doorway_mm is infinite"
        and not found["rows"][0]["note"]
    )
    assert set(found["rows"][0]) == set(COLUMNS)
    lines = (tmp_path / "accuracy.csv").read_text().splitlines()
    assert lines[0].split(",") == list(COLUMNS) and len(lines) == 3


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[float]]:
    """Return a clock that advances only by what is added to it."""
    now = [0.0]
    monkeypatch.setattr(interleaved_timing.time, "perf_counter", lambda: now[0])
    yield now


def test_settings_are_timed_in_turn_and_a_busy_moment_is_left_out(clock: list[float]) -> None:
    asked: list[tuple[str, int]] = []

    def answer(name: str, each: float) -> TimedSetting:
        def ask(poses: np.ndarray) -> None:
            asked.append((name, len(poses)))
            busy = 7.0 if name == "slow" and len(asked) == 5 else 0.0
            clock[0] += each * len(poses) + busy

        return TimedSetting(ask)

    subjects = [answer("slow", 3.0), answer("fast", 1.0)]
    ticks = []
    take_times(subjects, np.zeros((8, 4, 4)), 3, 4, lambda: ticks.append(1))
    # All poses once, untimed; then two runs of four poses.
    assert asked == [("slow", 8), ("slow", 4), ("slow", 4), ("fast", 8), ("fast", 4), ("fast", 4)] * 3
    assert len(ticks) == 6
    assert [s.mean for s in subjects] == [3.0, 1.0]
    assert [s.quantile(0.99) for s in subjects] == [3.0, 1.0]


def test_noise_is_what_the_middle_repetition_took_longer() -> None:
    subject = TimedSetting(
        lambda poses: None, 2, [np.array([2.0, 4.0]), np.array([4.0, 4.0]), np.array([9.0, 9.0])]
    )
    assert subject.mean == 1.5 and subject.noise == 8 / 6
    assert subject.quantile(0.0) == 1.0 and subject.quantile(1.0) == 2.0


@pytest.mark.parametrize("plan", [BRIEF, FULL])
def test_every_knob_has_one_default_and_its_other_settings_differ(plan: object) -> None:
    settings = engine_settings(plan, BuildConfig(resolution=1e-4), 0.0124)  # type: ignore[arg-type]
    knobs = {s.row.knob for s in settings}
    assert RADIUS not in knobs and len(knobs) == 6
    for knob in knobs:
        own = [s for s in settings if s.row.knob == knob]
        assert sum(s.row.default for s in own) == 1, knob
        assert len({(str(s.config), str(s.options)) for s in own}) == len(own), knob


def test_the_defaults_are_those_of_the_archive_that_is_given() -> None:
    own = BuildConfig(
        resolution=3e-3, degree=5, leaf=7, with_slab=False, voxel=2.0, radius=0.03, cells="balanced"
    )
    settings = engine_settings(BRIEF, own, 0.03)
    marked = {s.row.knob: s.row.setting for s in settings if s.row.default}
    assert marked == {
        TOLERANCE: "0", BUDGET: "none", STEP: "3 mm", DEGREE: "5", LEAF: "7", NODES: "sphere",
    }  # fmt: skip
    assert all(s.config == own for s in settings if s.row.default)
    for config in [s.config for s in (*settings, *radius_settings(BRIEF, own, 0.03))]:
        assert (config.voxel, config.radius, config.cells) == (2.0, 0.03, "balanced")
    assert [s.config.with_slab for s in settings if s.row.knob == NODES] == [True, False]


@pytest.mark.parametrize("plan", [BRIEF, FULL])
def test_no_radius_model_is_measured_twice(plan: MeasurementPlan) -> None:
    for radius in (0.0124, 0.00987, 0.003, 0.25):
        names = [s.row.setting for s in radius_settings(plan, BuildConfig(resolution=1e-4), radius)]
        assert len(set(names)) == len(names) == 5 * len(plan.factors), names


def test_with_another_avatar_the_leak_is_measured_and_the_doorway_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(user_errors, "leak_places", lambda truth, places: places)
    monkeypatch.setattr(user_errors, "leak", lambda scene, places, **_: Leak(1.0, 2.0, 3.0, 0.25))
    monkeypatch.setattr(user_errors, "doorway_error", lambda *_, **__: Doorway(math.inf, 0.5, math.inf))
    truth = SimpleNamespace(facades=["facade"])
    for own in (False, True):
        settings = [
            s
            for s in engine_settings(BRIEF, BuildConfig(resolution=1e-4), 0.0124)
            if s.row.knob in (TOLERANCE, DEGREE)
        ]
        ground: Any = SimpleNamespace(truth=truth, is_figure=own)
        archives: Any = SimpleNamespace(scene=lambda config: None)
        measure_user_errors(settings, archives, ground, BRIEF, lambda: None)
        for row in (s.row for s in settings):
            assert (row.leak_p50_mm, row.leak_p99_mm, row.leak_worst_mm, row.leak_share) == (1, 2, 3, 0.25)
            assert row.doorway_mm == (math.inf if own else None)
            assert bool(row.note) == (own and row.knob == TOLERANCE)


def test_doors_are_made_for_the_models_of_the_plan_and_fill_their_rows_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = MeasurementPlan(points=9000, made_models=("mean", "local+border"))
    plain = BuildConfig(resolution=1e-3)
    settings = [*engine_settings(plan, plain, 0.0124), *radius_settings(plan, plain, 0.0124)]
    asked = {}

    def made(folder: Path, config: BuildConfig, models: list[str], **others: Any) -> dict[str, Doorway]:
        asked.update(others, models=models, stored=config.models, step=config.resolution)
        others["tick"]()
        return {"mean": Doorway(0.58, 0.555, 25.0), "local+border": Doorway(math.inf, 0.555, math.inf)}

    monkeypatch.setattr(user_errors, "measure_doorways", made)
    ticks: list[None] = []
    measure_generated_doors(settings, tmp_path, plan, lambda: ticks.append(None))
    found = {s.row.setting: s.row.made_doorway_mm for s in settings if s.row.made_doorway_mm is not None}
    assert found == {"mean": 25.0, "local+border": math.inf} and len(ticks) == 1
    assert asked["models"] == ["mean", "local+border"] and asked["points"] == 9000 and asked["seed"] == 2012
    assert asked["stored"] == {"mean", "local", "border"} and asked["step"] == 1e-3
    assert BRIEF.made_models == () and set(FULL.made_models) == {"mean", "local", "border", "local+border"}
    assert FULL.places == 20_000


def test_lengths_are_named_as_people_say_them() -> None:
    names = [length_name(x) for x in (0.0, 1e-5, 1e-4, 1e-3, 5e-3, 0.01, 0.1)]
    assert names == ["0", "0.01 mm", "0.1 mm", "1 mm", "5 mm", "1 cm", "10 cm"]
