"""The questions of `Scene`, asked over zenoh of a server in another process.

What no server answers is `unknown`, never clear: zenoh's empty reply looks the same whether nobody is
there, a server died or a message was dropped (WIRE.md, "Empty replies").
"""

import logging
import threading
import uuid
from contextlib import ExitStack
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy as np
import zenoh

from ..schemas import keys
from ..schemas.answers import CollideAnswers, unknown_answers
from ..schemas.errors import (
    BadRequestError,
    BusyError,
    InternalError,
    SolidcloudError,
    UnknownAvatarError,
    UnknownSceneError,
    error_from_code,
)
from ..schemas.messages import (
    MSGPACK,
    WIRE_VERSION,
    AddAvatarRequest,
    AvatarInfo,
    CollideRequest,
    ErrorReply,
    Poses,
    Positions,
    SceneInfo,
    ScenesAnswer,
    check_answers,
    decode_answer,
    encode,
    make_poses,
    make_positions,
)
from .config import DEFAULT_ENDPOINT
from .transport import session_config

log = logging.getLogger(__name__)

# Poses in one request: 512 KiB, so that one client's long path does not keep others waiting for seconds, and
# an answer comes well within the timeout.
BATCH_POSES = 4096

_ENCODING = zenoh.Encoding(MSGPACK)


class _Avatar(NamedTuple):
    """An avatar as it was added, to be added again where a server does not know it (any more)."""

    points: Positions
    radius: float | None


class Client:
    """A scene served elsewhere; a context manager, thread-safe, with the methods of `Scene`.

    endpoint: where the server listens.  scene: the name it is served under.
    timeout: how long one request may take [s]; a long list of poses is several requests.

    Entering asks which scenes are served: UnknownSceneError names them if this one is not among them. With
    no server there, entering succeeds all the same: `collide` says `UNKNOWN`, and right answers come once
    a server does. Avatars are remembered, and added again to a server that does not know them.
    """

    def __init__(self, endpoint: str = DEFAULT_ENDPOINT, *, scene: str, timeout: float = 5.0) -> None:
        self.name = keys.check_name(scene, "scene")
        if not timeout > 0:
            raise BadRequestError(f"timeout is {timeout}: expected seconds above 0")
        self._endpoint, self._timeout = endpoint, timeout
        self._id = uuid.uuid4().hex
        self._avatars: dict[str, _Avatar] = {}
        self._lock = threading.Lock()
        self._seen = False  # whether a server of this scene ever answered
        self._stack: ExitStack | None = None

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            try:
                self._session = stack.enter_context(zenoh.open(session_config(connect=self._endpoint)))
            except zenoh.ZError as error:
                raise BadRequestError(
                    f"endpoint {self._endpoint!r}: {error}: expected one such as {DEFAULT_ENDPOINT}"
                ) from None
            # Gone with this process, however it ends: then the server forgets our avatars.
            token = keys.client_alive_key(self.name, self._id)
            stack.enter_context(self._session.liveliness().declare_token(token))
            # Declared once: a querier's route is known, an ad hoc `get` looks for it every time.
            self._queriers = {
                operation: stack.enter_context(
                    self._session.declare_querier(
                        keys.question_key(self.name, self._id, operation),
                        # By default zenoh keeps a reply back until the server has said that no other comes.
                        consolidation=zenoh.ConsolidationMode.NONE,
                        timeout=self._timeout,
                    )
                )
                for operation in keys.OPERATIONS
            }
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

    def info(self) -> SceneInfo:
        """What the scene is. BusyError: nobody answered."""
        payload = self._ask("info", b"")
        if payload is None:
            raise BusyError(
                f"no server of scene {self.name!r} answered at {self._endpoint} within {self._timeout} s: "
                f"start one with: solidcloud serve ARCHIVE --name {self.name} --listen {self._endpoint}"
            )
        return decode_answer(SceneInfo, payload)

    def add_avatar(self, name: str, points: Any, radius: float | None = None) -> AvatarInfo:
        """Give this client an avatar: (n, 3) float64, its own frame [m]; radius [m], see AddAvatarRequest.

        With nobody there it is remembered and added later; then `radius` is as given here and
        `bounding_radius` None. BadRequestError, TooLargeError: the avatar is refused, or the name is taken
        by another one.
        """
        avatar = _Avatar(make_positions(points).copy(), None if radius is None else float(radius))
        request = _add_request(name, avatar)
        with self._lock:
            known = self._avatars.get(name)
            if known is not None and not _same_avatar(known, avatar):
                raise BadRequestError(
                    f"avatar {name!r} was added with other points or another radius: choose another name"
                )
            self._avatars[name] = avatar
        try:
            payload = self._ask("add_avatar", request)
        except BusyError:
            payload = None  # remembered, and added with the first question about it
        except SolidcloudError:
            with self._lock:
                if known is None:
                    self._avatars.pop(name, None)
            raise
        if payload is None:
            return AvatarInfo(name, len(avatar.points), avatar.radius)
        return decode_answer(AvatarInfo, payload)

    def collide(self, name: str, poses: Any, margin: float = 0.0) -> CollideAnswers:
        """Whether an avatar touches the scene, for k poses (k, 4, 4) float64, avatar to world.

        margin: distance below which it is called contact [m]. What nobody answered in time is `UNKNOWN`.
        BadRequestError, BadTransformError, UnknownAvatarError, BusyError and others: as the server says.
        """
        array = make_poses(poses)
        margin = float(margin)
        parts = []
        for start in range(0, max(1, len(array)), BATCH_POSES):
            part = self._collide_batch(name, array[start : start + BATCH_POSES], margin)
            if part is None:
                # Not asked for the rest: a server that is frozen would cost a timeout for every batch.
                parts.append(unknown_answers(len(array) - start))
                break
            parts.append(part)
        return parts[0] if len(parts) == 1 else _join(parts)

    def _collide_batch(self, name: str, poses: Poses, margin: float) -> CollideAnswers | None:
        """One request; None: nobody answered."""
        request = encode(CollideRequest(name, poses, margin))
        try:
            payload = self._ask("collide", request)
        except UnknownAvatarError:
            # A server that was restarted, or that took us for gone, does not know what we added.
            with self._lock:
                avatar = self._avatars.get(name)
            if avatar is None:
                raise
            if self._ask("add_avatar", _add_request(name, avatar)) is None:
                return None
            payload = self._ask("collide", request)
        if payload is None:
            return None
        return check_answers(decode_answer(CollideAnswers, payload), len(poses))

    def _ask(self, operation: str, request: bytes) -> bytes | None:
        """Ask, and wait for the answer; None: nobody answered in time. Raises what an error reply says."""
        if self._stack is None:
            raise BadRequestError("this client is closed: ask inside `with Client(...) as scene`")
        for reply in self._queriers[operation].get(payload=request, encoding=_ENCODING):
            sample = reply.ok
            if sample is not None:
                self._seen = True
                return sample.payload.to_bytes()
            _raise_error(reply.err)
        if not self._seen:
            self._check_served()
        return None

    def _check_served(self) -> None:
        """UnknownSceneError if servers answer and none of them serves this scene."""
        served: set[str] = set()
        versions: set[int] = set()
        replies = self._session.get(
            keys.scenes_key(),
            # Several servers answer under the one key, and all of them count.
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=self._timeout,
            encoding=_ENCODING,
        )
        for reply in replies:
            if reply.ok is not None:
                answer = decode_answer(ScenesAnswer, reply.ok.payload.to_bytes())
                served.update(answer.scenes)
                versions.add(answer.wire_version)
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


