"""Test the paper's experiment: equal verdicts or an error, figures by the times, enclosing spheres."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from picture_checks import alike_in_grey, covered, drawn_figures, overlaps, share_of_figure
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import BadRequestError, InternalError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.cli.input.pose_file import write_poses
from solidcloud.server.report.common.paper_case import Case, archive_points, given_case
from solidcloud.server.report.common.sphere_pictures import LevelSpheres, level_spheres, render_spheres
from solidcloud.server.report.walk import walkthrough
from solidcloud.server.report.walk.path_figure import Curve, contact_spans, draw_path, rolling_median
from solidcloud.server.report.walk.walkthrough import PLAIN, SLAB, Structure

SEED = 7
STEP = 1e-3


def wall() -> np.ndarray:
    """Return a wall of 6,000 points on the lattice, 4 m by 2 m, at y = 0."""
    rng = np.random.default_rng(SEED)
    return (
        np.column_stack([rng.integers(0, 4000, 6000), rng.integers(0, 20, 6000), rng.integers(0, 2000, 6000)])
        * STEP
    )


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scan") / "wall.xyz"
    np.savetxt(path, wall(), fmt="%.3f")
    return path


@pytest.fixture(scope="module")
def case(scan: Path) -> Case:
    """Return a box of 60 points that moves into the wall and out again in 12 poses."""
    rng = np.random.default_rng(SEED)
    poses = np.tile(np.eye(4), (12, 1, 1))
    poses[:, :3, 3] = np.column_stack(
        [np.full(12, 2.0), np.abs(np.linspace(-2.0, 2.0, 12)), np.full(12, 1.0)]
    )
    return Case("wall", [scan], 32.0, STEP, rng.uniform(-0.5, 0.5, (60, 3)), np.arange(12) / 30, poses)


@pytest.fixture(scope="module")
def archive(scan: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    target = tmp_path_factory.mktemp("archive") / "wall"
    build_archive(
        [scan], target, BuildConfig(degree=4, cell_points=700, resolution=STEP, jobs=1, with_slab=False)
    )
    return target


def structure(kind: str = SLAB, degree: int = 8, verdict: tuple[int, ...] = (0, 1)) -> Structure:
    """Return measurements of a structure: two frames in three loops, one of them disturbed."""
    frames = np.array([[0.001, 0.1], [0.001, 0.1], [0.9, 0.1]])
    found = Structure(
        kind, degree, Path("nowhere"), frames, np.array([0.004, 0.002, 0.006]), np.array(verdict, np.uint8)
    )
    found.points, found.resident_bytes, found.archive_bytes = 1000, 9000, 4000
    return found


def test_whole_experiment_writes_every_file(case: Case, tmp_path: Path) -> None:
    out = tmp_path / "out"
    report = walkthrough.run(
        lambda _: case, out, tmp_path, degrees=(4, 16), loops=2, level=2, say=lambda _: None
    )
    stored = json.loads((out / "walkthrough.json").read_text())
    assert stored == report
    assert [(row["degree"], row["structure"]) for row in stored["table1"]] == [
        (4, SLAB), (4, PLAIN), (16, SLAB), (16, PLAIN)
    ]  # fmt: skip
    assert 0 < stored["case"]["contacts"] < 12 and stored["case"]["points"] == 6000
    assert all(row["frame_ms_best"] <= row["frame_ms"] <= row["slowest_frame_ms"] for row in stored["table1"])
    assert [row["fps_30_loop"] for row in stored["table1_paper"]] == [18.75, 16.14]
    with open(out / "table1.csv", newline="") as file:
        assert [row["structure"] for row in csv.DictReader(file)].count("paper") == 2
    with open(out / "figure7.csv", newline="") as file:
        frames = list(csv.DictReader(file))
    assert len(frames) == 12
    assert sum(row["verdict"] == "contact" for row in frames) == stored["case"]["contacts"]
    octree, many, balanced, many_balanced = stored["cells"]
    assert [row["kind"] for row in stored["cells"]] == ["octree", "octree", "balanced", "balanced"]
    assert (many["cells_asked"], octree["cells_asked"]) == (4096, None)
    assert octree["cells"] < many["cells"] and many["cell_points"] < 10
    assert octree["equal_heights"] == max(octree["levels"].values()) / octree["cells"]
    assert balanced["equal_heights"] == many_balanced["equal_heights"] == 1.0
    assert len(balanced["levels"]) == 1 and balanced["cells"] == sum(balanced["levels"].values())
    assert all(0 < row["batch_ms_best"] <= row["batch_ms"] for row in stored["cells"])
    with open(out / "cells.csv", newline="") as file:
        assert [int(row["cells"]) for row in csv.DictReader(file)] == [
            row["cells"] for row in stored["cells"]
        ]
    for name in ("figure7.png", "figure8.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")


def test_verdicts_that_differ_are_an_error() -> None:
    walkthrough.check_verdicts([structure(), structure(PLAIN)])
    with pytest.raises(InternalError, match=r"degree 6, plain spheres: 1 verdicts differ.*at pose 0"):
        walkthrough.check_verdicts([structure(), structure(PLAIN, 6, (Verdict.CONTACT, Verdict.CONTACT))])


def test_measure_refuses_structures_of_other_points(case: Case, tmp_path: Path) -> None:
    structures = walkthrough.build_structures(case, (8,), tmp_path, lambda _: None)
    np.savetxt(tmp_path / "far.xyz", wall() + np.array([0, 50, 0]), fmt="%.3f")
    config = BuildConfig(resolution=STEP, jobs=1, overwrite=True)
    build_archive([tmp_path / "far.xyz"], structures[1].folder, config)
    with pytest.raises(InternalError, match="verdicts differ"):
        walkthrough.measure(case, structures, 1, lambda _: None)


def test_a_frame_of_the_loop_takes_a_thirtieth_or_its_test() -> None:
    assert walkthrough.loop_fps(np.array([0.001, 0.002])) == pytest.approx(30)
    assert walkthrough.loop_fps(np.array([0.001, 0.1])) == pytest.approx(2 / (1 / 30 + 0.1))


def test_a_disturbed_loop_does_not_enter_the_table() -> None:
    row = walkthrough.table_row(structure())
    assert row["frame_ms"] == pytest.approx(50.5) and row["slowest_frame_ms"] == pytest.approx(100)
    assert row["tests_per_second"] == pytest.approx(2 / 0.101)
    assert row["batch_ms"] == pytest.approx(2.0) and row["batch_ms_best"] == pytest.approx(1.0)
    assert row["tests_per_second_batch"] == pytest.approx(500)
    assert row["resident_bytes_per_point"] == 9 and row["archive_bytes_per_point"] == 4


def test_comparison_names_the_best_degree_and_those_as_good() -> None:
    slow, near, best = structure(degree=4), structure(degree=6), structure(degree=10)
    slow.loops, near.loops, best.loops = np.array([0.004]), np.array([0.00202]), np.array([0.002])
    structures = [slow, near, best, structure(PLAIN, 4)]
    said = " ".join(walkthrough.compare([walkthrough.table_row(s) for s in structures], structures))
    assert "Ours: best at degree 10" in said and "worst at degree 4" in said and "a factor of 2.00" in said
    assert "of the best: degree 6, 10." in said
    assert "it slows the 30 fps loop" in said and "no test slows" not in said


@pytest.mark.parametrize("level", [1, 2, 3, 9])
def test_spheres_of_a_level_enclose_all_points(archive: Path, level: int) -> None:
    spheres = level_spheres(archive, level)
    distance = np.linalg.norm(wall()[:, None] - spheres.center[None], axis=2)
    assert (distance <= spheres.radius).any(axis=1).all(), f"seed {SEED}"


def test_each_partition_has_one_root_and_more_spheres_below(archive: Path) -> None:
    with Archive(archive) as opened:
        cells = int(opened.voxels["rows"][:, 0].sum())
        leaves = int(opened.voxels["leaves"].sum())
    assert cells > 1
    counts = [len(level_spheres(archive, level).radius) for level in (1, 2, 3, 9)]
    assert counts[0] == cells and counts[0] < counts[1] < counts[2] <= counts[3] == leaves
    assert not level_spheres(archive, 1).ended.any() and level_spheres(archive, 9).ended.all()
    assert np.unique(level_spheres(archive, 3).partition).tolist() == list(range(cells))


def test_level_zero_is_refused(archive: Path) -> None:
    with pytest.raises(BadRequestError, match="level 0"):
        level_spheres(archive, 0)


def test_nearer_sphere_hides_the_one_behind() -> None:
    centers = np.array([[0.0, 0.0, 0.0], [0.0, -5.0, 1.5]])  # the second is in front of the first
    pair = LevelSpheres(centers, np.array([1.0, 1.0]), np.array([0, 1]), np.zeros(2, bool))
    image = render_spheres(pair, 120)
    swapped = render_spheres(LevelSpheres(*(column[::-1] for column in pair)), 120)
    assert np.array_equal(image, swapped)
    assert (image[0, 0] == 1).all() and (image != 1).any()


def test_points_of_an_archive_make_the_same_case(archive: Path, tmp_path: Path) -> None:
    times, poses = np.array([0.0, 1.0]), np.tile(np.eye(4), (2, 1, 1))
    write_poses(tmp_path / "poses.csv", times, poses)
    np.savetxt(tmp_path / "avatar.xyz", wall()[:50], fmt="%.3f")
    made = given_case([], archive, tmp_path / "avatar.xyz", tmp_path / "poses.csv", tmp_path)
    assert made.step == STEP and len(made.avatar) == 50 and np.array_equal(made.poses, poses)
    build_archive(made.scans, tmp_path / "again", BuildConfig(resolution=made.step, jobs=1))
    with Archive(tmp_path / "again") as again:
        found = np.concatenate(list(archive_points(again)))
    order = [np.lexsort(points.T) for points in (np.rint(found / STEP), np.rint(wall() / STEP))]
    assert np.abs(found[order[0]] - wall()[order[1]]).max() < 1e-9


def test_a_path_without_poses_is_refused(scan: Path, tmp_path: Path) -> None:
    write_poses(tmp_path / "poses.csv", np.empty(0), np.empty((0, 4, 4)))
    with pytest.raises(BadRequestError, match="no poses"):
        given_case([scan], None, None, tmp_path / "poses.csv", tmp_path)


def test_contact_spans_are_the_runs_of_contact() -> None:
    times = np.arange(6) / 2
    assert contact_spans(times, np.array([1, 1, 0, 0, 1, 0], bool)) == [(0.0, 0.5), (2.0, 2.0)]
    assert contact_spans(times, np.zeros(6, bool)) == []


def test_rolling_median_drops_a_single_peak() -> None:
    assert rolling_median(np.array([1.0, 1, 9, 1, 2]), 3).tolist() == [1, 1, 1, 2, 2]


@pytest.mark.parametrize("degrees", [(4,), (4, 8), (4, 5, 6, 8, 10, 12, 16)])
def test_path_figure_is_legible_in_grey_and_nothing_overlaps(
    degrees: tuple[int, ...], tmp_path: Path
) -> None:
    rng = np.random.default_rng(SEED)
    curves = {
        kind: [Curve(degree, rng.uniform(1e-5, 9e-5, 90)) for degree in degrees] for kind in (SLAB, PLAIN)
    }
    contact = np.arange(90) % 30 < 5
    with drawn_figures() as figures:
        draw_path(
            np.arange(90) / 30,
            curves,
            np.full(90, 1e-6),
            contact,
            {4: 17.0, 8: 19.0},
            tmp_path / "figure7.png",
        )
    (figure,) = figures
    assert alike_in_grey(figure) == [] and overlaps(figure) == [] and covered(figure) == []
    assert share_of_figure(figure) > 0.75
