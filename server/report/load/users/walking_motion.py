"""Motion of people along a path, as poses: corners rounded, slower in tight turns, body turned ahead.

Poses come at an even rate and show the features of tracking: the sway of steps and a millimetre of
jitter. A prediction of users' positions must cope with both.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .....builder.synthetic.walk import RAMP, SOLE_HEIGHT, STRIDE

Floats = NDArray[np.float64]

RATE = 30.0  # poses per second
SPACING = 0.02  # between the samples of a path [m]
# A corner is rounded over this time at full speed, limited to a length [m]: before a door the path
# is straight for 9 m.
ROUNDING_SECONDS, MIN_ROUNDING, MAX_ROUNDING = 1.0, 1.2, 5.0
# Lateral acceleration [m/s²]: at 1.5 m/s a turn of 0.6 m radius is walked at full speed, at 5 m/s
# one of 6 m.
SIDEWAYS = 4.0
FASTER = 3.0  # acceleration and deceleration [m/s²]
# Steps sway the body: amplitude [m], and the length of two steps [m] at a stroll.
SWAY, STEPS = 0.02, 1.4
JITTER = 0.001  # standard deviation of each pose's position [m]
# Turning on the spot: maximum speed [rad/s], and how long a user looks in one direction [s].
TURN_SPEED, LOOK = np.radians(200.0), (0.4, 2.0)


class Way(NamedTuple):
    """Path as it is walked, sampled every SPACING metres before rounding.

    xy: (k, 2) [m].
    heading: (k,) [rad], continuous.
    length: (k,) along it [m].
    time: (k,) since its start [s].
    """

    xy: Floats
    heading: Floats
    length: Floats
    time: Floats


def make_way(corners: Floats, speed: float, closed: bool = False) -> Way:
    """Return the path through corners (n, 2) at `speed` [m/s] wherever its turns allow.

    closed: the last corner equals the first, and is rounded too.
    """
    width = int(np.clip(ROUNDING_SECONDS * speed, MIN_ROUNDING, MAX_ROUNDING) / 2 / SPACING) | 1
    steps = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.linspace(0.0, along[-1], max(2, int(along[-1] / SPACING)) + 1)
    xy = np.column_stack([np.interp(at, along, corners[:, k]) for k in range(2)])
    # Average twice: turning then begins and ends smoothly.
    for _ in range(2):
        xy = np.column_stack([_average(xy[:, k], width, closed) for k in range(2)])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    ahead = np.gradient(xy, axis=0)
    heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return Way(xy, heading, length, _times(length, heading, speed))


def _times(length: Floats, heading: Floats, speed: float) -> Floats:
    """Return the time of each sample (k,) [s], limited by `speed`, by turns and by acceleration."""
    bend = np.abs(np.gradient(heading, np.maximum.accumulate(length + 1e-9 * np.arange(len(length)))))
    square = np.minimum(speed**2, SIDEWAYS / np.maximum(bend, 1e-9))
    gain = 2 * FASTER * length
    square = np.minimum.accumulate(square - gain) + gain
    square = (np.minimum.accumulate((square + gain)[::-1])[::-1]) - gain
    pace = np.sqrt(square)
    return np.concatenate([[0.0], np.cumsum(2 * np.diff(length) / (pace[1:] + pace[:-1]))])


def walk(way: Way, time: Floats, floor: Callable[[Floats], Floats], rng: np.random.Generator) -> Floats:
    """Return poses (k, 4, 4) at path times `time` (k,) [s].

    The feet are on the highest floor within a stride, ramped.
    """
    xy = np.column_stack([np.interp(time, way.time, way.xy[:, k]) for k in range(2)])
    heading, length = np.interp(time, way.time, way.heading), np.interp(time, way.time, way.length)
    swayed = SWAY * np.sin(2 * np.pi * length / STEPS + rng.uniform(0, 2 * np.pi))
    xy += np.column_stack([-np.sin(heading), np.cos(heading)]) * swayed[:, None]
    return upright(
        xy + rng.normal(0.0, JITTER, xy.shape), np.interp(time, way.time, _heights(way, floor)), heading
    )


def _heights(way: Way, floor: Callable[[Floats], Floats]) -> Floats:
    """Return the height of the soles at each sample of a path (k,) [m]."""
    reach = int(STRIDE / SPACING)
    padded = np.pad(floor(way.xy), reach, mode="edge")
    highest = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).max(axis=1)
    return _average(highest, int(RAMP / SPACING) | 1, False) + SOLE_HEIGHT


def turning(time: Floats, rng: np.random.Generator) -> Floats:
    """Return the headings (k,) [rad] of a user who turns on the spot, at times (k,) from 0 on [s]."""
    at, heading = float(time[0]), float(rng.uniform(-np.pi, np.pi))
    looked = np.full(len(time), heading)
    while at < time[-1]:
        turn = float(rng.uniform(np.radians(30), np.radians(180)) * rng.choice((-1, 1)))
        # The minimum-jerk turn from rest to rest has a maximum speed of 15/8 of its mean.
        spent = 15 / 8 * abs(turn) / TURN_SPEED
        s = np.clip((time - at) / spent, 0.0, 1.0)
        looked += turn * s**3 * (10 - 15 * s + 6 * s**2)
        at += spent + float(rng.uniform(*LOOK))
    return looked


def stand(
    spot: Floats, heading: Floats, floor: Callable[[Floats], Floats], rng: np.random.Generator
) -> Floats:
    """Return poses (k, 4, 4) at places (k, 2), turned to headings (k,), with the jitter of tracking."""
    return upright(spot + rng.normal(0.0, JITTER, spot.shape), floor(spot) + SOLE_HEIGHT, heading)


def upright(xy: Floats, z: Floats, heading: Floats) -> Floats:
    """Return poses (k, 4, 4), avatar to world, of places (k, 2) and soles (k,) [m].

    heading: (k,) [rad], the direction of the avatar's +y.
    """
    c, s = np.sin(heading), -np.cos(heading)
    poses = np.zeros((len(xy), 4, 4))
    poses[:, 0, 0], poses[:, 0, 1] = c, -s
    poses[:, 1, 0], poses[:, 1, 1] = s, c
    poses[:, 2, 2] = poses[:, 3, 3] = 1.0
    poses[:, :2, 3], poses[:, 2, 3] = xy, z
    return poses


def _average(values: Floats, width: int, closed: bool) -> Floats:
    """Return the moving average over an odd width; beyond the ends it uses the loop, or the last value."""
    half = width // 2
    if closed:
        padded = np.concatenate([values[-half - 1 : -1], values, values[1 : half + 1]])
    else:
        padded = np.pad(values, half, mode="edge")
    return np.convolve(padded, np.full(width, 1 / width), mode="valid")
