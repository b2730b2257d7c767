"""One frame of one user on its way through the effects: what was wished, and what came of it so far."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ...schemas.answers import Verdict
from ..avatar import AvatarModel
from ..effort import EXACT, Effort
from ..vectors import dot, lowest_of, turned_back

Vec = NDArray[np.float64]  # (3,) [m]
Pose = NDArray[np.float64]  # (4, 4) float64, avatar to world, rigid


class Hit(NamedTuple):
    """What ended a motion. fraction: of the motion, gone.  verdict: CONTACT or UNKNOWN.

    avatar, cloud: (3,) centres of the two spheres that touch, world [m]; None where UNKNOWN.  what: "" the scene, else
    the object or user.  archive: which of the scene's archives; -1: none of them.  normal: (3,) unit, of the surface
    touched, towards the avatar; None where nobody estimated it.
    """

    fraction: float
    verdict: Verdict
    avatar: Vec | None
    cloud: Vec | None
    what: str = ""
    archive: int = -1
    normal: Vec | None = None


class Obstacle(Protocol):
    """What moves and blocks: the other users, the dynamic objects. See bodies.py.

    One obstacle may stand for many bodies: `Hit.what` names the one. What was touched when the frame began blocks only
    what goes deeper into it, so that an avatar gets free: then neither question says that it is touched.
    """

    name: str

    def sweep(self, avatar: AvatarModel, pose_from: Pose, pose_to: Pose, tolerance: float) -> Hit | None:
        """What ends the motion against it; None: nothing does. Nothing is touched before the hit's fraction."""

    def touches(self, avatar: AvatarModel, pose: Pose) -> Hit | None:
        """Whether it is touched by an avatar there."""

    def overlaps(self, avatar: AvatarModel, pose: Pose) -> bool:
        """Whether an avatar there touches it, whatever was touched when the frame began."""

    def give_way(self, frame: "Frame", hit: Hit, to: Pose) -> bool:
        """Asked of what ended a motion, the avatar at frame.pose and on its way to `to`: it may be pushed on, and then
        says that it was and that the way is worth going on."""


@dataclass(slots=True)
class Body:
    """What is remembered of a user between frames. name: as others are told.  avatar: its model.  pose: where it is.

    fall_speed: [m/s], 0 on the ground.  on_ground: whether the last frame left it standing.  clear: whether `pose` was
    found clear, of the archives `generations` (World.generations).  kept: what an effect keeps for itself, by its name.
    user: client and avatar.
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
    """One user's one frame. body: as the frame before left it; written once, when the frame is done (pipeline.py).

    wish: where to.  seconds: since the frame before.  world: what is asked (world.py).  pose, verdict: so far.
    generations: of the archives asked.  clear: whether nothing is touched at `pose`, which is asked once: `go` keeps
    it so.
    left: (3,) of the translation wished, not gone yet [m].  hits: what ended motions, in order.  blocked: what ended
    the wish first, and met: where; None: nothing did.  obstacles: what else blocks.  go: as far as nothing is touched;
    `stop` or `sweep` puts it there.  reports: fields of `Moved`.
    kept: what goes into `Body.kept`.
    """

    body: Body
    wish: Pose
    seconds: float
    world: Any
    effort: Effort = EXACT
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


# Go towards a pose from `frame.pose`, as far as nothing is touched; sets frame.pose, returns what ended it.
Go = Callable[[Frame, Pose], Hit | None]


class Runner(Protocol):
    """One effect of one scene. It keeps nothing of a user but in `Body`.

    A module of effects makes one: `make(effect, world)`. One with a method `begin(frame)`, too, is called before any
    effect runs: it may change the wish.
    """

    name: str

    def run(self, frame: Frame) -> None:
        """Its part of one frame."""


def moved_by(pose: Pose, way: Vec) -> Pose:
    """A pose carried along."""
    there = pose.copy()
    there[:3, 3] += way
    return there


def lowest(avatar: AvatarModel, pose: Pose, up: Vec) -> float:
    """How far up the lowest of an avatar's spheres, not none, begins under a pose [m]."""
    return dot(pose[:3, 3], up) + lowest_of(avatar.points, turned_back(pose, up)) - avatar.radius
