"""Motion of an avatar: what it meets first, the distance it keeps, and a clear final pose.

`stop` and `sweep` build `frame.go` from these functions.
"""

from ....schemas.wire.answers import Verdict
from ..world.frame import Frame, Hit, Pose
from ..world.vectors import dot, size, spread, turned_back, turned_by

# A motion that would be shorter is not begun [m]: otherwise a pushing avatar would tremble by the
# error of `lower`.
LEAST_WAY = 2e-5
# Along a wall that is grazed, the way back that keeps `skin` is long: at most this many times
# `skin`.
MOST_BACK = 4.0
# If a motion is undecided for more than this distance before its contact, the undecided part ends
# it [m].
DOUBT = 1e-4
# First way back from a pose that proves not to be clear [m], and its growth factor.
_BACK, _GROWS = 1e-7, 4.0


def first_hit(frame: Frame, to: Pose, tolerance: float) -> Hit | None:
    """Return what would first end the motion from frame.pose to a pose, scene or obstacle."""
    avatar, found = frame.body.avatar, None
    swept = frame.world.sweep(avatar, frame.pose, to, tolerance, frame.budget)
    if swept.verdict != Verdict.CLEAR:
        sure = swept.verdict == Verdict.CONTACT
        if sure and not swept.exact:
            sure = farthest(frame, to) * (swept.upper - swept.lower) <= DOUBT
        found = Hit(swept.lower, Verdict.UNKNOWN, None, None)
        if sure:
            found = Hit(swept.lower, swept.verdict, swept.avatar, swept.cloud, "", swept.archive)
    for obstacle in frame.obstacles:
        hit = obstacle.sweep(avatar, frame.pose, to, tolerance)
        if hit is not None and (found is None or hit.fraction < found.fraction):
            found = hit
    return found


def touched_at(frame: Frame, pose: Pose) -> Hit | None:
    """Return what is touched at a pose, with fraction 0, or a hit with UNKNOWN, or None."""
    avatar = frame.body.avatar
    verdict = frame.world.collide(avatar, pose, frame.budget)
    if verdict == Verdict.CONTACT:
        return frame.world.deepest(avatar, pose, frame.budget) or Hit(0.0, verdict, None, None)
    if verdict == Verdict.UNKNOWN:
        return Hit(0.0, verdict, None, None)
    return next((hit for each in frame.obstacles if (hit := each.touches(avatar, pose))), None)


def is_clear(frame: Frame, pose: Pose, *, proved: bool = False) -> bool:
    """Return whether it is known that nothing is touched at a pose.

    proved: known for the scene; only the other obstacles are then tested.
    """
    avatar = frame.body.avatar
    if not proved and frame.world.collide(avatar, pose, frame.budget) != Verdict.CLEAR:
        return False
    return not any(each.touches(avatar, pose) for each in frame.obstacles)


def farthest(frame: Frame, to: Pose) -> float:
    """Return how far any avatar point moves from frame.pose to a pose, at most or nearly so [m]."""
    avatar, begin = frame.body.avatar, frame.pose
    if not len(avatar.points):
        return 0.0
    way = to[:3, 3] - begin[:3, 3]
    if to[:3, :3].tobytes() == begin[:3, :3].tobytes():
        return size(way)
    turn = to[:3, :3] - begin[:3, :3]
    center = way + turned_by(turn, avatar.arrays.center[0])
    return size(center) + spread(turn) * float(avatar.arrays.radius[0])


def way_back(frame: Frame, to: Pose, hit: Hit, skin: float) -> float:
    """Return the share of the motion by which to stop before `hit`.

    The tangent plane of the two spheres is then `skin` away.
    """
    way = farthest(frame, to)
    if way <= 0.0 or skin <= 0.0:
        return 0.0
    if hit.avatar is None or hit.cloud is None:
        return skin / way
    out = hit.avatar - hit.cloud
    there, _ = frame.world.between(frame.body.avatar, frame.pose, to, min(hit.fraction, 1.0))
    # The point that touches, in the avatar's frame, and its displacement.
    point = turned_back(there, hit.avatar - there[:3, 3])
    goes = (to[:3, 3] - frame.pose[:3, 3]) + turned_by(to[:3, :3] - frame.pose[:3, :3], point)
    length, speed = size(out), size(goes)
    if speed <= 1e-9 * way:
        return min(1.0, skin / way)
    into = speed if length == 0.0 else -dot(goes, out) / length
    return skin / max(into, speed / MOST_BACK)


def settle(frame: Frame, to: Pose, fraction: float, proved: float) -> None:
    """Set frame.pose to that at `fraction` of the way to a pose, or before it where that is clear.

    proved: nothing touches before this fraction. The pose stays unchanged if the way is shorter
    than LEAST_WAY.
    """
    begin, way = frame.pose, farthest(frame, to)
    back = 0.0
    while (fraction - back) * way >= LEAST_WAY:
        pose, same = frame.world.between(frame.body.avatar, begin, to, fraction - back)
        if is_clear(frame, pose, proved=same and fraction - back < proved):
            frame.pose = pose
            return
        back = max(_GROWS * back, _BACK / way)


def gives_way(frame: Frame, hit: Hit, to: Pose) -> bool:
    """Return whether what was met was pushed on, which makes the motion worth trying again."""
    return bool(hit.what) and any(obstacle.give_way(frame, hit, to) for obstacle in frame.obstacles)


def note(frame: Frame, hit: Hit) -> None:
    """Record what ended a motion."""
    frame.hits.append(hit)
    if hit.verdict == Verdict.UNKNOWN and frame.verdict == Verdict.CLEAR:
        frame.verdict = Verdict.UNKNOWN


def set_out(frame: Frame) -> None:
    """Move towards the commanded pose."""
    assert frame.go is not None
    frame.blocked = frame.go(frame, frame.wish)
    frame.met = None if frame.blocked is None else frame.pose
    frame.left = frame.wish[:3, 3] - frame.pose[:3, 3]
