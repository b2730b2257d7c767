"""Motions between the poses of a path: their verdicts, their clearance, and poses on them.

`sweep` decides the verdict of a motion, and bounds its clearance from below: a motion that is clear
with a margin is farther than the margin from the scan at all of its poses.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.wire.answers import SweepAnswers, Verdict

Floats = NDArray[np.float64]
# Answers `sweep` for motions from poses (n, 4, 4) to poses (n, 4, 4), with a margin [m].
AskSweep = Callable[[Floats, Floats, float], SweepAnswers]

# Difference between the clearance of a path and the true one at which the search ends [m].
PRECISION = 1e-3
# Poses on a motion are computed here in another order of operations than in the server: contacts
# of the pose at which a motion touches are asked with this margin [m]. At 1e9 m, the farthest
# coordinate, the difference is some micrometres.
TOUCH_MARGIN = 1e-5
# Largest distance that an avatar point moves between the bounds of a first contact [m]: the default
# of `sweep`.
SWEEP_TOLERANCE = 1e-6


class Motions(NamedTuple):
    """Answers for the motions between consecutive poses.

    verdict: (n,).  touch: (n,) fraction at which there is a contact, the first one of a motion
    whose ends are not in contact; inf if there is none.
    clearance: (n,) lower bound of the distance on the whole motion [m], at most the reach; -inf in
    contact, NaN if unknown.
    """

    verdict: NDArray[np.uint8]
    touch: Floats
    clearance: Floats


def unknown_motions(count: int) -> Motions:
    """Return motions that were not examined."""
    return Motions(np.full(count, Verdict.UNKNOWN, np.uint8), np.full(count, np.inf), np.full(count, np.nan))


def examine_motions(
    sweep: AskSweep, poses: Floats, distance: Floats, verdict: NDArray[np.uint8], reach: float
) -> Motions:
    """Examine the motions between poses (n + 1, 4, 4).

    distance, verdict: (n + 1,), answers of `distance` within `reach` [m].
    A motion is swept with a margin below the distance at both ends, and if it is not clear, with
    half of it, and so on to zero. The clearance is thus at least half of the true one, and zero
    below about `PRECISION`.
    """
    found = unknown_motions(len(poses) - 1)
    ends = np.stack([verdict[:-1], verdict[1:]])
    touches = (ends == Verdict.CONTACT).any(axis=0)
    found.verdict[touches], found.clearance[touches] = Verdict.CONTACT, -np.inf
    found.touch[touches] = np.where(ends[0, touches] == Verdict.CONTACT, 0.0, 1.0)
    near = np.minimum(reach, np.minimum(distance[:-1], distance[1:]))
    # Margins are reach * 2^(-rung / 2), so that motions at similar distances share a request. The
    # margin of the last rung is zero.
    last = max(0, math.floor(2 * math.log2(reach / PRECISION)) + 1)
    rung = np.full(len(near), last)
    some = (ends == Verdict.CLEAR).all(axis=0) & (near > PRECISION)
    rung[some] = np.minimum(last, np.ceil(2 * np.log2(reach / near[some])).astype(np.int64))
    undecided: NDArray[np.bool_] = ~touches
    close: NDArray[np.bool_] = np.zeros(len(near), bool)
    while undecided.any():
        lowest = int(rung[undecided].min())
        margin = 0.0 if lowest == last else reach * 0.5 ** (lowest / 2)
        which = np.flatnonzero(undecided & (rung == lowest))
        answers = sweep(poses[which], poses[which + 1], margin)
        clear, contact = (which[answers.verdict == each] for each in (Verdict.CLEAR, Verdict.CONTACT))
        found.verdict[clear], found.clearance[clear] = Verdict.CLEAR, margin
        if lowest < last:
            undecided[clear] = False
            close[contact] = True
            rung[which] = min(last, lowest + 2)
            continue
        undecided[which] = False
        found.verdict[contact], found.clearance[contact] = Verdict.CONTACT, -np.inf
        found.touch[which] = answers.upper
        # A graze that cannot be decided: the scan is there.
        graze = which[answers.verdict == Verdict.UNKNOWN]
        found.clearance[graze[close[graze]]] = 0.0
    return found


def least_clearance(
    sweep: Callable[[NDArray[np.int64], float], NDArray[np.uint8]], motions: Motions, high: float
) -> float:
    """Return the least clearance of the motions that are clear, a lower bound [m].

    sweep: returns the verdicts of the motions with these numbers, with a margin [m].
    high: least distance at the poses, at least 0, at most the reach [m].
    The bound is less than the true value by at most `PRECISION`, unless something is unknown.
    """
    if (motions.clearance[motions.verdict == Verdict.UNKNOWN] == 0.0).any():
        return 0.0
    known = motions.clearance[motions.verdict == Verdict.CLEAR]
    low = float(known.min(initial=high))
    near = np.flatnonzero((motions.verdict == Verdict.CLEAR) & (motions.clearance < high))
    while high - low > PRECISION and len(near):
        middle = (low + high) / 2
        closer = near[sweep(near, middle) != Verdict.CLEAR]
        if len(closer):
            near, high = closer, middle
        else:
            low = middle
    return low


def poses_between(first: Floats, last: Floats, fractions: Floats) -> Floats:
    """Return poses (m, s, 4, 4) on the motions that `sweep` examines, up to rounding.

    first, last: (m, 4, 4).  fractions: (m, s), 0 to 1.  A motion is a screw motion: the shorter
    rotation from one pose to the other, at a constant rate, about an axis along which the body
    slides: server/kernels/motion/screw_motion.py has the definition.
    """
    axis, angle = _axis_angle(_turn(first[:, :3, :3], last[:, :3, :3]))
    moved = last[:, :3, 3] - first[:, :3, 3]
    along = (moved * axis).sum(axis=1, keepdims=True) * axis
    across = moved - along
    half = angle[:, None] / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(half < 1e-9, fractions, np.sin(fractions * half) / np.sin(half))
    back = _rotations(axis, -(1 - fractions) * half)
    poses = np.zeros((*fractions.shape, 4, 4))
    poses[..., 3, 3] = 1.0
    poses[..., :3, :3] = _rotations(axis, fractions * angle[:, None]) @ first[:, None, :3, :3]
    way = fractions[..., None] * along[:, None] + ratio[..., None] * (back @ across[:, None, :, None])[..., 0]
    poses[..., :3, 3] = first[:, None, :3, 3] + way
    return poses


def _turn(first: Floats, last: Floats) -> Floats:
    """Return the rotations (m, 3, 3) between rotations (m, 3, 3) of any scale.

    Sums are in the server's order: near half a turn, rounding decides about which side it goes.
    """
    one, two = (np.cumsum((each**2).reshape(-1, 9), axis=1)[:, -1] / 3.0 for each in (first, last))
    turn: Floats = last[:, :, None, 0] * first[:, None, :, 0]
    for k in (1, 2):
        turn = turn + last[:, :, None, k] * first[:, None, :, k]
    return turn / np.sqrt(one * two)[:, None, None]


def _axis_angle(turn: Floats) -> tuple[Floats, Floats]:
    """Return unit axes (m, 3) and angles (m,), 0 to pi, of rotations (m, 3, 3).

    The column of the quaternion's outer product with the largest component is used, so that nothing
    cancels near half a turn.
    """
    t, outer = turn, np.empty((len(turn), 4, 4))
    trace = t[:, 0, 0] + t[:, 1, 1] + t[:, 2, 2]
    outer[:, 0, 0] = 1 + trace
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        outer[:, 0, i + 1] = outer[:, i + 1, 0] = t[:, k, j] - t[:, j, k]
        outer[:, i + 1, i + 1] = 1 - trace + 2 * t[:, i, i]
        outer[:, j + 1, k + 1] = outer[:, k + 1, j + 1] = t[:, j, k] + t[:, k, j]
    diagonal = t[:, range(3), range(3)]
    column = np.where(trace >= diagonal.max(axis=1), 0, 1 + diagonal.argmax(axis=1))
    quaternion = outer[np.arange(len(turn)), column]
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    # The shorter way; half a turn is about the axis whose first non-zero component is positive.
    lead = np.take_along_axis(quaternion, (quaternion != 0).argmax(axis=1)[:, None], axis=1)
    quaternion *= np.where(lead < 0, -1.0, 1.0)
    sine = np.linalg.norm(quaternion[:, 1:], axis=1)
    axis = np.divide(
        quaternion[:, 1:],
        sine[:, None],
        out=np.tile([1.0, 0.0, 0.0], (len(turn), 1)),
        where=sine[:, None] > 0,
    )
    return axis, 2 * np.arctan2(sine, quaternion[:, 0])


def _rotations(axis: Floats, angles: Floats) -> Floats:
    """Return rotations (m, s, 3, 3) about axes (m, 3) by angles (m, s)."""
    cross = np.zeros((len(axis), 3, 3))
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        cross[:, k, j], cross[:, j, k] = axis[:, i], -axis[:, i]
    sine, versine = np.sin(angles)[..., None, None], 2 * np.sin(angles / 2)[..., None, None] ** 2
    rotations: Floats = np.eye(3) + sine * cross[:, None] + versine * (cross @ cross)[:, None]
    return rotations
