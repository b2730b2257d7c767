"""Test the accuracy report's reference answers, poses and checks, on a small hall."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_scans
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.synthetic.figure import figure_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import InternalError
from solidcloud.server.report.accuracy.accuracy_report import warnings_of
from solidcloud.server.report.accuracy.measurement.engine_settings import (
    Archives,
    Setting,
    compare_engine,
)
from solidcloud.server.report.accuracy.measurement.measured_scene import (
    REACH,
    MeasuredScene,
    archive_scene,
    config_of,
    unknown_regions,
)
from solidcloud.server.report.accuracy.measurement.measurement_plan import MeasurementPlan
from solidcloud.server.report.accuracy.measurement.reference_answers import (
    MAX_OFFSET,
    MIN_OFFSET,
    ReferenceAnswers,
    check_reference,
    find_reference,
)
from solidcloud.server.report.accuracy.measurement.setting_results import BUDGET, DEGREE, TOLERANCE, Row

PLAN = MeasurementPlan(frames=40, near_tangent=20, loops=1)
CONFIG = BuildConfig(resolution=1e-3, radius=0.01, jobs=1)


class Judged:
    """A hall with a wall along its middle, and the reference answers for it."""

    def __init__(self, folder: Path) -> None:
        rng = np.random.default_rng(9)
        floor = np.column_stack(
            [rng.uniform(0, 6, 4000), rng.uniform(0, 2, 4000), rng.normal(0, 0.002, 4000)]
        )
        # The walk goes through the middle of all points, y = 1.25 m. The wall is 0.4 m beside it.
        wall = np.column_stack([rng.uniform(0, 6, 1000), np.full(1000, 1.65), rng.uniform(0, 2, 1000)])
        scan = synthetic_scans.write_ply(folder / "hall.ply", np.concatenate([floor, wall]))
        build_archive([scan], folder / "hall", BuildConfig(voxel=1.0, resolution=1e-3, jobs=1))
        self.folder = folder / "work"
        self.folder.mkdir()
        avatar = folder / "figure.ply"
        synthetic_scans.write_ply(avatar, figure_points(200))
        self.scene: MeasuredScene = archive_scene(folder / "hall", PLAN, avatar, self.folder)
        self.archives = Archives(self.scene, self.folder)
        self.exact: ReferenceAnswers = find_reference(self.archives.scene(CONFIG), self.scene, PLAN)
        self.archive = Archive(self.archives.folder(CONFIG))


@pytest.fixture(scope="module")
def judged(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Judged]:
    made = Judged(tmp_path_factory.mktemp("judged"))
    yield made
    made.archive.close()
    made.archives.__exit__()


def test_both_verdicts_are_among_the_judged_poses(judged: Judged) -> None:
    assert 0 < judged.exact.contact.sum() < len(judged.exact.contact) == 80


def test_an_archive_is_built_again_as_it_was(judged: Judged, tmp_path: Path) -> None:
    given = BuildConfig(
        voxel=1.5, resolution=2e-3, radius=0.031, degree=5, leaf=9, cells="balanced", cell_points=200,
        with_slab=False, models=frozenset({"mean", "local"}), jobs=1,
    )  # fmt: skip
    build_archive([judged.scene.scan], tmp_path / "given", given)
    ground = archive_scene(tmp_path / "given", PLAN, None, tmp_path)
    with (
        Archives(ground, tmp_path) as archives,
        Archive(archives.folder(ground.config)) as again,
        Archive(tmp_path / "given") as first,
    ):
        assert again.header.options == first.header.options
        for name in ("radius", "degree", "leaf", "models", "points"):
            assert getattr(again.header, name) == getattr(first.header, name), name
        assert again.header.lattice == first.header.lattice
        assert config_of(first.header) == ground.config and ground.warnings == ()


def test_what_is_not_measured_is_said(judged: Judged) -> None:
    header, exact = judged.archive.header, judged.exact
    one = replace(header, unknown=np.zeros((1, 2, 3), np.int64))
    assert "unknown in 1 region." in unknown_regions(one)[0]
    assert (
        "unknown in 2 regions." in unknown_regions(replace(header, unknown=np.zeros((2, 2, 3), np.int64)))[0]
    )
    assert "unknown everywhere" in unknown_regions(replace(one, unknown_everywhere=True))[0]
    assert unknown_regions(header) == () and warnings_of(judged.scene, exact) == []
    ground = judged.scene._replace(warnings=("left out",))
    for changed, said in (
        ({"contact": np.zeros(80, bool)}, "None of the 80 judged poses touches"),
        ({"contact": np.ones(80, bool)}, "All 80 judged poses touch"),
        ({"tangent": exact.tangent[:0]}, "No pose was found within a micrometre"),
    ):
        first, second = warnings_of(ground, exact._replace(**changed))
        assert first == "left out" and second.startswith(said)


def test_near_tangent_poses_are_within_a_micrometre_on_either_side(judged: Judged) -> None:
    scene = judged.archives.scene(CONFIG)
    off = scene.distance("avatar", judged.exact.tangent_poses, REACH).signed_distance
    assert len(off) >= 10 and np.abs(off).max() <= MAX_OFFSET and np.abs(off).min() >= MIN_OFFSET / 4
    assert (off > 0).any() and (off < 0).any()
    assert ((off <= 0) == judged.exact.tangent).all()


def test_every_pair_of_points_agrees_with_the_judge_and_would_say_if_not(judged: Judged) -> None:
    exact = judged.exact
    assert check_reference(judged.archive, judged.scene, exact, 20) == 20
    for wrong in (exact._replace(contact=~exact.contact), exact._replace(tangent=~exact.tangent)):
        with pytest.raises(InternalError, match="every pair of points finds the opposite"):
            check_reference(judged.archive, judged.scene, wrong, 20)


@pytest.mark.parametrize(
    ("knob", "contact", "said", "options"),
    [
        (DEGREE, False, "differ from", {}),
        (TOLERANCE, False, "differ from", {}),
        (TOLERANCE, True, "called clear", {"tolerance": 0.1}),
        (BUDGET, True, "called clear", {"budget_visits": 1 << 40}),
    ],
)
def test_a_knob_that_changed_what_it_must_not_would_be_an_error(
    judged: Judged, knob: str, contact: bool, said: str, options: dict[str, Any]
) -> None:
    everywhere = np.full(len(judged.exact.contact), contact)
    wrong = judged.exact._replace(contact=everywhere)
    for exact, fails in ((judged.exact, False), (wrong, True)):
        settings = [Setting(Row(knob, "as it is"), CONFIG, options)]
        if fails:
            with pytest.raises(InternalError, match=said):
                compare_engine(settings, judged.archives, judged.scene, exact, lambda: None)
        else:
            compare_engine(settings, judged.archives, judged.scene, exact, lambda: None)
            row = settings[0].row
            assert row.late == row.unknown == 0 and row.decode_ms
            assert (row.early > 0) == (options == {"tolerance": 0.1})


def test_of_a_large_archive_the_voxels_around_its_middle_are_taken(judged: Judged, tmp_path: Path) -> None:
    few = archive_scene(
        judged.folder.parent / "hall", MeasurementPlan(max_points=3000, frames=40), None, tmp_path
    )
    assert "of 5,000 points" in few.name and few.truth is None and len(few.walk) == 40
    taken = int(few.name.split(", ", 1)[1].split(" ")[0].replace(",", ""))
    assert 0 < taken <= 3000
