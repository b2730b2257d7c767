"""Frames: the wishes of users on their way to a simulation, and their states on the way back. No zenoh here.

A mailbox for each user holds its latest wish; a thread empties all of them, has one frame simulated, and publishes what
came of it. It waits while nobody wishes, so that frames come at most as fast as wishes do.
"""

import logging
import math
import threading
import time
from collections.abc import Callable, Iterable
from typing import NamedTuple

from ...schemas.errors import BadRequestError, BusyError, SolidcloudError, TooLargeError
from ...schemas.wire.encoding import MSGPACK, decode_request, encode, wire_encoding
from ...schemas.wire.keys import User
from ...schemas.wire.messages import ErrorReply
from ...schemas.wire.moves import State, Wish
from ..runtime.stop_flag import Stop
from ..runtime.threads import start_thread
from ..runtime.watchdog import Watchdog
from ..served.served_scene import Answer, Outcome, Simulates, Turn

log = logging.getLogger(__name__)

# Mailboxes for each user that a scene has room for: who comes when it is full is told so, frame by frame.
_BOXES_A_USER = 2
# How often the thread that ends long frames looks [s].
_LOOK_SECONDS = 0.05
_STOPS = "the server stops"
# Of a wish: 2,048 objects take less as MessagePack. What is more is not read, and comes into no log.
_MOST_BYTES = 512 << 10


class Post(NamedTuple):
    """What was taken out of mailboxes. left, gone: users and clients that leave, before the turns.

    encodings: of each turn's wish, which its state is to have.
    """

    left: list[User]
    gone: list[str]
    turns: list[Turn]
    encodings: list[str]


class _Box:
    """One user's mailbox. seq: of the latest wish ever.  late: wishes dropped.  wish: the one that waits."""

    __slots__ = ("encoding", "late", "seq", "wish")

    def __init__(self) -> None:
        self.seq, self.late = -1, 0
        self.wish: Wish | None = None
        self.encoding = MSGPACK


