"""How an avatar goes: what it would meet first, how far from that it stays, and that it is clear where it ends.

`stop` and `sweep` put `frame.go` together of this.
"""

from ...schemas.answers import Verdict
from ..vectors import dot, size, spread, turned_back, turned_by
from .frame import Frame, Hit, Pose

# A motion that is stopped sooner is not begun [m]: else an avatar that pushes would tremble by what `lower` is off.
LEAST_WAY = 2e-5
# Along a wall that is grazed, the way back that leaves `skin` is long: at most so many times `skin`.
MOST_BACK = 4.0
# A doubt so far before a contact is what ended the motion, not the contact [m].
DOUBT = 1e-4
# First way back from a pose that proves not to be clear [m], and by how much it grows.
_BACK, _GROWS = 1e-7, 4.0


def first_hit(frame: Frame, to: Pose, tolerance: float) -> Hit | None:
    """What would end the motion from frame.pose to a pose first, of the scene and of what else blocks."""
    avatar, found = frame.body.avatar, None
    swept = frame.world.sweep(avatar, frame.pose, to, tolerance, frame.effort)
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
    """What is touched at a pose, with fraction 0, or is not known not to be."""
    avatar = frame.body.avatar
    verdict = frame.world.collide(avatar, pose, frame.effort)
    if verdict == Verdict.CONTACT:
        return frame.world.deepest(avatar, pose, frame.effort) or Hit(0.0, verdict, None, None)
    if verdict == Verdict.UNKNOWN:
        return Hit(0.0, verdict, None, None)
    return next((hit for each in frame.obstacles if (hit := each.touches(avatar, pose))), None)


def is_clear(frame: Frame, pose: Pose, *, proved: bool = False) -> bool:
    """Whether nothing is touched at a pose, and that is known.

    proved: of the scene; then only what else blocks is asked.
    """
    avatar = frame.body.avatar
    if not proved and frame.world.collide(avatar, pose, frame.effort) != Verdict.CLEAR:
        return False
    return not any(each.touches(avatar, pose) for each in frame.obstacles)


def farthest(frame: Frame, to: Pose) -> float:
    """How far any avatar point goes from frame.pose to a pose, at most, or hardly more [m]."""
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
    """Of the motion, the share to stay before `hit`: so that the tangent plane of the two spheres is `skin` away."""
    way = farthest(frame, to)
    if way <= 0.0 or skin <= 0.0:
        return 0.0
    if hit.avatar is None or hit.cloud is None:
        return skin / way
    out = hit.avatar - hit.cloud
    there, _ = frame.world.between(frame.body.avatar, frame.pose, to, min(hit.fraction, 1.0))
    # The point that touches, in the avatar's frame, and how it moves.
    point = turned_back(there, hit.avatar - there[:3, 3])
    goes = (to[:3, 3] - frame.pose[:3, 3]) + turned_by(to[:3, :3] - frame.pose[:3, :3], point)
    length, speed = size(out), size(goes)
    if speed <= 1e-9 * way:
        return min(1.0, skin / way)
    into = speed if length == 0.0 else -dot(goes, out) / length
    return skin / max(into, speed / MOST_BACK)


def settle(frame: Frame, to: Pose, fraction: float, proved: float) -> None:
    """Set frame.pose to that at `fraction` of the way to a pose, or so far before it that it is clear.

    proved: nothing touches before. Stays where it is, where that is no way worth the name.
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
    """Whether what was met on the way to a pose is pushed on, so that the way is worth trying again."""
    return bool(hit.what) and any(obstacle.give_way(frame, hit, to) for obstacle in frame.obstacles)


def note(frame: Frame, hit: Hit) -> None:
    """Write down what ended a motion."""
    frame.hits.append(hit)
    if hit.verdict == Verdict.UNKNOWN and frame.verdict == Verdict.CLEAR:
        frame.verdict = Verdict.UNKNOWN


def set_out(frame: Frame) -> None:
    """Go for the wish."""
    assert frame.go is not None
    frame.blocked = frame.go(frame, frame.wish)
    frame.met = None if frame.blocked is None else frame.pose
    frame.left = frame.wish[:3, 3] - frame.pose[:3, 3]
