"""What the accuracy report says in words: terms, a paragraph a knob, and what the figures come to."""

import math
from collections.abc import Sequence
from itertools import pairwise

from .accuracy_arithmetic import ALL_PAIRS, ARITHMETIC, PRIMITIVE, VOLUME
from .accuracy_row import ALONE, BUDGET, DEGREE, LEAF, NODES, RADIUS, SHEET, STEP, TOLERANCE, Row
from .accuracy_timing import NOISY

# Times that differ by less than this factor are called the same: of one archive built twice they did by 6 %.
SAME_TIME = 1.15

TERMS = {
    "pose": "where the avatar stands and how it is turned; each is one question: does it touch the scan there?",
    "time of a pose": "a dozen neighbouring poses are timed as one call and divided; the best of several repetitions. "
    "p50 is the middle one of these dozens, p99 the one that only one dozen in a hundred is slower than: a single pose "
    "may take longer.",
    "early, late": "early: called contact though the exact answer is clear, so one is stopped before touching. Late: "
    "called clear though the exact answer is contact, so one may pass through.",
    "unknown": "neither: the work allowed was spent before an answer was certain.",
    "near-tangent": "poses moved until the nearest spheres are within a micrometre of just touching, on either side: "
    "where rounding shows first.",
    "distance off": "how far the distance that is reported lies from the exact one.",
    "doorway": "how much wider than the figure a door must be made before the figure passes it upright along the "
    "middle. 0 would be perfect; the spheres that stand for the door's points make it narrower than it is.",
    "made doorway": "the same found the long way: façades are made with narrower and narrower doors, each is scanned "
    "and walked through. A narrow door's jambs are seen at a smaller angle, so more sparsely; and rays that graze "
    "both jambs leave points that hang in between, which stop the figure whatever their radius.",
    "leak": "how far a ball of 5 cm radius is past a wall's true surface when it is stopped: where points stand "
    "thinly, it slips in between. Negative: stopped before the surface. A ball that goes through counts 100 mm.",
    "passed": "the share of places where that ball goes right through the wall.",
    "Pareto front": "settings that no other beats: nothing is both faster and at least as good, nor better and as "
    "fast.",
}

CHARTS = {
    "main": "Each point is a setting, the star is what you get without saying anything. Left is faster, low is "
    "better; points ringed in green are on the Pareto front.",
    "verdicts": "The same settings against how often the verdict is not the exact one, and how far off a distance "
    "can be.",
    "volumes": "The same hierarchy, descended by the same plain program, with its nodes bounded by spheres, by "
    "spheres cut by a slab, and by boxes along the axes; and with a cube in place of each point's sphere.",
}

# Why `local` leaks less than `mean` at the same doorway, and not less than half: of the made façade.
LEFT = (
    "What density causes is gone: the median no longer grows with the spacing of points. What is left is chance gaps "
    "between points, and one jamb of the door that is scanned as thinly as the thinnest wall."
)

_PLAIN = (
    "Measured with a plain scalar descent, so that nothing but the test differs: its times compare with one another "
    "and not with the server's. "
)

KNOBS = {
    TOLERANCE: "How early contact may be called [m]. A tolerance alone is answered exactly, for that is the fastest: "
    "see the row `alone`. What the other rows show is the search that a budget asks for: it keeps bounds, may stop as "
    "soon as they are within the tolerance, and says how far it got if the budget is spent. Here the budget is never "
    "spent, so that the tolerance alone makes the difference.",
    BUDGET: "How many nodes may be looked at for one pose. When they are spent the answer is unknown: never a wrong "
    "clear.",
    STEP: "How fine the lattice is on which points are stored. The radius is held at the default's, so only the "
    "moving of points shows. A coarser lattice makes a smaller archive, and moves each point by up to half a step an "
    "axis.",
    DEGREE: "How many children a node of the hierarchy has. No answer changes.",
    LEAF: "How many points a leaf of the hierarchy holds at most. No answer changes.",
    NODES: "What bounds the points below a node, in the server itself: a sphere, as in the paper, or a sphere cut by "
    "the slab that holds its points. No answer changes.",
    RADIUS: "How large a sphere stands for each point: one mean for all (the paper's), one after the spacing around "
    "each point (local), smaller ones on the rims of surfaces (border), or a fixed figure; a number behind a colon is "
    "a factor. Early and late are counted against `mean`: here they say what differs, not what is wrong. At the same "
    "doorway error local leaks less than mean, for its median does not grow with the spacing of points; what is left "
    "is chance gaps, and a jamb of the door that is scanned as thinly as the thinnest wall.",
    SHEET: "What smaller spheres on rims are for. A sheet without thickness with a door of 1 m in it: all that the "
    "figure can meet is the rim. The façade's jambs are planes 1.2 m deep, with hardly a point on a rim: `border` "
    "changes next to nothing there. The ball is pushed at the sheet away from its rims.",
    ARITHMETIC: _PLAIN + "The test of two points in five kinds of arithmetic. Map coordinates are those of a scene at "
    "500 km east and 5,600 km north; the other kinds count from a place near the avatar or from the scan's origin.",
    VOLUME: _PLAIN + "Two leaves are compared as the server does it: the avatar's points are first held against the "
    "bound of the scene's leaf. The façade's walls stand along the axes, which favours boxes.",
    VOLUME + ", turned": _PLAIN + "The same scene and poses, turned so that no wall stands along an axis.",
    ALL_PAIRS: _PLAIN + "Two leaves are compared as the paper does it: every point of one with every point of the "
    "other.",
    PRIMITIVE: _PLAIN + "A cube as wide as the sphere in place of each sphere: simpler to test, and a corner reaches "
    "1.7 times as far as a side. Cubes stay along the world's axes however the avatar turns.",
    PRIMITIVE + ", turned": _PLAIN + "The same scene and poses, turned so that no wall stands along an axis.",
}  # fmt: skip


