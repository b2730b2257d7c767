"""End of a motion that touches: the touching point, and the pose `skin` before the contact.

The operations and their order are those of server/simulation/world/frame.py, which computes the same
for obstacles that are not of the scan. In one call with the sweep they take a tenth of the time.
"""

import math

from ..core.kernel_decorators import njit_no_refcount

# Least length of a motion [m]. With shorter ones a pushing avatar would tremble by the error of
# `lower`.
MIN_MOTION = 2e-5
# If a motion is undecided for more than this distance before its contact, it ends where the
# undecided part begins [m].
MAX_UNDECIDED = 1e-4
# Limit on the distance by which a motion stops before a contact, as a multiple of `skin`. In a
# grazing motion, the distance that keeps `skin` from the wall would be long.
MAX_SKIN_FACTOR = 4.0


@njit_no_refcount
def _norm(x, y, z):
    return math.sqrt(x * x + y * y + z * z)


@njit_no_refcount
def longest_way(pose_from, pose_to, avatar):
    """Return an approximate bound of the distance that any avatar point moves [m].

    pose_from, pose_to: (4, 4).
    """
    wx, wy, wz = (
        pose_to[0, 3] - pose_from[0, 3],
        pose_to[1, 3] - pose_from[1, 3],
        pose_to[2, 3] - pose_from[2, 3],
    )
    square, same = 0.0, True
    for r in range(3):
        for c in range(3):
            turn = pose_to[r, c] - pose_from[r, c]
            same &= pose_to[r, c] == pose_from[r, c]
            square += turn * turn
    if same:
        return _norm(wx, wy, wz)
    x, y, z = avatar.center[0, 0], avatar.center[0, 1], avatar.center[0, 2]
    wx += _turned(pose_from, pose_to, 0, x, y, z)
    wy += _turned(pose_from, pose_to, 1, x, y, z)
    wz += _turned(pose_from, pose_to, 2, x, y, z)
    return _norm(wx, wy, wz) + math.sqrt(square) * avatar.radius[0]


@njit_no_refcount
def _turned(pose_from, pose_to, r, x, y, z):
    """Return coordinate r of the displacement of a place by the rotation from one pose to another."""
    a, b, c = (
        pose_to[r, 0] - pose_from[r, 0],
        pose_to[r, 1] - pose_from[r, 1],
        pose_to[r, 2] - pose_from[r, 2],
    )
    return a * x + b * y + c * z


@njit_no_refcount
def write_point(pose, place, point):
    """Write a place (3,), world, in the frame of a pose (4, 4) to point (3,)."""
    x, y, z = place[0] - pose[0, 3], place[1] - pose[1, 3], place[2] - pose[2, 3]
    for k in range(3):
        point[k] = pose[0, k] * x + pose[1, k] * y + pose[2, k] * z


@njit_no_refcount
def skin_fraction(pose_from, pose_to, own, cloud, point, way, skin):
    """Return the share of a motion by which to stop before a contact.

    The avatar is then `skin` [m] away from the tangent plane of the two spheres.
    own, cloud: (3,), their centres, world.  point: (3,), that of the avatar's in its own frame.
    way: `longest_way`.
    """
    if way <= 0.0 or skin <= 0.0:
        return 0.0
    ox, oy, oz = own[0] - cloud[0], own[1] - cloud[1], own[2] - cloud[2]
    gx = (pose_to[0, 3] - pose_from[0, 3]) + _turned(pose_from, pose_to, 0, point[0], point[1], point[2])
    gy = (pose_to[1, 3] - pose_from[1, 3]) + _turned(pose_from, pose_to, 1, point[0], point[1], point[2])
    gz = (pose_to[2, 3] - pose_from[2, 3]) + _turned(pose_from, pose_to, 2, point[0], point[1], point[2])
    length, speed = _norm(ox, oy, oz), _norm(gx, gy, gz)
    if speed <= 1e-9 * way:
        return min(1.0, skin / way)
    into = speed if length == 0.0 else -(gx * ox + gy * oy + gz * oz) / length
    return skin / max(into, speed / MAX_SKIN_FACTOR)
