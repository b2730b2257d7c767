"""One frame of one user: its state, what ends a motion, and the motions that effects make of it."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ....schemas.wire.answers import Verdict
from ...avatars.avatar_model import AvatarModel
from ...queries.context.query_budget import EXACT, QueryBudget
from .vectors import dot, frobenius_norm, min_height, norm, rotate, rotate_back

Vec = NDArray[np.float64]  # (3,) [m]
Pose = NDArray[np.float64]  # (4, 4) float64, avatar to world, rigid

# A motion that would be shorter is not begun [m]: otherwise a pushing avatar would tremble by the
# error of `lower`.
MIN_MOTION = 2e-5
# Along a wall that is grazed, the way back that keeps `skin` is long: at most this many times
# `skin`.
MAX_SKIN_FACTOR = 4.0
# If a motion is undecided for more than this distance before its contact, the undecided part ends
# it [m].
MAX_UNDECIDED = 1e-4
# First way back from a pose that proves not to be clear [m], and its growth factor.
_FIRST_STEP_BACK, _STEP_GROWTH = 1e-7, 4.0


class Hit(NamedTuple):
    """End of a motion.

    fraction: of the motion, completed.  verdict: CONTACT or UNKNOWN.
    avatar, cloud: (3,) centres of the two spheres that touch, world [m]; None where UNKNOWN.  what:
    "" for the scene, else the object or user.  archive: index among the scene's archives; -1: none
    of them.  normal: (3,) unit, of the surface touched, towards the avatar; None where it was not
    estimated.
    """

    fraction: float
    verdict: Verdict
    avatar: Vec | None
    cloud: Vec | None
    what: str = ""
    archive: int = -1
    normal: Vec | None = None


class Obstacle(Protocol):
    """Bodies that move and block: the other users, the dynamic objects. See body_obstacles.py.

    One obstacle may represent many bodies: `Hit.what` names the one. A body that was touched when
    the frame began blocks only motions that go deeper into it, so that an avatar can get free. For
    other motions, neither `sweep` nor `touches` reports it.
    """

    name: str

    def sweep(self, avatar: AvatarModel, pose_from: Pose, pose_to: Pose, tolerance: float) -> Hit | None:
        """Return what ends the motion against it, or None.

        Nothing is touched before the hit's fraction.
        """

    def touches(self, avatar: AvatarModel, pose: Pose) -> Hit | None:
        """Return what an avatar at a pose touches of it, or None."""

    def overlaps(self, avatar: AvatarModel, pose: Pose) -> bool:
        """Return whether an avatar at a pose touches it.

        Bodies that were touched when the frame began count too.
        """

    def give_way(self, frame: "Frame", hit: Hit, to: Pose) -> bool:
        """Move the body that ended a motion, if possible; return whether to try the motion again.

        Called for each hit. The avatar is at frame.pose and on its way to `to`.
        """


@dataclass(slots=True)
class Body:
    """State of a user between frames.

    name: as other users see it.  avatar: its model.  pose: its current pose.
    fall_speed: [m/s], 0 on the ground.  on_ground: whether the avatar stood at the end of the last
    frame.  clear: whether `pose` was found clear, for the archives `generations`
    (World.generations).  effect_state: what effects store for
    themselves, by effect name.  user: client and
    avatar.
    """

    name: str
    avatar: AvatarModel
    pose: Pose
    fall_speed: float = 0.0
    on_ground: bool = False
    clear: bool = False
    generations: tuple[int, ...] = ()
    effect_state: dict[str, Any] = field(default_factory=dict)
    user: tuple[str, str] = ("", "")


@dataclass(slots=True)
class Frame:
    """One frame of one user.

    body: as the previous frame left it; written once, when the frame is finished (pipeline.py).
    target: the commanded pose.  seconds: since the previous frame.  world: answers the queries
    (collision_world.py).  pose, verdict: so far.
    generations: of the archives in use.  clear: whether nothing is touched at `pose`; queried once,
    then maintained by `advance`.
    remaining: (3,), the part of the commanded translation not completed yet [m].  hits: what ended
    motions, in order.  blocked, blocked_pose: what ended the commanded motion first, and the pose there;
    None: nothing did.  obstacles: what else blocks.
    advance: moves as far as nothing is touched; set by `stop` or `sweep`.  reports: fields of `Moved`.
    effect_state: entries for `Body.effect_state`.
    """

    body: Body
    target: Pose
    seconds: float
    world: Any
    budget: QueryBudget = EXACT
    pose: Pose = field(default_factory=lambda: np.eye(4))
    verdict: Verdict = Verdict.CLEAR
    generations: tuple[int, ...] = ()
    clear: bool = False
    remaining: Vec = field(default_factory=lambda: np.zeros(3))
    hits: list[Hit] = field(default_factory=list)
    blocked: Hit | None = None
    blocked_pose: Pose | None = None
    obstacles: list[Obstacle] = field(default_factory=list)
    advance: "Advance | None" = None
    fall_speed: float = 0.0
    on_ground: bool = False
    simulated: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    reports: dict[str, Any] = field(default_factory=dict)
    effect_state: dict[str, Any] = field(default_factory=dict)


# Move towards a pose from `frame.pose`, as far as nothing is touched; set frame.pose and return
# what ended it.
Advance = Callable[[Frame, Pose], Hit | None]


class Runner(Protocol):
    """One effect of one scene. It stores the state of a user only in `Body`.

    Each effect's module creates one: `make(effect, world)`. If a runner also has a method
    `begin(frame)`, it is called before any effect runs and may change the motion command.
    """

    name: str

    def run(self, frame: Frame) -> None:
        """Run this effect for one frame."""


def translated(pose: Pose, way: Vec) -> Pose:
    """Return a pose translated by a vector."""
    there = pose.copy()
    there[:3, 3] += way
    return there


def lowest_height(avatar: AvatarModel, pose: Pose, up: Vec) -> float:
    """Return the lowest height of an avatar's spheres under a pose, along `up` [m].

    The avatar has at least one sphere.
    """
    return dot(pose[:3, 3], up) + min_height(avatar.points, rotate_back(pose, up)) - avatar.radius


def find_first_hit(frame: Frame, to: Pose, tolerance: float) -> Hit | None:
    """Return what would first end the motion from frame.pose to a pose, scene or obstacle."""
    avatar, found = frame.body.avatar, None
    swept = frame.world.sweep(avatar, frame.pose, to, tolerance, frame.budget)
    if swept.verdict != Verdict.CLEAR:
        sure = swept.verdict == Verdict.CONTACT
        if sure and not swept.exact:
            sure = max_displacement(frame, to) * (swept.upper - swept.lower) <= MAX_UNDECIDED
        found = Hit(swept.lower, Verdict.UNKNOWN, None, None)
        if sure:
            found = Hit(swept.lower, swept.verdict, swept.avatar, swept.cloud, "", swept.archive)
    for obstacle in frame.obstacles:
        hit = obstacle.sweep(avatar, frame.pose, to, tolerance)
        if hit is not None and (found is None or hit.fraction < found.fraction):
            found = hit
    return found


def find_touched(frame: Frame, pose: Pose) -> Hit | None:
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


def max_displacement(frame: Frame, to: Pose) -> float:
    """Return how far any avatar point moves from frame.pose to a pose, at most or nearly so [m]."""
    avatar, begin = frame.body.avatar, frame.pose
    if not len(avatar.points):
        return 0.0
    way = to[:3, 3] - begin[:3, 3]
    if to[:3, :3].tobytes() == begin[:3, :3].tobytes():
        return norm(way)
    turn = to[:3, :3] - begin[:3, :3]
    center = way + rotate(turn, avatar.arrays.center[0])
    return norm(center) + frobenius_norm(turn) * float(avatar.arrays.radius[0])


def skin_fraction(frame: Frame, to: Pose, hit: Hit, skin: float) -> float:
    """Return the share of the motion by which to stop before `hit`.

    The tangent plane of the two spheres is then `skin` away.
    """
    way = max_displacement(frame, to)
    if way <= 0.0 or skin <= 0.0:
        return 0.0
    if hit.avatar is None or hit.cloud is None:
        return skin / way
    out = hit.avatar - hit.cloud
    there, _ = frame.world.between(frame.body.avatar, frame.pose, to, min(hit.fraction, 1.0))
    # The point that touches, in the avatar's frame, and its displacement.
    point = rotate_back(there, hit.avatar - there[:3, 3])
    goes = (to[:3, 3] - frame.pose[:3, 3]) + rotate(to[:3, :3] - frame.pose[:3, :3], point)
    length, speed = norm(out), norm(goes)
    if speed <= 1e-9 * way:
        return min(1.0, skin / way)
    into = speed if length == 0.0 else -dot(goes, out) / length
    return skin / max(into, speed / MAX_SKIN_FACTOR)


def settle_before(frame: Frame, to: Pose, fraction: float, proved: float) -> None:
    """Set frame.pose to that at `fraction` of the way to a pose, or before it where that is clear.

    proved: nothing touches before this fraction. The pose stays unchanged if the way is shorter
    than MIN_MOTION.
    """
    begin, way = frame.pose, max_displacement(frame, to)
    back = 0.0
    while (fraction - back) * way >= MIN_MOTION:
        pose, same = frame.world.between(frame.body.avatar, begin, to, fraction - back)
        if is_clear(frame, pose, proved=same and fraction - back < proved):
            frame.pose = pose
            return
        back = max(_STEP_GROWTH * back, _FIRST_STEP_BACK / way)


def pushes_on(frame: Frame, hit: Hit, to: Pose) -> bool:
    """Return whether what was met was pushed on, which makes the motion worth trying again."""
    return bool(hit.what) and any(obstacle.give_way(frame, hit, to) for obstacle in frame.obstacles)


def record_hit(frame: Frame, hit: Hit) -> None:
    """Record what ended a motion."""
    frame.hits.append(hit)
    if hit.verdict == Verdict.UNKNOWN and frame.verdict == Verdict.CLEAR:
        frame.verdict = Verdict.UNKNOWN


def follow_command(frame: Frame) -> None:
    """Move towards the commanded pose."""
    assert frame.advance is not None
    frame.blocked = frame.advance(frame, frame.target)
    frame.blocked_pose = None if frame.blocked is None else frame.pose
    frame.remaining = frame.target[:3, 3] - frame.pose[:3, 3]
