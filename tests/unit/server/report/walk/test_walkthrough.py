"""Test the paper's experiment: equal verdicts or an error, figures by the times, enclosing spheres."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.errors import BadRequestError, InternalError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.cli.input.pose_file import write_poses
from solidcloud.server.report.common.paper_case import Case, given_case
from solidcloud.server.report.walk import walkthrough
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


def test_a_path_without_poses_is_refused(scan: Path, tmp_path: Path) -> None:
    write_poses(tmp_path / "poses.csv", np.empty(0), np.empty((0, 4, 4)))
    with pytest.raises(BadRequestError, match="no poses"):
        given_case([scan], None, None, tmp_path / "poses.csv", tmp_path)
