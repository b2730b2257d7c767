"""Test `solidcloud accuracy` with a small façade, a few settings and few poses."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
import synthetic_scans
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.server.cli import main as cli
from solidcloud.server.report.accuracy.measurement import measurement_plan
from solidcloud.server.report.accuracy.measurement.measurement_plan import MeasurementPlan

SMALL = MeasurementPlan(
    points=20_000, frames=48, near_tangent=12, brute=12, loops=1, tolerances=(0.0, 0.05),
    budgets=(30,), steps=(1e-2,), degrees=(4, 8), leaves=(16, 32), factors=(1.0,), places=60,
)  # fmt: skip


def report_of(folder: Path, *arguments: str) -> dict:
    """Run the command, check that its files agree, and return the content of its JSON."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measurement_plan, "BRIEF", SMALL)
        assert cli.run(["accuracy", *arguments, "-o", str(folder)]) == 0
    report = json.loads((folder / "accuracy.json").read_text())
    with open(folder / "accuracy.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["setting"] for row in rows] == [row["setting"] for row in report["rows"]]
    page = (folder / "accuracy.html").read_text()
    # Remove the pictures: by chance, the letters "http" would appear in the pictures of one page in
    # fifty.
    words, pictures = re.subn(r"data:image/png;base64,[A-Za-z0-9+/=]+", "", page)
    assert "http" not in words and pictures == len(list(folder.glob("*.png")))
    return report


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict:
    return report_of(tmp_path_factory.mktemp("accuracy") / "report")


def test_an_archive_that_cannot_be_opened_leaves_no_folder(tmp_path: Path) -> None:
    assert cli.run(["accuracy", str(tmp_path / "none"), "-o", str(tmp_path / "report")]) != 0
    assert not (tmp_path / "report").exists()


def rows_of(report: dict, knob: str) -> dict[str, dict]:
    return {row["setting"]: row for row in report["rows"] if row["knob"] == knob}


def test_exact_settings_are_right_and_a_tolerance_is_early_at_most(made: dict) -> None:
    exact, early = rows_of(made, "tolerance")["0"], rows_of(made, "tolerance")["tolerance 5 cm"]
    assert made["facts"]["judged_contacts"] > 0 and made["facts"]["poses_judged_by_every_pair"] == 12
    assert exact["poses"] == 96 and exact["wrong_share"] == 0.0 and exact["distance_max_mm"] == 0.0
    assert exact["tangent"] > 0 and exact["tangent_early"] + exact["tangent_late"] == 0
    assert early["early"] > 0 and early["late"] == early["unknown"] == 0
    assert 0 < early["distance_max_mm"] <= 50.0 + 1e-6
    for knob in ("degree", "leaf size", "bounding volume"):
        assert all(row["wrong_share"] == 0.0 for row in rows_of(made, knob).values())


def test_a_spent_budget_is_unknown_and_never_wrong(made: dict) -> None:
    row = rows_of(made, "budget")["30 visits"]
    assert row["unknown"] > 0 and row["early"] == row["late"] == 0 and row["node_tests"] <= 30


def test_a_coarser_lattice_is_smaller_and_moves_distances_by_what_it_declares(made: dict) -> None:
    fine, coarse = rows_of(made, "lattice step")["0.1 mm"], rows_of(made, "lattice step")["1 cm"]
    assert coarse["archive_bytes"] < fine["archive_bytes"]
    assert fine["distance_max_mm"] == 0.0 < coarse["distance_max_mm"] <= 3**0.5 * 5.0 + 1e-3


def test_every_row_is_timed_and_its_ratio_is_to_the_default_of_its_knob(made: dict) -> None:
    for row in (row for row in made["rows"] if "sheet" not in row["knob"]):
        assert row["mean_us"] > 0 and row["p50_us"] <= row["p99_us"], row["setting"]
        default = next(r for r in made["rows"] if r["knob"] == row["knob"] and r["default"])
        assert row["times"] == pytest.approx(row["mean_us"] / default["mean_us"])


def test_radius_models_and_felt_errors_are_measured(made: dict) -> None:
    models = rows_of(made, "radius model")
    assert {"mean", "local", "border", "local+border"} < models.keys()
    for row in models.values():
        assert (
            row["leak_p50_mm"] <= row["leak_p99_mm"] <= row["leak_worst_mm"] and 0 <= row["leak_share"] <= 1
        )
    assert sum(name.startswith("fixed") for name in models) == 1
    assert (
        rows_of(made, "tolerance")["tolerance 5 cm"]["doorway_mm"]
        != rows_of(made, "tolerance")["0"]["doorway_mm"]
    )


def test_border_opens_the_door_of_a_thin_sheet(made: dict) -> None:
    rows = rows_of(made, "radius model, a thin sheet with a door")
    assert list(rows) == ["mean", "mean:2", "mean:3", "border", "border:2", "border:3"]
    assert abs(rows["border:3"]["doorway_mm"]) < rows["mean:3"]["doorway_mm"] / 2
    assert rows["border:3"]["leak_p99_mm"] - rows["mean:3"]["leak_p99_mm"] < 0.5
    assert all(row["made_doorway_mm"] is None for row in made["rows"])


def test_an_archive_that_is_given_is_walked_over_and_has_no_doors(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    floor = np.column_stack([rng.uniform(0, 8, 9000), rng.uniform(0, 3, 9000), rng.normal(0, 0.002, 9000)])
    # The walk goes through the middle of all points, y = 2.33 m. The wall is 0.4 m beside it.
    wall = np.column_stack([rng.uniform(0, 8, 5000), np.full(5000, 2.73), rng.uniform(0, 2, 5000)])
    scan = synthetic_scans.write_ply(tmp_path / "hall.ply", np.concatenate([floor, wall]))
    build_archive(
        [scan], tmp_path / "hall", BuildConfig(voxel=2.0, resolution=1e-3, degree=5, leaf=20, radius=0.03)
    )
    report = report_of(tmp_path / "report", str(tmp_path / "hall"))
    assert report["facts"]["points"] == 14_000 and report["facts"]["lattice_step_m"] == 1e-3
    assert 0 < report["facts"]["judged_contacts"] < report["facts"]["judged_poses"] == 96
    assert report["facts"]["near_tangent_poses"] > 0
    assert all(row["doorway_mm"] is None and row["leak_p99_mm"] is None for row in report["rows"])
    assert rows_of(report, "lattice step")["1 mm"]["default"]
    assert rows_of(report, "degree")["5"]["default"] and rows_of(report, "leaf size")["20"]["default"]
    assert report["facts"]["radius_m"] == 0.03 and report["facts"]["warnings"] == []
    assert rows_of(report, "tolerance")["0"]["wrong_share"] == 0.0