def findings(rows: Sequence[Row], brute: int = 0) -> list[str]:
    """What the figures come to, in sentences; each is left out where its settings were not measured.

    brute: at how many poses every pair of points was compared.
    """
    said = [
        _exact(rows, brute),
        _tolerance(rows),
        _budget(rows),
        _lattice(rows),
        _radius(rows),
        _equal_door(rows),
        _made(rows),
    ]
    said += [_sheet(rows), _arithmetic(rows)]
    said += [_volumes(rows, ""), _volumes(rows, ", turned"), _cubes(rows)]
    return [line for line in said if line]


def _find(rows: Sequence[Row], knob: str, setting: str | None = None) -> Row | None:
    """A setting of a knob; None: its default."""
    return next(
        (r for r in rows if r.knob == knob and (r.setting == setting if setting else r.default)),
        None,
    )


def _exact(rows: Sequence[Row], brute: int) -> str:
    row = _find(rows, TOLERANCE)
    if row is None or row.mean_us is None:
        return ""
    said = f"The exact answer takes {row.mean_us:.1f} µs a pose, p99 of dozens {row.p99_us:.1f} µs."
    plain = _find(rows, ARITHMETIC, "integers")
    if plain is None or not brute:
        return said
    # Its verdicts are those that the others are compared with: that none is wrong says nothing. What else agrees does.
    wrong = plain.early + plain.late + plain.tangent_early + plain.tangent_late
    agree = "agree" if not wrong else f"disagree {wrong} times"
    return (
        f"{said} The judge: every pair of points in integers at {brute:,} poses, and the plain integer descent at "
        f"{plain.poses + plain.tangent:,} poses, {plain.tangent:,} of them near-tangent, {agree} with it."
    )


def _tolerance(rows: Sequence[Row]) -> str:
    own = [r for r in rows if r.knob == TOLERANCE and not r.default and r.times is not None]
    searches = [r for r in own if not r.setting.endswith(ALONE)]
    alone = next((r for r in own if r.setting.endswith(ALONE)), None)
    if not searches or alone is None:
        return ""
    best = min(searches, key=lambda r: r.times or 0.0)
    said = (
        f"A tolerance alone is answered exactly: {alone.early + alone.late} of {alone.poses:,} verdicts are wrong with "
        f"{alone.setting.removesuffix(ALONE)}, in {_ratio(alone, 'the exact answer')}. "
        f"A budget asks for a search that may stop within the tolerance: at best, {best.setting}, it takes "
        f"{_ratio(best, 'the exact answer')}, and calls {best.early:,} of {best.poses:,} poses early"
    )
    faster = not _noisy(best) and (best.times or 0.0) * SAME_TIME < 1.0
    return f"{said}." if faster else f"{said}: no time is seen to be won, but the work is bounded."


def _noisy(row: Row) -> bool:
    """Whether other work disturbed a row's times."""
    return row.noise is not None and row.noise > NOISY


def _alike(one: float, other: float) -> bool:
    """Whether two times differ by no more than noise."""
    return max(one, other) <= SAME_TIME * min(one, other)