class Mailboxes:
    """The latest wish of each user. Thread-safe; bounded, and so is the share of each turn."""

    def __init__(self, most: int, turn: Callable[[str], str] = str) -> None:
        """most: mailboxes, at a time.

        turn: returns the turn of a client (liveliness_tokens.py); by default each has its own.
        """
        self._most, self._turn = most, turn
        self._boxes: dict[User, _Box] = {}
        self._waiting: dict[User, None] = {}  # with a wish, in the order they came
        self._left: dict[User, None] = {}  # each once, however often it says so
        self._gone: dict[str, None] = {}
        self._closed = False
        self._changed = threading.Condition()

    def put(self, user: User, wish: Wish, encoding: str = MSGPACK) -> bool:
        """Take a wish in: it replaces one that waits. One that is older than the latest is dropped, and counted.

        Return whether it is the latest one once more. Raise BusyError where there is no room for one more user.
        """
        with self._changed:
            box = self._boxes.get(user)
            if box is None:
                # One turn may take half of the room, so that there is always some for another.
                turn = self._turn(user.client)
                own = sum(self._turn(other.client) == turn for other in self._boxes)
                if len(self._boxes) >= self._most or own >= max(1, self._most // 2):
                    raise BusyError(
                        f"{len(self._boxes)} users wish to walk this scene, {own} of this client (all clients without "
                        "a liveliness token count as one): come again later"
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
        """A user leaves; what it wished before is dropped. Who has no mailbox is not there."""
        with self._changed:
            if user not in self._boxes:
                return
            self._forget([user])
            self._left[user] = None
            self._changed.notify()

    def leave_client(self, client: str) -> None:
        """All users of a client leave."""
        with self._changed:
            self._forget([user for user in self._boxes if user.client == client])
            self._gone[client] = None
            self._changed.notify()

    def keep(self, users: Iterable[User]) -> None:
        """Forget all other users but those whose wishes wait."""
        with self._changed:
            kept = {*users, *self._waiting}
            self._forget([user for user in self._boxes if user not in kept])

    def _forget(self, users: list[User]) -> None:
        for user in users:
            self._boxes.pop(user, None)
            self._waiting.pop(user, None)

    def take(self) -> Post | None:
        """All that waits, waiting for some of it; None: closed, and nothing is left."""
        with self._changed:
            while not (self._waiting or self._left or self._gone or self._closed):
                self._changed.wait()
            if not (self._waiting or self._left or self._gone):
                return None
            post = Post(list(self._left), list(self._gone), [], [])
            for user in self._waiting:
                box = self._boxes[user]
                assert box.wish is not None, "only boxes with a wish wait"
                post.turns.append(Turn(user, box.wish, box.late))
                post.encodings.append(box.encoding)
                box.wish = None
            self._waiting, self._left, self._gone = {}, {}, {}
            return post

    def close(self) -> None:
        """Take no more in; what waits is still taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def __len__(self) -> int:
        """Mailboxes there are."""
        with self._changed:
            return len(self._boxes)


class Frames:
    """The sessions of one scene: wishes as bytes in, states as bytes out. No method raises."""

    def __init__(
        self,
        simulation: Simulates,
        publish: Callable[[User, Answer], None],
        max_seconds: float = math.inf,
        turn: Callable[[str], str] = str,
    ) -> None:
        """Make mailboxes for the users of a simulation.

        publish: sends a user's state, or why there is none; must not block.  max_seconds: what one frame of all users
        may take; users that it did not come to by then stay where they were.  turn: as in `Mailboxes`.
        """
        self._simulation, self._publish, self._max_seconds = simulation, publish, max_seconds
        self._at_work: tuple[float, Stop] | None = None  # since when, and what ends it
        self._watchdog = Watchdog(self._look, period=_LOOK_SECONDS)
        self.most_users = simulation.most_users
        self._boxes = Mailboxes(_BOXES_A_USER * simulation.most_users, turn)
        self._given_up = False

    def wish(self, user: User, payload: bytes, encoding: str | None) -> bool:
        """Take a wish in, or refuse it at once. Return whether it is the user's latest one once more."""
        try:
            if not self.fits(user, len(payload), encoding):
                return False
            stated = wire_encoding(encoding)
            return self._boxes.put(user, decode_request(Wish, payload, stated), stated)
        except SolidcloudError as error:
            self._send(user, error, encoding)
            return False

    def fits(self, user: User, size: int, encoding: str | None) -> bool:
        """Return whether a wish of so many bytes is taken; refuse it otherwise."""
        if size > _MOST_BYTES:
            self._send(user, TooLargeError(f"a wish of {size} bytes: at most {_MOST_BYTES}"), encoding)
        return size <= _MOST_BYTES

    def leave(self, user: User) -> None:
        """A user leaves the scene."""
        self._boxes.leave(user)

    def client_gone(self, client: str) -> None:
        """All users of a client leave the scene."""
        self._boxes.leave_client(client)

    def run(self) -> None:
        """Simulate frames until `close`. A thread's work."""
        watching = start_thread("frames-watchdog", self._watchdog.run)
        try:
            while (post := self._boxes.take()) is not None:
                try:
                    self._frame(post)
                except Exception:  # of this frame alone
                    log.exception("a frame of %d users", len(post.turns))
        finally:
            self._watchdog.close()
            watching.join()

    def _look(self, now: float) -> bool:
        """Stop a frame that has taken too long; return whether there is one at work."""
        if (at_work := self._at_work) is None:
            return False
        begun, stop = at_work
        if now - begun >= self._max_seconds:
            stop.set(f"the frame took longer than {self._max_seconds:g} s")
        return True

    def _frame(self, post: Post) -> None:
        """One frame, and what is said of it."""
        for user in post.left:
            self._simulation.end(user)
        for client in post.gone:
            self._simulation.end_client(client)
        if post.turns:
            outcomes = self._step(post.turns)
            for outcome, encoding in zip(outcomes, post.encodings, strict=True):
                self._send(outcome.user, outcome.state, encoding, outcome.about)
        users = self._simulation.users
        if len(self._boxes) > len(users):
            self._boxes.keep(users)

    def _step(self, turns: list[Turn]) -> list[Outcome]:
        """Simulate one frame, which the watchdog ends if it takes too long."""
        stop, now = Stop(), time.monotonic()
        self._at_work = now, stop
        if self._given_up:  # read after the flag is there for `give_up` to set
            stop.set(_STOPS)
        if self._watchdog.asleep:
            self._watchdog.wake()
        try:
            return self._simulation.step(turns, now, stops=[stop] * len(turns))
        finally:
            self._at_work = None

    def _send(
        self, user: User, said: State | SolidcloudError, encoding: str | None, about: bytes = b""
    ) -> None:
        """Publish what is said to a user; what cannot be sent is logged, for nobody waits for it.

        about: as in `Answer`.
        """
        try:
            stated = wire_encoding(encoding)
        except BadRequestError:
            stated = MSGPACK
        try:
            if isinstance(said, SolidcloudError):
                reply = ErrorReply(said.code, str(said))
                self._publish(user, Answer(encode(reply, stated), stated, False, about))
            else:
                self._publish(user, Answer(encode(said, stated), stated, True, about))
        except Exception:
            log.exception("the state of %s of client %s", user.avatar, user.client)

    def close(self) -> None:
        """End `run` once what came is done; a frame that is at work is ended early."""
        self._boxes.close()
        self._stop_frame()

    def give_up(self) -> None:
        """End the frame at work early, and each one after it."""
        self._given_up = True
        self._stop_frame()

    def _stop_frame(self) -> None:
        """End the frame at work early, if there is one."""
        if (at_work := self._at_work) is not None:
            at_work[1].set(_STOPS)
