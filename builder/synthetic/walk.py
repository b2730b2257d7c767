"""Path of the paper's walkthrough on a generated façade: 40 seconds, 30 poses a second.

[Fig12], section 3 and figure 2: the avatar walks alongside walls, around a column and through the
open door. This path runs along the cloister's wall, around the free column of the forecourt, up the
steps, through the centre of the door, along the nave's wall and back, out of the door touching a
jamb, and down the steps. It overlaps walls, column and jamb on purpose, by about a centimetre; the
feet are 3 cm above the floor.
"""

import numpy as np
from numpy.typing import NDArray

from .truth import DoorTruth, FacadeTruth

SOLE_HEIGHT = 0.03
# Half the figure's width (figure.py, 1.75 m): the distance of a path alongside a wall.
HALF_WIDTH = 0.256
# Distance of the figure's side from a surface [m]: BRUSH overlaps it, PASS clears noise and radii.
BRUSH, PASS = -0.01, 0.06
# Length of the moving average that rounds the path's corners [m].
ROUNDING_LENGTH = 0.40
SAMPLE_SPACING = 0.005
# The figure's hands and feet reach 0.39 m before and behind it. STRIDE, the range of the highest
# floor, is larger: the ramp, rounded over RAMP, is complete before the foot is over the step.
STRIDE, RAMP = 0.60, 0.40


def walk_poses(
    truth: FacadeTruth, frames: int = 1200, rate: float = 30.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times (k,) [s] and poses (k, 4, 4), avatar to world, at a constant speed along the path.

    Rotation is about z only, with +y of the avatar along the direction of travel. The path is about
    55 m long: at 1,200 frames and 30 a second, 1.4 m/s.
    """
    path = _rounded(_corners(truth))
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    at = np.linspace(0.0, length[-1], frames)
    xy = np.column_stack([np.interp(at, length, path[:, k]) for k in range(2)])
    ahead = np.gradient(path, axis=0)
    turned = _average(
        np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0])), int(ROUNDING_LENGTH / SAMPLE_SPACING) | 1
    )
    heading = np.interp(at, length, turned)
    height = np.interp(at, length, _heights(truth, path, length))
    # The avatar faces +y: it is rotated by heading - 90 degrees, whose cosine is the sine of the
    # heading.
    c, s = np.sin(heading), -np.cos(heading)
    poses = np.zeros((frames, 4, 4))
    poses[:, 0, 0], poses[:, 0, 1] = c, -s
    poses[:, 1, 0], poses[:, 1, 1] = s, c
    poses[:, 2, 2] = poses[:, 3, 3] = 1.0
    poses[:, :2, 3] = xy + np.asarray(truth.origin[:2])
    poses[:, 2, 3] = height + truth.origin[2]
    return np.arange(frames) / rate, poses


def floor_height(truth: FacadeTruth, xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the height of the floor [m] below positions (k, 2) in the façade's frame.

    The floor is the forecourt, a step or the nave.
    """
    x, y = xy[:, 0], xy[:, 1]
    floor = np.where(y >= 0.0, truth.floor, 0.0)
    for step in truth.steps:
        on = (x >= step.x_left) & (x <= step.x_right) & (y >= step.y_front) & (y <= step.y_back)
        floor = np.where(on, np.maximum(floor, step.z), floor)
    return floor


def _corners(truth: FacadeTruth) -> NDArray[np.float64]:
    """Return the path's corners (n, 2), in the façade's frame."""
    wall = truth.wall("cloister").offset + HALF_WIDTH
    nave = truth.wall("nave right").offset - HALF_WIDTH
    column = truth.column("forecourt left")
    door: DoorTruth = truth.door("main")
    # On the way out the figure faces -y and keeps to the jamb at x_right.
    jamb = door.x_right - HALF_WIDTH
    around = column.radius + HALF_WIDTH
    turn = np.linspace(np.pi, 2 * np.pi, 60)
    # Rounding shrinks a circle by about ROUNDING²/24/radius: 1 cm.
    ring = around + ROUNDING_LENGTH**2 / 24 / around
    gap = np.where(np.abs(turn - 1.5 * np.pi) < 0.8, BRUSH, PASS)
    circle = np.column_stack([column.x + (ring + gap) * np.cos(turn), column.y + (ring + gap) * np.sin(turn)])
    return np.concatenate(
        [
            [(-6.6, -14.2), (wall + PASS, -12.2), (wall + PASS, -9.6), (wall + BRUSH, -9.2)],
            [(wall + BRUSH, -7.8), (wall + PASS, -7.4), (wall + PASS, -6.2), (column.x - around - 0.5, -5.2)],
            circle,
            [(column.x + around + 0.3, -4.6), (0.0, -4.2), (0.0, 1.6), (0.8, 2.2)],
            [(5.6, 2.2), (nave - PASS, 3.8), (nave - PASS, 5.6), (nave - BRUSH, 5.9), (nave - BRUSH, 7.1)],
            [
                (nave - PASS, 7.4),
                (nave - PASS, 8.4),
                (6.0, 9.4),
                (4.9, 9.0),
                (4.3, 7.6),
                (1.0, 7.2),
                (0.4, 4.6),
            ],
            [(jamb - PASS, 2.6), (jamb - PASS, 1.2), (jamb - BRUSH, 0.9), (jamb - BRUSH, 0.3)],
            [(jamb - PASS, 0.0), (0.3, -1.0), (0.3, -4.0), (1.6, -6.2)],
        ]
    )


def _rounded(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rounded path with a point every SAMPLE_SPACING; straight stretches stay unchanged."""
    lengths = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    at = np.linspace(0.0, lengths[-1], int(lengths[-1] / SAMPLE_SPACING))
    path = np.column_stack([np.interp(at, lengths, corners[:, k]) for k in range(2)])
    width = int(ROUNDING_LENGTH / SAMPLE_SPACING) | 1
    return np.column_stack([_average(path[:, k], width) for k in range(2)])


def _heights(
    truth: FacadeTruth, path: NDArray[np.float64], length: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the heights of the soles along the path [m].

    A height is the highest floor within a stride, ramped, plus SOLE_HEIGHT.
    """
    even = np.arange(0.0, length[-1], SAMPLE_SPACING)
    xy = np.column_stack([np.interp(even, length, path[:, k]) for k in range(2)])
    reach = int(STRIDE / SAMPLE_SPACING)
    padded = np.pad(floor_height(truth, xy), reach, mode="edge")
    highest = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).max(axis=1)
    return np.interp(length, even, _average(highest, int(RAMP / SAMPLE_SPACING) | 1)) + SOLE_HEIGHT


def _average(values: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Return the moving average over an odd width, with the end values repeated."""
    padded = np.pad(values, width // 2, mode="edge")
    return np.convolve(padded, np.full(width, 1 / width), mode="valid")
