"""Session of one avatar: sends many motion commands a second and receives the resulting states.

Motion commands (`Wish` on the wire) are published, and states arrive as replies to one long query
(state_query.py). No call waits for an answer, except `wait` and `states`.
"""

import logging
import math
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from time import monotonic
from types import TracebackType
from typing import Any, Self

import zenoh

from ...schemas.errors import BadRequestError, BusyError, SolidcloudError, UnknownAvatarError
from ...schemas.wire import key_expressions
from ...schemas.wire.encoding import MSGPACK, encode
from ...schemas.wire.motion_messages import Late, State, Wish, motion_fields, object_poses
from ..runtime.threads import start_loop
from ..scene_interface import LatestState
from ..zenoh_common.endpoints import zenoh_words
from ..zenoh_common.zenoh_settings import FRAME_QOS
from .server_connection import ServerConnection
from .state_query import StateQuery, decode_reply

log = logging.getLogger(__name__)

# States stored for `states`: some ten seconds. The oldest are dropped.
_MAX_STATES = 1024
# Largest number of a motion command that `CommandNumbers.follow` accepts. Most programs store it as
# int64, which must not overflow.
_MAX_NUMBER = 1 << 62
# Interval at which a motion command without a resulting state is sent again, and for how long [s].
_REPEAT_SECONDS, _MAX_REPEAT_SECONDS = 1.0, 5.0
# Number of consecutive refusals of motion commands after each of which the avatar is added again.
_MAX_REFUSALS = 100


class CommandNumbers:
    """Increasing numbers of one user's motion commands. Thread-safe."""

    def __init__(self) -> None:
        self._last = 0
        self._lock = threading.Lock()

    def next(self) -> int:
        """Return a number above all previous ones."""
        with self._lock:
            self._last += 1
            return self._last

    def follow(self, seq: int) -> None:
        """Continue above a number that the server has received, perhaps from another program.

        The server drops a motion command whose number is not greater than the last one's.
        """
        with self._lock:
            if self._last < seq < _MAX_NUMBER:
                self._last = seq


