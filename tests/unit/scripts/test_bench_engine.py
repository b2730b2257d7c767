"""Test the parts of scripts/bench_engine: poses, classes, targets and turns. Nothing is timed."""

import csv
import json
import math
from pathlib import Path
from types import SimpleNamespace

import naive
import numpy as np
import pytest
from bench_engine_cases import compared_sides, engine_picture
from measurement import query_poses
from measurement.contact_definition import Judge, least_distance
from picture_checks import alike_in_grey, covered, drawn_figures, overlaps
from scipy.spatial import cKDTree
from solidcloud.builder.synthetic.facade import build_facade
from solidcloud.builder.synthetic.walk import walk_poses
from solidcloud.server.report.common import bench_results, machine
from solidcloud.server.report.common.machine import Clock

PLANE = np.array([[x, y, 0.0] for x in np.arange(0, 2, 0.05) for y in np.arange(0, 2, 0.05)])
BODY = np.array([[0.0, 0, 0.1], [0.1, 0, 0.1], [0, 0, 1.0]])


def least(points: np.ndarray, avatar: np.ndarray, pose: np.ndarray) -> float:
    """Return the least distance of centres, over all pairs."""
    placed = avatar @ pose[:3, :3].T + pose[:3, 3]
    return float(np.sqrt(((placed[:, None] - points) ** 2).sum(axis=2).min()))


def test_jitter_moves_every_pose_by_at_most_its_size_and_keeps_the_given_ones(
    rng: np.random.Generator,
) -> None:
    given = query_poses.upright(rng.uniform(-9, 9, (50, 3)), rng.uniform(-3, 3, 50))
    before = given.copy()
    moved = query_poses.jittered(given, rng)
    shift = moved[:, :3, 3] - given[:, :3, 3]
    assert np.array_equal(given, before)
    assert np.array_equal(moved[:, :, :3], given[:, :, :3])
    assert (np.abs(shift) <= query_poses.JITTER * (1 + 1e-6)).all()
    assert (shift != 0).any(axis=1).all()
    assert not np.array_equal(moved, query_poses.jittered(given, rng))


def test_walk_at_another_rate_is_the_same_path() -> None:
    truth = build_facade().truth
    coarse, fine = query_poses.walk_at(truth, 30.0), query_poses.walk_at(truth, 90.0)
    assert np.array_equal(coarse, walk_poses(truth)[1])
    assert len(fine) == 3 * len(coarse)
    assert np.allclose(fine[[0, -1]], coarse[[0, -1]])
    step = np.linalg.norm(np.diff(fine[:, :3, 3], axis=0), axis=1).max()
    assert cKDTree(fine[:, :3, 3]).query(coarse[:, :3, 3])[0].max() <= step


def test_every_pose_is_in_one_class() -> None:
    contact = np.array([True, False, False, False, True])
    masks = query_poses.classes(contact, np.array([-0.1, 0.2, 0.5, np.inf, np.inf]), far=0.5)
    assert {name: mask.tolist() for name, mask in masks.items()} == {
        "far": [False, False, False, True, False],
        "clear, near": [False, True, True, False, False],
        "contact": [True, False, False, False, True],
    }


def test_gaps_are_those_of_all_pairs(rng: np.random.Generator) -> None:
    points, avatar = rng.uniform(0, 2, (500, 3)), rng.uniform(-0.3, 0.3, (200, 3))
    given = query_poses.upright(rng.uniform(-1, 3, (60, 3)), rng.uniform(-3, 3, 60))
    expected = np.array([least(points, avatar, pose) for pose in given]) - 0.02
    expected[expected > 0.5] = np.inf
    found = query_poses.gaps(cKDTree(points), avatar, given, 0.02)
    assert np.isinf(expected).any() and np.isfinite(expected).any()
    assert np.allclose(found, expected)


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.6, 0.0, 0.8)])
def test_touching_shift_is_where_the_last_pair_parts(
    rng: np.random.Generator, axis: tuple[float, ...]
) -> None:
    points, placed = rng.uniform(0, 1, (300, 3)), rng.uniform(0, 1, (40, 3))
    shift = query_poses.touching_shift(points, placed, axis, 0.05)

    def distance(more: float) -> float:
        moved = placed + (shift + more) * np.array(axis)
        return float(np.sqrt(((moved[:, None] - points) ** 2).sum(axis=2).min()))

    assert distance(0.0) == pytest.approx(0.05, abs=1e-12)
    assert all(distance(more) > 0.05 for more in (1e-6, 1e-3, 0.1, 0.5))
    assert distance(-1e-6) < 0.05


