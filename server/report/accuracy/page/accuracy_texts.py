"""Texts of the accuracy report: the answer in a sentence, the settings to choose from, and the findings."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from ..measurement.accuracy_results import ColdRow, MemoryRow, Report
from ..measurement.pose_classes import CLASSES

# Tolerances of the settings that are recommended [m].
NEAR, COARSE = 0.03, 0.1
# Within this of 1 a ratio is called the same time.
SAME = 0.05


class Choice(NamedTuple):
    """A setting to choose, and what it costs here, as texts."""

    name: str
    how: str
    error: str
    near: str
    elsewhere: str
    wait: str
    read: str
    choose: str


def _near_and_rest(report: Report, tolerance: float) -> tuple[list[MemoryRow], list[MemoryRow]]:
    """Return the rows of `collide` with a tolerance: for poses that touch or are within NEAR, and for the others."""
    rows = _rows(report, tolerance)
    near = [row for row in rows if row.kind in list(CLASSES)[:2]]
    return near, [row for row in rows if row not in near]


def _rows(report: Report, tolerance: float) -> list[MemoryRow]:
    return [row for row in report.memory if row.question == "collide" and row.tolerance == tolerance]


def _mean(rows: Sequence[MemoryRow], what: str) -> float:
    """Return a mean over classes, weighted by their shares."""
    total = sum(row.share for row in rows)
    return sum(getattr(row, what) * row.share for row in rows) / total if total else float("nan")


def cold_row(report: Report, tolerance: float | None) -> ColdRow | None:
    """Return the row of a tolerance with nothing in memory."""
    return next((row for row in report.cold if row.tolerance == tolerance), None)


def saved(ratio: float, what: str) -> str:
    """Describe a ratio: saves 42 % of what there is, saves none of it, or adds 20 % to it."""
    if abs(ratio - 1.0) <= SAME:
        return f"saves none of the {what}"
    if ratio < 1.0:
        return f"saves {100 * (1 - ratio):.0f} % of the {what}"
    return f"adds {100 * (ratio - 1):.0f} % to the {what}"


def answer(report: Report) -> str:
    """Return the answer to what accuracy costs in time, in one sentence."""
    near, rest = _near_and_rest(report, NEAR)
    said = f"With the scene in memory, an error of {NEAR * 100:g} cm"
    if near:
        said += f" {saved(_ratio(near, report), 'time')} where a pose touches or is that near"
    if rest:
        said += f"{', and' if near else ''} {saved(_ratio(rest, report), 'time')} elsewhere"
    cold = cold_row(report, COARSE)
    if cold is not None:
        said += f"; with nothing in memory, {COARSE * 100:g} cm {saved(cold.wait, 'wait')}"
        said += f" and {saved(cold.bytes_ratio, 'bytes')}" if cold.bytes_ratio is not None else ""
    return said + "."


def _ratio(rows: Sequence[MemoryRow], report: Report) -> float:
    """Return the time of some classes together relative to their exact time."""
    kinds = {row.kind for row in rows}
    exact = [row for row in _rows(report, 0.0) if row.kind in kinds]
    return _mean(rows, "time_us") / _mean(exact, "time_us") if rows else float("nan")


def choices(report: Report) -> list[Choice]:
    """Return the three settings to choose from."""
    settings = (
        ("Exact", 0.0, "the default", "Leave it so, unless time or memory are short."),
        ("Near", NEAR, f"tolerance={NEAR:g}", "Choose it if most poses touch or nearly touch."),
        (
            "Coarse",
            COARSE,
            f"tolerance={COARSE:g}",
            "Choose it for scenes larger than memory, or to answer at once.",
        ),
    )
    found = []
    for name, tolerance, how, choose in settings:
        near, rest = _near_and_rest(report, tolerance)
        cold = cold_row(report, tolerance or None)
        found.append(
            Choice(
                name, how,
                "none" if not tolerance else f"contact up to {tolerance * 100:g} cm early, never late",
                f"{_mean(near, 'time_us'):.1f} µs" if near else "", f"{_mean(rest, 'time_us'):.1f} µs" if rest else "",
                f"{cold.wait_ms:.1f} ms" if cold else "",
                f"{cold.read_bytes / 1e3:,.0f} kB" if cold and cold.read_bytes is not None else "", choose,
            )
        )  # fmt: skip
    return found


def findings(report: Report) -> list[str]:
    """Return sentences about each of the report's questions, for the terminal and the page."""
    said = [
        answer(report),
        _checked(report),
        _fields(report),
        _walks(report),
        _radii(report),
        _frames(report),
    ]
    return [line for line in said if line]


