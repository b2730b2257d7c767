"""Accuracy report: what an error allowed saves in time, in memory and from disk, and what errors settings "
"have.

`solidcloud accuracy` calls `run`, which writes accuracy.json, accuracy.html and the charts.
Everything runs in this process, on one core.
"""

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ....builder.run.executor import Progress
from ....schemas.archive.archive import Archive
from ....schemas.runtime.new_file import new_file
from ....schemas.runtime.os_errors import check_writable
from ....schemas.wire.answers import Verdict
from ...scene import Scene
from ..common.machine import BUSY, cores, cpu_name
from ..common.paired_times import Floats
from ..common.sphere_pictures import load_pyplot
from .measurement.accuracy_results import RadiusRow, Report
from .measurement.cold_curve import along, can_drop, cold_curve
from .measurement.distance_field import field_rows
from .measurement.frame_curve import frame_rows
from .measurement.measured_scene import AVATAR, MeasuredScene, archive_scene, generated_scene
from .measurement.measurement_plan import MeasurementPlan
from .measurement.memory_curve import class_count, memory_curve
from .measurement.radius_errors import FACADES, STORED, count_settings, radius_rows, with_made_doorways
from .measurement.reference_answers import ReferenceAnswers, check_reference, find_reference
from .measurement.small_memory import walk_rows
from .measurement.thin_sheet import count_sheet, measure_sheet


def run(
    out: Path,
    scratch: Path,
    plan: MeasurementPlan,
    progress: Progress,
    archive: Path | None = None,
    avatar: Floats | None = None,
) -> Report:
    """Measure everything and write it into the folder `out`.

    scratch: a folder for scans and archives, which the caller removes.
    archive: folder of an archive to measure; None: one built from a generated façade.
    avatar: points (n, 3) [m]; None: the generated figure.
    Raises SolidcloudError if matplotlib is missing.
    """
    from .page.accuracy_charts import draw_charts
    from .page.accuracy_page import write_page

    load_pyplot()  # fails now if matplotlib is missing, not after minutes of measuring
    if archive is not None:
        Archive(archive).close()  # fails before the output folder is created
    out.mkdir(parents=True, exist_ok=True)
    check_writable(out)
    with cores(1):
        report = measure(scratch, plan, progress, archive, avatar)
    with _part(progress, "draw", 1) as tick:
        with new_file(out / "accuracy.json") as file:
            file.write((json.dumps(report.as_dict(), indent=1, allow_nan=False) + "\n").encode())
        write_page(report, draw_charts(report, out), out / "accuracy.html")
        tick()
    return report


