"""Motion of a walking avatar and the search for ground below its end, in one call."""

from ....schemas.kernels import compiling as nb
from ....schemas.wire.answers import Verdict
from .sweep_resident import sweep_resident

_CLEAR, _UNKNOWN = int(Verdict.CLEAR), int(Verdict.UNKNOWN)


@nb.njit(nogil=True, cache=True)
def walk_resident(
    pose_from, pose_to, moves, down, below, body, scratch, radius, other_units, box, held, stop, unknown,
    unknown_everywhere, tolerance, skin, rows, result, rows_below, result_below,
):  # fmt: skip
    """Sweep a motion and, if it is clear, the translation `down` from its end; see `sweep_resident`.

    moves: whether there is a motion; otherwise only the translation is swept.  down: (3,) float64,
    world [m].  below: (4, 4), scratch.  rows_below, result_below: as rows and result, of the
    translation; its end is not computed.
    Returns (rows, verdict, node visits) of the motion and the same of the translation. A number of
    rows of -1 means that the part was not answered, or not asked for because of the part before.
    """
    needed, verdict, visits = 0, _CLEAR, 0
    if moves:
        needed, verdict, visits, _, _ = sweep_resident(
            pose_from, pose_to, body, scratch, radius, other_units, box, held, stop, unknown, unknown_everywhere,
            tolerance, skin, rows, result,
        )  # fmt: skip
    if needed < 0 or verdict != _CLEAR:
        return needed, verdict, visits, -1, _UNKNOWN, 0
    for r in range(4):
        for c in range(4):
            below[r, c] = pose_to[r, c]
    for r in range(3):
        below[r, 3] += down[r]
    needed_below, verdict_below, visits_below, _, _ = sweep_resident(
        pose_to, below, body, scratch, radius, other_units, box, held, stop, unknown, unknown_everywhere, tolerance,
        -1.0, rows_below, result_below,
    )  # fmt: skip
    return needed, verdict, visits, needed_below, verdict_below, visits_below
