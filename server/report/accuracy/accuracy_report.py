"""Accuracy report: query time and errors of each setting, varying one parameter ("knob") at a time.

`solidcloud accuracy` calls `run`, which writes accuracy.csv, accuracy.json, accuracy.html and the
charts. Everything runs in this process: it builds archives from one scan, opens, queries and closes
them.
"""

import csv
import json
import os
import time
from dataclasses import asdict
from pathlib import Path

from ....builder.run.executor import Progress
from ....schemas.archive.archive import Archive
from ....schemas.process.os_errors import check_writable
from ..common.sphere_pictures import load_pyplot
from .measurement.engine_settings import (
    Archives,
    Setting,
    compare_costs,
    compare_engine,
    engine_settings,
    radius_settings,
    time_costs,
    time_engine,
)
from .measurement.measured_scene import MeasuredScene, archive_scene, generated_scene
from .measurement.measurement_plan import MeasurementPlan
from .measurement.reference_answers import ReferenceAnswers, check_reference, find_reference
from .measurement.setting_results import COLUMNS, SHOWN, Report, Row, mark_pareto_fronts
from .measurement.thin_sheet import count_sheet, measure_sheet
from .measurement.user_errors import FACADES, USER_ERROR_KNOBS, measure_generated_doors, measure_user_errors


def run(
    out: Path,
    scratch: Path,
    plan: MeasurementPlan,
    progress: Progress,
    archive: Path | None = None,
    avatar: Path | None = None,
) -> Report:
    """Measure everything and write it into the folder `out`.

    scratch: a folder for scans and archives, which the caller removes.
    archive: folder of an archive to measure; None: one built from a generated façade.
    avatar: a file of points; None: the generated figure.
    Raises SolidcloudError if matplotlib is missing.
    """
    from .page.error_charts import draw_charts
    from .page.html_page import write_page

    load_pyplot()  # fails now if matplotlib is missing, not after minutes of measuring
    if archive is not None:
        Archive(archive).close()  # fails before the output folder is created
    out.mkdir(parents=True, exist_ok=True)
    check_writable(out)
    report = measure(scratch, plan, progress, archive, avatar)
    progress.start("draw", 1, "page")
    write_rows(report, out)
    charts = draw_charts(report.rows, report.scene, out)
    write_page(report, charts, out / "accuracy.html")
    progress.advance(1)
    progress.finish()
    return report


def measure(
    scratch: Path,
    plan: MeasurementPlan,
    progress: Progress,
    archive: Path | None = None,
    avatar: Path | None = None,
) -> Report:
    """Measure everything and return the report without writing it."""
    begin = time.perf_counter()
    progress.start("make", 1, "scene")
    if archive is not None:
        measured = archive_scene(archive, plan, avatar, scratch)
    else:
        measured = generated_scene(plan, avatar, scratch)
    progress.advance(1)
    progress.finish()
    with Archives(measured, scratch) as archives:
        progress.start("reference", 2, "parts", [1.0, 1.0])
        reference = find_reference(archives.scene(measured.config), measured, plan)
        progress.advance(1)
        with Archive(archives.folder(measured.config)) as opened:
            header = opened.header
            checked = check_reference(opened, measured, reference, plan.brute)
        progress.advance(1)
        progress.finish()
        settings = engine_settings(plan, measured.config, header.radius)
        settings += radius_settings(plan, measured.config, header.radius)
        measure_engine(settings, archives, measured, reference, plan, progress)
        rows = [s.row for s in settings]
        if measured.truth is not None and measured.is_figure:
            rows += measure_generated_scenes(settings, scratch, plan, progress)
    mark_pareto_fronts(rows, SHOWN)
    facts = {
        "scene": measured.name,
        "warnings": warnings_of(measured, reference),
        "points": header.points,
        "lattice_step_m": measured.step,
        "radius_m": header.radius,
        "avatar_points": len(measured.avatar),
        "walk_poses": len(measured.walk),
        "judged_poses": len(measured.judged),
        "judged_contacts": int(reference.contact.sum()),
        "near_tangent_poses": len(reference.tangent),
        "poses_judged_by_every_pair": checked,
        "seconds": time.perf_counter() - begin,
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "processors": os.cpu_count(),
        "plan": asdict(plan),
    }
    return Report(measured.name, rows, facts)


def warnings_of(measured: MeasuredScene, reference: ReferenceAnswers) -> list[str]:
    """Return sentences about effects that this measurement cannot show."""
    said = list(measured.warnings)
    if not reference.contact.any():
        said.append(
            f"None of the {len(reference.contact):,} judged poses touches: wrong clear verdicts cannot appear."
        )
    if reference.contact.all():
        said.append(
            f"All {len(reference.contact):,} judged poses touch: wrong contact verdicts cannot appear."
        )
    if not len(reference.tangent):
        said.append(
            "No pose was found within a micrometre of touching: the effect of rounding is not measured."
        )
    return said


def measure_engine(
    settings: list[Setting],
    archives: Archives,
    measured: MeasuredScene,
    reference: ReferenceAnswers,
    plan: MeasurementPlan,
    progress: Progress,
) -> None:
    """Measure the settings of the server's engine: verdicts, doorways and leaks, times."""

    def tick() -> None:
        progress.advance(1)

    costs = compare_costs(settings, measured.config)
    progress.start("verdicts", len(settings), "settings", costs)
    compare_engine(settings, archives, measured, reference, tick)
    progress.finish()
    if measured.truth is not None:
        costs = [1.0] * sum(s.row.knob in USER_ERROR_KNOBS for s in settings)
        progress.start("doors, walls", len(costs), "settings", costs)
        measure_user_errors(settings, archives, measured, plan, tick)
        progress.finish()
    costs = time_costs(settings) * plan.loops
    progress.start("times", len(costs), "settings", costs)
    time_engine(settings, archives, measured, plan, tick)
    progress.finish()


def measure_generated_scenes(
    settings: list[Setting], scratch: Path, plan: MeasurementPlan, progress: Progress
) -> list[Row]:
    """Measure on other generated scenes: a sheet with a door, and façades with narrower doors.

    Returns the rows of the sheet. The doorways are entered into the rows of `settings`.
    """

    def tick() -> None:
        progress.advance(1)

    progress.start("sheet", count_sheet(), "settings", [1.0] * count_sheet())
    rows = measure_sheet(scratch, tick)
    progress.finish()
    if plan.made_models:
        progress.start("doors made", FACADES, "façades", [1.0] * FACADES)
        measure_generated_doors(settings, scratch / "doors", plan, tick)
        progress.finish()
    return rows


def write_rows(report: Report, out: Path) -> None:
    """Write accuracy.json, with facts and rows, and accuracy.csv, with the rows."""
    rows = [row.as_dict() for row in report.rows]
    (out / "accuracy.json").write_text(
        json.dumps({"facts": report.facts, "rows": rows}, indent=1, allow_nan=False) + "\n"
    )
    with open(out / "accuracy.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows({**row, "front": " ".join(row["front"])} for row in rows)
