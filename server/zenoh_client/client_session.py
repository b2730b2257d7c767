"""Session of one avatar: sends many motion commands a second and receives the resulting states.

Motion commands (`Wish` on the wire) are published, and states arrive as replies to one long query
(state_query.py). No call waits for an answer, except `wait` and `states`.
"""

import logging
import math
import threading
from contextlib import ExitStack
from time import monotonic
from types import TracebackType
from typing import Any, Self

import zenoh

from ...schemas.errors import BadRequestError, SolidcloudError, UnknownAvatarError
from ...schemas.wire import key_expressions
from ...schemas.wire.encoding import MSGPACK, encode
from ...schemas.wire.motion_messages import Late, State, Wish
from ..runtime.threads import start_loop
from ..scene_interface import Session
from ..zenoh_common.endpoints import zenoh_words
from ..zenoh_common.zenoh_settings import FRAME_QOS
from .server_connection import ServerConnection
from .state_query import StateQuery, decode_reply

log = logging.getLogger(__name__)

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


class ClientSession(Session):
    """Session of one avatar, made by `Client.session`; a context manager, thread-safe.

    `states` yields the server's states and errors in order, `latest` returns the last one. Without
    a server no states arrive, and the age of `latest` grows. When a server answers again, the
    session continues at the pose of the last state.
    """

    _no_state = ": no server received it, or the server is slow: send further commands"

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
        super().__init__(scene, avatar, late)
        self._connection, self._numbers = connection, numbers
        self._session, self._user = connection.session, self._present_user()
        self._states = StateQuery(
            connection.session,
            key_expressions.state_key(scene, self._user),
            connection.anchor,
            lambda: connection.avatars.digests([avatar]),
        )
        self._target: Any = None  # the pose last commanded; None after a velocity
        self._time = 0.0
        self._published = -math.inf  # time of the last one, on the monotonic clock
        self._last: Wish | None = None  # as it was sent
        self._sent = -math.inf  # time at which it was first sent
        self._answered = 0  # number of the last motion command that the server replied to
        self._refusals = 0
        self._stack: ExitStack | None = None

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
            self._stack, self._open = stack.pop_all(), True
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
            with self._commands:
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
        with self._commands:
            stack, self._stack, self._open = self._stack, None, False
            if stack is not None:
                try:
                    self._publisher.delete()
                except zenoh.ZError as error:  # the client was closed before, which the server notices
                    log.debug("leaving: %s", error)
        if stack is not None:
            stack.close()
            with self._changed:
                self._changed.notify_all()

    def _next_number(self) -> int:
        return self._numbers.next()

    def _send(self, wish: Wish) -> None:
        """Send a motion command for the first time."""
        self._publish(wish)
        self._sent, self._time = self._published, wish.time
        if len(wish.pose):
            self._target = wish.pose
        elif self._latest is not None:
            self._target = None

    def _publish(self, wish: Wish) -> None:
        """Publish a motion command. The caller holds `_commands`."""
        if self._stack is None:
            raise BadRequestError("this session is closed: wish inside `with client.session(...) as session`")
        self._publisher.put(encode(wish))
        self._published, self._last = monotonic(), wish

    def _repeat(self) -> None:
        """Send the last motion command again if it, or its state, was dropped on the way."""
        with self._commands:
            last, now = self._last, monotonic()
            if last is None or last.seq <= self._answered or self._stack is None:
                return
            # A query that was sent just now may reach the server after the command. The answer would then
            # be a reply to the query before, which nobody reads any more.
            if now - self._states.sent < _REPEAT_SECONDS / 2:
                return
            if now - self._published >= _REPEAT_SECONDS and now - self._sent < _MAX_REPEAT_SECONDS:
                try:
                    self._publish(last)
                except zenoh.ZError as error:  # the client was closed before
                    log.debug("sending again: %s", error)

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
                self._answered = 0 if self._last is None else self._last.seq
            elif self._latest is not None and _is_same(found, self._latest):
                return  # the server sent it twice
            else:
                self._answered, self._refusals = max(self._answered, found.seq), 0
                self._numbers.follow(found.seq)
            super()._keep(found)

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
            with self._commands:
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
