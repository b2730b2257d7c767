"""Scenarios of `.github/walks.png`: what a walking user meets in a scan, each simulated in a session."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .drawn_case import Case, Row, section
from .made_shapes import RADIUS, SPACING, box, circle, ground, walls
from .simulated_walks import CLEAR, FALL, FRAME, OTHER, SCAN, Steering, Walk, opened, straight

Floats = NDArray[np.float64]

# Height of the base above the floor at the start, and walking speed [m, m/s].
FEET, SPEED = 0.04, 1.2
# Width of the door and depth of its wall [m].
DOOR, DEPTH = 0.9, 0.2
# Stairs: height and depth of a step, and their number [m].
RISE, TREAD, STEPS = 0.17, 0.3, 4
# Slopes: one to walk, one too steep for the default limit of 45 degrees [degrees].
GENTLE, STEEP = 30.0, 55.0
COLUMN = 0.3  # radius [m]
# Number of users of the crowd, distance that they keep [m], and the frame in which they are shown.
USERS, MARGIN, SEEN = 7, 0.05, 36


def door_wall(half: float) -> list[Floats]:
    """Return the outlines of a wall along x with a door at x = 0. half: its half length [m]."""
    return [box((DOOR / 2, 0.0), (half, DEPTH)), box((-half, 0.0), (-DOOR / 2, DEPTH))]


def door(folder: Path) -> Case:
    """Pass a door, straight and obliquely."""
    turn = np.radians(40.0)
    x, y = SPEED * np.sin(turn), SPEED * np.cos(turn)
    with opened(folder, walls(door_wall(1.9), (-1.9, -1.5, 1.9, 1.6), SPACING)) as scene:
        found = [
            scene.walk((0.12, -1.1, FEET), straight(0.0, SPEED), 1.9),
            scene.walk((-1.1, -1.0, FEET), straight(x, y), 2.4),
        ]
        dots = section("plan", scene.points)
    return Case(
        "door", "Door", "straight, and obliquely along a jamb",
        (Row("plan", dots, found, (-1.5, -1.35), (1.5, 1.45), 8),),
        {
            "both pass": all(walk.places[-1, 1] > DEPTH + RADIUS for walk in found),
            "the straight one touches nothing": bool((found[0].touched == CLEAR).all()),
            "the oblique one slides": bool((found[1].touched == SCAN).any()),
        },
    )  # fmt: skip


def jamb(folder: Path) -> Case:
    """Walk into a jamb with some overlap."""
    overlap = 0.08
    with opened(folder, walls(door_wall(1.6), (-1.6, -1.2, 1.6, 1.3), SPACING)) as scene:
        start = (DOOR / 2 - RADIUS + overlap, -0.75, FEET)
        found = scene.walk(start, straight(0.0, SPEED), 1.4)
        dots = section("plan", scene.points)
    return Case(
        "jamb", "Jamb", f"{overlap * 100:.0f} cm too far right: slides off the jamb",
        (Row("plan", dots, [found], (-1.0, -1.05), (1.0, 1.15), 6),),
        {
            "it passes": bool(found.places[-1, 1] > DEPTH + RADIUS),
            "it touches the jamb": bool((found.touched == SCAN).any()),
            "it moves aside by the overlap": bool(found.places[0, 0] - found.places[-1, 0] > overlap),
        },
    )  # fmt: skip


def stairs_profile() -> Floats:
    """Return the profile (k, 2) of stairs up to a landing and down again."""
    line = [(-0.9, 0.0)]
    for step in range(STEPS):
        line += [(step * TREAD, step * RISE), (step * TREAD, (step + 1) * RISE)]
    half = np.array([*line, ((STEPS - 1) * TREAD + 0.7, STEPS * RISE)])
    middle = half[-1, 0]
    return np.concatenate([half, (half * [-1.0, 1.0] + [2 * middle, 0.0])[-2::-1]])


def stairs(folder: Path) -> Case:
    """Climb stairs and descend them."""
    profile = stairs_profile()
    with opened(folder, ground(profile, 0.4, SPACING)) as scene:
        found = scene.walk((-0.6, 0.0, FEET), straight(SPEED, 0.0), (np.ptp(profile[:, 0]) - 0.6) / SPEED)
        dots = section("side", scene.points)
    top = found.places[:, 2].max()
    return Case(
        "stairs", "Stairs", f"steps of {RISE * 100:.0f} cm, up and down",
        (Row("side", dots, [found], (-0.9, -0.25), (float(profile[-1, 0]), 2.45), 13),),
        {
            "it climbs all steps": bool(abs(top - found.places[0, 2] - STEPS * RISE) < 0.02),
            "it descends all steps": bool(abs(found.places[-1, 2] - found.places[0, 2]) < 0.02),
            "it never falls": not (found.touched == FALL).any(),
        },
    )  # fmt: skip


def slope(folder: Path) -> Case:
    """Walk up a slope to a landing, and at one that is too steep."""
    gentle, steep = np.tan(np.radians([GENTLE, STEEP]))
    profile = np.array([[-0.8, 0.0], [0.0, 0.0], [1.4, 1.4 * gentle], [2.6, 1.4 * gentle]])
    profile = np.concatenate([profile, [[3.6, 1.4 * gentle + 1.0 * steep]]])
    with opened(folder, ground(profile, 0.4, SPACING)) as scene:
        found = scene.walk((-0.5, 0.0, FEET), straight(SPEED, 0.0), 3.6)
        dots = section("side", scene.points)
    top = 1.4 * gentle
    return Case(
        "slope", "Slope", f"{GENTLE:.0f}°: walked; {STEEP:.0f}°: too steep",
        (Row("side", dots, [found], (-0.75, -0.25), (3.35, 2.75), 13),),
        {
            "it walks up the gentle one": bool(found.places[-1, 2] > top),
            "it does not climb the steep one": bool(found.places[:, 2].max() < top + 0.1),
            "it stands before the steep one": bool(found.places[-1, 0] < 2.6 and found.touched[-1] == SCAN),
        },
    )  # fmt: skip


def column(folder: Path) -> Case:
    """Walk at a column, to the left and to the right of its middle."""
    lines = [circle((0.0, 0.0), COLUMN, 96)]
    with opened(folder, walls(lines, (-1.2, -1.6, 1.2, 1.6), SPACING)) as scene:
        found = [
            scene.walk((x, -1.15, FEET), straight(0.0, SPEED), seconds)
            for x, seconds in ((-0.25, 1.9), (0.1, 2.3))
        ]
        dots = section("plan", scene.points)
    return Case(
        "column", "Column", "walked around by sliding",
        (Row("plan", dots, found, (-1.0, -1.45), (1.0, 1.45), 8),),
        {
            "each passes on its side": bool(
                found[0].places[-1, 1] > COLUMN and found[0].places[-1, 0] < -COLUMN
                and found[1].places[-1, 1] > COLUMN and found[1].places[-1, 0] > COLUMN
            ),
            "both slide": all((walk.touched == SCAN).any() for walk in found),
        },
    )  # fmt: skip


def _to_door(aside: float) -> Steering:
    """Return the steering of a user who walks to the door, and then to (aside, 1.75) behind it."""

    def velocity(place: Floats, _time: float) -> tuple[float, float]:
        goal = np.array([aside, 1.75] if place[1] > DEPTH / 2 else [0.0, DEPTH / 2 + 0.1])
        way = goal - place[:2]
        x, y = way / max(float(np.linalg.norm(way)), SPEED * FRAME) * SPEED
        return float(x), float(y)

    return velocity


def crowd(folder: Path) -> Case:
    """Walk through one door with many users at the same time."""
    angles = np.linspace(-1.2, 1.2, USERS)
    # They arrive one after another. Users who all arrive at once jam in an arch before the door.
    far = 0.8 + 0.3 * (3 * np.arange(USERS) % USERS)
    starts = np.stack([far * np.sin(angles), -far * np.cos(angles), np.full(USERS, FEET)], axis=1)
    steering = [_to_door(x) for x in np.linspace(-2.1, 2.1, USERS).tolist()]
    options = {"crowd": {"margin": MARGIN}}
    points = walls(door_wall(2.8), (-2.8, -2.9, 2.8, 2.2), SPACING)
    with opened(folder, points, options, extra=["crowd"]) as scene:
        found = scene.walks(starts.tolist(), steering, 5.2)
        dots = section("plan", scene.points)
    apart = nearest_users(found)
    return Case(
        "crowd", "Crowd", f"{USERS} users, {MARGIN * 100:.0f} cm apart: start, {SEEN * FRAME:.1f} s (dark), end",
        (Row("plan", dots, found, (-2.3, -2.65), (2.3, 2.05), moments=(0, len(found[0].touched), SEEN)),),
        {
            "all pass": all(walk.places[-1, 1] > DEPTH for walk in found),
            "users touch users": any((walk.touched == OTHER).any() for walk in found),
            "they keep their distance": apart > MARGIN - 0.002,
            "none falls": not any((walk.touched == FALL).any() for walk in found),
        },
    )  # fmt: skip


def nearest_users(found: list[Walk]) -> float:
    """Return the least distance of two users' outlines at a frame's end [m]."""
    places = np.array([walk.places[:, :2] for walk in found])
    far = np.linalg.norm(places[:, None] - places[None], axis=3)
    far[np.arange(len(found)), np.arange(len(found))] = np.inf
    return float(far.min()) - 2 * RADIUS


SCENARIOS: tuple[Callable[[Path], Case], ...] = (door, jamb, column, stairs, slope, crowd)
