"""The questions of `Scene`, asked over zenoh of a server in another process.

What no server answers is `unknown`, never clear: zenoh's empty reply looks the same whether nobody is
there, a server died or a message was dropped (WIRE.md, "Empty replies").
"""

import logging
import queue
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import zenoh

from ..schemas.errors import (
    BadRequestError,
    BusyError,
    InternalError,
    SolidcloudError,
    TooLargeError,
    UnknownAvatarError,
    UnknownSceneError,
    error_from_code,
)
from ..schemas.wire import key_expressions
from ..schemas.wire.answers import Part
from ..schemas.wire.encoding import MSGPACK, decode_answer, encode
from ..schemas.wire.path_messages import PathRequest, answers_to_part, check_path_parameters
from ..schemas.wire.question_rules import Question, check_answers, make_unknown
from ..schemas.wire.questions import QUESTIONS
from ..schemas.wire.request_limits import MAX_POSES
from ..schemas.wire.requests import has_tolerance_or_budget, make_poses, make_positions
from ..schemas.wire.scene_messages import (
    WIRE_VERSION,
    AvatarInfo,
    ErrorReply,
    ReloadAnswer,
    SceneInfo,
    ScenesAnswer,
)
from ..schemas.wire.stats import StatsAnswer, StatsRequest
from .zenoh_client.added_avatars import Added, AddedAvatars
from .zenoh_client.client_identity import OPEN_SECONDS, Identity
from .zenoh_client.client_session import ClientSession, WishNumbers
from .zenoh_client.request_batches import BatchedQueries
from .zenoh_common.endpoints import DEFAULT_ENDPOINT, check_endpoint, zenoh_words
from .zenoh_common.sealed_replies import OtherAvatarError, SealedQuery, TrustAnchor
from .zenoh_common.zenoh_settings import session_config

log = logging.getLogger(__name__)

# Of the time that a query is kept open, how much must have passed for a silence to be a server's that is slow: clocks
# differ by a little.
_NEARLY = 0.9

# How often a question about avatars is asked, in all, where the server does not know them.
_MOST_TRIES = 3

_ENCODING = zenoh.Encoding(MSGPACK)


