"""Dispatch of requests: decode a request, pass it to its scene, and encode the answer."""

import logging
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from functools import cache
from typing import Any, NamedTuple

from msgspec import structs

from ...schemas.errors import (
    BadRequestError,
    BusyError,
    ErrorCode,
    SolidcloudError,
    TooLargeError,
    UnknownAvatarError,
    UnknownSceneError,
)
from ...schemas.wire import key_expressions
from ...schemas.wire.encoding import MSGPACK, decode_request, encode, wire_encoding
from ...schemas.wire.motion_messages import MoveRequest
from ...schemas.wire.overview_messages import OverviewRequest
from ...schemas.wire.path_messages import PathRequest
from ...schemas.wire.question_rules import Question
from ...schemas.wire.question_table import QUESTIONS
from ...schemas.wire.request_limits import MAX_MESSAGE_BYTES
from ...schemas.wire.requests import AddAvatarRequest, QuestionRequest
from ...schemas.wire.scene_messages import WIRE_VERSION, ErrorReply, ReloadAnswer, ScenesAnswer
from ...schemas.wire.stats import StatsRequest
from ...schemas.wire.tile_messages import TileRequest, VoxelsRequest
from ...schemas.wire.warming_parts import MOTION, needed_part
from ..runtime.stop_flag import NO_STOP, StopFlag
from ..scene_interface import (
    AvatarShape,
    EncodedReply,
    LimitReached,
    ServedScene,
    ServedWatch,
    recording_avatars,
)
from .command_mailboxes import FrameLoop
from .server_config import ServerConfig
from .warming import Warming

log = logging.getLogger(__name__)


class _Operation(NamedTuple):
    """Operation with a payload.

    request: type of its request.  counted: field whose length `ServerConfig.max_poses` bounds; ""
    for none.
    ask: function of scene, request, client and stop flag that returns the answer, or an iterator of
    its parts.
    """

    request: type
    counted: str
    ask: Callable[[ServedScene, Any, str, StopFlag], Any]


# Operations with a payload that are not questions.
_OTHERS = {
    "add_avatar": _Operation(
        AddAvatarRequest,
        "",
        lambda s, r, c, stop: s.add_avatar(r.name, AvatarShape(r.points, r.radius, r.inner_points), client=c),
    ),
    "move": _Operation(
        MoveRequest,
        "",
        lambda s, r, c, stop: s.move(
            r.avatar, r.pose_from, r.pose_to, r.seconds, late=r.late, client=c, stop=stop
        ),
    ),
    "overview": _Operation(OverviewRequest, "", lambda s, r, c, stop: s.overview(r.limit)),
    "voxels": _Operation(VoxelsRequest, "", lambda s, r, c, stop: s.voxels(r.place, r.reach, r.limit)),
    "tile": _Operation(TileRequest, "", lambda s, r, c, stop: s.tile(r.archive, r.voxel, r.detail, r.level)),
    "path": _Operation(
        PathRequest,
        "poses",
        lambda s, r, c, stop: s.path(r.avatar, r.poses, r.op, client=c, stop=stop, **r.parameters()),
    ),
}


@cache
def _operation(name: str) -> _Operation | None:
    """Return the description of an operation; None for one without a payload."""
    question = QUESTIONS.get(name)
    if question is None:
        return _OTHERS.get(name)
    own: Question[Any] = question

    def ask(scene: ServedScene, request: QuestionRequest, client: str, stop: StopFlag) -> Any:
        client_too = {"client": client} if own.about_avatars else {}
        return scene.ask(own, *request.arguments(), stop=stop, **client_too, **request.options())

    return _Operation(own.request, own.counted, ask)


