"""Options of the mover in `.github/mover.png`: each with at least two values, in simulated sessions."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from solidcloud.schemas.scene.effect_table import Ground, Step, Stop

from .drawn_case import Case, Measure, Row, section
from .made_shapes import RADIUS, SPACING, crate, ground, walls
from .scenarios import FEET, SPEED
from .simulated_walks import FALL, OTHER, Walk, opened, straight

Floats = NDArray[np.float64]

# The values that the panels show [m, degrees]; the first of each is the default.
SKINS, HEIGHTS, SLOPES, CLEARANCES = (0.002, 0.03), (0.2, 0.1), (45.0, 30.0), (0.03, 0.1)
# Height of the step that HEIGHTS tell apart [m], and angle of the slope that SLOPES do [degrees].
STEP, SLOPE = 0.15, 38.0
# Drops [m], and the values of `ground.snap` that tell them apart [m].
DROPS, SNAPS = (0.15, 0.3), (0.2, 0.35)
# Where the walks at SKINS begin [m]. The avatar never moves back: a frame that begins nearer to the
# wall than the skin stays where it is, so the skin is seen only from some starts.
SKIN_START = -0.924
# Heights of the sills that CLEARANCES tell apart [m].
SILLS = (0.02, 0.07)
# Side of the crate, and where the wall stands behind it [m].
CRATE, WALL = 0.4, 1.2


def skin(folder: Path) -> Case:
    """Walk straight at a wall."""
    rows, gaps = [], []
    for value in SKINS:
        points = walls([np.array([[0.0, -0.5], [0.0, 0.5]])], (-1.3, -0.5, 0.0, 0.5), SPACING)
        with opened(folder, points, {"stop": {"skin": value}}) as scene:
            found = scene.walk((SKIN_START, 0.0, FEET), straight(SPEED, 0.0), 1.0)
            gaps.append(scene.free_way(found.places[-1], (0.2, 0.0, 0.0)))
            dots = section("plan", scene.points)
        end = float(found.places[-1, 0]) + RADIUS
        text = f"{gaps[-1] * 1000:.0f} mm"
        rows.append(
            Row(
                "plan", dots, [found], (-1.25, -0.3), (0.28, 0.3), 7, _label(value, Stop().skin, " m"),
                measures=(Measure((end, 0.0), (-SPACING / 2, 0.0), text, (0.15, 0.0)),), scale_left=True,
            )
        )  # fmt: skip
    return Case(
        "skin", "stop.skin", "distance kept from what stops the avatar", tuple(rows),
        {f"skin {value:g} is kept": abs(gap - value) < 1e-3 for value, gap in zip(SKINS, gaps, strict=True)},
    )  # fmt: skip


def step_height(folder: Path) -> Case:
    """Walk at a step."""
    profile = np.array([[-0.8, 0.0], [0.2, 0.0], [0.2, STEP], [1.0, STEP]])
    found = [_walked(folder, profile, {"step": {"height": value}}, -0.4, 0.85) for value in HEIGHTS]
    rows = _rows(found, HEIGHTS, Step().height, " m", (-0.7, -0.25), (0.9, 2.2))
    rise = [float(walk.places[-1, 2] - walk.places[0, 2]) for walk, _ in found]
    return Case(
        "step", "step.height", f"a step of {STEP * 100:.0f} cm", rows,
        beside=True,
        claims={"the default climbs": abs(rise[0] - STEP) < 0.02, "the lower one does not": abs(rise[1]) < 0.02},
    )  # fmt: skip


def slope_limit(folder: Path) -> Case:
    """Walk at a slope."""
    rise = float(np.tan(np.radians(SLOPE)))
    profile = np.array([[-0.8, 0.0], [0.0, 0.0], [0.6, 0.6 * rise], [1.0, 0.6 * rise]])
    found = [_walked(folder, profile, {"ground": {"slope": value}}, -0.45, 0.95) for value in SLOPES]
    rows = _rows(found, SLOPES, Ground().slope, "°", (-0.7, -0.15), (0.9, 2.3))
    rose = [float(walk.places[-1, 2] - walk.places[0, 2]) for walk, _ in found]
    return Case(
        "slope", "ground.slope", f"a slope of {SLOPE:.0f}°", rows,
        beside=True,
        claims={"the default walks up": rose[0] > 0.5 * rise, "the lower one stays below": abs(rose[1]) < 0.05},
    )  # fmt: skip


def snap(folder: Path) -> Case:
    """Walk down two ledges."""
    first, second = DROPS
    profile = np.array(
        [[-2.4, first + second], [0.0, first + second], [0.0, second], [1.5, second], [1.5, 0.0], [4.0, 0.0]]
    )
    found = [
        _walked(folder, profile, {"ground": {"snap": value}}, -1.8, 4.3, first + second) for value in SNAPS
    ]
    rows = _rows(found, SNAPS, Step().height, " m", (-2.2, -0.62), (3.9, 2.15))
    rows = tuple(row._replace(label_low=True) for row in rows)
    fell = [[_fell(walk, -0.3, 1.2), _fell(walk, 1.2, 3.0)] for walk, _ in found]
    text = f"down {first * 100:.0f} and {second * 100:.0f} cm"
    return Case(
        "snap", "ground.snap", text, rows,
        {
            "the low drop is followed": not fell[0][0] and not fell[1][0],
            "the high drop is fallen": fell[0][1],
            "a larger value follows the high drop": not fell[1][1],
        },
    )  # fmt: skip


def clearance(folder: Path) -> Case:
    """Walk over two sills, seen near the ground."""
    low, high = SILLS
    line = [[-0.5, 0.0]]
    for x, height in ((0.25, low), (1.0, high)):
        line += [[x, 0.0], [x, height], [x + 0.08, height], [x + 0.08, 0.0]]
    profile = np.array([*line, [1.7, 0.0]])
    found = [
        _walked(folder, profile, {"ground": {"clearance": value}}, -0.25, 1.5, value - FEET + SPACING / 2)
        for value in CLEARANCES
    ]
    rows, gaps = [], []
    for (walk, dots), value in zip(found, CLEARANCES, strict=True):
        x, _, feet = walk.places[np.abs(walk.places[:, 0] - 0.72).argmin()].tolist()
        gaps.append(feet - SPACING / 2)  # from the spheres of the scan
        text = f"{gaps[-1] * 100:.0f} cm"
        rows.append(
            Row(
                "side", dots, [walk], (-0.5, -0.12), (1.7, 0.5), 11, _label(value, Ground().clearance, " m"),
                measures=(Measure((x, SPACING / 2), (x, feet), text, (x - 0.13, feet + 0.065)),),
            )
        )  # fmt: skip
    rose = [float(np.ptp(walk.places[8:, 2])) for walk, _ in found]
    text = f"height of the feet; sills of {low * 100:.0f} and {high * 100:.0f} cm"
    return Case(
        "clearance", "ground.clearance", text, tuple(rows),
        {
            "feet are at the clearance": all(
                abs(gap - value) < 0.3 * value for gap, value in zip(gaps, CLEARANCES, strict=True)
            ),
            "the low one steps over a sill": rose[0] > high / 2,
            "both reach the end": all(walk.places[-1, 0] > 1.2 for walk, _ in found),
        },
    )  # fmt: skip


def push(folder: Path) -> Case:
    """Walk at a crate that gives way, and at one that does not."""
    rows, ends, walked = [], [], []
    start = [0.0, 0.0, FEET]
    pose = np.eye(4)
    pose[:3, 3] = start
    for kind in ("pushed", "kinematic"):
        points = walls([np.array([[WALL, -0.5], [WALL, 0.5]])], (-1.2, -0.5, WALL, 0.5), SPACING)
        item = {"name": "crate", "avatar": "crate", "kind": kind, "pose": pose.tolist()}
        with opened(
            folder, points, extra=["objects"], objects=[item], shapes={"crate": crate(CRATE)}
        ) as scene:
            found = scene.walk((-0.95, 0.0, FEET), straight(SPEED, 0.0), 1.9, {"crate": start})
            dots = section("plan", scene.points)
        ends.append(float(found.objects[-1, 0, 0]))
        walked.append(found)
        rows.append(
            Row("plan", dots, [found], (-1.2, -0.5), (1.35, 0.5), 14, kind, crate=CRATE, scale_left=True)
        )
    return Case(
        "push", "objects.kind", "a crate pushed to a wall; one that stays", tuple(rows),
        {
            "the pushed one stops at the wall": abs(ends[0] + CRATE / 2 - (WALL - SPACING / 2)) < 0.01,
            "the user stops at it": bool(walked[0].places[-1, 0] < ends[0] - CRATE / 2 - RADIUS + 0.005),
            "the kinematic one stays": ends[1] == 0.0,
            "it stops the user": bool(walked[1].touched[-1] == OTHER),
        },
    )  # fmt: skip


def _walked(
    folder: Path, profile: Floats, options: dict[str, Any], x: float, seconds: float, height: float = 0.0
) -> tuple[Walk, Floats]:
    """Simulate a walk to the right from x, on a ground of this height there; return the dots too."""
    with opened(folder, ground(profile, 0.4, SPACING), options) as scene:
        walk = scene.walk((x, 0.0, height + FEET), straight(SPEED, 0.0), seconds)
        return walk, section("side", scene.points)


def _rows(
    found: list[tuple[Walk, Floats]],
    values: tuple[float, ...],
    default: float,
    unit: str,
    low: tuple[float, float],
    high: tuple[float, float],
) -> tuple[Row, ...]:
    """Return side views of walks, one a value of an option."""
    return tuple(
        Row("side", dots, [walk], low, high, 14, _label(value, default, unit))
        for (walk, dots), value in zip(found, values, strict=True)
    )


def _label(value: float, default: float, unit: str) -> str:
    """Return the text of a value, which says whether it is the default."""
    return f"{value:g}{unit}" + (", the default" if value == default else "")


def _fell(walk: Walk, begin: float, end: float) -> bool:
    """Return whether a walk fell between two places along x."""
    there = (walk.places[1:, 0] > begin) & (walk.places[1:, 0] < end)
    return bool((walk.touched[there] == FALL).any())


OPTIONS: tuple[Callable[[Path], Case], ...] = (skin, step_height, slope_limit, snap, clearance, push)
