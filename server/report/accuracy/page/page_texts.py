"""Texts of the accuracy report: terms, a paragraph per knob, and a summary of the results."""

import math
from collections.abc import Sequence
from itertools import pairwise

from ..measurement.interleaved_timing import NOISY
from ..measurement.setting_results import (
    BUDGET,
    DEGREE,
    LEAF,
    NODES,
    RADIUS,
    SHEET,
    STEP,
    TOLERANCE,
    Row,
)

# Times that differ by less than this factor are called the same: times of one archive built twice
# differed by 6 %.
SAME_TIME = 1.15

TERMS = {
    "pose": "position and orientation of the avatar. Each pose is one query: does the avatar touch the scan there?",
    "time per pose": "a group of consecutive poses, a dozen by default, is timed as one call, and the time is divided "
    "by their number; the best of several repetitions counts. p50 is the median of these groups, and one group in a "
    "hundred is slower than p99. A single pose may take longer.",
    "early, late": "early: contact is reported although the exact answer is clear; the avatar is stopped before it "
    "touches. Late: clear is reported although the exact answer is contact; the avatar may pass through.",
    "unknown": "neither contact nor clear: the budget was spent before the answer was certain.",
    "near-tangent": "poses at which the nearest spheres are within a micrometre of touching, on either side. Rounding "
    "errors appear first at these poses.",
    "distance error": "difference between the reported distance and the exact one.",
    "doorway": "extra width that a door needs before the figure passes upright along its middle. 0 would be perfect; "
    "the spheres that represent the door's points make it narrower than it is.",
    "made doorway": "the same error, measured directly: façades are generated with doors of decreasing width, each is "
    "scanned and walked through. The jambs of a narrow door are seen at a smaller angle and therefore have fewer "
    "points. Rays that graze both jambs also leave points in the opening, which stop the figure whatever their radius.",
    "leak": "distance between a wall's true surface and a ball of 5 cm radius that has passed it and is then stopped: "
    "where points are sparse, the ball slips between them. Negative: stopped before the surface. A ball that passes "
    "through counts as 100 mm.",
    "passed": "share of places where that ball passes through the wall.",
    "Pareto front": "settings that no other setting beats: none is both faster and at least as good, or better and as "
    "fast.",
}

CHARTS = {
    "main": "Each point is a setting; the star is the default. Left is faster, low is better; points with a green ring "
    "are on the Pareto front.",
    "verdicts": "The same settings against the share of verdicts that differ from the exact ones, and against the "
    "largest distance error.",
}

# Why `local` leaks less than `mean` at the same doorway error, but not less than half; on the
# generated façade.
LEFT = (
    "The effect of density is gone: the median leak no longer grows with the spacing of points. The rest is due to "
    "random gaps between points, and to one jamb of the door that is scanned as sparsely as the sparsest wall."
)

KNOBS = {
    TOLERANCE: "Distance by which contact may be reported early [m]. It ends the exact search as soon as a pair of "
    "points within margin plus tolerance is met, and changes nothing else: poses farther away than that take as long "
    "as without it.",
    BUDGET: "Maximum number of node visits per pose. When it is spent, the answer is unknown, never a wrong clear.",
    STEP: "Step of the lattice on which points are stored. The radius is that of the default, and only the "
    "displacement of points has an effect. A coarser lattice makes a smaller archive, and moves each point by up to "
    "half a step per axis.",
    DEGREE: "Maximum number of children of a node of the hierarchy. No answer changes.",
    LEAF: "Maximum number of points of a leaf of the hierarchy. No answer changes.",
    NODES: "Bounding volume of a node in the server: a sphere, as in the paper, or a sphere cut by the slab that "
    "contains its points. No answer changes.",
    RADIUS: "Radius of the sphere that represents each point: one mean for all (as in the paper), one that follows the "
    "spacing around each point (local), smaller ones on the rims of surfaces (border), or a fixed radius. A number "
    "after a colon is a factor. Early and late are counted against `mean`: here they are differences, not errors. At "
    "the same doorway error local leaks less than mean, because its median leak does not grow with the spacing of "
    "points. The rest is due to random gaps, and to a jamb of the door that is scanned as sparsely as the sparsest "
    "wall.",
    SHEET: "The purpose of smaller spheres on rims. The scene is a sheet without thickness with a door of 1 m: the "
    "figure can only touch the rim. The façade's jambs are planes 1.2 m deep with hardly a point on a rim, where "
    "`border` changes almost nothing. The ball is pushed at the sheet away from its rims.",
}  # fmt: skip


