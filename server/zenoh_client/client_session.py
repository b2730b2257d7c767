"""A session: one avatar of a client that wishes many times a second, and hears where it got to.

Over zenoh, beside the questions of `Client`: wishes go out and states come in without anybody waiting for an answer.
"""

import logging
import math
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from time import monotonic
from types import TracebackType
from typing import Any, Self

import numpy as np
import zenoh

from ...schemas.errors import BadRequestError, BusyError, SolidcloudError, UnknownAvatarError, error_from_code
from ...schemas.wire import key_expressions
from ...schemas.wire.encoding import MSGPACK, decode_answer, encode
from ...schemas.wire.motion_messages import State, Wish
from ...schemas.wire.scene_messages import ErrorReply
from ..scene_interface import LatestState
from ..zenoh_common.endpoints import zenoh_words
from ..zenoh_common.sealed_replies import OtherAvatarError, TrustAnchor
from ..zenoh_common.zenoh_settings import FRAME_QOS
from .state_query import StateQuery

log = logging.getLogger(__name__)

# States kept for whoever asks for each of them: some ten seconds; of more, the oldest go.
_KEPT = 1024
# Numbers beyond this are not followed: a wish's is an int64 in most programs.
_MOST_NUMBER = 1 << 62
# How long a wish may be without a state before it is sent once more, and how long it is worth sending [s].
_PATIENCE, _MOST_PATIENCE = 1.0, 5.0
# Refusals in a row that a server is told of an avatar again for: one that refuses it all the same is at fault.
_MOST_AGAIN = 100


class WishNumbers:
    """The numbers of one user's wishes, growing. Thread-safe."""

    def __init__(self) -> None:
        self._last = 0
        self._lock = threading.Lock()

    def next(self) -> int:
        """Return a number above all before."""
        with self._lock:
            self._last += 1
            return self._last

    def follow(self, seq: int) -> None:
        """Go on above a number that the server has had, from another program of the same client perhaps.

        The server drops a wish whose number is no greater than the last one's.
        """
        with self._lock:
            if self._last < seq < _MOST_NUMBER:
                self._last = seq