def test_touching_shift_of_what_passes_by_is_none() -> None:
    assert query_poses.touching_shift(PLANE, BODY + np.array([5.0, 0, 0]), (0.0, 0, 1), 0.02) == -np.inf


def test_feet_are_at_the_height_of_contact_or_a_step_beside_it() -> None:
    walk = query_poses.upright(
        np.column_stack([np.linspace(0.5, 1.5, 22), np.full(22, 1.0), np.full(22, 0.03)]), np.zeros(22)
    )
    found = query_poses.feet_on_floor(PLANE, BODY, walk, 0.04, 22)
    gaps = np.array([least(PLANE, BODY, pose) for pose in found.poses]) - 0.04
    steps = np.resize(query_poses.FOOT_STEPS, 22)
    assert len(found.poses) == 22
    assert (np.sign(gaps[steps != 0]) == np.sign(steps[steps != 0])).all()
    assert np.abs(gaps[steps == 0]).max() < 1e-12
    assert (np.abs(gaps) <= np.abs(steps) + 1e-12).all()


def test_near_surfaces_leaves_a_small_gap(rng: np.random.Generator) -> None:
    found = query_poses.near_surfaces(cKDTree(PLANE), PLANE, BODY, 0.06, rng, 40).poses
    gaps = np.array([least(PLANE, BODY, pose) - 0.06 for pose in found])
    low, high = query_poses.LEFT
    assert len(found) >= 20
    assert (gaps <= high + 1e-9).all(), "what was not around may be nearer, not farther"
    assert ((gaps >= low - 1e-9) & (gaps > 0)).any() and (gaps < 0).any()


def test_free_space_keeps_away(rng: np.random.Generator) -> None:
    bounds = np.array([[0.0, 0, -1], [2, 2, 2]])
    for far in (0.0, 0.3):
        found = query_poses.free_space(cKDTree(PLANE), bounds, BODY, 0.04, rng, 40, far).poses
        assert len(found) == 40
        assert all(least(PLANE, BODY, pose) - 0.04 > far for pose in found)


def test_walls_are_a_centimetre_away(rng: np.random.Generator) -> None:
    truth = build_facade().truth
    wall = truth.wall("nave right")
    y, z = np.meshgrid(np.arange(wall.low, wall.high, 0.05), np.arange(wall.z_low, wall.z_low + 2, 0.05))
    points = np.column_stack([np.full(y.size, wall.offset), y.ravel(), z.ravel()])
    found = query_poses.along_walls(points, BODY, truth, 0.04, rng, 60).poses
    gaps = [least(points, BODY, pose) - 0.04 for pose in found]
    assert len(found) >= 10
    assert np.allclose(gaps, query_poses.SLIDING, atol=1e-12)


def test_inside_columns(rng: np.random.Generator) -> None:
    truth = build_facade().truth
    for x, y, z in query_poses.inside_columns(truth, rng, 30).poses[:, :3, 3]:
        assert any((x, y) == (c.x, c.y) and c.z_low <= z <= c.z_high for c in truth.columns)


@pytest.mark.parametrize(
    ("measured", "limit", "at_least", "word"),
    [
        (0.25, 0.25, False, bench_results.MET),
        (0.2501, 0.25, False, bench_results.MISSED),
        (100.0, 99.0, True, bench_results.MET),
        (98.0, 99.0, True, bench_results.MISSED),
        (None, 1.0, False, bench_results.NOT_MEASURED),
        (1.0, None, False, bench_results.NOT_MEASURED),
        (math.nan, 1.0, False, bench_results.MISSED),
        (math.nan, 1.0, True, bench_results.MISSED),
    ],
)
def test_a_goal_is_met_missed_or_not_measured(
    measured: float | None, limit: float | None, at_least: bool, word: str
) -> None:
    assert bench_results.Goal("key", "section", "text", measured, limit, "µs", at_least).word == word