class Client(BatchedQueries):
    """A scene served elsewhere; a context manager, thread-safe, with the methods of `Scene`.

    endpoint: where the server listens.  scene: the name it is served under.
    timeout: how long one request may take [s]; a long list of poses is several requests.
    key_file: holds the server's key, as given to `solidcloud serve --key-file`; None: the key that a server of the same
    user on the same host has left is found by itself. With a key, a reply that is not sealed with it is as no reply.

    Entering asks which scenes are served: UnknownSceneError names them if this one is not among them. With
    no server there, entering succeeds all the same: `collide` says `UNKNOWN`, and right answers come once
    a server does. Avatars are remembered, and added again to a server that does not know them. Where a server with a
    key answers about other avatars than those that were added, the answer is as none, and the client goes on under
    another id, which nobody knows.

    unanswered: how many poses, rays, points, motions and objects nobody answered so far, and are `UNKNOWN` for that.
    """

    def __init__(
        self,
        endpoint: str = DEFAULT_ENDPOINT,
        *,
        scene: str,
        timeout: float = 5.0,
        key_file: Path | str | None = None,
    ) -> None:
        self.name = key_expressions.check_name(scene, "scene")
        if not timeout > 0:
            raise BadRequestError(f"timeout is {timeout}: expected seconds above 0")
        self._endpoint, self._timeout = endpoint, timeout
        self._anchor = TrustAnchor(endpoint, key_file)
        self._added = AddedAvatars()
        self._numbers: dict[str, WishNumbers] = {}  # by avatar
        self._lock = threading.Lock()
        self._renewing = threading.Lock()
        self.unanswered = 0
        self._seen = False  # whether a server of this scene ever answered
        self._stack: ExitStack | None = None

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            self._session = stack.enter_context(_session(self._endpoint))
            self._identity = Identity(self._session, self.name, self._timeout)
            stack.callback(self._leave)
            self._check_served()
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Leave the server, which forgets this client's avatars. Closing twice is allowed."""
        stack, self._stack = self._stack, None
        if stack is not None:
            stack.close()

    def _leave(self) -> None:
        """Have the server forget this client."""
        with self._renewing:
            self._identity.close()

    @property
    def _id(self) -> str:
        """Return the id under which this client asks at present."""
        return self._identity.id

    def info(self) -> SceneInfo:
        """What the scene is. BusyError: nobody answered."""
        return decode_answer(SceneInfo, self._answered("info", self._timeout))

    def reload(self) -> ReloadAnswer:
        """Have the server serve what is in the archive's folder now; what is asked after this is answered of it.

        BusyError: nobody answered, or the server still answers of the generation before the one served. FormatError
        and others: what is there cannot be served; the server serves on what it did.
        """
        return decode_answer(
            ReloadAnswer, self._answered("reload", max(self._timeout, OPEN_SECONDS["reload"]))
        )

    def stats(self, keys: bool = False) -> StatsAnswer:
        """What the server keeps of the scene in memory, and how it did. keys: name the resident voxels, too.

        BusyError: nobody answered.
        """
        return decode_answer(
            StatsAnswer, self._answered("stats", self._timeout, encode(StatsRequest(key_expressions)))
        )

    def _answered(self, operation: str, seconds: float, request: bytes = b"") -> bytes:
        """The answer to a question about the scene itself; BusyError: nobody answered."""
        begin = time.monotonic()
        payload = self._ask(operation, request)
        if payload is None:
            raise BusyError(self._silence(operation, seconds, time.monotonic() - begin))
        return payload

    def silence(self, operation: str) -> str:
        """Say why nobody may have answered an operation, and what to do."""
        if not self._seen:
            return self._silence(operation, self._timeout, 0.0)
        return (
            f"the server of scene {self.name!r} at {self._endpoint} is gone, or has not answered {operation!r} within "
            f"{self._timeout:g} s: ask again, or start one with: {self._start()}"
        )

    def _start(self) -> str:
        """Return the command that starts a server of this scene."""
        return f"solidcloud serve ARCHIVE --name {self.name} --listen {self._endpoint}"

    def _silence(self, operation: str, seconds: float, waited: float) -> str:
        """Why a question may have had no answer, and what to do. seconds: for which one was waited for at most."""
        where = f"scene {self.name!r} at {self._endpoint}"
        # A question that no server gets ends at once, one whose server is gone as soon as that is seen.
        if self._seen and waited > _NEARLY * seconds:
            then = ", and its log says when it is done" if operation == "reload" else ""
            return (
                f"the server of {where} has not answered {operation!r} within {seconds:g} s: it may still be at work"
                f"{then}: ask again, or start it anew"
            )
        start = self._start()
        if self._seen:
            return f"the server of {where} is gone, expected its answer to {operation!r}: start one with: {start}"
        return f"no server of {where}, expected one that answers {operation!r}: start one with: {start}"

    def add_avatar(self, name: str, points: Any, radius: float | None = None) -> AvatarInfo:
        """Give this client an avatar: (n, 3) float64, its own frame [m]; radius [m], see AddAvatarRequest.

        With nobody there it is remembered and added later; then `radius` is as given here and
        `bounding_radius` None. BadRequestError, TooLargeError: the avatar is refused, or the name is taken
        by another one.
        """
        avatar = Added(make_positions(points).copy(), None if radius is None else float(radius))
        request = avatar.request(name)
        new = self._added.add(name, avatar)
        try:
            payload = self._ask("add_avatar", request)
        except BusyError:
            payload = None  # remembered, and added with the first question about it
        except SolidcloudError:
            if new:
                self._added.remove(name)
            raise
        if payload is None:
            return AvatarInfo(name, len(avatar.points), avatar.radius)
        return self._added.accepted(name, payload)

    def path(self, name: str, poses: Any, op: str = "collide", **parameters: Any) -> Iterator[Part]:
        """Ask `op` (collide, distance, contacts, sweep) along up to 100,000 poses, in one request.

        parameters: what `op` takes beside the poses, tolerance and budgets included; `budget_ms` is for the whole path.
        sweep: k - 1 motions, from each pose to the next. Yields answers for [first, first + n) of `total` as they
        come, in order and without gaps: what never came, within `timeout` of what came before, is `UNKNOWN`.
        """
        array = make_poses(poses)
        check_path_parameters(op, parameters)
        if len(array) > MAX_POSES:
            raise TooLargeError(f"path of {len(array)} poses: at most {MAX_POSES}: ask for it in pieces")
        request = PathRequest(name, array, op, **parameters)  # type: ignore[arg-type]
        question = QUESTIONS[op]
        total = question.items_along(len(array))
        return self._parts(question, encode(request), name, total, has_tolerance_or_budget(parameters))

    def _parts(
        self, question: Question[Any], request: bytes, name: str, total: int, bounded: bool
    ) -> Iterator[Part]:
        """The parts of a path, each once and in order, whatever came of them."""

        def missing(stop: int) -> Part:
            self._note_unanswered(stop - expected)
            none = make_unknown(question.answers, stop - expected, bounded=bounded)
            part: Part = answers_to_part(none, expected, total)
            return part

        expected, complete = 0, False
        for payload in self._replies(request, name):
            part = decode_answer(question.part, payload)
            check_answers(part, len(part))
            if part.total != total or part.first < 0 or part.first + len(part) > total:
                raise InternalError(
                    f"part of a path for {part.first} to {part.first + len(part)} of {part.total}: "
                    f"expected some of {total}"
                )
            if part.first < expected or (len(part) == 0 and total):
                log.warning("part of a path for %d of %d came twice, or late: left out", part.first, total)
                continue
            if part.first > expected:
                yield missing(part.first)
            expected = part.first + len(part)
            complete = expected == total
            yield part
            if complete:
                break
        if not complete:
            yield missing(total)

    def _replies(self, request: bytes, name: str) -> Iterator[bytes]:
        """The replies to a path until there are no more, or none came in time; errors are raised."""
        for tried in range(1, _MOST_TRIES + 1):
            taken = False
            try:
                for payload in self._stream("path", request, [name]):
                    taken = True
                    yield payload
                return
            except UnknownAvatarError as unknown:
                # Said before the first part, if at all.
                if taken or not self._go_on([name], unknown, tried):
                    return

    def session(self, avatar: str) -> ClientSession:
        """A session of an avatar, this client's or one of the scene's own: `with` it, wish and hear where it gets to.

        avatar: 1 to 64 of A-Z, a-z, 0-9, '.', '_' and '-'.  The scene's server simulates the effects that it calls for.
        """
        self._check_open()
        key_expressions.check_name(avatar, "avatar of a session")
        with self._lock:
            numbers = self._numbers.setdefault(avatar, WishNumbers())
        return ClientSession(
            self._session,
            self.name,
            lambda: key_expressions.User(self._id, avatar),
            numbers,
            self._anchor,
            lambda: self._added.about([avatar]),
            lambda unknown: self._add_again([avatar], unknown),
        )

    def _note_unanswered(self, count: int) -> None:
        """Count what nobody answered."""
        with self._lock:
            self.unanswered += count

    def _ask_about(self, operation: str, request: bytes, names: Sequence[str]) -> bytes | None:
        """Ask about avatars, adding them again where the server does not know them; None: nobody answered."""
        for tried in range(1, _MOST_TRIES + 1):
            try:
                return self._ask(operation, request, names)
            except UnknownAvatarError as unknown:
                if not self._go_on(names, unknown, tried):
                    break
        return None

    def _go_on(self, names: Sequence[str], unknown: UnknownAvatarError, tried: int) -> bool:
        """Return whether to ask once more about avatars, which are then known to the server.

        unknown: what the server says; raised where it still does not know them.  tried: how often it was asked.
        """
        if tried < _MOST_TRIES:
            return self._add_again(names, unknown)
        if isinstance(unknown, OtherAvatarError):
            return False
        raise unknown

    def _add_again(self, names: Sequence[str], unknown: UnknownAvatarError) -> bool:
        """Add avatars to a server that was restarted, or that took us for gone; False: nobody answered.

        unknown: what the server says; raised again if we do not know one either. Where the server has others under
        their names, this client begins anew, under a fresh id.
        """
        added = self._added.known(names)
        if isinstance(unknown, OtherAvatarError):
            # Without all digests the avatars may be ours: their radius is not known here before they are added.
            if self._added.about(names) is not None:
                self._begin_anew(unknown.key_expression)
        elif len(added) < len(set(names)):
            raise unknown
        asked = self._identity
        try:
            return self._add(added)
        except TooLargeError:
            raise
        except BadRequestError:  # perhaps somebody else was first to add one of that name
            self._begin_anew(asked.keys["add_avatar"])
            return self._add(added)

    def _add(self, added: dict[str, Added]) -> bool:
        """Add avatars to the server; return whether it answered."""
        for name, avatar in added.items():
            payload = self._ask("add_avatar", avatar.request(name))
            if payload is None:
                return False
            self._added.accepted(name, payload)
        return True

    def _begin_anew(self, key_expression: str) -> None:
        """Take a fresh id, if the present one is that of a key expression: somebody else knows that."""
        with self._renewing:
            self._check_open()
            before = self._identity
            if not before.asked(key_expression):
                return
            log.warning(
                "scene %s at %s: the server has other avatars under this client's id than it added: another program "
                "knows the id; going on under a fresh one",
                self.name,
                self._endpoint,
            )
            self._identity = Identity(self._session, self.name, self._timeout)
            before.close()

    def _ask(self, operation: str, request: bytes, names: Sequence[str] = ()) -> bytes | None:
        """Ask, and wait for the answer; None: nobody answered in time. Raises what an error reply says.

        names: the avatars that the answer is about, in the request's order.
        """
        querier, asked = self._asked(operation, request, names)
        replies = querier.get(payload=request, encoding=_ENCODING, attachment=asked.nonce)
        asked.sent()
        for reply in replies:
            payload = _answer_of(reply, asked)
            if payload is not None:
                self._seen = True
                return payload
        if not self._seen:
            self._check_served()
        return None

    def _stream(self, operation: str, request: bytes, names: Sequence[str]) -> Iterator[bytes]:
        """Ask, and yield every reply as it comes, until there are no more or no believed one for `timeout`."""
        # Without bound: a channel that is full would hold up all that comes over this session.
        came: queue.SimpleQueue[Any] = queue.SimpleQueue()
        handler = zenoh.handlers.Callback(came.put, lambda: came.put(None))
        querier, asked = self._asked(operation, request, names)
        cancel = zenoh.CancellationToken()
        querier.get(
            handler, payload=request, encoding=_ENCODING, attachment=asked.nonce, cancellation_token=cancel
        )
        answered = False
        until = time.monotonic() + self._timeout
        try:
            while (reply := _next(came, until)) is not None:
                payload = _answer_of(reply, asked)
                if payload is not None:
                    self._seen = answered = True
                    yield payload
                    until = time.monotonic() + self._timeout
        finally:
            cancel.cancel()
        if not answered and not self._seen:
            self._check_served()

    def _asked(
        self, operation: str, request: bytes, names: Sequence[str]
    ) -> tuple[zenoh.Querier, SealedQuery]:
        """Return what asks one operation under the present id, and what reads the replies."""
        self._check_open()
        identity = self._identity
        asked = SealedQuery(
            self._anchor, identity.keys[operation], request, partial(self._added.about, names)
        )
        return identity.queriers[operation], asked

    def _querier(self, operation: str) -> zenoh.Querier:
        """Return what asks one operation under the present id."""
        self._check_open()
        return self._identity.queriers[operation]

    def _check_open(self) -> None:
        """BadRequestError where this client is closed."""
        if self._stack is None:
            raise BadRequestError("this client is closed: ask inside `with Client(...) as scene`")

    def _check_served(self) -> None:
        """UnknownSceneError if servers answer and none of them serves this scene."""
        served, versions = _ask_scenes(self._session, self._timeout, self._anchor)
        if versions - {WIRE_VERSION}:
            raise InternalError(
                f"a server at {self._endpoint} speaks wire version {max(versions)}, this client "
                f"{WIRE_VERSION}: upgrade the older one"
            )
        if self.name in served:
            self._seen = True
        elif versions:
            names = ", ".join(sorted(served)) or "none"
            raise UnknownSceneError(f"scene {self.name!r} is not served at {self._endpoint}; served: {names}")