def _add_request(name: str, avatar: _Avatar) -> bytes:
    """The request that adds an avatar."""
    return encode(AddAvatarRequest(name, avatar.points, avatar.radius))


def _same_avatar(known: _Avatar, other: _Avatar) -> bool:
    """Whether two avatars are one, bit for bit."""
    return known.radius == other.radius and np.array_equal(known.points, other.points)


def _raise_error(error: Any) -> None:
    """Raise what an error reply says; return where zenoh, and not a server, is the one who says it."""
    if str(error.encoding).split(";", 1)[0] != MSGPACK:
        # zenoh's own, such as "Timeout": nobody answered.
        log.debug("no answer: %s", error.payload.to_bytes()[:200])
        return
    reply = decode_answer(ErrorReply, error.payload.to_bytes())
    raise error_from_code(reply.code, reply.message)


def _join(parts: list[CollideAnswers]) -> CollideAnswers:
    """The answers of several requests as those of one, in order. Residency is that after the last answer."""
    answered = [part for part in parts if part.resident or part.hits or part.misses] or parts
    return CollideAnswers(
        np.concatenate([part.verdict for part in parts]),
        np.concatenate([part.outside for part in parts]),
        np.concatenate([part.voxels_missing for part in parts]),
        np.concatenate([part.node_visits for part in parts]),
        np.concatenate([part.point_tests for part in parts]),
        engine_seconds=sum(part.engine_seconds for part in parts),
        hits=sum(part.hits for part in parts),
        misses=sum(part.misses for part in parts),
        resident=answered[-1].resident,
        resident_bytes=answered[-1].resident_bytes,
        faults=tuple(dict.fromkeys(fault for part in parts for fault in part.faults)),
    )