def findings(rows: Sequence[Row], brute: int = 0) -> list[str]:
    """Summarise the results in sentences. A sentence is left out if its settings were not measured.

    brute: number of poses at which every pair of points was compared.
    """
    said = [
        _exact(rows, brute),
        _tolerance(rows),
        _budget(rows),
        _lattice(rows),
        _radius(rows),
        _equal_door(rows),
        _made(rows),
        _sheet(rows),
    ]
    return [line for line in said if line]


def _find(rows: Sequence[Row], knob: str, setting: str | None = None) -> Row | None:
    """Return the row of a setting of a knob, or of its default if `setting` is None."""
    return next(
        (r for r in rows if r.knob == knob and (r.setting == setting if setting else r.default)),
        None,
    )


def _exact(rows: Sequence[Row], brute: int) -> str:
    row = _find(rows, TOLERANCE)
    if row is None or row.mean_us is None:
        return ""
    said = f"The exact answer takes {row.mean_us:.1f} µs per pose, p99 of groups {row.p99_us:.1f} µs."
    if not brute:
        return said
    # The exact answer is the reference: its own count of wrong verdicts means nothing.
    return f"{said} Check: a test of every pair of points in integers at {brute:,} poses agrees with it."


def _tolerance(rows: Sequence[Row]) -> str:
    own = [r for r in rows if r.knob == TOLERANCE and not r.default and r.times is not None]
    if not own:
        return ""
    best = min(own, key=lambda r: r.times or 0.0)
    said = (
        f"A tolerance ends the search early where something is near: at best, {best.setting}, a pose takes "
        f"{_ratio(best, 'the exact answer')}, and {best.early:,} of {best.poses:,} poses are called early"
    )
    faster = not _noisy(best) and (best.times or 0.0) * SAME_TIME < 1.0
    return f"{said}." if faster else f"{said}: on these poses it is not measurably faster."


def _noisy(row: Row) -> bool:
    """Return whether other work on the machine disturbed a row's times."""
    return row.noise is not None and row.noise > NOISY


def _alike(one: float, other: float) -> bool:
    """Return whether two times differ only by noise."""
    return max(one, other) <= SAME_TIME * min(one, other)


def _ratio(row: Row, of: str = "", base: Row | None = None) -> str:
    """Describe the ratio of a row's time to that of its knob's default, or of `base`.

    Differences within noise are called equal.
    of: name of what it is compared with; empty if the sentence already contains it.
    """
    times = (row.times if base is None else (row.mean_us or 0.0) / (base.mean_us or math.inf)) or 0.0
    if _alike(times, 1.0):
        return f"the same time{of and f' as {of}'}, within noise"
    if _noisy(row) or (base is not None and _noisy(base)):
        return f"a time too noisy to compare{of and f' with {of}'}"
    return f"{times:.2f} times the time{of and f' of {of}'}"


def _budget(rows: Sequence[Row]) -> str:
    spent = [r for r in rows if r.knob == BUDGET and not r.default]
    enough = [r for r in spent if not r.unknown]
    if not spent:
        return ""
    least = min(spent, key=lambda r: r.value or 0.0)
    tail = f" {enough[0].setting} suffice for every pose here." if enough else ""
    return (
        f"A budget bounds the work and never causes a wrong clear: with {least.setting} it leaves "
        f"{least.unknown / max(least.poses, 1):.0%} of poses unknown.{tail}"
    )


def _lattice(rows: Sequence[Row]) -> str:
    steps = [r for r in rows if r.knob == STEP and r.archive_bytes]
    default = _find(rows, STEP)
    if default is None or len(steps) < 2:
        return ""
    parts = [
        f"{r.setting}: {r.archive_bytes / (default.archive_bytes or 1):.2f} times the bytes, distance errors up to "
        f"{r.distance_max_mm or 0.0:.2g} mm"
        for r in steps
        if not r.default and r.archive_bytes
    ]
    return f"Lattice step, compared with {default.setting}: " + "; ".join(parts) + "."