def scenes_at(
    endpoint: str = DEFAULT_ENDPOINT, timeout: float = 5.0, key_file: Path | str | None = None
) -> list[str]:
    """The names of the scenes that are served at an endpoint, in order. BusyError: nobody answered."""
    anchor = TrustAnchor(endpoint, key_file)
    with _session(endpoint) as session:
        served, versions = _ask_scenes(session, timeout, anchor)
    if not versions:
        raise BusyError(
            f"no server answered at {endpoint} within {timeout:g} s: "
            f"start one with: solidcloud serve ARCHIVE --listen {endpoint}"
        )
    return sorted(served)


def _session(endpoint: str) -> zenoh.Session:
    """A session connected to an endpoint; BadRequestError for one that is none."""
    check_endpoint(endpoint, "endpoint")
    try:
        return zenoh.open(session_config(connect=endpoint))
    except zenoh.ZError as error:
        raise BadRequestError(
            f"endpoint {endpoint!r}: {zenoh_words(error)}: expected one such as {DEFAULT_ENDPOINT}"
        ) from None


def _ask_scenes(session: zenoh.Session, timeout: float, anchor: TrustAnchor) -> tuple[set[str], set[int]]:
    """The scenes that are served, and the wire versions of the servers that answered."""
    served: set[str] = set()
    versions: set[int] = set()
    asked = SealedQuery(anchor, key_expressions.scenes_key())
    replies = session.get(
        key_expressions.scenes_key(),
        attachment=asked.nonce,
        # Several servers answer under the one key, and all of them count.
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=timeout,
        encoding=_ENCODING,
    )
    for reply in replies:
        ok, payload = asked.read(reply) or (False, b"")
        if ok:
            answer = decode_answer(ScenesAnswer, payload)
            served.update(answer.scenes)
            versions.add(answer.wire_version)
    return served, versions


def _next(came: "queue.SimpleQueue[Any]", until: float) -> Any:
    """Wait for the next of what comes; None: no more does, or none by `until`, on the monotonic clock [s]."""
    left = until - time.monotonic()
    try:
        return came.get(timeout=left) if left > 0 else None
    except queue.Empty:
        return None


def _answer_of(reply: zenoh.Reply, asked: SealedQuery) -> bytes | None:
    """Return the bytes of an answer to what was asked; None: it is not the server's.

    Raises the error of an error reply.
    """
    found = asked.read(reply)
    if found is None:
        return None
    ok, payload = found
    if not ok:
        said = decode_answer(ErrorReply, payload)
        raise error_from_code(said.code, said.message)
    return payload