def test_figures_are_medians_and_the_best_is_the_least_time_or_the_highest_rate() -> None:
    part = bench_results.Part("collide")
    assert part.add("walk", "ours", "collide", [3.0, 1.0, 2.0], "µs", 5) == 2.0
    part.add("walk", "ours", "path", [3.0, 1.0, 2.0], "poses/s")
    assert [(f.value, f.best, f.repetitions) for f in part.figures] == [(2.0, 1.0, 3), (2.0, 3.0, 3)]
    assert part.value("walk", "ours", "collide") == 2.0
    assert part.value("walk", "theirs", "collide") is None


def test_ratio_needs_both() -> None:
    assert bench_results.ratio(1.0, 4.0) == 0.25
    assert (
        bench_results.ratio(None, 4.0) is None
        and bench_results.ratio(1.0, None) is None
        and bench_results.ratio(1.0, 0.0) is None
    )


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "-"),
        (0.0, "0"),
        (math.inf, "inf"),
        (0.01234, "0.0123"),
        (9.876, "9.88"),
        (12.3, "12.3"),
        (123456.7, "123,457"),
    ],
)
def test_numbers_have_three_digits_that_count(value: float | None, text: str) -> None:
    assert bench_results.number(value) == text


def a_report() -> list[bench_results.Part]:
    """Return two sections: one with a met, a missed and an unmeasured target, and one that failed."""
    part = bench_results.Part("collide", missing=["peers"], others=0.1)
    part.add("façade, walk", "ours, voxel 32 m", "collide", [9.0, 10.0], "µs", 1200)
    part.add("façade, walk", compared_sides.TABLE, "collide", 39.0, "µs", 1200)
    part.goal("table", "mean / table", 10 / 39, 0.25, "x")
    part.goal("far", "far poses", 1.0, 2.0, "µs")
    part.goal("capt", "mean / CAPT", None, 0.15, "x")
    return [part, bench_results.Part("scans", error="RuntimeError: no")]


def test_goal_rows_carry_their_notes() -> None:
    rows = bench_results.goal_rows(a_report(), {"table": "tried a grid"})
    assert [row["verdict"] for row in rows] == [
        bench_results.MISSED,
        bench_results.MET,
        bench_results.NOT_MEASURED,
    ]
    assert [row["note"] for row in rows] == ["tried a grid", "", ""]


def test_a_miss_is_printed_with_its_note(capsys: pytest.CaptureFixture[str]) -> None:
    bench_results.show(a_report(), {"table": "tried a grid"})
    said = capsys.readouterr().out
    assert "table: 1 of 1 missed: tried a grid" in said
    assert "far:" not in said and "capt:" not in said, "met, or not measured, and nothing to note"
    assert "not measured (collide): peers" in said
    assert "section scans ended early: RuntimeError: no" in said
    assert "busy" not in said


def test_other_work_on_the_machine_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    parts = a_report()
    parts[0].others = 5.0
    bench_results.show(parts, {})
    assert "busy: 5.0 others wanted a core: not figures to quote" in capsys.readouterr().out


def test_the_report_is_written_and_drawn(tmp_path: Path) -> None:
    bench_results.write(a_report(), {}, {"seconds": 1.0}, tmp_path / "out" / "engine.json")
    report = json.loads((tmp_path / "out" / "engine.json").read_text())
    assert [section["section"] for section in report["sections"]] == ["collide", "scans"]
    assert len(report["goals"]) == 3
    with open(tmp_path / "out" / "engine.csv", newline="") as file:
        assert [row["side"] for row in csv.DictReader(file)] == ["ours, voxel 32 m", compared_sides.TABLE]
    for number, parts in enumerate((a_report(), [bench_results.Part("memory")])):
        with drawn_figures() as figures:
            engine_picture.draw(parts, {}, "a machine", tmp_path / f"{number}.png")
        (figure,) = figures
        assert alike_in_grey(figure) == [] and overlaps(figure) == [] and covered(figure) == []
        assert (tmp_path / f"{number}.png").read_bytes().startswith(b"\x89PNG")


