"""Protocols of a served scene: answers requests and simulates frames."""

from collections.abc import Collection, Iterator, Sequence
from enum import Enum
from typing import Any, NamedTuple, Protocol, TypeVar

from ...schemas.errors import SolidcloudError
from ...schemas.wire.answers import Cost, Part
from ...schemas.wire.keys import User
from ...schemas.wire.messages import AvatarInfo, ReloadAnswer, SceneInfo, StatsAnswer
from ...schemas.wire.moves import Moved, State, Wish
from ...schemas.wire.questions import Question
from ..runtime.stop_flag import Stop
from .avatar_limits import AvatarLimits

_A = TypeVar("_A", bound=Cost)


class Full(Enum):
    """Limit of a server that is reached."""

    REQUESTS = "requests in flight, of all clients"
    OWN_REQUESTS = "requests in flight, of one client"
    PATHS = "paths"
    STATES = "queries for states"


class Answer(NamedTuple):
    """Encoded reply: its bytes, their encoding, and whether it is an answer or an error.

    about: the joined digests of the client's own avatars that answered; the seal names them.
    """

    payload: bytes
    encoding: str
    ok: bool
    about: bytes = b""


class Turn(NamedTuple):
    """Motion command of one user in one frame.

    late: number of its motion commands dropped so far because a newer one had arrived.
    """

    user: User
    wish: Wish
    late: int = 0


class Outcome(NamedTuple):
    """Result of a turn. state: the user's new state, or an error.  about: as in `Answer`."""

    user: User
    state: State | SolidcloudError
    about: bytes = b""


class Latest(NamedTuple):
    """The last state of a session's avatar, and how long ago it came [s]."""

    state: State
    age: float


class Simulates(Protocol):
    """Simulation of the frames of users that move in a scene; thread-safe."""

    @property
    def most_users(self) -> int: ...
    @property
    def users(self) -> list[User]: ...
    def step(
        self,
        turns: Sequence[Turn],
        now: float | None = None,
        *,
        stops: Sequence[Stop] | None = None,
    ) -> list[Outcome]: ...
    def end(self, user: User) -> None: ...
    def end_client(self, client: str) -> None: ...
    def warm(self) -> None: ...


class SceneLike(Protocol):
    """Scene that answers a service's requests; thread-safe. Refuses one with a SolidcloudError.

    `ask`, `path` and `move` take the parameters of those of `Scene`. Each notes the avatars that answer
    (answering_avatars.py) in the calling thread, before it returns.
    simulation: of its users' frames; None if it has none.
    """

    name: str

    @property
    def simulation(self) -> Simulates | None: ...
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
    def reload(self) -> ReloadAnswer: ...
    def stats(self, keys: bool = False) -> StatsAnswer: ...
    def warm(self) -> None: ...
    def close(self) -> None: ...
