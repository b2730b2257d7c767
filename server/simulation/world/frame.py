"""One frame of one user: its state, the hits that end motions, and the motions of effects."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.wire.answers import Verdict
from ...avatars.avatar_model import AvatarModel
from ...queries.query_inputs import EXACT, QueryBudget
from .vectors import dot, frobenius_norm, min_height, norm, rotate, rotate_back

Vec = NDArray[np.float64]  # (3,) [m]
Pose = NDArray[np.float64]  # (4, 4) float64, avatar to world, rigid

# Limit of the obstacles that an answer lists.
MAX_TOUCHED = 16


class Hit(NamedTuple):
    """End of a motion.

    fraction: completed share of the motion.  verdict: CONTACT or UNKNOWN.
    avatar, cloud: (3,) centres of the two touching spheres, world [m]; None if UNKNOWN.
    what: "" for the scene, otherwise the name of the object or user.
    archive: index among the scene's archives; -1 if the hit is not of the scan.
    normal: (3,) unit, of the touched surface, towards the avatar; None if it was not estimated.
    point: (3,) centre of the avatar's touching sphere, avatar frame [m]; None if the hit is not of
    the scan, or did not end a motion.
    unloaded: whether it is UNKNOWN because voxels are not in memory.
    rest: length of the motion that was left [m], if `unloaded`.
    end: (4, 4), pose at which a motion with a skin ends, which is proved clear for the scan; None if
    not known.
    upper: fraction at which it certainly touches; inf if not known.  exact: whether no other contact
    can come first, and no avatar point moves farther than the tolerance from `fraction` to `upper`.
    """

    fraction: float
    verdict: Verdict
    avatar: Vec | None
    cloud: Vec | None
    what: str = ""
    archive: int = -1
    normal: Vec | None = None
    point: Vec | None = None
    unloaded: bool = False
    rest: float = 0.0
    end: Pose | None = None
    upper: float = math.inf
    exact: bool = True


@dataclass(slots=True)
class Body:
    """State of a user between frames.

    name: as other users see it.  avatar: its model.  pose: (4, 4), its current pose.
    fall_speed: [m/s], 0 on the ground.  on_ground: whether the avatar stood at the end of the last
    frame.
    clear: whether `pose` was found clear, for the archives `generations` (World.generations).
    effect_state: data that effects keep between frames, by effect name.
    user: client and avatar.
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

    body: as the previous frame left it; written once, when the frame is finished.
    target: the commanded pose (4, 4), a copy, which effects may change.
    seconds: time since the previous frame.
    world: answers the queries (collision_world.py).  budget: of the queries.
    pose, verdict: reached so far.  generations: of the archives in use.
    clear: whether nothing is touched at `pose`.
    remaining: (3,), part of the commanded translation that is not completed yet [m].
    hits: hits that ended motions, in order.
    obstacles: besides the scan, each a `BodyObstacle` (body_obstacles.py).
    fall_speed, on_ground: new values of `Body`.
    simulated: names of effects.  reports: fields of `Moved`.
    effect_state: entries for `Body.effect_state`.
    apart: whether it is proved that no obstacle is touched at `pose`.
    walks, walk_hits: for walker.py: whether a part has run, and the hits that Python answered with, by
    their row.  visits: node visits of each part in its last call.
    leaving: the last pose in contact from which a motion began (leaving.py), or None.
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
    obstacles: list[Any] = field(default_factory=list)
    fall_speed: float = 0.0
    on_ground: bool = False
    simulated: list[str] = field(default_factory=list)
    reports: dict[str, Any] = field(default_factory=dict)
    effect_state: dict[str, Any] = field(default_factory=dict)
    apart: bool = False
    walks: bool = False
    walk_hits: dict[int, Hit] | None = None
    visits: list[int] = field(default_factory=list)
    leaving: Any = None

    @property
    def lacked(self) -> int:
        """Return how often queries of this frame lacked a voxel; always 0 if it waits for voxels."""
        return 0 if self.budget.late is None else self.budget.late.count


# An effect of a scene: runs it for one frame, and returns its report, if it has one. It stores the
# state of a user only in `Body`. The function `make(effect, world)` of an effect's file returns it.
Run = Callable[[Frame], Any]


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


def is_translation(pose: Pose, to: Pose) -> bool:
    """Return whether two poses have the same orientation, bit for bit."""
    return pose[:3, :3].tobytes() == to[:3, :3].tobytes()


def first_body_hit(frame: Frame, to: Pose, tolerance: float, until: float, *, below: bool) -> Hit | None:
    """Return the first hit of the motion from frame.pose to a pose with obstacles, before `until`.

    until: fraction of the motion.  below: as for `find_first_hit`.
    """
    found = None
    for obstacle in frame.obstacles:
        hit = obstacle.sweep(frame.body.avatar, frame.pose, to, tolerance, below=below)
        if hit is not None and hit.fraction < until:
            found, until = hit, hit.fraction
    return found


def find_touched(frame: Frame, pose: Pose) -> Hit | None:
    """Return a hit with fraction 0 if a pose touches something or is unknown, or None."""
    avatar, lacked = frame.body.avatar, frame.lacked
    verdict = frame.world.collide(avatar, pose, frame.budget)
    if verdict == Verdict.CONTACT:
        return frame.world.deepest(avatar, pose, frame.budget) or Hit(0.0, verdict, None, None)
    if verdict == Verdict.UNKNOWN:
        return Hit(0.0, verdict, None, None, unloaded=frame.lacked > lacked)
    return next((hit for each in frame.obstacles if (hit := each.touches(avatar, pose))), None)


def is_clear(frame: Frame, pose: Pose, *, proved: bool = False) -> bool:
    """Return whether it is known that nothing is touched at a pose.

    proved: whether this is already proved for the scene; then only obstacles are tested.
    """
    avatar = frame.body.avatar
    if not proved and frame.world.collide(avatar, pose, frame.budget) != Verdict.CLEAR:
        return False
    return not touches_bodies(frame, pose)


def touches_bodies(frame: Frame, pose: Pose) -> bool:
    """Return whether an obstacle is touched at a pose."""
    return any(each.touches(frame.body.avatar, pose) for each in frame.obstacles)


def max_displacement(frame: Frame, to: Pose) -> float:
    """Return an approximate bound of the distance that any avatar point moves to a pose [m].

    The motion begins at frame.pose.
    """
    avatar, begin = frame.body.avatar, frame.pose
    if not len(avatar.points):
        return 0.0
    way = to[:3, 3] - begin[:3, 3]
    if is_translation(begin, to):
        return norm(way)
    turn = to[:3, :3] - begin[:3, :3]
    center = way + rotate(turn, avatar.arrays.center[0])
    return norm(center) + frobenius_norm(turn) * float(avatar.arrays.radius[0])


def record_hit(frame: Frame, hit: Hit) -> None:
    """Record a hit where the frame begins."""
    frame.hits.append(hit)
    if hit.verdict == Verdict.UNKNOWN and frame.verdict == Verdict.CLEAR:
        frame.verdict = Verdict.UNKNOWN