def test_sides_take_turns_and_no_pose_comes_twice(rng: np.random.Generator) -> None:
    given = query_poses.upright(np.zeros((10, 3)), np.zeros(10))
    seen: list[tuple[str, np.ndarray, np.ndarray]] = []

    def side(name: str, **options: int) -> compared_sides.Contender:
        def time(warm: np.ndarray, asked: np.ndarray) -> float:
            seen.append((name, warm, asked))
            return float(len(seen))

        return compared_sides.Contender(name, time, **options)

    contenders = [side("a"), side("b", most=4, loops=2)]
    times = compared_sides.time_in_turn(contenders, given, 3, Clock(1e9), rng)
    assert [name for name, _, _ in seen] == ["a", "b", "a", "b", "a"]
    assert times == {"a": [1.0, 3.0, 5.0], "b": [2.0, 4.0]}
    assert [len(asked) for name, _, asked in seen if name == "b"] == [4, 4]
    asked = [array for name, warm, asked in seen if name == "a" for array in (warm, asked)]
    assert not any(np.array_equal(one, other) for k, one in enumerate(asked) for other in asked[:k])
    assert np.array_equal(seen[0][2][[0, 3, 6, 9]], seen[1][2]), "both sides are asked about the same poses"


def test_a_clock_that_is_late_allows_one_loop() -> None:
    assert list(Clock(1e9).loops(3)) == [0, 1, 2]
    assert list(Clock(-1.0).loops(3)) == [0]


def test_a_clock_averages_who_else_wanted_a_core(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = iter([0, 3, 0])
    monkeypatch.setattr(machine, "others_running", lambda: next(seen))
    clock = Clock(1e9)
    assert clock.busy == 0.0
    assert len(list(clock.loops(3))) == 3
    assert clock.busy == 1.0


def test_the_judge_says_what_the_naive_one_says(rng: np.random.Generator) -> None:
    points, avatar = np.round(rng.uniform(0, 1, (300, 3)), 3), rng.uniform(-0.2, 0.2, (30, 3))
    given = query_poses.random_poses(rng, points, avatar, 40, 0.1)
    expected = naive.collide(points, (0.0, 0, 0), 1e-3, 0.02, avatar, 0.01, given)
    judge = Judge(points, (0.0, 0, 0), 1e-3, 0.02)
    assert [judge.touches(avatar, 0.01, pose) for pose in given] == expected.tolist()
    assert [judge.touches(avatar, 0.01, pose, all_pairs=True) for pose in given] == expected.tolist()
    assert 0 < expected.sum() < len(given)
    placed = avatar @ given[0, :3, :3].T + given[0, :3, 3]
    assert least_distance(points, placed) == pytest.approx(least(points, avatar, given[0]))


def test_a_wrong_verdict_of_ours_is_wrong_and_of_a_peer_is_a_remark(rng: np.random.Generator) -> None:
    given = query_poses.upright(np.column_stack([np.full((4, 2), 1.0), [-0.1, 0.0, 0.5, 0.6]]), np.zeros(4))
    place = SimpleNamespace(
        scenes={"ours": None}, avatar=BODY, radius=0.02, judge=Judge(PLANE, (0.0, 0, 0), 0.05, 0.02),
        tree=cKDTree(PLANE), case=SimpleNamespace(distance=0.04), local=lambda local: local,
    )  # fmt: skip
    right = np.array([True, False, False, False])
    other = np.array([True, True, False, False])
    part = bench_results.Part("collide")
    compared_sides.hold(part, "a set", place, given, right, {"ours": right, "CAPT": right})
    assert not part.wrong and not part.remarks
    compared_sides.hold(part, "a set", place, given, right, {"ours": right, "CAPT": other})
    assert not part.wrong and "CAPT differs from ours on 1 poses" in part.remarks[0]
    compared_sides.hold(part, "a set", place, given, other, {"ours": other, "CAPT": right})
    assert len(part.wrong) == 1 and "[1]" in part.wrong[0]