class ClientSession:
    """Session of one avatar, made by `Client.session`; a context manager, thread-safe.

    `states` yields the server's states and errors in order, `latest` returns the last one. Without
    a server no states arrive, and the age of `latest` grows. When a server answers again, the
    session continues at the pose of the last state.
    """

    def __init__(
        self,
        connection: ServerConnection,
        scene: str,
        avatar: str,
        numbers: CommandNumbers,
        late: Late = "wait",
    ) -> None:
        """Make a session; entering it begins it.

        numbers: of motion commands, increasing over all sessions of this avatar.  late: of its
        motion commands, as in `Wish`.
        """
        self._late = late
        self._connection, self._scene, self._avatar, self._numbers = connection, scene, avatar, numbers
        self._session, self._user = connection.session, self._present_user()
        self._states = StateQuery(
            connection.session,
            key_expressions.state_key(scene, self._user),
            connection.anchor,
            lambda: connection.avatars.digests([avatar]),
        )
        self._publishing = threading.Lock()  # held from numbering to sending, to keep the order
        self._target: Any = None  # the pose last commanded; None after a velocity
        self._time = 0.0
        self._published = -math.inf  # time of the last one, on the monotonic clock
        self._last: Wish | None = None  # as it was sent
        self._sent = -math.inf  # time at which it was first sent
        self._answered = 0  # number of the last motion command that the server replied to
        self._changed = threading.Condition()
        self._kept: deque[State | SolidcloudError] = deque(maxlen=_MAX_STATES)
        self._latest: State | None = None
        self._error: SolidcloudError | None = None  # newer than `_latest`
        self._received = -math.inf  # time of `_latest`
        self._refusals = 0
        self._stack: ExitStack | None = None

    def __repr__(self) -> str:
        """Return the avatar, the scene, and whether the session is open, in one line."""
        latest, begun = self._latest, "closed" if self._stack is None else "open"
        state = "no state yet" if latest is None else f"{latest!r}, {monotonic() - self._received:.2g} s ago"
        return f"<Session of {self._avatar!r} in {self._scene!r}: {begun}, {state}>"

    def _present_user(self) -> key_expressions.User:
        """Return the user of this session under the client's present id."""
        return key_expressions.User(self._connection.client_id, self._avatar)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            try:
                self._states.open()
                stack.callback(self._states.close)
                self._publisher = self._declare_publisher()
                stack.callback(self._undeclare_publisher)
            except zenoh.ZError as error:
                raise BadRequestError(
                    f"session of avatar {self._avatar!r} in scene {self._scene!r}: {zenoh_words(error)}: expected "
                    "an open client: begin it inside `with Client(...) as scene`"
                ) from None
            thread = start_loop(f"session-{self._avatar}", self._receive)
            # The thread ends after it has taken everything that arrived before the end.
            stack.callback(thread.join)
            stack.callback(self._states.end)
            self._stack = stack.pop_all()
        return self

    def _declare_publisher(self) -> zenoh.Publisher:
        """Return a publisher of the present user's motion commands."""
        return self._session.declare_publisher(
            key_expressions.command_key(self._scene, self._user), encoding=MSGPACK, **FRAME_QOS
        )

    def _undeclare_publisher(self) -> None:
        try:
            self._publisher.undeclare()
        except zenoh.ZError as error:  # the client was closed before
            log.debug("leaving: %s", error)

    def _follow_client(self) -> None:
        """Continue under the client's new id if it has taken one. Runs in the receiving thread."""
        user = self._present_user()
        if user == self._user:
            return
        try:
            with self._publishing:
                if self._stack is None:
                    return
                self._publisher.delete()  # ends the avatar's body under the old id
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
        """Leave the scene: the server removes the avatar's body. Closing twice is allowed."""
        with self._publishing:
            stack, self._stack = self._stack, None
            if stack is not None:
                try:
                    self._publisher.delete()
                except zenoh.ZError as error:  # the client was closed before, which the server notices
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
        objects: Mapping[str, Any] | None = None,
        time: float | None = None,
    ) -> int:
        """Send a motion command with either a pose or a velocity; return its number.

        pose: (4, 4) or (1, 4, 4) float64.  velocity: (3,) [m/s].  turn: with a velocity, about the
        scene's up axis [rad/s].  objects: poses of the scene's objects that this user moves, by
        name.
        time: of the command, on a clock that does not go backwards [s]; None: this process's clock.
        The state that results has the number as `seq`. Without a server, the command is lost and no
        states arrive. The last command is sent again every second, for at most 5 s, until its state
        arrives. Raise BadRequestError for an invalid command, or if the session is closed.
        """
        poses, speed = motion_fields(pose, velocity)
        moved = object_poses(objects)
        with self._publishing:
            wish = Wish(
                seq=self._numbers.next(),
                time=monotonic() if time is None else float(time),
                pose=poses,
                velocity=speed,
                turn=float(turn),
                objects=moved,
                late=self._late,
            )
            self._publish(wish)
            self._sent, self._time = self._published, wish.time
            if len(wish.pose):
                self._target = wish.pose
            elif self._latest is not None:
                self._target = None
        return wish.seq

    def _publish(self, wish: Wish) -> None:
        """Publish a motion command. The caller holds `_publishing`."""
        if self._stack is None:
            raise BadRequestError("this session is closed: wish inside `with client.session(...) as session`")
        self._publisher.put(encode(wish))
        self._published, self._last = monotonic(), wish

    def _repeat(self) -> None:
        """Send the last motion command again if it, or its state, was dropped on the way."""
        with self._publishing:
            last, now = self._last, monotonic()
            if last is None or last.seq <= self._answered or self._stack is None:
                return
            if now - self._published >= _REPEAT_SECONDS and now - self._sent < _MAX_REPEAT_SECONDS:
                try:
                    self._publish(last)
                except zenoh.ZError as error:  # the client was closed before
                    log.debug("sending again: %s", error)

    def latest(self) -> LatestState | None:
        """Return the last state, with its age; None before the first one.

        Raise, once, the last error since that state.
        """
        with self._changed:
            self._raise_error()
            return (
                None if self._latest is None else LatestState.of(self._latest, monotonic() - self._received)
            )

    def wait(self, seq: int, timeout: float = 5.0) -> State:
        """Wait for the state of a motion command or of a newer one, and return it.

        Raise BusyError if none arrives within `timeout` [s]. Raise, once, the last error since the
        last state.
        """
        with self._changed:
            self._changed.wait_for(
                lambda: bool(self._error) or self._stack is None or self._reached(seq), timeout
            )
            self._raise_error()
            if self._latest is None or self._latest.seq < seq:
                raise BusyError(
                    f"no state of wish {seq} of avatar {self._avatar!r} in scene {self._scene!r} within "
                    f"{timeout:g} s: no server received it, or the server is slow: send further commands"
                )
            return self._latest

    def _raise_error(self) -> None:
        """Raise, once, the last error since the last state. The caller holds `_changed`."""
        error, self._error = self._error, None
        if error is not None:
            raise error

    def _reached(self, seq: int) -> bool:
        """Return whether the state of a motion command has arrived. The caller holds `_changed`."""
        return self._latest is not None and self._latest.seq >= seq

    def states(self, timeout: float = 5.0) -> Iterator[State]:
        """Yield states in order, until none arrives for `timeout` [s] or the session is closed.

        At most 1,024 states are stored; the oldest are dropped. Raise an error of the server at its
        place among the states.
        """
        while True:
            with self._changed:
                self._changed.wait_for(lambda: bool(self._kept) or self._stack is None, timeout)
                if not self._kept:
                    return
                found = self._kept.popleft()
            if isinstance(found, SolidcloudError):
                raise found
            yield found

    def _receive(self) -> None:
        """Take states and errors until the session ends. Runs in a thread."""
        while (replies := self._states.take(lambda: self._published)) is not None:
            unknown: UnknownAvatarError | None = None
            for reply in replies:
                found = decode_reply(State, reply)
                if isinstance(found, UnknownAvatarError):
                    unknown = found
                else:
                    self._keep(found)
            if unknown is not None:
                self._begin_again(unknown)
            self._follow_client()
            self._repeat()

    def _keep(self, found: State | SolidcloudError) -> None:
        """Store a state or an error for the methods that return it."""
        with self._changed:
            if isinstance(found, SolidcloudError):
                self._error = found
                self._answered = 0 if self._last is None else self._last.seq
            elif self._latest is not None and _is_same(found, self._latest):
                return  # the server sent it twice
            else:
                self._answered = max(self._answered, found.seq)
                self._latest, self._error = found, None
                self._numbers.follow(found.seq)
                self._received, self._refusals = monotonic(), 0
            self._kept.append(found)
            self._changed.notify_all()

    def _begin_again(self, unknown: UnknownAvatarError) -> None:
        """Add the avatar and send its pose again to a server that does not know them.

        unknown: the server's error; stored for the caller if there is no pose to send, or after too
        many attempts. The server was restarted, has dropped this client's avatars or has another
        avatar of the name. Or a velocity replaced the first motion command, which had the pose.
        """
        self._refusals += 1
        try:
            try:
                if not self._connection.add_again([self._avatar], unknown):
                    return  # no server answers; the next motion command causes another attempt
                self._follow_client()
            except UnknownAvatarError:
                if self._latest is None:  # neither this client's avatar nor the scene's
                    raise
            with self._publishing:
                pose = self._last_pose()
                if pose is None or self._refusals > _MAX_REFUSALS:
                    raise unknown
                if self._stack is not None:
                    # Without a velocity, which might replace the pose again.
                    self._publish(Wish(seq=self._numbers.next(), time=self._time, pose=pose))
        except SolidcloudError as error:
            self._keep(error)

    def _last_pose(self) -> Any:
        """Return the pose (1, 4, 4) last commanded, or of the last state; None without both."""
        if self._target is not None:
            return self._target
        return None if self._latest is None else self._latest.pose.copy()


def _is_same(one: State, other: State) -> bool:
    """Return whether two states are of the same frame of the same motion command."""
    return (one.seq, one.time, one.frame) == (other.seq, other.time, other.frame)
