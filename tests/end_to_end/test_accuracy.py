"""Test `solidcloud accuracy` with a small façade and a hall, few settings and few poses."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import synthetic_scans
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.server.cli import main as cli
from solidcloud.server.report.accuracy.measurement import frame_curve, measurement_plan
from solidcloud.server.report.accuracy.measurement.measurement_plan import MeasurementPlan

SMALL = MeasurementPlan(
    points=20_000, frames=120, near_tangent=12, brute=12, rounds=2, tolerances=(0.01, 0.03, 0.1), cells=(0.1,),
    field_cells=400_000, places=3, shares=(0.5,), walked=20, frame_tolerances=(1e-5, 1e-2), factors=(1.0,), walls=60,
)  # fmt: skip


def report_of(folder: Path, *arguments: str) -> dict:
    """Run the command, check that its files agree, and return the content of its JSON."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(measurement_plan, "BRIEF", SMALL)
        patch.setattr(frame_curve, "PAIRS", 2)
        patch.setattr(frame_curve, "MOST", 20)
        assert cli.run(["accuracy", *arguments, "-o", str(folder)]) == 0
    report = json.loads((folder / "accuracy.json").read_text())
    page = (folder / "accuracy.html").read_text()
    # Remove the pictures: by chance, the letters "http" would appear in the pictures of one page in
    # fifty.
    words, pictures = re.subn(r"data:image/png;base64,[A-Za-z0-9+/=]+", "", page)
    assert "http" not in words and pictures == len(list(folder.glob("*.png")))
    return report


def test_an_archive_that_cannot_be_opened_leaves_no_folder(tmp_path: Path) -> None:
    assert cli.run(["accuracy", str(tmp_path / "none"), "-o", str(tmp_path / "report")]) != 0
    assert not (tmp_path / "report").exists()


@pytest.mark.slow
def test_the_facade_is_built_and_all_questions_are_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = report_of(tmp_path / "report")
    facts = report["facts"]
    assert facts["judged_contacts"] > 0 and facts["poses_judged_by_every_pair"] == 12
    assert facts["judged_poses"] == 240 and facts["near_tangent_poses"] > 0
    assert {row["question"] for row in report["memory"]} == {"collide", "distance"}
    assert [row["tolerance"] for row in report["cold"]] == [None, 0.0, 0.1]
    assert [row["kind"] for row in report["walks"]] == ["exact", "bounds"]
    assert [row["tolerance"] for row in report["frames"]] == [1e-5, 1e-2]
    models = {row["setting"]: row for row in report["radii"] if row["scene"] == "façade"}
    assert {"mean", "local", "border", "local+border"} < models.keys() and len(models) == 5
    for row in models.values():
        assert row["leak_p50_mm"] <= row["leak_p99_mm"] <= row["leak_worst_mm"] and 0 <= row["passed"] <= 1
        assert row["time_us"] > 0 and row["made_doorway_mm"] is None
    sheet = {row["setting"]: row for row in report["radii"] if row["scene"] == "sheet"}
    assert list(sheet) == ["mean", "mean:2", "mean:3", "border", "border:2", "border:3"]
    assert abs(sheet["border:3"]["doorway_mm"]) < sheet["mean:3"]["doorway_mm"] / 2
    assert sheet["border:3"]["leak_p99_mm"] - sheet["mean:3"]["leak_p99_mm"] < 0.5
    said = capsys.readouterr().out
    assert "With the scene in memory, an error of 3 cm" in said and "accuracy.html" in said


def test_an_archive_that_is_given_is_walked_over_and_has_no_doors(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    floor = np.column_stack([rng.uniform(0, 8, 9000), rng.uniform(0, 3, 9000), rng.normal(0, 0.002, 9000)])
    # The walk goes through the middle of all points, y = 2.33 m. The wall is 0.4 m beside it.
    wall = np.column_stack([rng.uniform(0, 8, 5000), np.full(5000, 2.73), rng.uniform(0, 2, 5000)])
    scan = synthetic_scans.write_ply(tmp_path / "hall.ply", np.concatenate([floor, wall]))
    build_archive(
        [scan], tmp_path / "hall", BuildConfig(voxel=2.0, resolution=1e-3, degree=5, leaf=20, radius=0.03)
    )
    before = {path: path.read_bytes() for path in (tmp_path / "hall").rglob("*.h5")}
    report = report_of(tmp_path / "report", str(tmp_path / "hall"))
    facts = report["facts"]
    assert facts["points"] == 14_000 and facts["lattice_step_m"] == 1e-3 and facts["radius_m"] == 0.03
    assert 0 < facts["judged_contacts"] < facts["judged_poses"] == 240 and facts["near_tangent_poses"] > 0
    assert report["radii"] == [] and report["memory"] and report["walks"]
    assert {path: path.read_bytes() for path in (tmp_path / "hall").rglob("*.h5")} == before
