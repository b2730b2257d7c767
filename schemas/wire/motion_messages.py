"""Messages of one frame of one avatar: the motion command, and the resulting motion.

WIRE.md states when each is sent. The report of each effect is a field of `Moved`, which is omitted
if the scene does not declare the effect.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any, Literal, cast, get_args

import msgspec
import numpy as np

from ..archive.pose_arrays import make_poses, one_pose
from ..errors import BadRequestError
from .answer_forms import VERDICT_NAMES
from .answers import Verdict
from .arrays import Poses
from .encoding import JSON, encode
from .request_limits import MAX_FRAME_SECONDS
from .requests import Count, Length, Name, Request, check_one_pose

Vector = tuple[float, float, float]

# What a frame does about voxels that are not in memory: wait until they are loaded, or bound them.
Late = Literal["wait", "bounds"]
WAIT, BOUNDS = get_args(Late)

# Default duration of a frame, 30 of which make a second [s].
FRAME_SECONDS = 1 / 30


class MoveRequest(Request, frozen=True, kw_only=True):
    """Compute the pose that an avatar reaches towards a target, and what it touches; stateless.

    avatar: the name under which it was added.
    pose_from, pose_to: (1, 4, 4) float64, avatar to world, rigid.
    seconds: duration of the frame, which gravity depends on, at most 10 [s].
    late: what the frame does about voxels that are not in memory.
    """

    avatar: Name
    pose_from: Poses
    pose_to: Poses
    seconds: Length = FRAME_SECONDS
    late: Late = "wait"

    def __post_init__(self) -> None:
        Request.__post_init__(self)
        check_one_pose("pose_from", self.pose_from)
        check_one_pose("pose_to", self.pose_to)
        if self.seconds > MAX_FRAME_SECONDS:
            raise BadRequestError(f"seconds is {self.seconds}: expected {MAX_FRAME_SECONDS:g} at most")


class Wish(Request, frozen=True, kw_only=True):
    """Motion command: the pose or the velocity that a user wants; sent 30 to 90 times a second.

    It has either `pose` or `velocity`.
    seq: greater in every command; a command whose seq is not greater than the last one's is
    dropped.
    time: time of the command on the client's clock, which must not go backwards [s].
    pose: (1, 4, 4) float64, avatar to world, rigid.  velocity: world [m/s].
    turn: about the scene's up axis [rad/s], with velocity.
    objects: poses (4, 4) row-major of the scene's objects that this user moves.
    late: what the frame does about voxels that are not in memory.
    """

    seq: Count
    time: Length
    pose: Poses = msgspec.field(default_factory=lambda: make_poses(np.empty((0, 4, 4))))
    velocity: Vector | None = None
    turn: float = 0.0
    objects: dict[str, list[list[float]]] = msgspec.field(default_factory=dict)
    late: Late = "wait"

    def __post_init__(self) -> None:
        Request.__post_init__(self)
        if len(self.pose) == (self.velocity is not None):
            raise BadRequestError("a wish with both or neither of pose and velocity: expected exactly one")
        if len(self.pose):
            check_one_pose("pose", self.pose)
        _check_finite("velocity", self.velocity or ())
        _check_finite("turn", [self.turn])
        for name, rows in self.objects.items():
            if [len(row) for row in rows] != [4, 4, 4, 4]:
                raise BadRequestError(f"object {name!r}: expected a pose of 4 rows of 4 numbers")
            _check_finite(f"pose of object {name!r}", [number for row in rows for number in row])


def _check_finite(what: str, numbers: Iterable[float]) -> None:
    """Raise BadRequestError for NaN or infinity, which have no defined answer (NUMERICS.md N7)."""
    for number in numbers:
        if not math.isfinite(number):
            raise BadRequestError(f"{what} holds {number}: expected finite numbers")


def checked_late(late: str) -> Late:
    """Return `late` of a session or a move. Raise BadRequestError for another value."""
    if late not in get_args(Late):
        raise BadRequestError(f"late is {late!r}: expected {' or '.join(map(repr, get_args(Late)))}")
    return cast(Late, late)


def motion_fields(pose: Any, velocity: Any) -> tuple[Poses, Vector | None]:
    """Return pose and velocity of a motion command as the fields of a `Wish`.

    pose: (4, 4) or (1, 4, 4), or None.  velocity: 3 numbers [m/s], or None.
    Raise BadRequestError for a pose of another shape, or unless a velocity has 3 numbers.
    """
    poses = np.empty((0, 4, 4)) if pose is None else one_pose(pose)[None]
    speed = None if velocity is None else tuple(float(part) for part in velocity)
    if speed is not None and len(speed) != 3:
        raise BadRequestError(f"velocity of {len(speed)} numbers: expected 3 [m/s]")
    return poses, speed


def object_poses(objects: Mapping[str, Any] | None) -> dict[str, list[list[float]]]:
    """Return the poses of objects, (4, 4) or (1, 4, 4) each, as the field of a `Wish`.

    Raise BadRequestError for a pose of another shape.
    """
    return {
        name: one_pose(pose, f"pose of object {name!r}").tolist() for name, pose in (objects or {}).items()
    }


class Touched(msgspec.Struct, frozen=True, omit_defaults=True):
    """One obstacle that stopped a motion.

    place: of the scan point, world [m].  normal: the contact normal, where estimated.
    what: "" for the scene, else the object or user.
    unknown: whether the motion stopped at data that could not be examined, and not at a contact.
    unloaded: whether that is so because voxels are not in memory yet: a later frame may go on.
    """

    place: Vector
    normal: Vector | None = None
    what: str = ""
    unknown: bool = False
    unloaded: bool = False


class GroundReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """Report of the effect `ground`.

    on_ground: the avatar is standing.  speed: of falling [m/s].
    normal: of the surface on which the avatar stands.
    """

    on_ground: bool
    speed: float = 0.0
    normal: Vector | None = None


class ProximityReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """Report of the effect `proximity`, as an answer of `distance`.

    distance: signed [m]; null: beyond reach.
    """

    distance: float | None = None
    avatar: Vector | None = None
    cloud: Vector | None = None
    normal: Vector | None = None
    unknown: bool = False


class ContactCluster(msgspec.Struct, frozen=True):
    """One cluster of contacts, in the report of the effect `contacts`.

    count: pairs.  deepest: signed distance of the deepest pair [m].
    avatar, cloud: centres of that pair, world [m].
    """

    count: int
    deepest: float
    avatar: Vector
    cloud: Vector


class ContactsReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """Report of the effect `contacts`.

    clusters: deepest first.  total: number of clusters, listed or not.
    """

    clusters: list[ContactCluster] = []
    total: int = 0
    unknown: bool = False


class UncertaintyReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """Report of the effect `uncertainty`.

    probability: of contact.
    scans: probability for each scan alone, by its file; only scans that matter.
    """

    probability: float
    scans: dict[str, float] = {}
    unknown: bool = False


class ObjectsReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """Report of the effect `objects`.

    poses: row-major, of the objects that moved.
    touching: pairs that touch; "" is the scene, other names are of objects.
    """

    poses: dict[str, list[list[float]]] = {}
    touching: list[tuple[str, str]] = []


class CrowdReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """Report of the effect `crowd`.

    met: number of other users that stopped this one.
    """

    met: int = 0


class Moved(msgspec.Struct, frozen=True, eq=False, kw_only=True, omit_defaults=True):
    """Result of one frame.

    pose: (1, 4, 4) float64, the avatar's pose now.
    verdict: of that pose, a value of `Verdict`. UNKNOWN also if the motion stopped because the rest
    of the way is not known to be clear.
    left: length of the commanded motion not carried out [m].  touched: obstacles that stopped it.
    simulated: effects, in the order in which they ran.
    stepped: height climbed by `step` [m].
    ground, proximity, contacts, uncertainty, objects, crowd: the report of each effect.
    unknown: whether the frame needed data that could not be examined. With it, any of these fields
    might differ.
    unloaded: part of `left` that was not carried out because voxels are not in memory yet [m].
    `repr` and `str` are one line, such as "at (1.25, 0.5, 0): clear, 0.1 m left".
    """

    pose: Poses
    verdict: int = int(Verdict.CLEAR)
    left: float = 0.0
    touched: list[Touched] = []
    simulated: list[str] = []
    stepped: float = 0.0
    ground: GroundReport | None = None
    proximity: ProximityReport | None = None
    contacts: ContactsReport | None = None
    uncertainty: UncertaintyReport | None = None
    objects: ObjectsReport | None = None
    crowd: CrowdReport | None = None
    unknown: bool = False
    unloaded: float = 0.0

    def __repr__(self) -> str:
        """Return the position reached, its verdict and what stopped the motion."""
        at = ", ".join(f"{value:.4g}" for value in self.pose[0, :3, 3])
        parts = [f"at ({at}): {VERDICT_NAMES.get(self.verdict, self.verdict)}"]
        if self.left:
            parts.append(f"{self.left:.4g} m left")
        if self.unloaded:
            parts.append(f"{self.unloaded:.4g} m not in memory yet")
        if self.touched:
            parts.append(f"{len(self.touched)} obstacle{'s' * (len(self.touched) != 1)}")
        return ", ".join(parts)

    def to_dict(self) -> dict[str, Any]:
        """Return the fields as dicts, lists, numbers and strings, ready for `json.dumps`.

        Fields with their default value are omitted, as on the wire and by `solidcloud query --json`.
        """
        found: dict[str, Any] = msgspec.json.decode(encode(self, JSON))
        return found


class State(Moved, frozen=True, eq=False, kw_only=True, omit_defaults=True):
    """Result of one frame (`Moved`) as sent to the user of the motion command.

    seq, time: of the motion command.  frame: the server's frame number, increasing.
    late: motion commands dropped so far because a newer one had arrived.
    seconds: time that the frame took in the server.
    """

    seq: int
    time: float
    frame: int
    late: int = 0
    seconds: float = 0.0

    def __repr__(self) -> str:
        """Return the number of the motion command, and the result as `Moved` does."""
        return f"command {self.seq}: {Moved.__repr__(self)}"
