"""Interface of a scene: the query methods of `Scene` and `Client`, and what a server requires.

`Scene` and `Client` inherit `QueryMethods`, and their sessions inherit `Session`. `ServedScene` is the
interface that a server requires of a scene; the types before it are exchanged between the two. This
file imports neither zenoh nor numba.
"""

import threading
from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import Enum
from time import monotonic
from typing import Any, NamedTuple, Protocol, TypeVar, Unpack

import numpy as np
from msgspec import structs
from numpy.typing import ArrayLike, NDArray

from ..schemas.errors import BadRequestError, BusyError, SolidcloudError
from ..schemas.wire.answers import (
    CollideAnswers,
    ContactsAnswers,
    Cost,
    DistanceAnswers,
    ObjectsAnswers,
    Part,
    RaycastAnswers,
    SweepAnswers,
    WithinAnswers,
)
from ..schemas.wire.key_expressions import User
from ..schemas.wire.motion_messages import Late, Moved, State, Wish, motion_fields, object_poses
from ..schemas.wire.overview_messages import OverviewAnswer
from ..schemas.wire.question_rules import Question, suggestion_for
from ..schemas.wire.question_table import COLLIDE, CONTACTS, DISTANCE, OBJECTS, RAYCAST, SWEEP, WITHIN
from ..schemas.wire.requests import DEFAULT_REACH, QuestionOptions
from ..schemas.wire.residency_messages import ResidencyChanges
from ..schemas.wire.scene_messages import AvatarInfo, ReloadAnswer, SceneInfo
from ..schemas.wire.stats import StatsAnswer
from ..schemas.wire.tile_messages import TileAnswer, VoxelsAnswer
from .runtime.stop_flag import NO_STOP, StopFlag

_A = TypeVar("_A", bound=Cost)

# Owner of the avatars that every client may use in requests. No client can have this id, because
# it is not a valid part of a key expression.
EVERYBODY = "*"
# Owner of the avatars added in the serving process, not by a client.
THIS_PROCESS = ""
# States stored for `Session.states`: some ten seconds. The oldest are dropped.
_MAX_STATES = 1024


class QueryOptions(QuestionOptions, total=False):
    """Options of the query methods: those of every query, and two that only a `Scene` takes.

    client: owner of the avatar.  stop: flag that ends the work early.
    """

    client: str
    stop: StopFlag


class TolerantOptions(QueryOptions, total=False):
    """Options of a query that takes a tolerance [m]."""

    tolerance: float


class DistanceOptions(TolerantOptions, total=False):
    """Options of `distance`."""

    relative_tolerance: float


