"""Early contact: a pair of points within reach plus tolerance, found before the descent needs it.

A request with a tolerance runs the descent of collide_poses.py unchanged, in the same order and
with the same bounds, and may end it earlier: as soon as some pair of points is known to be within
reach plus tolerance. Such a pair is looked for at two places. At two leaf nodes, the points are
compared with the larger distance. At a flat node, such as a piece of floor below a foot, the exact
descent only has to prove that nothing is in reach, and ends. There, one leaf node is looked up, and
its points are compared with those of the avatar that are near the plane.

Pruning uses the reach alone, so a pose never takes more node visits than without a tolerance, and
never more with a larger one. A pair near the tolerance may be overlooked, which costs no
correctness: the verdict is then that of tolerance 0.

The descent to that leaf node counts as point tests, not as node visits: it tests no bounds. Stored
discs of known point spacing, half as wide as a node, were tried instead. On the walk at 3 cm they
found 8 % of the poses within tolerance, because the exact descent ends at nodes of 0.3 to 0.5 m;
this finds 95 % and needs nothing stored.
"""

import numpy as np

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.kernels import compiling as nb
from ..core.kernel_decorators import njit_no_refcount
from ..core.node_overlap import U32, lanes_meet, next_near
from ..core.scene_arrays import COUNT, COUNTED, FIRST, LANES, ROW_WORDS

U = np.uint64  # see placed_avatar.py
# Verdicts of the kernels. EARLY: some pair is within reach plus tolerance, perhaps beyond reach.
CLEAR, CONTACT, UNKNOWN = 0, 1, 2  # schemas/wire/answers.py Verdict
EARLY = 3


@njit_no_refcount
def set_early(early, tolerance, units, units_per_step, error):
    """Write early (2,) float32 for one pose: a distance [steps], and the square of a sure pair.

    tolerance: exact units, above 0.  units: reach of the smallest sphere of a scan point, exact
    units.  error: of `make_thresholds` for the reach. A pair of centres whose float32 square is at
    most `early[1]` is within reach plus tolerance; -1 if none is sure.
    """
    extra = np.float64(tolerance) / units_per_step
    distance = np.float64(units) / units_per_step + extra
    # The error grows by 2 sqrt(3) U32 of what the reach grows by; 8 U32 cover that and all roundings
    # here.
    sure = distance * (1.0 - 8.0 * U32) - np.float64(error)
    early[0], early[1] = np.float32(distance), np.float32(-1.0)
    if sure > 0.0:
        early[1] = np.float32(sure * sure * (1.0 - 16.0 * U32))


@njit_no_refcount
def _leaf_towards(words, ints, rows, row, x, y, z):
    """Return the leaf node below `row` that is reached by the nearest centre at each level.

    rows: the voxel's first row.  x, y, z: float32, relative to the voxel's low corner.
    """
    first = np.int64(ints[U(row + FIRST)])
    while first >= 0:
        child = U(rows + first * ROW_WORDS)
        nearest, least = child, np.float32(np.inf)
        for _ in range(ints[U(row + COUNT)] & COUNTED):
            dx, dy, dz = x - words[child], y - words[child + U(1)], z - words[child + U(2)]
            square = dx * dx + dy * dy + dz * dz
            if square < least:
                nearest, least = child, square
            child += U(ROW_WORDS)
        row = np.int64(nearest)
        first = np.int64(ints[U(row + FIRST)])
    return row


@njit_no_refcount
def surely_near(words, ints, halves, block_words, location, row, x, y, z, lanes, block, early, keep, keep8):
    """Return whether a point of an avatar's block is within reach plus tolerance of a point found.

    location: VoxelLocation.  row: an inner node.  x, y, z: float32, the centre of the avatar's
    node, from the frame.  lanes: of PlacedAvatar.  early: see `set_early`.  keep, keep8: scratch.
    Returns (whether, point tests).
    """
    off_x, off_y, off_z = location.x, location.y, location.z
    leaf = _leaf_towards(words, ints, location.rows, row, x - off_x, y - off_y, z - off_z)
    if not lanes_meet(words, leaf, lanes, block, off_x, off_y, off_z, early[0], keep):
        return False, 0
    number = ~np.int64(ints[U(leaf + FIRST)])
    block_at = location.blocks + number * block_words
    lane_at = location.lanes + number * 3 * LANES
    low_x = off_x + np.float32(ints[U(block_at)])
    low_y = off_y + np.float32(ints[U(block_at + 1)])
    low_z = off_z + np.float32(ints[U(block_at + 2)])
    lane, tested = next_near(halves, lane_at, low_x, low_y, low_z, lanes, block, early[1], keep, keep8, 0)
    return lane >= 0, LANES * tested


@nb.njit(nogil=True, cache=True)
def write_verdict_bounds(verdict, radii, low, high, early, lower, upper, exact):
    """Write what verdicts within a tolerance say about the signed distance, and turn EARLY to CONTACT.

    verdict: (k,) uint8.  radii: (k,) int64, the depth limit of a pair, exact units.  low, high,
    early: [m], above which distance a pose is CLEAR, and up to which CONTACT and EARLY.
    Writes lower, upper (k,) float64 [m], and exact (k,) bool.

    No store is conditional: with `if said == EARLY: verdict[i] = CONTACT` LLVM 22.1 vectorised the
    loop such that it wrote beyond the end of `exact` (test_verdict_bounds.py).
    """
    for i in range(verdict.shape[0]):
        said = verdict[i]
        lower[i] = low if said == CLEAR else -radii[i] / UNITS_PER_METRE
        upper[i] = high if said == CONTACT else early if said == EARLY else np.inf
        exact[i] = (said == CLEAR) | (said == CONTACT)
        verdict[i] = CONTACT if said == EARLY else said