class ClientSession:
    """One avatar's session; made by `Client.session`, a context manager, thread-safe.

    What the server says comes to `states`, each in its order, and to `latest`. While no server answers there are none,
    and `latest` grows old; once there is one again, it goes on from where the last state left the avatar.
    """

    def __init__(
        self,
        session: zenoh.Session,
        scene: str,
        user: Callable[[], key_expressions.User],
        numbers: "WishNumbers",
        anchor: TrustAnchor,
        about: Callable[[], bytes | None],
        add_again: Callable[[UnknownAvatarError], bool],
    ) -> None:
        """Make a session; entering it begins it.

        user: returns who wishes: the client may take another id.  numbers: of wishes, growing over all sessions of this
        user.  about: as in `SealedQuery`.  add_again: adds the avatar to a server that does not know it; False: nobody
        answered; raises what it is given where this client has not added it either.
        """
        self._session, self._scene, self._user_now, self._user = session, scene, user, user()
        self._numbers, self._add_again = numbers, add_again
        self._states = StateQuery(session, key_expressions.state_key(scene, self._user), anchor, about)
        self._publishing = threading.Lock()  # so that wishes leave in the order of their numbers
        self._aim: Any = None  # the pose last wished, until a velocity goes on from a state
        self._time = 0.0
        self._wished = -math.inf  # when, on the monotonic clock
        self._last: Wish | None = None  # as it was sent
        self._sent = -math.inf  # when, for the first time
        self._answered = 0  # the number of the last wish that the server said something of
        self._changed = threading.Condition()
        self._kept: deque[State | SolidcloudError] = deque(maxlen=_KEPT)
        self._latest: State | None = None
        self._error: SolidcloudError | None = None  # newer than `_latest`
        self._when = -math.inf
        self._again = 0
        self._stack: ExitStack | None = None

    def __enter__(self) -> Self:
        thread = threading.Thread(
            target=self._hear, name=f"solidcloud-session-{self._user.avatar}", daemon=True
        )
        with ExitStack() as stack:
            try:
                self._states.open()
                stack.callback(self._states.close)
                self._publisher = self._declare_publisher()
                stack.callback(self._undeclare_publisher)
            except zenoh.ZError as error:
                raise BadRequestError(
                    f"session of avatar {self._user.avatar!r} in scene {self._scene!r}: {zenoh_words(error)}: expected "
                    "an open client: begin it inside `with Client(...) as scene`"
                ) from None
            thread.start()
            # The thread ends once it has heard what came until the end.
            stack.callback(thread.join)
            stack.callback(self._states.end)
            self._stack = stack.pop_all()
        return self

    def _declare_publisher(self) -> zenoh.Publisher:
        """Return what publishes the wishes of the present user."""
        return self._session.declare_publisher(
            key_expressions.command_key(self._scene, self._user), encoding=MSGPACK, **FRAME_QOS
        )

    def _undeclare_publisher(self) -> None:
        try:
            self._publisher.undeclare()
        except zenoh.ZError as error:  # the client was closed before
            log.debug("leaving: %s", error)

    def _follow_client(self) -> None:
        """Wish and hear under the client's id, where it took another. Work of the thread that hears."""
        user = self._user_now()
        if user == self._user:
            return
        try:
            with self._publishing:
                if self._stack is None:
                    return
                self._publisher.delete()  # others may walk where the avatar stood
                self._undeclare_publisher()
                self._user = user
                self._publisher = self._declare_publisher()
            self._states.move(key_expressions.state_key(self._scene, user))
        except zenoh.ZError as error:  # the client is being closed
            log.debug("following: %s", error)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the scene: others may walk where the avatar stood. Closing twice is allowed."""
        with self._publishing:
            stack, self._stack = self._stack, None
            if stack is not None:
                try:
                    self._publisher.delete()
                except zenoh.ZError as error:  # the client was closed before: the server sees that by itself
                    log.debug("leaving: %s", error)
        if stack is not None:
            stack.close()
            with self._changed:
                self._changed.notify_all()

    def wish(
        self,
        pose: Any = None,
        velocity: Any = None,
        turn: float = 0.0,
        *,
        objects: dict[str, list[list[float]]] | None = None,
        time: float | None = None,
    ) -> int:
        """Wish to be at a pose, (4, 4) or (1, 4, 4) float64, or to go at a velocity (3,) [m/s]; one of the two.

        Returns the number of the wish, which its state has as `seq`. turn: with a velocity, about the scene's up axis
        [rad/s].  objects: poses of the scene's objects that this user moves.  time: of the wish, on a clock of the
        caller's that does not go back [s]; None: this process's. What no server hears is lost, and nothing says so but
        that no states come: wish on. The last wish is sent again each second, for 5 s at most, until a state of it
        comes. BadRequestError: what is no wish, or the session is closed.
        """
        array = np.empty((0, 4, 4)) if pose is None else np.asarray(pose, np.float64).reshape(-1, 4, 4)
        speed = None if velocity is None else tuple(float(part) for part in velocity)
        if speed is not None and len(speed) != 3:
            raise BadRequestError(f"velocity of {len(speed)} numbers: expected 3 [m/s]")
        with self._publishing:
            wish = Wish(
                seq=self._numbers.next(),
                time=monotonic() if time is None else float(time),
                pose=np.ascontiguousarray(array),
                velocity=speed,  # type: ignore[arg-type]
                turn=float(turn),
                objects=objects or {},
            )
            self._publish(wish)
            self._sent, self._time = self._wished, wish.time
            if len(wish.pose):
                self._aim = wish.pose
            elif self._latest is not None:
                self._aim = None
        return wish.seq

    def _publish(self, wish: Wish) -> None:
        """Send a wish. To be called with `_publishing` held."""
        if self._stack is None:
            raise BadRequestError("this session is closed: wish inside `with client.session(...) as session`")
        self._publisher.put(encode(wish))
        self._wished, self._last = monotonic(), wish

    def _wish_again(self) -> None:
        """Send the last wish once more where nothing came of it: it, or its state, was dropped on the way."""
        with self._publishing:
            last, now = self._last, monotonic()
            if last is None or last.seq <= self._answered or self._stack is None:
                return
            if now - self._wished >= _PATIENCE and now - self._sent < _MOST_PATIENCE:
                try:
                    self._publish(last)
                except zenoh.ZError as error:  # the client was closed before
                    log.debug("wishing again: %s", error)

    def latest(self) -> LatestState | None:
        """The last state that came, and its age; None: none came yet. Raises, once, what the server refused since."""
        with self._changed:
            self._raise_error()
            return None if self._latest is None else LatestState(self._latest, monotonic() - self._when)

    def wait(self, seq: int, timeout: float = 5.0) -> State:
        """The state of a wish, or of a newer one, waited for. BusyError: none came within `timeout` [s].

        Raises, once, what the server refused since the last state.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: bool(self._error) or self._stack is None or self._reached(seq), timeout
            )
            self._raise_error()
            if self._latest is None or self._latest.seq < seq:
                raise BusyError(
                    f"no state of wish {seq} of avatar {self._user.avatar!r} in scene {self._scene!r} within "
                    f"{timeout:g} s: no server heard it, or it is behind: wish on"
                )
            return self._latest

    def _raise_error(self) -> None:
        """Raise, once, what the server refused since the last state. To be called with `_changed` held."""
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _reached(self, seq: int) -> bool:
        """Whether the state of a wish came. To be called with `_changed` held."""
        return self._latest is not None and self._latest.seq >= seq

    def states(self, timeout: float = 5.0) -> Iterator[State]:
        """Each state as it comes, in order, until none came for `timeout` [s] or the session is closed.

        Of more than 1,024 that nobody took, the oldest are left out. Raises what the server refused, where it stands
        among them.
        """
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._kept) or self._stack is None, timeout)
                if not self._kept:
                    return
                said = self._kept.popleft()
            if isinstance(said, SolidcloudError):
                raise said
            yield said

    def _hear(self) -> None:
        """Take what comes. A thread's work."""
        while (came := self._states.take(lambda: self._wished)) is not None:
            unknown: UnknownAvatarError | None = None
            for each in came:
                said = _said(each)
                if isinstance(said, UnknownAvatarError):
                    unknown = said
                else:
                    self._keep(said)
            if unknown is not None:
                self._begin_again(unknown)
            self._follow_client()
            self._wish_again()

    def _keep(self, said: State | SolidcloudError) -> None:
        """Have what the server says where it is asked for."""
        with self._changed:
            if isinstance(said, SolidcloudError):
                self._error = said
                self._answered = 0 if self._last is None else self._last.seq
            elif self._latest is not None and _same(said, self._latest):
                return  # sent once more
            else:
                self._answered = max(self._answered, said.seq)
                self._latest, self._error = said, None
                self._numbers.follow(said.seq)
                self._when, self._again = monotonic(), 0
            self._kept.append(said)
            self._changed.notify_all()

    def _begin_again(self, unknown: UnknownAvatarError) -> None:
        """Come to a server that does not know the avatar, or where it is, or that has another of its name.

        It was restarted, took us for gone, or a velocity took the place of the pose that was to be the first wish.
        """
        self._again += 1
        try:
            try:
                if not self._add_again(unknown):
                    return  # nobody answered; the next wish asks again
                self._follow_client()
            except UnknownAvatarError:
                if self._latest is None:  # neither this client's nor the scene's
                    raise
            with self._publishing:
                pose = self._where()
                if pose is None or self._again > _MOST_AGAIN:
                    raise unknown
                if self._stack is not None:
                    # Alone: a velocity behind it might take its place once more. It is one frame's way.
                    self._publish(Wish(seq=self._numbers.next(), time=self._time, pose=pose))
        except SolidcloudError as error:
            self._keep(error)

    def _where(self) -> Any:
        """The pose (1, 4, 4) last wished, or where the avatar was when the server last said so; None: neither."""
        if self._aim is not None:
            return self._aim
        return None if self._latest is None else self._latest.pose.copy()


def _same(one: State, other: State) -> bool:
    """Return whether two states are of the same frame of the same wish."""
    return (one.seq, one.time, one.frame) == (other.seq, other.time, other.frame)


def _said(came: tuple[bool, bytes] | OtherAvatarError) -> State | SolidcloudError:
    """Return what the server says; an error where it cannot be read."""
    if isinstance(came, OtherAvatarError):
        return came
    ok, payload = came
    try:
        return decode_answer(State, payload) if ok else _error_of(payload)
    except SolidcloudError as error:
        return error


def _error_of(payload: bytes) -> SolidcloudError:
    """What a refusal says."""
    reply = decode_answer(ErrorReply, payload)
    return error_from_code(reply.code, reply.message)