def _ratio(row: Row, of: str = "", base: Row | None = None) -> str:
    """A row's time over that of its knob's default, or of `base`, in words that claim no more than was seen.

    of: what it is compared with, in words; empty where that is said before.
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
    tail = f" {enough[0].setting} are enough for every pose here." if enough else ""
    return (
        f"A budget bounds the work and never calls clear what touches: of {least.setting} it leaves "
        f"{least.unknown / max(least.poses, 1):.0%} of poses unknown.{tail}"
    )


def _lattice(rows: Sequence[Row]) -> str:
    steps = [r for r in rows if r.knob == STEP and r.archive_bytes]
    default = _find(rows, STEP)
    if default is None or len(steps) < 2:
        return ""
    parts = [
        f"{r.setting}: {r.archive_bytes / (default.archive_bytes or 1):.2f} times the bytes, distances off by up to "
        f"{r.distance_max_mm or 0.0:.2g} mm"
        for r in steps
        if not r.default and r.archive_bytes
    ]
    return f"Lattice step, against {default.setting}: " + "; ".join(parts) + "."


def _radius(rows: Sequence[Row]) -> str:
    mean = _find(rows, RADIUS)
    others = [r for r in rows if r.knob == RADIUS and not r.default and ":" not in r.setting]
    if mean is None or mean.leak_p99_mm is None or not others:
        return ""
    if mean.doorway_mm is None:  # another avatar than the made figure
        leaks = [f"{r.setting} {r.leak_p99_mm:.0f} mm" for r in (mean, *others) if r.leak_p99_mm is not None]
        return "Radius models, 99th percentile of the leak: " + "; ".join(leaks) + "."
    parts = [
        f"{r.setting} {r.doorway_mm:.0f} and {r.leak_p99_mm:.0f} mm"
        for r in (mean, *others)
        if r.doorway_mm is not None and r.leak_p99_mm is not None
    ]
    return "Radius models, doorway and 99th percentile of the leak: " + "; ".join(parts) + "."


def _equal_door(rows: Sequence[Row]) -> str:
    """The leak of `mean` and of `local` at one doorway error, that of `mean`: a fair comparison of two models.

    A factor alone trades one error for the other, so that models with different doorways do not compare.
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
    return f"{said}: half is not reached. {LEFT}"


def leak_at(rows: Sequence[Row], model: str, doorway: float) -> float | None:
    """The 99th percentile of the leak [mm] of a radius model at a doorway error [mm], linear between its factors.

    None where the factors measured do not reach there from both sides.
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
    return "Doorway by doors that were made narrower and narrower: " + "; ".join(parts) + "."


def _door(error: float | None) -> str:
    """A doorway's error in words."""
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
    said = "Doorway of a thin sheet, where a surface ends: " + "; ".join(parts) + "."
    wider = own.get("border")
    if wider is not None and (wider.doorway_mm or 0.0) < 0.0:
        said += f" At the mean radius border makes this door wider than it is, by {-(wider.doorway_mm or 0.0):.0f} mm."
    return said


def _arithmetic(rows: Sequence[Row]) -> str:
    own = [r for r in rows if r.knob == ARITHMETIC]
    if not own:
        return ""
    parts = [
        f"{r.setting} {_ratio(r)}, {r.early + r.late} of {r.poses:,} and "
        f"{r.tangent_early + r.tangent_late} of {r.tangent:,} near-tangent wrong"
        for r in own
        if not r.default
    ]
    return (
        "Arithmetic, against float32 with a certified bound and integers where it does not decide: "
        + "; ".join(parts)
        + "."
    )


def _volumes(rows: Sequence[Row], suffix: str) -> str:
    own = {r.setting: r for r in rows if r.knob == VOLUME + suffix}
    if not {"sphere", "sphere with slab", "box"} <= own.keys():
        return ""
    sphere, slab, box = (own[name].mean_us or 0.0 for name in ("sphere", "sphere with slab", "box"))
    where = "walls turned off the axes" if suffix else "walls along the axes"
    if _alike(box, sphere):
        order = "Groups of boxes and groups of spheres take the same time, within noise,"
    elif box < sphere:
        order = "Groups of boxes beat groups of spheres"
    else:
        order = "Groups of spheres beat groups of boxes"
    third = (
        "as long as boxes, within noise"
        if _alike(box, slab)
        else f"{'more' if box < slab else 'less'} than boxes"
    )
    return (
        f"{order} as bounds, {where}: {box:.1f} against {sphere:.1f} µs a pose in a plain descent. A sphere cut by a "
        f"slab takes {slab:.1f} µs: {third}."
    )


def _cubes(rows: Sequence[Row]) -> str:
    lines = []
    for suffix, where in (("", "walls along the axes"), (", turned", "turned")):
        own = [r for r in rows if r.knob == PRIMITIVE + suffix]
        cubes = next((r for r in own if r.setting.startswith("points cubes")), None)
        boxes = next((r for r in own if r.setting == "points spheres, nodes boxes"), None)
        if cubes is None or boxes is None or not boxes.mean_us:
            continue
        lines.append(
            f"{where}: {_ratio(cubes, 'spheres under the same boxes', boxes)}, "
            f"{cubes.early} of {cubes.poses:,} poses early, distances off by up to "
            f"{cubes.distance_max_mm or 0.0:.0f} mm"
        )
    return "Cubes in place of spheres for points, " + "; ".join(lines) + "." if lines else ""