def _checked(report: Report) -> str:
    facts = report.facts
    return (
        "All answers were checked: no touching pose was called clear, and no error was larger than "
        f"allowed. At {facts['poses_judged_by_every_pair']:,} poses a test of every pair of points agrees "
        "with the exact answer."
    )


def _fields(report: Report) -> str:
    """Compare the finest distance field with the exact answer, over all poses of the classes measured."""
    exact = {row.kind: row for row in _rows(report, 0.0)}
    cell = min((row.cell for row in report.fields), default=0.0)
    own = [row for row in report.fields if row.cell == cell and row.kind in exact]
    if len(own) < 2:  # of a single class there is no mean to speak of
        return ""
    shares = [exact[row.kind].share for row in own]
    field = sum(share * row.time_us for share, row in zip(shares, own, strict=True))
    engine = sum(share * row.time_us / row.ratio for share, row in zip(shares, own, strict=True))
    wrong = sum(share * (row.false_clear + row.early) for share, row in zip(shares, own, strict=True))
    return (
        f"A distance field with cells of {cell * 100:g} cm takes {field / engine:.1f} times as long as the "
        f"exact answer, is wrong at {100 * wrong / sum(shares):.0f} % of the poses, and takes "
        f"{size_name(own[0].scene_bytes)} for the whole scene, whose voxels take "
        f"{size_name(report.facts['decoded_bytes'])}."
    )


def size_name(count: float) -> str:
    """Format a number of bytes."""
    units = ("bytes", "kB", "MB", "GB", "TB")
    power = min(len(units) - 1, int(math.log10(max(count, 1)) / 3))
    return f"{count / 1000**power:.3g} {units[power]}"


def _walks(report: Report) -> str:
    bounds = [row for row in report.walks if row.kind == "bounds" and not row.note]
    if not bounds:
        return ""
    least = min(bounds, key=lambda row: row.memory)
    return (
        f"A walk at 5 m/s with {least.memory:g} of the scene in memory, by bounds: {least.stalls} of "
        f"{least.frames} frames over 33 ms, {least.false_clear} wrongly clear, {100 * least.early:.0f} % of "
        "the clear poses stopped early."
    )


def _radii(report: Report) -> str:
    own = {row.setting: row for row in report.radii if row.scene == "façade"}
    mean, local = own.get("mean"), own.get("local")
    if mean is None or local is None:
        return ""
    said = (
        f"A ball of 5 cm radius passes right through a wall at {100 * mean.passed:.1f} % of the places with "
        f"one radius for all points, and at {100 * local.passed:.1f} % with one that follows their spacing "
        "(local)"
    )
    if mean.time_us and local.time_us:
        said += f", which takes {local.time_us / mean.time_us:.2f} times as long"
    if mean.doorway_mm is not None:
        said += f"; a door must be {mean.doorway_mm:.0f} and {local.doorway_mm or 0.0:.0f} mm wider than the figure"
    return said + "."


def _frames(report: Report) -> str:
    if not report.frames:
        return ""
    first, last = report.frames[0], report.frames[-1]
    return (
        f"A frame of a walk of {first.way:.1f} m takes {first.time_us:.0f} µs; with a tolerance of "
        f"{last.tolerance * 100:g} cm for its sweeps it takes {last.ratio:.2f} times as long."
    )
