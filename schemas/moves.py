"""One frame of one avatar: what is wished, and what came of it. WIRE.md says when each is sent.

What an effect says is a field of `Moved` that is left out where the scene does not call for the effect.
"""

import math
from collections.abc import Iterable

import msgspec
import numpy as np

from .answers import Verdict
from .arrays import Poses
from .errors import BadRequestError
from .requests import Count, Length, Name, Request, check_one_pose, make_poses

Vector = tuple[float, float, float]

LONGEST_SECONDS = 10.0
# Of one frame, 30 of which make a second, for whoever does not say [s].
FRAME_SECONDS = 1 / 30


class MoveRequest(Request, frozen=True, kw_only=True):
    """Ask where an avatar gets that goes from one pose towards another, and what it meets; nothing is remembered.

    avatar: the name it was added under.  pose_from, pose_to: (1, 4, 4) float64, avatar to world, rigid.
    seconds: the frame lasts, which gravity asks for, at most 10 [s].
    """

    avatar: Name
    pose_from: Poses
    pose_to: Poses
    seconds: Length = FRAME_SECONDS

    def __post_init__(self) -> None:
        Request.__post_init__(self)
        check_one_pose("pose_from", self.pose_from)
        check_one_pose("pose_to", self.pose_to)
        if self.seconds > LONGEST_SECONDS:
            raise BadRequestError(f"seconds is {self.seconds}: expected {LONGEST_SECONDS:g} at most")


class Wish(Request, frozen=True, kw_only=True):
    """Where a user wants to be, or how fast to go; published 30 to 90 times a second. One of pose and velocity.

    seq: greater in every wish; one that is no greater than the last is dropped.  time: of the wish on the client's
    clock, which does not go back [s].  pose: (1, 4, 4) float64, avatar to world, rigid.  velocity: world [m/s].
    turn: about the scene's up axis [rad/s], with velocity.  objects: poses (4, 4) row-major of the scene's objects
    that this user moves.
    """

    seq: Count
    time: Length
    pose: Poses = msgspec.field(default_factory=lambda: make_poses(np.empty((0, 4, 4))))
    velocity: Vector | None = None
    turn: float = 0.0
    objects: dict[str, list[list[float]]] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        Request.__post_init__(self)
        if len(self.pose) == (self.velocity is not None):
            raise BadRequestError("a wish has pose or velocity: expected one of them")
        if len(self.pose):
            check_one_pose("pose", self.pose)
        _check_finite("velocity", self.velocity or ())
        _check_finite("turn", [self.turn])
        for name, rows in self.objects.items():
            if [len(row) for row in rows] != [4, 4, 4, 4]:
                raise BadRequestError(f"object {name!r}: expected a pose of 4 rows of 4 numbers")
            _check_finite(f"pose of object {name!r}", [number for row in rows for number in row])


def _check_finite(what: str, numbers: Iterable[float]) -> None:
    """BadRequestError for a number no answer exists for (NUMERICS.md N7)."""
    for number in numbers:
        if not math.isfinite(number):
            raise BadRequestError(f"{what} holds {number}: expected finite numbers")


class Touched(msgspec.Struct, frozen=True, omit_defaults=True):
    """One thing that stopped a motion. place: of the scan point, world [m].  normal: the way out, where estimated.

    what: "" the scene; else the object or user. unknown: nothing was touched: the way on is not known to be clear.
    """

    place: Vector
    normal: Vector | None = None
    what: str = ""
    unknown: bool = False


class GroundReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """Of `ground`. on_ground: standing.  speed: of falling [m/s].  normal: of what is stood on."""

    on_ground: bool
    speed: float = 0.0
    normal: Vector | None = None


class ProximityReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """Of `proximity`: as `distance` answers. distance: signed [m]; null: beyond reach."""

    distance: float | None = None
    avatar: Vector | None = None
    cloud: Vector | None = None
    normal: Vector | None = None
    unknown: bool = False


class ContactCluster(msgspec.Struct, frozen=True):
    """Of `contacts`, one place that is touched: pairs, the deepest pair's signed distance [m] and ends, world [m]."""

    count: int
    deepest: float
    avatar: Vector
    cloud: Vector


class ContactsReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """Of `contacts`. clusters: deepest first.  total: of them, those not listed too."""

    clusters: list[ContactCluster] = []
    total: int = 0
    unknown: bool = False


class UncertaintyReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """Of `uncertainty`. probability: of contact.  scans: of each scan alone, by its file; those that matter."""

    probability: float
    scans: dict[str, float] = {}
    unknown: bool = False


class ObjectsReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """Of `objects`. poses: row-major, of those that moved.  touching: pairs; "" is the scene, names are of objects."""

    poses: dict[str, list[list[float]]] = {}
    touching: list[tuple[str, str]] = []


class CrowdReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """Of `crowd`. met: how many other users stopped this one."""

    met: int = 0


class Moved(msgspec.Struct, frozen=True, eq=False, kw_only=True, omit_defaults=True):
    """What came of one frame.

    pose: (1, 4, 4) float64, where the avatar is now.  verdict: of that pose, a value of `Verdict`; UNKNOWN too where
    the way on is not known to be clear, and the avatar went no farther than it is.  left: of the motion wished, not
    gone [m].  touched: what stopped it.  simulated: effects, in the order they ran.  skipped: effects that the frame's
    budget had no room for.  stepped to crowd: what each effect says.  unknown: something that the frame asked could not
    be looked at: had it been, all of this might differ.
    """

    pose: Poses
    verdict: int = int(Verdict.CLEAR)
    left: float = 0.0
    touched: list[Touched] = []
    simulated: list[str] = []
    skipped: list[str] = []
    stepped: float = 0.0
    ground: GroundReport | None = None
    proximity: ProximityReport | None = None
    contacts: ContactsReport | None = None
    uncertainty: UncertaintyReport | None = None
    objects: ObjectsReport | None = None
    crowd: CrowdReport | None = None
    unknown: bool = False


class State(Moved, frozen=True, eq=False, kw_only=True, omit_defaults=True):
    """`Moved`, as the user who wished it is told. seq, time: of the wish.  frame: the server's, growing.

    late: wishes dropped so far because a newer one had come.  seconds: the frame took in the server.
    """

    seq: int
    time: float
    frame: int
    late: int = 0
    seconds: float = 0.0
