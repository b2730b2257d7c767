"""Scratch of the motions of one avatar, kept from one to the next: allocating it takes 2 us a motion."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.kernels import compiling as nb
from ..core.array_references import reference
from .moving_avatar import MovingAvatar, make_moving
from .sweep_segments import PlanSpace, SweepProgress, make_plan_space


class OneMotion(NamedTuple):
    """Arrays of one motion, as those of k in sweep_segments.py and sweep_advance.py; scratch.

    first, last: (1, 4, 4).  counts: (4, 1).  which: (1,), zero.
    origin: (3,), zero.  pose: (4, 4).  The others are (1,).
    """

    first: NDArray[np.float64]
    last: NDArray[np.float64]
    units: NDArray[np.int64]
    progress: SweepProgress
    counts: NDArray[np.uint32]
    which: NDArray[np.int64]
    cursor: NDArray[np.int64]
    moved: NDArray[np.float64]
    origin: NDArray[np.float64]
    pose: NDArray[np.float64]


@reference
class MotionScratch(NamedTuple):
    """Reference to the scratch of an avatar's motions, see array_references.py."""

    moving: MovingAvatar
    space: PlanSpace
    one: OneMotion


@nb.njit(nogil=True, cache=True)
def make_scratch(avatar):
    """Allocate the scratch for an avatar, not empty. It serves one motion at a time."""
    progress = SweepProgress(
        np.zeros(1),
        np.ones(1),
        np.ones(1),
        np.zeros(1),
        np.zeros(1),
        np.zeros((1, 2, 3)),
        np.zeros(1),
        np.zeros(1),
    )
    one = OneMotion(
        np.empty((1, 4, 4)), np.empty((1, 4, 4)), np.empty(1, np.int64), progress, np.zeros((4, 1), np.uint32),
        np.zeros(1, np.int64), np.zeros(1, np.int64), np.empty(1), np.zeros(3), np.empty((4, 4)),
    )  # fmt: skip
    return MotionScratch(make_moving(avatar), make_plan_space(), one)