class QueryMethods:
    """The queries that have one answer each. `Scene` and `Client` implement `ask`.

    name: of an avatar.
    poses: one (4, 4) or many (k, 4, 4) float64, avatar to world; one is a batch of one, and its
    answers have length 1. `solidcloud.poses` makes poses from quaternions, angles and rotations,
    and from rotations of float32 numbers, which are rounded too far to be accepted.
    margin: distance below which two spheres count as in contact [m].
    reach: farthest distance worth reporting [m].
    options: budget_ms, radius_model, and of some queries tolerance [m] and relative_tolerance: WIRE.md.
    """

    # Names of the options that `ask` takes besides those of the question.
    own_options: frozenset[str] = QueryOptions.__optional_keys__

    def ask(self, question: Question[_A], *arguments: Any, **options: Any) -> _A:
        """Answer a question.

        arguments: the fields of its request, in their order.  options: further fields and query
        options, by name.
        """
        raise NotImplementedError

    def check_options(self, question: Question[Any], options: Mapping[str, Any]) -> None:
        """Raise TypeError for an option that is not known, and suggest one that is."""
        known = question.options | self.own_options
        for name in options:
            if name not in known:
                takes = [*question.parameters, *sorted(known)]
                raise TypeError(
                    f"{type(self).__name__}.{question.name}() got an unexpected keyword argument {name!r}: "
                    f"{suggestion_for(name, takes)}it takes {', '.join(takes)}"
                )

    def collide(
        self, name: str, poses: Any, margin: float = 0.0, **options: Unpack[TolerantOptions]
    ) -> CollideAnswers:
        """Test for k poses if an avatar touches the scene."""
        return self.ask(COLLIDE, name, poses, margin, **options)

    def distance(
        self, name: str, poses: Any, reach: float = DEFAULT_REACH, **options: Unpack[DistanceOptions]
    ) -> DistanceAnswers:
        """Measure for k poses the distance from an avatar to the scene, up to `reach`: 1 m.

        A larger reach takes more time, and loads more of the archive.
        """
        return self.ask(DISTANCE, name, poses, reach, **options)

    def contacts(
        self,
        name: str,
        poses: Any,
        limit: int = 100,
        margin: float = 0.0,
        cluster_distance: float | None = None,
        **options: Unpack[TolerantOptions],
    ) -> ContactsAnswers:
        """List for k poses the pairs in contact: the deepest `limit` of each, and all clusters."""
        return self.ask(CONTACTS, name, poses, limit, margin, cluster_distance, **options)

    def sweep(
        self,
        name: str,
        pose_from: Any,
        pose_to: Any,
        margin: float = 0.0,
        **options: Unpack[TolerantOptions],
    ) -> SweepAnswers:
        """Find for k motions between two poses the first contact of an avatar with the scene.

        pose_from, pose_to: equally many, as `poses`.
        """
        return self.ask(SWEEP, name, pose_from, pose_to, margin, **options)

    def raycast(
        self, origins: Any, directions: Any, reach: float, **options: Unpack[QueryOptions]
    ) -> RaycastAnswers:
        """Find for k rays, (k, 3) and (k, 3), the first scan point whose sphere each hits."""
        return self.ask(RAYCAST, origins, directions, reach, **options)

    def within(self, points: Any, reach: float, **options: Unpack[QueryOptions]) -> WithinAnswers:
        """Find for k points (k, 3) the nearest scan point, up to `reach`."""
        return self.ask(WITHIN, points, reach, **options)

    def objects(
        self,
        objects: Sequence[Sequence[Any]],
        margin: float = 0.0,
        **options: Unpack[QueryOptions],
    ) -> ObjectsAnswers:
        """Test avatars against the scene and against each other.

        objects: (name, pose, group = 1, mask = all bits) each, a pose (4, 4) or (1, 4, 4).
        """
        return self.ask(OBJECTS, objects, margin, **options)


def list_avatars(names: Sequence[str]) -> str:
    """Return a few names of avatars for the `repr` of a scene."""
    if not names:
        return "no avatars"
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return f"avatar{'s' * (len(names) > 1)} {', '.join(names[:3])}{more}"


class AvatarLimits(NamedTuple):
    """Limits on avatars, for all clients together and for each one.

    bytes: of their arrays.  avatars: their number.  clients: number of clients with avatars.
    """

    bytes: int
    bytes_by_client: int
    avatars: int
    avatars_by_client: int
    clients: int


class LimitReached(Enum):
    """Limit of a server that a request exceeds."""

    REQUESTS = "requests in flight, of all clients"
    OWN_REQUESTS = "requests in flight, of one client"
    PATHS = "paths"
    STATES = "queries for states or changes"


class EncodedReply(NamedTuple):
    """Encoded reply: its bytes, their encoding, and whether it is an answer or an error.

    about: joined digests of the client's avatars that the answer used, for the reply's seal.
    """

    payload: bytes
    encoding: str
    ok: bool
    about: bytes = b""


class FrameCommand(NamedTuple):
    """Motion command of one user in one frame.

    late: number of its motion commands dropped so far because a newer one had arrived.
    """

    user: User
    wish: Wish
    late: int = 0


class FrameResult(NamedTuple):
    """Result of a motion command in a frame.

    state: the user's new state, or an error.  about: as in `EncodedReply`.
    """

    user: User
    state: State | SolidcloudError
    about: bytes = b""


class LatestState(State, frozen=True, eq=False, kw_only=True):
    """The last state of a session's avatar, with its age.

    age: time since it arrived [s].
    """

    age: float

    def __repr__(self) -> str:
        """Return the state in one line, with its age."""
        return f"{State.__repr__(self)}, {self.age:.2g} s ago"


