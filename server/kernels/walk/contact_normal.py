"""Normal of a contact between an avatar and the scan, also at free edges, corners and creases.

The smoothed normal of the scan points around a touched one is the surface's if the avatar touches
the surface from one side. At a free edge, such as the jamb of a door in a wall scanned as one sheet
of points, it is still the sheet's, and an avatar would press against the edge for ever.

The normal of a contact separates the two bodies: near the touched point, the avatar lies on one
side of the plane, and the scan on the other. The smoothed normal of the scan is therefore taken if
its plane separates the avatar's patch, which is the points of its surface within reach of the
touched one. Otherwise the contact is at an edge, and three directions are compared: the smoothed
normal of the scan, that of the avatar, and the direction from the touched sphere to the touching
one. The one whose plane the points of both patches exceed least is taken. Where a smooth body
touches an edge, this is the body's normal, as for the contact of a vertex with a face in Baraff
1989 (Analytical Methods for Dynamic Simulation of Non-penetrating Rigid Bodies).

The border of a scan is not recognized from the scan alone, as by Bendels et al. 2006 (Detecting
Holes in Point Set Surfaces): a body that stands flat against a sheet beside its edge keeps the
sheet's normal, and uneven spacing is not taken for a border.
"""

import numpy as np

from ....schemas.kernels import compiling as nb
from ..bodies.avatar_patch import lowest_heights
from ..core.normal_codes import NO_NORMAL, SUMS, decode_normal, normal_code
from ..motion.sweep_resident import POINT
from .walk_normals import hit_normal, scan_heights
from .walk_queries import pair_of
from .walk_state import ARCHIVE, HAS_NORMAL, HAS_PAIR, HAS_POINT, NORMAL, pose_now
from .walk_vectors import divided, dot, minus, norm, rotate, rotate_back, times, vector

# The avatar's patch may exceed the plane of the scan's normal by this share of the reach: by 1 cm
# with 8 cm. Bumps and noise of a wall let a body exceed it by less. Beside an edge, a body with a
# radius of 25 cm exceeds it by more if it is turned by more than 17 degrees.
MAX_EXCESS_SHARE = 0.125


@nb.njit(nogil=True, cache=True)
def contact_normal(walk, hit):
    """Return whether the normal of a contact is known, and it: a unit vector towards the avatar."""
    result = walk.memory.tape[hit]
    if result[HAS_NORMAL] != 0.0:
        return True, vector(result[NORMAL : NORMAL + 3])  # of a body, or of a motion that began in contact
    known, smoothed = hit_normal(walk, hit, 0)
    if result[ARCHIVE] < 0.0 or result[HAS_PAIR] == 0.0 or result[HAS_POINT] == 0.0:
        return known, smoothed
    own, cloud = pair_of(walk, hit)
    out = minus(own, cloud)
    apart = norm(out)
    if apart == 0.0:
        return known, smoothed
    normals, lowest, sums = np.zeros((3, 3)), np.zeros(3), np.zeros(SUMS, np.int64)
    count = 0
    if known:
        _put(normals, 0, smoothed)
        _lowest(walk, hit, out, apart, normals[:1], lowest[:1], sums)
        if lowest[0] >= -MAX_EXCESS_SHARE * walk.settings.normal_reach:
            return True, smoothed
        count = 1
    pair = divided(out, apart)
    _put(normals, count, pair)
    count += 1
    _lowest(walk, hit, out, apart, normals[:count], lowest[:count], sums)
    code = normal_code(sums)
    if code != NO_NORMAL:
        own_normal = rotate(pose_now(walk), decode_normal(code))
        _put(normals, count, times(-1.0 if dot(own_normal, pair) < 0.0 else 1.0, own_normal))
        _lowest(walk, hit, out, apart, normals[count : count + 1], lowest[count : count + 1], sums)
        count += 1
    highest = scan_heights(walk, hit, normals[:count], 0)
    best, least = 0, np.inf
    for n in range(count):
        excess = max(-lowest[n], highest[n])
        if excess < least:
            best, least = n, excess
    return True, vector(normals[best])


@nb.njit(nogil=True, cache=True)
def _put(normals, n, normal):
    """Write a vector to row n."""
    for r in range(3):
        normals[n, r] = normal[r]


@nb.njit(nogil=True, cache=True)
def _lowest(walk, hit, out, apart, normals, lowest, sums):
    """Find the least height of the avatar's patch over the plane of each normal (k, 3).

    A plane touches the scan's sphere.  out: from the touched sphere to the touching one, `apart`
    long [m].  lowest: (k,), set [m].  sums: (SUMS,) int64, set as `normal_code` takes them.
    """
    pose, directions = pose_now(walk), np.empty((normals.shape[0], 3))
    for n in range(normals.shape[0]):
        _put(directions, n, rotate_back(pose, vector(normals[n])))
    point = walk.memory.tape[hit, POINT : POINT + 3]
    lowest_heights(walk.avatar, point, walk.settings.normal_reach, directions, lowest, sums)
    for n in range(normals.shape[0]):
        lowest[n] = lowest[n] + dot(out, vector(normals[n])) - apart