def _radius(rows: Sequence[Row]) -> str:
    mean = _find(rows, RADIUS)
    others = [r for r in rows if r.knob == RADIUS and not r.default and ":" not in r.setting]
    if mean is None or mean.leak_p99_mm is None or not others:
        return ""
    if mean.doorway_mm is None:  # the avatar is not the generated figure
        leaks = [f"{r.setting} {r.leak_p99_mm:.0f} mm" for r in (mean, *others) if r.leak_p99_mm is not None]
        return "Radius models, 99th percentile of the leak: " + "; ".join(leaks) + "."
    parts = [
        f"{r.setting} {r.doorway_mm:.0f} and {r.leak_p99_mm:.0f} mm"
        for r in (mean, *others)
        if r.doorway_mm is not None and r.leak_p99_mm is not None
    ]
    return "Radius models, doorway error and 99th percentile of the leak: " + "; ".join(parts) + "."


def _equal_door(rows: Sequence[Row]) -> str:
    """Compare the leaks of `mean` and `local` at the same doorway error, that of `mean`.

    A factor trades one error for the other: models with different doorway errors are not
    comparable.
    """
    mean = _find(rows, RADIUS)
    if mean is None or mean.doorway_mm is None or mean.leak_p99_mm is None:
        return ""
    leak = leak_at(rows, "local", mean.doorway_mm)
    if leak is None:
        return ""
    said = (
        f"At the doorway error of mean ({mean.doorway_mm:.0f} mm) local leaks {leak:.0f} mm at p99 against "
        f"{mean.leak_p99_mm:.0f} mm, interpolated between its factors"
    )
    if leak <= max(mean.leak_p99_mm, 0.0) / 2:
        return f"{said}: half or less."
    if leak >= mean.leak_p99_mm:
        return f"{said}: no gain."
    return f"{said}: more than half. {LEFT}"


def leak_at(rows: Sequence[Row], model: str, doorway: float) -> float | None:
    """Interpolate the 99th percentile of the leak [mm] of a radius model at a doorway error [mm].

    The interpolation is linear between the model's factors. Returns None if the measured doorway
    errors do not enclose the given one.
    """
    known = sorted(
        (r.doorway_mm, r.leak_p99_mm)
        for r in rows
        if r.knob == RADIUS and r.setting.split(":")[0] == model
        if r.doorway_mm is not None and math.isfinite(r.doorway_mm) and r.leak_p99_mm is not None
    )
    for (door, leak), (wider, less) in pairwise(known):
        if door <= doorway <= wider:
            return leak if wider == door else leak + (less - leak) * (doorway - door) / (wider - door)
    return None


def _made(rows: Sequence[Row]) -> str:
    known = [r for r in rows if r.made_doorway_mm is not None and r.doorway_mm is not None]
    if not known:
        return ""
    parts = [f"{r.setting} {_door(r.made_doorway_mm)} (inferred: {_door(r.doorway_mm)})" for r in known]
    return "Doorway error measured on generated doors of decreasing width: " + "; ".join(parts) + "."


def _door(error: float | None) -> str:
    """Format a doorway error."""
    return f"{error:.0f} mm" if error is not None and math.isfinite(error) else "none passes"


def _sheet(rows: Sequence[Row]) -> str:
    own = {r.setting: r for r in rows if r.knob == SHEET and r.doorway_mm is not None}
    pairs = [(r, own.get(f"border{name[4:]}")) for name, r in own.items() if name.split(":")[0] == "mean"]
    parts = [
        f"at {mean.value:g} times the mean radius {_door(mean.doorway_mm)} with mean, {_door(border.doorway_mm)} with "
        f"border, leaks (p99) {mean.leak_p99_mm or 0.0:.0f} and {border.leak_p99_mm or 0.0:.0f} mm"
        for mean, border in pairs
        if border is not None
    ]
    if not parts:
        return ""
    said = "Doorway error of a thin sheet, at the rim of a surface: " + "; ".join(parts) + "."
    wider = own.get("border")
    if wider is not None and (wider.doorway_mm or 0.0) < 0.0:
        said += f" At the mean radius, border makes this door {-(wider.doorway_mm or 0.0):.0f} mm wider than it is."
    return said
