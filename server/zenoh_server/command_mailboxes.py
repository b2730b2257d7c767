"""Motion commands on a server: queues, mailboxes and the thread that simulates frames.

Received motion commands (`Wish` on the wire) wait in `WaitingCommands` until they are decoded. A
mailbox for each user then holds its latest one. A thread empties all mailboxes, simulates one frame
and publishes the resulting states. It waits while there are no motion commands, so there are at
most as many frames as motion commands.
"""

import logging
import math
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from ...schemas.errors import BadRequestError, BusyError, SolidcloudError, TooLargeError
from ...schemas.wire.encoding import MSGPACK, decode_request, encode, wire_encoding
from ...schemas.wire.key_expressions import User
from ...schemas.wire.motion_messages import State, Wish
from ...schemas.wire.request_limits import MAX_COMMAND_BYTES
from ...schemas.wire.scene_messages import ErrorReply
from ..runtime.stop_flag import StopFlag
from ..runtime.threads import start_thread
from ..scene_interface import EncodedReply, FrameCommand, FrameResult, ServedSimulation
from .watchdog import Watchdog

log = logging.getLogger(__name__)

# Mailboxes for each user that a scene has room for: a user beyond its capacity receives an error in
# each frame.
_BOXES_A_USER = 2
# Interval at which the watchdog checks for long frames [s].
_LOOK_SECONDS = 0.05
_STOPS = "the server stops"
# Limits of one turn and of all turns [bytes]. Beyond them, the oldest motion commands of a turn are
# dropped, except its last one.
_MAX_BYTES_A_TURN, _MAX_BYTES = 1 << 20, 16 << 20
# Size of a motion command without its payload [bytes].
_OVERHEAD = 256

_WaitingCommand = tuple[User, Any, int]


class WaitingCommands:
    """Queue of motion commands for each turn. Not thread-safe.

    A turn is a client, or all clients without a liveliness token (fair_queues.py). If a turn
    exceeds its bytes, its oldest motion commands are dropped, because newer ones replace them
    anyway.
    """

    def __init__(self, turn: Callable[[str], str]) -> None:
        """Begin empty. turn: returns the turn of a client (fair_queues.py)."""
        self._turn = turn
        self._queues: OrderedDict[str, deque[_WaitingCommand]] = OrderedDict()  # the next turn first
        self._sizes: dict[str, int] = {}
        self._size = 0

    def put(self, user: User, wish: Any, size: int) -> None:
        """Add a motion command. size: of its payload [bytes]."""
        turn = self._turn(user.client)
        self._queues.setdefault(turn, deque()).append((user, wish, size + _OVERHEAD))
        self._count(turn, size + _OVERHEAD)
        queue = self._queues[turn]
        while len(queue) > 1 and (self._sizes[turn] > _MAX_BYTES_A_TURN or self._size > _MAX_BYTES):
            self._count(turn, -queue.popleft()[2])

    def take(self) -> tuple[User, Any] | None:
        """Remove and return the next motion command with its user; None if there is none."""
        if not self._queues:
            return None
        turn, queue = self._queues.popitem(last=False)
        user, wish, size = queue.popleft()
        self._count(turn, -size)
        if queue:
            self._queues[turn] = queue
        else:
            del self._sizes[turn]
        return user, wish

    def _count(self, turn: str, size: int) -> None:
        """Add `size` bytes to the counts."""
        self._sizes[turn] = self._sizes.get(turn, 0) + size
        self._size += size


class MailboxContents(NamedTuple):
    """Contents taken out of the mailboxes.

    left: users that leave; handled before the turns.
    encodings: encoding of each turn's motion command, also used for its state.
    """

    left: list[User]
    turns: list[FrameCommand]
    encodings: list[str]


class _Box:
    """Mailbox of one user.

    seq: number of the latest motion command received.  late: number of dropped motion commands.
    wish: the motion command that waits.
    """

    __slots__ = ("encoding", "late", "seq", "wish")

    def __init__(self) -> None:
        self.seq, self.late = -1, 0
        self.wish: Wish | None = None
        self.encoding = MSGPACK