class RequestDispatcher:
    """Answers requests on the wire from scenes. Thread-safe; never raises: errors are answers."""

    def __init__(self, scenes: Sequence[ServedScene], config: ServerConfig) -> None:
        names = [key_expressions.check_name(scene.name, "scene") for scene in scenes]
        if len(set(names)) != len(names):
            raise BadRequestError(f"scenes {', '.join(names)}: expected distinct names: rename one")
        self._scenes = {scene.name: scene for scene in scenes}
        self._config = config
        self._frames: dict[str, FrameLoop] = {}
        self.warming = Warming(scenes)
        self.left_at_work = False  # set at the end of serving if a request did not end in time
        for scene in scenes:
            scene.limit_avatars(config.avatar_limits)

    def scenes(self, encoding: str | None) -> EncodedReply:
        """Return the answer that lists the served scenes."""
        formats = {scene.info().format_version for scene in self._scenes.values()}
        answer = ScenesAnswer(sorted(self._scenes), WIRE_VERSION, max(formats, default=0))
        try:
            stated = wire_encoding(encoding)
            return EncodedReply(encode(answer, stated), stated, True)
        except SolidcloudError as error:
            return self._error(encoding, error.code, str(error))

    def answer(
        self, key: str, payload: bytes, encoding: str | None, stop: StopFlag | None = None
    ) -> EncodedReply | Iterator[EncodedReply]:
        """Return the answer to a request under this key; an iterator if it comes in parts.

        stop: ends the work early once it is set; what was not computed by then is unknown.
        """
        avatars: list[bytes] = []
        try:
            stated = wire_encoding(encoding)
            with recording_avatars(avatars):
                found = self._ask(key, payload, stated, NO_STOP if stop is None else stop)
            about = b"".join(avatars)
            if isinstance(found, Iterator):
                return self._parts(key, found, stated, about)
            return self._encoded(found, stated, about)
        except Exception as error:
            return self._failed(key, encoding, error, b"".join(avatars))

    def _parts(self, key: str, parts: Iterator[Any], encoding: str, about: bytes) -> Iterator[EncodedReply]:
        """Yield parts as answers; an error is the last one."""
        try:
            for part in parts:
                yield self._encoded(part, encoding, about)
        except Exception as error:
            yield self._failed(key, encoding, error, about)

    def _encoded(self, message: Any, encoding: str, about: bytes) -> EncodedReply:
        """Encode a message as an answer. Raise TooLargeError if its receiver would drop it."""
        payload = encode(message, encoding)
        # The margin is far larger than zenoh's headers.
        if len(payload) > MAX_MESSAGE_BYTES - (1 << 16):
            raise TooLargeError(
                f"the answer takes {len(payload)} bytes, a message holds {MAX_MESSAGE_BYTES}: ask for less at a time"
            )
        return EncodedReply(payload, encoding, True, about)

    def _failed(self, key: str, encoding: str | None, error: Exception, about: bytes) -> EncodedReply:
        """Return an error as an answer.

        An error that is not a SolidcloudError is logged, and only its type is sent.
        about: digests of the avatars that were looked up; if one is unknown, the answer names no
        avatars.
        """
        if isinstance(error, SolidcloudError):
            answer = self._error(encoding, error.code, str(error))
            return answer if isinstance(error, UnknownAvatarError) else answer._replace(about=about)
        log.error("a request failed with an internal error: %s", key, exc_info=error)
        answer = self._error(
            encoding, ErrorCode.INTERNAL, f"{type(error).__name__} in the server: see the server's log"
        )
        return answer._replace(about=about)

    def busy(self, encoding: str | None, full: LimitReached) -> EncodedReply:
        """Return the answer to a request that exceeds a limit. full: the limit reached."""
        as_one = "(all clients without a liveliness token count as one)"
        config = self._config
        message = {
            LimitReached.REQUESTS: f"up to {config.max_in_flight} requests are in flight here: ask again later",
            LimitReached.OWN_REQUESTS: (
                f"{config.max_in_flight_by_client} requests of this client are in flight, the most that this server "
                f"takes {as_one}: wait for answers"
            ),
            LimitReached.PATHS: (
                f"this server answers up to {config.max_paths} paths at a time, {max(1, config.max_paths // 2)} of one "
                f"client {as_one}: ask again when one has ended"
            ),
            LimitReached.STATES: (
                "this scene has the maximum number of open queries for states or changes: try again later"
            ),
        }[full]
        return self._error(encoding, ErrorCode.BUSY, message)

    def refuse(self, encoding: str | None, error: SolidcloudError) -> EncodedReply:
        """Return an error as an answer to a query that is not a request."""
        return self._error(encoding, error.code, str(error))

    def watch(self, scene: str) -> ServedWatch:
        """Return the changes of what is resident of a scene from now on."""
        return self._scenes[scene].residency_changes()

    def client_gone(self, scene: str, client: str) -> None:
        """Remove the avatars of a disconnected client, and end its bodies."""
        if (frames := self._frames.get(scene)) is not None:
            frames.client_gone(client)
        self._scenes[scene].drop_client(client)

    def drop_unused(self, scene: str, alive: Collection[str]) -> None:
        """Drop avatars unused for long, except those of clients in `alive`."""
        self._scenes[scene].drop_unused_avatars(alive, self._config.avatar_seconds)

    def frames(
        self,
        scene: str,
        publish: Callable[[key_expressions.User, EncodedReply], None],
        turn: Callable[[str], str] = str,
    ) -> FrameLoop | None:
        """Return the frame loop of a scene, which sends states with `publish`; None without one.

        turn: returns the turn of a client (fair_queues.py); by default each has its own.
        """
        if (simulation := self._scenes[scene].simulation) is None:
            return None
        limit = self._config.max_request_seconds
        frames = FrameLoop(simulation, publish, limit, turn, lambda: self.warming.check(MOTION))
        return self._frames.setdefault(scene, frames)

    def _ask(self, key: str, payload: bytes, encoding: str, stop: StopFlag) -> Any:
        """Send one request to the scene that its key names."""
        route = key_expressions.parse_query_key(key)
        scene = self._scenes.get(route.scene)
        if scene is None:
            served = ", ".join(sorted(self._scenes))
            raise UnknownSceneError(f"scene {route.scene!r} is not served here; served: {served}")
        operation = _operation(route.operation)
        if operation is None:
            if route.operation == "stats":
                asked = decode_request(StatsRequest, payload, encoding) if payload else StatsRequest()
                return structs.replace(scene.stats(asked.keys), compiling=self.warming.compiling)
            if payload:
                raise BadRequestError(
                    f"{route.operation} with a payload of {len(payload)} bytes: expected none"
                )
            # `reload` answers as a path of one part, because a separate thread sends parts and no
            # worker has to wait.
            if route.operation == "reload":
                return self._reload(scene)
            return structs.replace(scene.info(), compiling=self.warming.compiling)
        request: Any = decode_request(operation.request, payload, encoding)
        self._check_size(operation, request)
        if self.warming.left:
            asked_for = request.op if isinstance(request, PathRequest) else route.operation
            self.warming.check(needed_part(asked_for))
        return operation.ask(scene, request, route.client, stop)

    def _reload(self, scene: ServedScene) -> Iterator[ReloadAnswer]:
        """Reload one scene when the answer is requested; log and raise errors."""
        try:
            if self.warming.left:
                raise BusyError("reload not ready: this server is still warming: ask again in some seconds")
            answer = scene.reload()
        except Exception as error:
            log.error("%s cannot be reloaded and is served as before: %s", scene.name, error)
            raise
        log.info(
            "reloaded %s in %.1f s: generation %d, was %d; %d points",
            scene.name, answer.seconds, answer.generation_after, answer.generation_before, answer.points,
        )  # fmt: skip
        yield answer

    def reload(self) -> None:
        """Reload every scene in turn. Log errors; a scene that fails is served as before."""
        for scene in self._scenes.values():
            with suppress(Exception):
                next(self._reload(scene))

    def _check_size(self, operation: _Operation, request: Any) -> None:
        """Raise TooLargeError for a request that exceeds this server's limits."""
        if operation.counted:
            count, most = len(getattr(request, operation.counted)), self._config.max_poses
            if count > most:
                raise TooLargeError(f"{count} {operation.counted} in a request: at most {most}: split them")
        elif operation.request is AddAvatarRequest and len(request.points) > self._config.max_avatar_points:
            most = self._config.max_avatar_points
            raise TooLargeError(f"avatar of {len(request.points)} points: at most {most}: thin it out first")

    def _error(self, encoding: str | None, code: ErrorCode, message: str) -> EncodedReply:
        """Return an error as an answer, in the stated encoding if that is valid."""
        try:
            stated = wire_encoding(encoding)
        except BadRequestError:
            stated = MSGPACK
        return EncodedReply(encode(ErrorReply(code, message), stated), stated, False)