class Session:
    """Session of one avatar: sends motion commands, and keeps the states that result. Thread-safe.

    The sessions of `Scene` and `Client` inherit it. They implement `_next_number` and `_send`, call `_keep`
    with what results, and set `_open` while the session is open.
    """

    # Why no state came in time, for an error.
    _no_state = ""

    def __init__(self, scene: str, avatar: str, late: Late) -> None:
        """Create a session. late: of its motion commands, as in `Wish`."""
        self._scene, self._avatar, self._late = scene, avatar, late
        self._commands = threading.Lock()  # held from numbering to sending, to keep the order
        self._changed = threading.Condition()
        self._kept: deque[State | SolidcloudError] = deque(maxlen=_MAX_STATES)
        self._latest: State | None = None
        self._error: SolidcloudError | None = None  # newer than `_latest`
        self._received = 0.0  # time of `_latest`
        self._open = False

    def _next_number(self) -> int:
        """Return the number of the next motion command, above all before."""
        raise NotImplementedError

    def _send(self, wish: Wish) -> None:
        """Send a motion command. The caller holds `_commands`."""
        raise NotImplementedError

    def __repr__(self) -> str:
        """Return the avatar, the scene, and whether the session is open, in one line."""
        latest, begun = self._latest, "open" if self._open else "closed"
        state = "no state yet" if latest is None else f"{latest!r}, {monotonic() - self._received:.2g} s ago"
        return f"<Session of {self._avatar!r} in {self._scene!r}: {begun}, {state}>"

    def wish(
        self,
        pose: Any = None,
        velocity: Any = None,
        turn: float = 0.0,
        *,
        objects: Mapping[str, Any] | None = None,
        time: float | None = None,
    ) -> int:
        """Send a motion command with either a pose or a velocity; return its number.

        pose: (4, 4) or (1, 4, 4) float64.  velocity: (3,) [m/s].  turn: with a velocity, about the
        scene's up axis [rad/s].  objects: poses of the scene's objects that this user moves, by
        name.
        time: of the command, on a clock that does not go backwards [s]; None: this process's clock.
        The state that results has the number as `seq`. Of a session in this process it is there when
        this returns. Without a server, the command is lost and no states arrive: the last command is
        sent again every second, for at most 5 s, until its state arrives.
        Raise BadRequestError for an invalid command, or if the session is closed. `latest`, `wait` and
        `states` raise the error of a refused frame.
        """
        poses, speed = motion_fields(pose, velocity)
        moved = object_poses(objects)
        with self._commands:
            if not self._open:
                raise BadRequestError(
                    "this session is closed: wish inside `with scene.session(...) as session`"
                )
            wish = Wish(
                seq=self._next_number(),
                time=monotonic() if time is None else float(time),
                pose=poses,
                velocity=speed,
                turn=float(turn),
                objects=moved,
                late=self._late,
            )
            self._send(wish)
        return wish.seq

    def _keep(self, found: State | SolidcloudError) -> None:
        """Store a state or an error for `latest`, `wait` and `states`."""
        with self._changed:
            if isinstance(found, SolidcloudError):
                self._error = found
            else:
                self._latest, self._error, self._received = found, None, monotonic()
            self._kept.append(found)
            self._changed.notify_all()

    def _raise_error(self) -> None:
        """Raise, once, the last error since the last state. The caller holds `_changed`."""
        error, self._error = self._error, None
        if error is not None:
            raise error

    def latest(self) -> LatestState | None:
        """Return the last state, with its age; None before the first one.

        Raise, once, the last error since that state.
        """
        with self._changed:
            self._raise_error()
            if self._latest is None:
                return None
            return LatestState(**structs.asdict(self._latest), age=monotonic() - self._received)

    def wait(self, seq: int, timeout: float = 5.0) -> State:
        """Wait for the state of a motion command or of a newer one, and return it.

        Raise BusyError if none comes within `timeout` [s]. Raise, once, the last error since the last
        state.
        """

        def reached() -> bool:
            return self._latest is not None and self._latest.seq >= seq

        with self._changed:
            self._changed.wait_for(lambda: bool(self._error) or not self._open or reached(), timeout)
            self._raise_error()
            if self._latest is None or self._latest.seq < seq:
                raise BusyError(
                    f"no state of wish {seq} of avatar {self._avatar!r} in scene {self._scene!r} within "
                    f"{timeout:g} s{self._no_state}"
                )
            return self._latest

    def states(self, timeout: float = 5.0) -> Iterator[State]:
        """Yield states in order, until none comes for `timeout` [s] or the session is closed.

        At most 1,024 states are stored; the oldest are dropped. Raise an error at its place among the
        states.
        """
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._kept) or not self._open, timeout)
                if not self._kept:
                    return
                found = self._kept.popleft()
            if isinstance(found, SolidcloudError):
                raise found
            yield found