class Mailboxes:
    """Latest motion command of each user. Thread-safe; bounded in total and for each turn."""

    def __init__(self, most: int, turn: Callable[[str], str] = str) -> None:
        """Make an empty set of mailboxes.

        most: limit of mailboxes at a time.
        turn: returns the turn of a client (fair_queues.py); by default each client has its own.
        """
        self._most, self._turn = most, turn
        self._boxes: dict[User, _Box] = {}
        self._waiting: dict[User, None] = {}  # users with a motion command, in order of arrival
        self._left: dict[User, None] = {}  # users that leave, each once
        self._closed = False
        self._changed = threading.Condition()

    def put(self, user: User, wish: Wish, encoding: str = MSGPACK) -> bool:
        """Store a motion command, replacing one that waits; drop and count an outdated one.

        Return whether it repeats the latest one. Raise BusyError if there is no room for another
        user.
        """
        with self._changed:
            box = self._boxes.get(user)
            if box is None:
                # One turn may take half of the mailboxes, so that some are always left for others.
                turn = self._turn(user.client)
                own = sum(self._turn(other.client) == turn for other in self._boxes)
                if len(self._boxes) >= self._most or own >= max(1, self._most // 2):
                    raise BusyError(
                        f"{len(self._boxes)} users move in this scene, {own} of this client (all clients without "
                        "a liveliness token count as one): try again later"
                    )
                box = self._boxes[user] = _Box()
            if wish.seq == box.seq:
                return True
            if wish.seq < box.seq:
                box.late += 1
                return False
            if box.wish is not None:
                box.late += 1
            box.seq, box.wish, box.encoding = wish.seq, wish, encoding
            self._waiting[user] = None
            self._changed.notify()
            return False

    def leave(self, user: User) -> None:
        """Queue the departure of a user; drop its waiting motion command.

        A user without a mailbox is ignored.
        """
        self._leave(lambda other: other == user)

    def leave_client(self, client: str) -> None:
        """Queue the departure of all users of a client."""
        self._leave(lambda user: user.client == client)

    def _leave(self, leaves: Callable[[User], bool]) -> None:
        with self._changed:
            users = [user for user in self._boxes if leaves(user)]
            self._forget(users)
            self._left.update(dict.fromkeys(users))
            self._changed.notify()

    def keep(self, users: Iterable[User]) -> None:
        """Remove the mailboxes of all users but these and those whose motion commands wait."""
        with self._changed:
            kept = {*users, *self._waiting}
            self._forget([user for user in self._boxes if user not in kept])

    def _forget(self, users: list[User]) -> None:
        for user in users:
            self._boxes.pop(user, None)
            self._waiting.pop(user, None)

    def take(self) -> MailboxContents | None:
        """Wait until a mailbox has contents and take all; return None once closed and empty."""
        with self._changed:
            while not (self._waiting or self._left or self._closed):
                self._changed.wait()
            if not (self._waiting or self._left):
                return None
            post = MailboxContents(list(self._left), [], [])
            for user in self._waiting:
                box = self._boxes[user]
                assert box.wish is not None, "only mailboxes with a motion command wait"
                post.turns.append(FrameCommand(user, box.wish, box.late))
                post.encodings.append(box.encoding)
                box.wish = None
            self._waiting, self._left = {}, {}
            return post

    def close(self) -> None:
        """Mark the mailboxes as closed; `take` still returns what waits."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __len__(self) -> int:
        """Return the number of mailboxes."""
        with self._changed:
            return len(self._boxes)


class FrameLoop:
    """Sessions of one scene: encoded motion commands in, encoded states out. No method raises."""

    def __init__(
        self,
        simulation: ServedSimulation,
        publish: Callable[[User, EncodedReply], None],
        max_seconds: float = math.inf,
        turn: Callable[[str], str] = str,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        """Make mailboxes for the users of a simulation.

        publish: sends a user's state, or the reason why there is none; must not block.
        max_seconds: time limit of one frame of all users; users not yet simulated by then keep
        their poses.  turn: as in `Mailboxes`.
        check: raises SolidcloudError while no motion commands are accepted.
        """
        self._simulation, self._publish, self._max_seconds = simulation, publish, max_seconds
        self._at_work: tuple[float, StopFlag] | None = None  # start and stop flag of the running frame
        self._watchdog = Watchdog(self._look, period=_LOOK_SECONDS)
        self.most_users = simulation.most_users
        self._boxes = Mailboxes(_BOXES_A_USER * simulation.most_users, turn)
        self._check, self._given_up = check, False

    def wish(self, user: User, payload: bytes, encoding: str | None) -> bool:
        """Store a motion command or refuse it; return whether it repeats the user's latest one."""
        try:
            if not self.fits(user, len(payload), encoding):
                return False
            self._check()
            stated = wire_encoding(encoding)
            return self._boxes.put(user, decode_request(Wish, payload, stated), stated)
        except SolidcloudError as error:
            self._send(user, error, encoding)
            return False

    def fits(self, user: User, size: int, encoding: str | None) -> bool:
        """Return whether a motion command of `size` bytes is accepted; refuse it otherwise."""
        if size > MAX_COMMAND_BYTES:
            self._send(
                user, TooLargeError(f"motion command of {size} bytes: at most {MAX_COMMAND_BYTES}"), encoding
            )
        return size <= MAX_COMMAND_BYTES

    def leave(self, user: User) -> None:
        """Remove a user from the scene with the next frame."""
        self._boxes.leave(user)

    def client_gone(self, client: str) -> None:
        """Remove all users of a client from the scene with the next frame."""
        self._boxes.leave_client(client)

    def run(self) -> None:
        """Simulate frames until `close`. Runs in a thread."""
        watching = start_thread("frames-watchdog", self._watchdog.run)
        try:
            while (post := self._boxes.take()) is not None:
                try:
                    self._frame(post)
                except Exception:  # affects this frame only
                    log.exception("a frame of %d users failed", len(post.turns))
        finally:
            self._watchdog.close()
            watching.join()

    def _look(self, now: float) -> bool:
        """Stop a frame that has taken too long; return whether a frame is running."""
        if (at_work := self._at_work) is None:
            return False
        begun, stop = at_work
        if now - begun >= self._max_seconds:
            stop.set(f"the frame took longer than {self._max_seconds:g} s")
        return True

    def _frame(self, post: MailboxContents) -> None:
        """Simulate one frame and publish its states."""
        for user in post.left:
            self._simulation.end(user)
        if post.turns:
            outcomes = self._step(post.turns)
            for outcome, encoding in zip(outcomes, post.encodings, strict=True):
                self._send(outcome.user, outcome.state, encoding, outcome.about)
        users = self._simulation.users
        if len(self._boxes) > len(users):
            self._boxes.keep(users)

    def _step(self, turns: list[FrameCommand]) -> list[FrameResult]:
        """Simulate one frame; the watchdog stops it if it takes too long."""
        stop, now = StopFlag(), time.monotonic()
        self._at_work = now, stop
        if self._given_up:  # read after `_at_work` is set, so that `give_up` finds the flag
            stop.set(_STOPS)
        if self._watchdog.asleep:
            self._watchdog.wake()
        try:
            return self._simulation.step(turns, now, stop)
        finally:
            self._at_work = None

    def _send(
        self, user: User, said: State | SolidcloudError, encoding: str | None, about: bytes = b""
    ) -> None:
        """Publish a state or an error to a user; log a failure, because no caller waits for it.

        about: as in `EncodedReply`.
        """
        try:
            stated = wire_encoding(encoding)
        except BadRequestError:
            stated = MSGPACK
        try:
            if isinstance(said, SolidcloudError):
                reply = ErrorReply(said.code, str(said))
                self._publish(user, EncodedReply(encode(reply, stated), stated, False, about))
            else:
                self._publish(user, EncodedReply(encode(said, stated), stated, True, about))
        except Exception:
            log.exception("cannot send the state of %s of client %s", user.avatar, user.client)

    def close(self) -> None:
        """End `run` after the motion commands received so far; stop a running frame early."""
        self._boxes.close()
        self._stop_frame()

    def give_up(self) -> None:
        """Stop the running frame early, and each one after it."""
        self._given_up = True
        self._stop_frame()

    def _stop_frame(self) -> None:
        """Stop the running frame early, if there is one."""
        if (at_work := self._at_work) is not None:
            at_work[1].set(_STOPS)