def measure(
    scratch: Path,
    plan: MeasurementPlan,
    progress: Progress,
    archive: Path | None = None,
    avatar: Floats | None = None,
) -> Report:
    """Measure everything and return the report without writing it."""
    begin = time.perf_counter()
    with _part(progress, "make scene", 1) as tick:
        if archive is not None:
            measured = archive_scene(archive, plan, avatar)
        else:
            measured = generated_scene(plan, avatar, STORED, scratch)
        tick()
    body = measured.avatar
    with Scene.open(measured.archive) as scene, Archive(measured.archive) as opened:
        scene.add_avatar(AVATAR, body)
        with _part(progress, "reference", 2) as tick:
            measured = _without_unknown(scene, measured)
            reference = find_reference(scene, measured, plan)
            tick()
            checked = check_reference(opened, measured, reference, plan.brute)
            tick()
        with _part(progress, "in memory", class_count(reference)) as tick:
            memory = memory_curve(scene, measured.judged, reference, plan, tick)
        with _part(progress, "fields", len(plan.cells)) as tick:
            fields = field_rows(opened, scene, body, measured.judged, reference, plan, tick)
        facts = _facts(scene, opened, measured, reference, plan)
    places = along(measured.walk, 0.1)
    places = places[:: max(1, len(places) // plan.places)][: plan.places]
    with _part(progress, "cold", len(places)) as tick:
        cold = cold_curve(measured.archive, body, places, plan.tolerances[2:], tick)
    with _part(progress, "small memory", 2 * len(plan.shares)) as tick:
        walks = walk_rows(measured.archive, body, measured.walk, plan.shares, plan.walked, tick)
    radii = _radii(measured, scratch, plan, progress)
    with _part(progress, "frames", len(plan.frame_tolerances)) as tick:
        walk, touching = measured.walk, reference.contact[: len(measured.walk)]
        frames = frame_rows(measured.archive, body, walk, touching, plan.frame_tolerances, scratch, tick)
    facts |= {"poses_judged_by_every_pair": checked, "seconds": time.perf_counter() - begin}
    return Report(facts, memory, fields, cold, walks, radii, frames)


def _without_unknown(scene: Scene, measured: MeasuredScene) -> MeasuredScene:
    """Return the scene without the poses that are unknown because scans were left out there."""
    known = [
        scene.collide(AVATAR, poses).verdict != Verdict.UNKNOWN for poses in (measured.walk, measured.around)
    ]
    return measured._replace(walk=measured.walk[known[0]], around=measured.around[known[1]])


def _radii(
    measured: MeasuredScene, scratch: Path, plan: MeasurementPlan, progress: Progress
) -> list[RadiusRow]:
    """Measure the radius models on the façade, and on a sheet with a door; none without ground truth."""
    if measured.modelled is None:
        return []
    with _part(progress, "radius models", count_settings(plan)) as tick:
        rows = radius_rows(measured.modelled, measured, plan, tick)
    if not measured.is_figure:
        return rows
    if plan.made_models:
        with _part(progress, "doors made", FACADES) as tick:
            rows = with_made_doorways(rows, scratch / "doors", measured.config, plan, tick)
    with _part(progress, "sheet", count_sheet()) as tick:
        return rows + measure_sheet(scratch, tick)


def _facts(
    scene: Scene,
    archive: Archive,
    measured: MeasuredScene,
    reference: ReferenceAnswers,
    plan: MeasurementPlan,
) -> dict[str, Any]:
    """Return the facts about scene, machine and plan."""
    header, load = archive.header, os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    return {
        "scene": measured.name,
        "warnings": _warnings(measured, reference, load),
        "points": header.points,
        "voxels": len(archive.coordinates),
        "decoded_bytes": scene.info().resident_bytes,
        "lattice_step_m": header.lattice.step,
        "radius_m": header.radius,
        "avatar_points": len(measured.avatar),
        "walk_poses": len(measured.walk),
        "judged_poses": len(measured.judged),
        "judged_contacts": int(reference.contact.sum()),
        "near_tangent_poses": len(reference.tangent),
        "processor": cpu_name(),
        "processors": os.cpu_count(),
        "load_average": load,
        "plan": asdict(plan),
    }


def _warnings(measured: MeasuredScene, reference: ReferenceAnswers, load: float) -> list[str]:
    """Return sentences about what this measurement cannot show."""
    said = [*measured.warnings, *reference_warnings(reference)]
    if not can_drop():
        said.append(
            "This system cannot drop its cache of a file: the waits with nothing in memory are too short."
        )
    if load > BUSY + 1:
        said.append(
            f"Other work ran on this machine (load average {load:.1f}): compare times only with one another."
        )
    return said


def reference_warnings(reference: ReferenceAnswers) -> list[str]:
    """Return sentences about verdicts that are missing among the reference answers."""
    said = []
    if not reference.contact.any():
        said.append(f"None of the {len(reference.contact):,} judged poses touches.")
    if reference.contact.all():
        said.append(f"All {len(reference.contact):,} judged poses touch.")
    if not len(reference.tangent):
        said.append(
            "No pose was found within a micrometre of touching: the effect of rounding is not checked."
        )
    return said


@contextmanager
def _part(progress: Progress, name: str, steps: int) -> Iterator[Callable[[], None]]:
    """Show a part of the measurement; yield the function to call after each of its steps."""
    progress.start(name, steps, "steps")
    yield lambda: progress.advance(1)
    progress.finish()
