"""One frame of one user on its way through the effects: motion command and results so far."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ....schemas.wire.answers import Verdict
from ...avatars.avatar_model import AvatarModel
from ...queries.context.query_budget import EXACT, QueryBudget
from .vectors import dot, lowest_of, turned_back

Vec = NDArray[np.float64]  # (3,) [m]
Pose = NDArray[np.float64]  # (4, 4) float64, avatar to world, rigid


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
    """Bodies that move and block: the other users, the dynamic objects. See bodies.py.

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
    (World.generations).  kept: what effects store for themselves, by effect name.  user: client and
    avatar.
    """

    name: str
    avatar: AvatarModel
    pose: Pose
    fall_speed: float = 0.0
    on_ground: bool = False
    clear: bool = False
    generations: tuple[int, ...] = ()
    kept: dict[str, Any] = field(default_factory=dict)
    user: tuple[str, str] = ("", "")


@dataclass(slots=True)
class Frame:
    """One frame of one user.

    body: as the previous frame left it; written once, when the frame is finished (pipeline.py).
    wish: the commanded pose.  seconds: since the previous frame.  world: answers the queries
    (collision_world.py).  pose, verdict: so far.
    generations: of the archives in use.  clear: whether nothing is touched at `pose`; queried once,
    then maintained by `go`.
    left: (3,), the part of the commanded translation not completed yet [m].  hits: what ended
    motions, in order.  blocked, met: what ended the commanded motion first, and the pose there;
    None: nothing did.  obstacles: what else blocks.
    go: moves as far as nothing is touched; set by `stop` or `sweep`.  reports: fields of `Moved`.
    kept: entries for `Body.kept`.
    """

    body: Body
    wish: Pose
    seconds: float
    world: Any
    budget: QueryBudget = EXACT
    pose: Pose = field(default_factory=lambda: np.eye(4))
    verdict: Verdict = Verdict.CLEAR
    generations: tuple[int, ...] = ()
    clear: bool = False
    left: Vec = field(default_factory=lambda: np.zeros(3))
    hits: list[Hit] = field(default_factory=list)
    blocked: Hit | None = None
    met: Pose | None = None
    obstacles: list[Obstacle] = field(default_factory=list)
    go: "Go | None" = None
    fall_speed: float = 0.0
    on_ground: bool = False
    simulated: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    reports: dict[str, Any] = field(default_factory=dict)
    kept: dict[str, Any] = field(default_factory=dict)


# Move towards a pose from `frame.pose`, as far as nothing is touched; set frame.pose and return
# what ended it.
Go = Callable[[Frame, Pose], Hit | None]


class Runner(Protocol):
    """One effect of one scene. It stores the state of a user only in `Body`.

    Each effect's module creates one: `make(effect, world)`. If a runner also has a method
    `begin(frame)`, it is called before any effect runs and may change the motion command.
    """

    name: str

    def run(self, frame: Frame) -> None:
        """Run this effect for one frame."""


def moved_by(pose: Pose, way: Vec) -> Pose:
    """Return a pose translated by a vector."""
    there = pose.copy()
    there[:3, 3] += way
    return there


def lowest(avatar: AvatarModel, pose: Pose, up: Vec) -> float:
    """Return the lowest height of an avatar's spheres under a pose, along `up` [m].

    The avatar has at least one sphere.
    """
    return dot(pose[:3, 3], up) + lowest_of(avatar.points, turned_back(pose, up)) - avatar.radius
