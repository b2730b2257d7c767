"""Normal of a contact between an avatar and the scan, also at free edges, corners and creases.

The smoothed normal of the scan points around a touched one is the surface's if the avatar touches
the surface from one side. At a free edge, such as the jamb of a door in a wall scanned as one sheet
of points, it is still the sheet's, and an avatar would press against the edge for ever.

The normal of a contact separates the two bodies: near the touched point, the avatar lies on one
side of the plane, and the scan on the other. The smoothed normal of the scan is therefore taken if
its plane separates the avatar's patch, which is its points within reach of the touched one.
Otherwise the contact is at an edge, and three directions are compared: the smoothed normal of the
scan, that of the avatar, and the direction from the touched sphere to the touching one. The one
whose plane the points of both patches exceed least is taken. Where a smooth body touches an edge,
this is the body's normal, as for the contact of a vertex with a face in Baraff 1989 (Analytical
Methods for Dynamic Simulation of Non-penetrating Rigid Bodies).

The border of a scan is not recognized from the scan alone, as by Bendels et al. 2006 (Detecting
Holes in Point Set Surfaces): a body that stands flat against a sheet beside its edge keeps the
sheet's normal, and uneven spacing or the boundary of a voxel is not taken for a border.
"""

import numpy as np
from numpy.typing import NDArray

from ....schemas.kernels.normal_codes import NO_NORMAL, decode_normal, normal_code
from ...avatars.avatar_model import make_avatar
from ...kernels.bodies.avatar_patch import SUMS, lowest_heights
from ...kernels.core.array_references import refer_to_avatar
from .frame import Frame, Hit, Vec
from .vectors import dot, norm, rotate, rotate_back

# The avatar's patch may exceed the plane of the scan's normal by this share of the reach: by 1 cm
# with 8 cm. Bumps and noise of a wall let a body exceed it by less. Beside an edge, a body with a
# radius of 25 cm exceeds it by more if it is turned by more than 17 degrees.
MAX_EXCESS_SHARE = 0.125


def contact_normal(frame: Frame, hit: Hit, reach: float) -> Vec | None:
    """Return the unit normal (3,) of a contact, towards the avatar; None if it is unknown.

    hit: ended a motion of the frame.  reach: points within this distance of the touched ones form
    the surfaces [m].
    """
    smoothed: Vec | None = frame.world.normal(hit, reach, frame.budget)
    if hit.archive < 0 or hit.avatar is None or hit.cloud is None:
        return smoothed
    out = hit.avatar - hit.cloud
    apart = norm(out)
    if apart == 0.0 or hit.point is None:
        return smoothed
    if smoothed is not None and _lowest(frame, hit, reach, [smoothed])[0][0] >= -MAX_EXCESS_SHARE * reach:
        return smoothed
    return _best(frame, hit, reach, smoothed, out / apart)


def _best(frame: Frame, hit: Hit, reach: float, smoothed: Vec | None, pair: Vec) -> Vec:
    """Return the normal (3,) that separates the patches best.

    smoothed: (3,) of the scan, or None.  pair: (3,) unit, from the touched scan point to the
    touching avatar point.
    """
    normals = [pair] if smoothed is None else [smoothed, pair]
    lowest, sums = _lowest(frame, hit, reach, normals)
    code = normal_code(sums)
    if code != NO_NORMAL:
        own = rotate(frame.pose, np.array(decode_normal(code)))
        normals.append(-own if dot(own, pair) < 0.0 else own)
        lowest += _lowest(frame, hit, reach, normals[-1:])[0]
    highest = frame.world.highest(hit, np.array(normals), reach, frame.budget).tolist()
    excess = [max(-low, high) for low, high in zip(lowest, highest, strict=True)]
    return normals[excess.index(min(excess))]


def _lowest(
    frame: Frame, hit: Hit, reach: float, normals: list[Vec]
) -> tuple[list[float], NDArray[np.int64]]:
    """Return the least height of the avatar's patch over the plane of each normal [m], and its sums.

    A plane touches the scan's sphere. sums: (10,), as `normal_code` takes them.
    """
    assert hit.avatar is not None and hit.cloud is not None and hit.point is not None
    directions = np.array([rotate_back(frame.pose, each) for each in normals])
    heights, sums = np.empty(len(normals)), np.empty(SUMS, np.int64)
    body = frame.world.body(frame.body.avatar)
    point = np.ascontiguousarray(hit.point)
    body.call(lowest_heights, body.reference, point, reach, directions, heights, sums)
    out = hit.avatar - hit.cloud
    apart = norm(out)
    found = [low + dot(out, each) - apart for low, each in zip(heights.tolist(), normals, strict=True)]
    return found, sums


def warm_patch() -> None:
    """Compile the kernels before the first contact needs them."""
    body = refer_to_avatar(make_avatar([[0.0, 0.0, 0.0]], 0.1).arrays)
    sums = np.empty(SUMS, np.int64)
    lowest_heights(body, np.zeros(3), 0.1, np.zeros((1, 3)), np.empty(1), sums)
    normal_code(sums)
