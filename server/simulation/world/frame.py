"""One frame of one user: its state, the hits that end motions, and arithmetic of poses and vectors.

Vectors and rotations are computed with Python's floats, or by numpy element by element, in a fixed
order of operations. numpy multiplies matrices with a library whose order of sums and use of fused
operations depend on the processor: the same motion commands could give other poses on another
machine. No library guarantees the bits of a sine either. For three numbers this is also faster: a
product by numpy takes a microsecond. kernels/motion/vector_tuples.py has the same in compiled code.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.wire.answers import Verdict
from ...avatars.avatar_model import AvatarModel
from ...kernels.motion.screw_motion import sine_cosine
from ...queries.query_inputs import EXACT, QueryBudget

Vec = NDArray[np.float64]  # (3,) [m]
Matrix = NDArray[np.float64]  # (3, 3), or the upper left of a pose (4, 4)
Pose = NDArray[np.float64]  # (4, 4) float64, avatar to world, rigid

_QUARTER = 0.5 * math.pi
# Names under which `Body.effect_state` keeps the point and the normal of the plane that the avatar stands
# on, (6,), and the place where it was raised last, (3,).
GROUND_PLANE, RAISED = "ground", "ground raised"
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
    obstacle: the `BodyObstacle` (bodies.py) that was hit, or None.
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
    obstacle: Any = None


@dataclass(slots=True)
class Body:
    """State of a user between frames.

    name: as other users see it.  avatar: its model.  pose: (4, 4), its current pose.
    fall_speed: [m/s], 0 on the ground.  on_ground: whether the avatar stood at the end of the last
    frame.
    clear: whether `pose` was found clear, for the archives `generations` (World.generations).
    effect_state: data that effects keep between frames, by effect name.
    user: client and avatar.
    time, heard: time of its last command, on its own and on the server's clock [s]; time is None before
    the end of its first frame.
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
    time: float | None = None
    heard: float = 0.0


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
    obstacles: besides the scan, each a `BodyObstacle` (bodies.py).
    fall_speed, on_ground: new values of `Body`.
    simulated: names of effects.  reports: fields of `Moved`.
    effect_state: entries for `Body.effect_state`.
    apart: whether it is proved that no obstacle is touched at `pose`.
    walks, walk_hits: for walker.py: whether a part has run, and the hits that Python answered with, by
    their row.  visits: node visits of each part in its last call.
    leaving: the last pose in contact from which a motion began (first_hits.py), or None.
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
    walk_hits: dict[int, Hit] = field(default_factory=dict)
    visits: list[int] = field(default_factory=list)
    leaving: Any = None

    @property
    def lacked(self) -> int:
        """Return how often queries of this frame lacked a voxel; always 0 if it waits for voxels."""
        return 0 if self.budget.late is None else self.budget.late.count


# An effect of a scene: runs it for one frame, and returns its report, if it has one. It stores the
# state of a user only in `Body`. The function `make(effect, world)` of an effect's file returns it.
Run = Callable[[Frame], Any]


def dot(one: Vec, other: Vec) -> float:
    """Return the dot product of two vectors (3,)."""
    (a, b, c), (x, y, z) = one.tolist(), other.tolist()
    return float(a * x + b * y + c * z)


def norm(vector: Vec) -> float:
    """Return the length of a vector (3,)."""
    x, y, z = vector.tolist()
    return math.sqrt(x * x + y * y + z * z)


def unit_vector(vector: tuple[float, float, float]) -> Vec:
    """Return the direction of a vector that is not zero."""
    found = np.array(vector, np.float64)
    return found / norm(found)


def horizontal(vector: Vec, up: Vec) -> Vec:
    """Return the part of a vector that is perpendicular to a unit vector."""
    flat: Vec = vector - dot(vector, up) * up
    return flat


def rotate(rotation: Matrix, vector: Vec) -> Vec:
    """Return rotation @ vector."""
    (a, b, c), (d, e, f), (g, h, i) = (row[:3] for row in rotation[:3].tolist())
    x, y, z = vector.tolist()
    return np.array([a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z])


def rotate_back(rotation: Matrix, vector: Vec) -> Vec:
    """Return vector @ rotation, which inverts `rotate`."""
    return rotate(rotation[:3, :3].T, vector)


def multiply(one: Matrix, other: Matrix) -> Matrix:
    """Return the product (3, 3) of two matrices."""
    return np.column_stack([rotate(one, other[:3, column]) for column in range(3)])


def frobenius_norm(matrix: Matrix) -> float:
    """Return the Frobenius norm of a matrix (3, 3), which bounds its largest singular value."""
    square = 0.0  # `sum` adds the rounding errors too, from Python 3.12 on
    for row in matrix.tolist():
        for x in row[:3]:
            square += x * x
    return math.sqrt(square)


def min_height(points: NDArray[np.float64], up: Vec) -> float:
    """Return the least height of points (n, 3) along a direction; n > 0."""
    x, y, z = up.tolist()
    return float((points[:, 0] * x + points[:, 1] * y + points[:, 2] * z).min())


def rotation_matrix(axis: Vec, angle: float) -> Matrix:
    """Return the rotation (3, 3) about a unit vector by an angle [rad], by Rodrigues' formula."""
    quarters = math.floor(angle / _QUARTER)
    s, c = sine_cosine(min(max(angle - quarters * _QUARTER, 0.0), _QUARTER))
    for _ in range(quarters % 4):
        s, c = c, -s
    x, y, z = axis.tolist()
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + s * cross + (1.0 - c) * multiply(cross, cross)


def orthonormalize(rotation: Matrix) -> Matrix:
    """Return a rotation without the rounding errors that products of many rotations accumulate."""
    first = rotation[:, 0] / norm(rotation[:, 0])
    second = rotation[:, 1] - first * dot(first, rotation[:, 1])
    second /= norm(second)
    (a, b, c), (x, y, z) = first.tolist(), second.tolist()
    return np.column_stack([first, second, [b * z - c * y, c * x - a * z, a * y - b * x]])


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