class ServedSimulation(Protocol):
    """Simulation of the frames of users that move in a scene; thread-safe."""

    @property
    def most_users(self) -> int: ...
    @property
    def users(self) -> list[User]: ...
    def step(
        self,
        turns: Sequence[FrameCommand],
        now: float | None = None,
        stop: StopFlag = NO_STOP,
    ) -> list[FrameResult]: ...
    def end(self, user: User) -> None: ...


class ServedWatch(Protocol):
    """Changes of what is resident of a scene, as `Scene.residency_changes` returns them."""

    def take(self, *, always: bool = False) -> ResidencyChanges | None: ...
    def close(self) -> None: ...


class AvatarShape(NamedTuple):
    """Shape of an avatar.

    points: (n, 3) in the avatar's frame [m].  radius: of each point's sphere [m]; None: half the
    mean closest-point distance of the points.
    inner_points: number of points that fill the inside of a mesh; they are the last ones.
    description: of what was taken from a file or mesh, and how; empty for points.
    """

    points: ArrayLike
    radius: float | None = None
    inner_points: int = 0
    description: str = ""

    @property
    def surface(self) -> NDArray[np.float64]:
        """Return the points (n, 3) of the surface [m]."""
        points = np.asarray(self.points, np.float64)
        return points[: len(points) - self.inner_points]


class ServedScene(Protocol):
    """Scene that answers a server's requests, or refuses them with a SolidcloudError. Thread-safe.

    `ask`, `path` and `move` take the parameters of the same methods of `Scene`. Each calls
    `record_avatar` in the calling thread for every avatar that it uses, before it returns.
    simulation: simulation of the users' frames; None for a scene without one.
    """

    name: str

    @property
    def simulation(self) -> ServedSimulation | None: ...
    def info(self) -> SceneInfo: ...
    def add_avatar(
        self, name: str, points: Any, radius: float | None = None, *, client: str = ""
    ) -> AvatarInfo: ...
    def ask(self, question: Question[_A], *arguments: Any, **options: Any) -> _A: ...
    def path(self, *what: Any, **parameters: Any) -> Iterator[Part]: ...
    def move(self, *what: Any, **parameters: Any) -> Moved: ...
    def limit_avatars(self, limits: AvatarLimits) -> None: ...
    def drop_unused_avatars(self, alive: Collection[str], seconds: float) -> None: ...
    def drop_client(self, client: str) -> None: ...
    def overview(self, limit: int = 100_000) -> OverviewAnswer: ...
    def voxels(self, place: Any, reach: float | None = None, limit: int = 4096) -> VoxelsAnswer: ...
    def tile(self, archive: int, voxel: Any, detail: int = 0, level: int | None = None) -> TileAnswer: ...
    def residency_changes(self) -> ServedWatch: ...
    def reload(self) -> ReloadAnswer: ...
    def stats(self, keys: bool = False) -> StatsAnswer: ...
    def warm(self, *parts: str) -> None: ...
    def close(self) -> None: ...


class _Recorded(threading.local):
    digests: list[bytes] | None = None


_RECORDED = _Recorded()


@contextmanager
def recording_avatars(digests: list[bytes]) -> Iterator[None]:
    """Make `record_avatar` append to `digests` in this thread, for a `with`.

    The seal of a reply names the avatars that the answer used (WIRE.md, "Seals"), so that a client
    can verify that they are those it added. An avatar is recorded when it is looked up, because it
    may be dropped and another added under its name while the answer is computed.
    """
    before, _RECORDED.digests = _RECORDED.digests, digests
    try:
        yield
    finally:
        _RECORDED.digests = before


def record_avatar(digest: bytes) -> None:
    """Record the digest of an avatar that was looked up; ignore the empty one of a scene avatar."""
    if digest and _RECORDED.digests is not None:
        _RECORDED.digests.append(digest)
