"""Accuracy report: query time and errors of each setting, varying one parameter ("knob") at a time.

`solidcloud accuracy` calls `run`, which writes accuracy.csv, accuracy.json, accuracy.html and the
charts. Everything runs in this process: it builds archives from one scan, opens, queries and closes
them.
"""

import csv
import json
import os
import time
from dataclasses import asdict, replace
from pathlib import Path

from ....builder.config import BuildConfig
from ....builder.run.progress import Progress
from ....schemas.archive.archive import Archive
from ....schemas.process.os_errors import check_writable
from ..common.sphere_pictures import load_pyplot
from .accuracy_arithmetic import PRIMITIVE, VOLUME, check_judge, measure_plain, plain_settings
from .accuracy_case import (
    AVATAR,
    REACH,
    Ground,
    given_ground,
    judged_contact,
    made_ground,
    tangent_poses,
    turned_ground,
)
from .accuracy_engine import (
    Archives,
    Exact,
    Setting,
    count_timed,
    engine_settings,
    judge_engine,
    radius_settings,
    time_engine,
)
from .accuracy_felt import FACADES, FELT, measure_felt, measure_made
from .accuracy_plan import Plan
from .accuracy_report import Report
from .accuracy_row import COLUMNS, SHOWN, Row, mark_front
from .accuracy_sheet import count_sheet, measure_sheet

TURNED = (VOLUME, PRIMITIVE)


def run(
    out: Path,
    scratch: Path,
    plan: Plan,
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
    from .accuracy_page import write_page
    from .accuracy_picture import draw_charts

    load_pyplot()  # fails now if matplotlib is missing, not after minutes of measuring
    if archive is not None:
        Archive(archive).close()  # fails before the output folder is created
    out.mkdir(parents=True, exist_ok=True)
    check_writable(out)
    report = measure(scratch, plan, progress, archive, avatar)
    progress.start("draw", 1, "page")
    write_rows(report, out)
    charts = draw_charts(report.rows, report.ground, out)
    write_page(report, charts, out / "accuracy.html")
    progress.advance(1)
    progress.finish()
    return report


def measure(
    scratch: Path, plan: Plan, progress: Progress, archive: Path | None = None, avatar: Path | None = None
) -> Report:
    """Measure everything and return the report without writing it."""
    begin = time.perf_counter()
    progress.start("make", 1, "scene")
    ground = given_ground(archive, plan, avatar, scratch) if archive else made_ground(plan, avatar, scratch)
    progress.advance(1)
    progress.finish()
    with Archives(ground, scratch) as archives:
        progress.start("judge", 2, "parts")
        exact = judge(ground, ground.config, archives, plan)
        progress.advance(1)
        with Archive(archives.folder(with_slabs(ground))) as opened:
            header = opened.header
            checked = check_judge(opened, ground, exact, plan.brute)
            progress.advance(1)
            progress.finish()
            settings = engine_settings(plan, ground.config, header.radius)
            settings += radius_settings(plan, ground.config, header.radius)
            measure_engine(settings, archives, ground, exact, plan, progress)
            rows = [s.row for s in settings]
            if ground.truth is not None and ground.own:
                rows += measure_made_scenes(settings, scratch, plan, progress)
            progress.start("plain", len(plain_settings()) * (1 + plan.loops), "settings")
            rows += measure_plain(opened, ground, exact, plan, lambda: progress.advance(1))
            progress.finish()
    rows += measure_turned(ground, scratch, plan, progress)
    mark_front(rows, SHOWN)
    facts = {
        "scene": ground.name,
        "warnings": warnings_of(ground, exact),
        "points": header.points,
        "lattice_step_m": ground.step,
        "radius_m": header.radius,
        "avatar_points": len(ground.avatar),
        "walk_poses": len(ground.walk),
        "judged_poses": len(ground.judged),
        "judged_contacts": int(exact.contact.sum()),
        "near_tangent_poses": len(exact.tangent),
        "poses_judged_by_every_pair": checked,
        "seconds": time.perf_counter() - begin,
        "load_average": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "processors": os.cpu_count(),
        "plan": asdict(plan),
    }
    return Report(ground.name, rows, facts)


def with_slabs(ground: Ground) -> BuildConfig:
    """Return the ground's configuration with slabs, which the plain descent needs."""
    return replace(ground.config, with_slab=True)


def judge(ground: Ground, config: BuildConfig, archives: Archives, plan: Plan) -> Exact:
    """Return the reference answers: the server's exact ones on the archive of `config`."""
    scene = archives.scene(config)
    tangent = tangent_poses(scene, ground.judged, plan.near_tangent)
    distance = scene.distance(AVATAR, ground.judged, REACH).signed_distance
    return Exact(judged_contact(scene, ground.judged), distance, judged_contact(scene, tangent), tangent)


def warnings_of(ground: Ground, exact: Exact) -> list[str]:
    """Return sentences about effects that this measurement cannot show."""
    said = list(ground.warnings)
    if not exact.contact.any():
        said.append(
            f"None of the {len(exact.contact):,} judged poses touches: wrong clear verdicts cannot appear."
        )
    if exact.contact.all():
        said.append(f"All {len(exact.contact):,} judged poses touch: wrong contact verdicts cannot appear.")
    if not len(exact.tangent):
        said.append(
            "No pose was found within a micrometre of touching: the effect of rounding is not measured."
        )
    return said


def measure_engine(
    settings: list[Setting], archives: Archives, ground: Ground, exact: Exact, plan: Plan, progress: Progress
) -> None:
    """Measure the settings of the server's engine: verdicts, doorways and leaks, times."""

    def tick() -> None:
        progress.advance(1)

    progress.start("verdicts", len(settings), "settings")
    judge_engine(settings, archives, ground, exact, tick)
    progress.finish()
    if ground.truth is not None:
        progress.start("doors, walls", sum(s.row.knob in FELT for s in settings), "settings")
        measure_felt(settings, archives, ground, plan, tick)
        progress.finish()
    progress.start("times", count_timed(settings) * plan.loops, "settings")
    time_engine(settings, archives, ground, plan, tick)
    progress.finish()


def measure_made_scenes(settings: list[Setting], scratch: Path, plan: Plan, progress: Progress) -> list[Row]:
    """Measure on other generated scenes: a sheet with a door, and façades with narrower doors.

    Returns the rows of the sheet. The doorways are entered into the rows of `settings`.
    """

    def tick() -> None:
        progress.advance(1)

    progress.start("sheet", count_sheet(), "settings")
    rows = measure_sheet(scratch, tick)
    progress.finish()
    if plan.made_models:
        progress.start("doors made", FACADES, "façades")
        measure_made(settings, scratch / "doors", plan, tick)
        progress.finish()
    return rows


def measure_turned(ground: Ground, scratch: Path, plan: Plan, progress: Progress) -> list[Row]:
    """Measure bounding volumes and primitives on a scene whose walls are oblique to the axes.

    Axis-aligned walls favour boxes; the orientation does not matter to spheres.
    """
    folder = scratch / "turned"
    folder.mkdir(exist_ok=True)
    turned = turned_ground(ground, folder)
    count = sum(knob in TURNED for knob, _ in plain_settings())
    progress.start("turned", count * (1 + plan.loops), "settings")
    with Archives(turned, folder) as archives:
        exact = judge(turned, turned.config, archives, plan)
        with Archive(archives.folder(with_slabs(turned))) as opened:
            rows = measure_plain(opened, turned, exact, plan, lambda: progress.advance(1), only=TURNED)
    for row in rows:
        row.knob += ", turned"
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
