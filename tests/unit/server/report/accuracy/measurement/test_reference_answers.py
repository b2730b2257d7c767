"""Test the accuracy report's reference answers, poses, checks and curves, on a small hall."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import synthetic_scans
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.synthetic.figure import figure_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import InternalError
from solidcloud.server.report.accuracy.accuracy_report import reference_warnings
from solidcloud.server.report.accuracy.measurement import frame_curve, measured_scene
from solidcloud.server.report.accuracy.measurement.cold_curve import cold_curve
from solidcloud.server.report.accuracy.measurement.distance_field import field_rows
from solidcloud.server.report.accuracy.measurement.frame_curve import frame_rows, longest_run
from solidcloud.server.report.accuracy.measurement.measured_scene import (
    AVATAR,
    REACH,
    MeasuredScene,
    archive_scene,
    unknown_regions,
)
from solidcloud.server.report.accuracy.measurement.measurement_plan import MeasurementPlan
from solidcloud.server.report.accuracy.measurement.memory_curve import class_count, memory_curve
from solidcloud.server.report.accuracy.measurement.pose_classes import (
    CALL,
    LONGEST,
    class_members,
    timed_poses,
)
from solidcloud.server.report.accuracy.measurement.reference_answers import (
    MAX_OFFSET,
    MIN_OFFSET,
    ReferenceAnswers,
    VoxelSteps,
    check_reference,
    find_reference,
    points_in_box,
)
from solidcloud.server.report.accuracy.measurement.small_memory import walk_rows
from solidcloud.server.scene import Scene

PLAN = MeasurementPlan(
    frames=120, near_tangent=20, rounds=2, tolerances=(0.01, 0.1), cells=(0.1, 0.2), field_cells=100_000
)


class Judged:
    """A hall with a wall along its middle, the reference answers for it, and counted ticks."""

    def __init__(self, folder: Path) -> None:
        rng = np.random.default_rng(9)
        floor = np.column_stack(
            [rng.uniform(0, 6, 4000), rng.uniform(0, 2, 4000), rng.normal(0, 0.002, 4000)]
        )
        # The walk goes through the middle of all points, y = 1.25 m. The wall is 0.4 m beside it.
        wall = np.column_stack([rng.uniform(0, 6, 1000), np.full(1000, 1.65), rng.uniform(0, 2, 1000)])
        self.points = np.concatenate([floor, wall])
        scan = synthetic_scans.write_ply(folder / "hall.ply", self.points)
        self.folder = folder / "hall"
        build_archive([scan], self.folder, BuildConfig(voxel=1.0, resolution=1e-3, jobs=1))
        self.measured: MeasuredScene = archive_scene(self.folder, PLAN, figure_points(200))
        self._stack = ExitStack()
        self.scene = self._stack.enter_context(Scene.open(self.folder))
        self.scene.add_avatar(AVATAR, self.measured.avatar)
        self.archive = self._stack.enter_context(Archive(self.folder))
        self.exact: ReferenceAnswers = find_reference(self.scene, self.measured, PLAN)
        self.ticks = 0

    def tick(self) -> None:
        """Count a step of progress."""
        self.ticks += 1

    def close(self) -> None:
        """Close scene and archive."""
        self._stack.close()


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Judged]:
    made = Judged(tmp_path_factory.mktemp("judged"))
    yield made
    made.close()


def test_both_verdicts_are_among_the_judged_poses(judged: Judged) -> None:
    assert 0 < judged.exact.contact.sum() < len(judged.exact.contact) == 240


def test_what_is_not_measured_is_said(judged: Judged) -> None:
    header, exact = judged.archive.header, judged.exact
    one = replace(header, unknown=np.zeros((1, 2, 3), np.int64))
    assert "unknown in 1 region." in unknown_regions(one)[0]
    two = replace(header, unknown=np.zeros((2, 2, 3), np.int64))
    assert "unknown in 2 regions." in unknown_regions(two)[0]
    assert "unknown everywhere" in unknown_regions(replace(one, unknown_everywhere=True))[0]
    assert unknown_regions(header) == () and reference_warnings(exact) == []
    for changed, said in (
        ({"contact": np.zeros(240, bool)}, "None of the 240 judged poses touches"),
        ({"contact": np.ones(240, bool)}, "All 240 judged poses touch"),
        ({"tangent": exact.tangent[:0]}, "No pose was found within a micrometre"),
    ):
        (warning,) = reference_warnings(exact._replace(**changed))
        assert warning.startswith(said)


def test_near_tangent_poses_are_within_a_micrometre_on_either_side(judged: Judged) -> None:
    off = judged.scene.distance(AVATAR, judged.exact.tangent_poses, REACH).signed_distance
    assert len(off) >= 10 and np.abs(off).max() <= MAX_OFFSET and np.abs(off).min() >= MIN_OFFSET / 4
    assert (off > 0).any() and (off < 0).any()
    assert ((off <= 0) == judged.exact.tangent).all()


def test_every_pair_of_points_agrees_with_the_judge_and_would_say_if_not(judged: Judged) -> None:
    exact = judged.exact
    assert check_reference(judged.archive, judged.measured, exact, 20) == 20
    for wrong in (exact._replace(contact=~exact.contact), exact._replace(tangent=~exact.tangent)):
        with pytest.raises(InternalError, match="every pair of points finds the opposite"):
            check_reference(judged.archive, judged.measured, wrong, 20)


def test_a_box_yields_the_points_of_the_voxels_that_it_meets(judged: Judged) -> None:
    low, high = np.array([1.2, 0.3, -0.5]), np.array([2.9, 0.8, 0.5])
    found = points_in_box(judged.archive, low, high)
    inside = judged.points[((judged.points >= low) & (judged.points <= high)).all(axis=1)]
    assert 0 < len(inside) <= len(found) < len(judged.points)
    for point in inside[:50]:
        assert np.abs(found - point).max(axis=1).min() <= 1e-3
    voxels = VoxelSteps(judged.archive)
    assert len(voxels.in_box(low, high)) == len(voxels.in_box(low, high)) == len(found)
    assert len(voxels.in_box(low + 100.0, high + 100.0)) == 0


def test_a_walk_through_a_large_archive_reads_the_voxels_around_its_middle(
    judged: Judged, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(measured_scene, "CROSSED", 2)
    some = measured_scene.middle_points(judged.archive)
    assert 0 < len(some) < 5000 and np.ptp(some[:, 0]) <= 2.0
    monkeypatch.setattr(measured_scene, "SAMPLED", 10)
    assert 0 < len(measured_scene.middle_points(judged.archive)) <= 2 * 20


def test_classes_hold_each_pose_once_and_calls_are_neither_short_nor_long() -> None:
    distance = np.concatenate([np.linspace(-0.2, 0.6, 4001), [np.inf] * 30])
    members = class_members(distance)
    assert sorted(np.concatenate(list(members.values()))) == list(range(len(distance)))
    assert distance[members["contact"]].max() <= 0.0 < distance[members["clear by up to 3 cm"]].min()
    assert "farther" in members and "contact" not in class_members(distance[2000:])
    for count in (20, 599, 600, 1201, 5000):
        poses = np.arange(count * 16, dtype=float).reshape(count, 4, 4)
        assert CALL <= len(timed_poses(poses)) <= LONGEST + CALL


def test_the_curve_in_memory_has_each_class_and_stays_within_its_bounds(judged: Judged) -> None:
    judged.ticks = 0
    rows = memory_curve(judged.scene, judged.measured.judged, judged.exact, PLAN, judged.tick)
    assert judged.ticks == class_count(judged.exact)
    kinds = list(class_members(judged.exact.distance))
    assert len(kinds) >= 3
    for kind in kinds:
        own = [row for row in rows if row.kind == kind and row.question == "collide"]
        assert [row.tolerance for row in own] == [0.0, 0.01, 0.1]
        assert own[0].ratio == 1.0 and own[0].repeats and own[0].early == 0.0
        visits = [row.visits for row in own]
        assert visits == sorted(visits, reverse=True) and all(row.time_us > 0 for row in own)
    errors = [row.error_mm for row in rows if row.question == "distance" and row.tolerance == 0.0]
    assert errors and max(error or 0.0 for error in errors) == 0.0
    assert any(row.early for row in rows)


@pytest.mark.parametrize("contact", [False, True])
def test_an_answer_outside_its_bounds_would_be_an_error(judged: Judged, contact: bool) -> None:
    exact = judged.exact
    wrong = exact._replace(contact=np.full(len(exact.contact), contact), distance=exact.distance + 0.02)
    with pytest.raises(InternalError, match="outside its bounds"):
        memory_curve(judged.scene, judged.measured.judged, wrong, PLAN, judged.tick)


def test_a_field_that_never_says_clear_wrongly_is_early_more_often(judged: Judged) -> None:
    poses, exact = judged.measured.judged, judged.exact
    rows = field_rows(judged.archive, judged.scene, judged.measured.avatar, poses, exact, PLAN, judged.tick)
    assert {row.cell for row in rows} == {0.1, 0.2} and len({row.kind for row in rows}) >= 2
    for row in rows:
        assert row.early_if_safe >= row.early and row.time_us > 0 and row.field_bytes <= 4 * 100_000 * 1.2
    fine, coarse = (next(row.scene_bytes for row in rows if row.cell == cell) for cell in (0.1, 0.2))
    assert coarse < fine


def test_with_nothing_in_memory_less_is_read_for_an_answer_with_an_error(judged: Judged) -> None:
    judged.ticks = 0
    places = judged.measured.walk[10::40]
    rows = cold_curve(judged.folder, judged.measured.avatar, places, (0.1, 0.5), judged.tick)
    assert [row.tolerance for row in rows] == [None, 0.0, 0.1, 0.5] and judged.ticks == len(places)
    assert rows[0].wait == rows[0].wait_low == rows[0].wait_high == 1.0 and rows[0].loaded == 1.0
    for row in rows:
        assert row.wait_ms > 0 and row.wait_low <= row.wait <= row.wait_high
    assert rows[3].loaded < 1.0
    if rows[0].read_bytes is not None:
        assert rows[0].read_bytes > 0 and rows[0].bytes_ratio == 1.0


def test_a_walk_by_bounds_is_never_wrongly_clear(judged: Judged) -> None:
    avatar, walk = judged.measured.avatar, judged.measured.walk
    rows = walk_rows(judged.folder, avatar, walk, (1.0, 1e-6), 20, judged.tick)
    assert [(row.memory, row.kind) for row in rows] == [
        (1.0, "exact"), (1.0, "bounds"), (1e-6, "exact"), (1e-6, "bounds"),
    ]  # fmt: skip
    exact, bounds, *none = rows
    assert exact.frames == bounds.frames > 10 and exact.early == 0.0
    assert exact.false_clear == bounds.false_clear == 0 and bounds.early < 1.0
    assert all("does not fit" in row.note and row.frames == 0 for row in none)


def test_a_frame_with_a_tolerance_ends_near_that_without(
    judged: Judged, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frame_curve, "PAIRS", 2)
    monkeypatch.setattr(frame_curve, "MOST", 20)
    avatar, walk = judged.measured.avatar, judged.measured.walk
    touching = judged.exact.contact[: len(walk)]
    rows = frame_rows(judged.folder, avatar, walk, touching, (1e-5, 0.1), tmp_path, judged.tick)
    assert [row.tolerance for row in rows] == [1e-5, 0.1]
    assert rows[0].apart_mm == 0.0 and rows[1].apart_mm < 150.0
    assert all(row.time_us > 0 and row.p99_us >= row.time_us / 2 and row.way > 0 for row in rows)


def test_frames_follow_the_longest_part_that_is_clear() -> None:
    assert longest_run(np.array([True, False, True, True, False])) == slice(2, 4)
    assert longest_run(np.ones(3, bool)) == slice(0, 3) == longest_run(np.zeros(3, bool))
