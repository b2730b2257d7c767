"""Test the accuracy report's reference answers, poses, checks and curves, on a small hall."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import synthetic_scans
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.synthetic.figure import figure_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import InternalError
from solidcloud.server.report.accuracy.measurement.measured_scene import (
    AVATAR,
    REACH,
    MeasuredScene,
    archive_scene,
)
from solidcloud.server.report.accuracy.measurement.measurement_plan import MeasurementPlan
from solidcloud.server.report.accuracy.measurement.memory_curve import class_count, memory_curve
from solidcloud.server.report.accuracy.measurement.pose_classes import (
    class_members,
)
from solidcloud.server.report.accuracy.measurement.reference_answers import (
    MAX_OFFSET,
    MIN_OFFSET,
    ReferenceAnswers,
    check_reference,
    find_reference,
)
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
