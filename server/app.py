"""Builds a server of its parts, warms them, starts them and stops them, in that order.

`Service` is what is between the bytes of the wire and the scenes; `serve` is what the command runs.
"""

import logging
import signal
import socket
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

from ..schemas import keys
from ..schemas.answers import CollideAnswers
from ..schemas.errors import (
    BadRequestError,
    ErrorCode,
    SolidcloudError,
    TooLargeError,
    UnknownSceneError,
)
from ..schemas.messages import (
    MSGPACK,
    WIRE_VERSION,
    AddAvatarRequest,
    AvatarInfo,
    CollideRequest,
    ErrorReply,
    SceneInfo,
    ScenesAnswer,
    decode_request,
    encode,
    wire_encoding,
)
from .config import ServerConfig
from .transport import Answer, Transport

log = logging.getLogger(__name__)


class SceneLike(Protocol):
    """What a service asks its questions of; thread-safe. Raises SolidcloudErrors for what it refuses."""

    name: str

    def info(self) -> SceneInfo: ...
    def add_avatar(
        self, name: str, points: Any, radius: float | None = None, *, client: str = ""
    ) -> AvatarInfo: ...
    def collide(self, name: str, poses: Any, margin: float = 0.0, *, client: str = "") -> CollideAnswers: ...
    def drop_client(self, client: str) -> None: ...
    def warm(self) -> None: ...
    def close(self) -> None: ...


class Service:
    """Answers the wire's questions by asking scenes. Thread-safe; never raises: an error is an answer too."""

    def __init__(self, scenes: Sequence[SceneLike], config: ServerConfig) -> None:
        names = [keys.check_name(scene.name, "scene") for scene in scenes]
        if len(set(names)) != len(names):
            raise BadRequestError(f"scenes {', '.join(names)}: each needs a name of its own")
        self._scenes = {scene.name: scene for scene in scenes}
        self._config = config
        # Read once: it does not change, and nobody is to wait for it.
        self._infos = {scene.name: scene.info() for scene in scenes}

    def scenes(self, encoding: str | None) -> Answer:
        """Which scenes are served here."""
        formats = {info.format_version for info in self._infos.values()}
        answer = ScenesAnswer(sorted(self._scenes), WIRE_VERSION, max(formats, default=0))
        try:
            stated = wire_encoding(encoding)
            return Answer(encode(answer, stated), stated, True)
        except SolidcloudError as error:
            return self._error(encoding, error.code, str(error))

    def answer(self, key: str, payload: bytes, encoding: str | None) -> Answer:
        """The answer to the question asked under this key."""
        try:
            stated = wire_encoding(encoding)
            return Answer(encode(self._ask(key, payload, stated), stated), stated, True)
        except SolidcloudError as error:
            return self._error(encoding, error.code, str(error))
        except Exception as error:
            log.exception("a request failed for no reason of its own: %s", key)
            text = f"{type(error).__name__} in the server: its log says more"
            return self._error(encoding, ErrorCode.INTERNAL, text)

    def busy(self, encoding: str | None) -> Answer:
        """The answer to a question there is no room for."""
        most = self._config.max_in_flight
        return self._error(
            encoding, ErrorCode.BUSY, f"up to {most} requests are in flight here: ask again later"
        )

    def client_gone(self, scene: str, client: str) -> None:
        """Forget the avatars of a client that went."""
        self._scenes[scene].drop_client(client)

    def warm(self) -> None:
        """Warm every scene, so that the first client does not wait for compilers."""
        for scene in self._scenes.values():
            scene.warm()

    def _ask(self, key: str, payload: bytes, encoding: str) -> Any:
        """Put one question to the scene its key names."""
        route = keys.parse_question(key)
        scene = self._scenes.get(route.scene)
        if scene is None:
            served = ", ".join(sorted(self._scenes))
            raise UnknownSceneError(f"scene {route.scene!r} is not served here; served: {served}")
        if route.operation == "collide":
            return self._collide(scene, decode_request(CollideRequest, payload, encoding), route.client)
        if route.operation == "add_avatar":
            return self._add_avatar(scene, decode_request(AddAvatarRequest, payload, encoding), route.client)
        if payload:
            raise BadRequestError(f"info with a payload of {len(payload)} bytes: expected none")
        return self._infos[route.scene]

    def _collide(self, scene: SceneLike, request: CollideRequest, client: str) -> CollideAnswers:
        most = self._config.max_poses
        if len(request.poses) > most:
            raise TooLargeError(f"{len(request.poses)} poses in a request: at most {most}: split them")
        return scene.collide(request.avatar, request.poses, request.margin, client=client)

    def _add_avatar(self, scene: SceneLike, request: AddAvatarRequest, client: str) -> AvatarInfo:
        most = self._config.max_avatar_points
        if len(request.points) > most:
            raise TooLargeError(f"avatar of {len(request.points)} points: at most {most}: thin it out first")
        return scene.add_avatar(request.name, request.points, request.radius, client=client)

    def _error(self, encoding: str | None, code: ErrorCode, message: str) -> Answer:
        """An error as an answer, in the encoding that was stated if it is one."""
        try:
            stated = wire_encoding(encoding)
        except BadRequestError:
            stated = MSGPACK
        return Answer(encode(ErrorReply(code, message), stated), stated, False)


@contextmanager
def serving(scenes: Sequence[SceneLike], config: ServerConfig) -> Iterator[None]:
    """Serve scenes while inside; they stay the caller's, to be closed after.

    Entered once everything is warm and reachable. SolidcloudError: a scene or the endpoint is unusable.
    """
    service = Service(scenes, config)
    service.warm()
    with Transport([scene.name for scene in scenes], service, config):
        yield


def serve(scenes: Sequence[SceneLike], config: ServerConfig) -> None:
    """Serve scenes until SIGTERM or SIGINT, then answer what was accepted and return. Main thread only."""
    # A thread in pure Python may keep the interpreter for 5 ms by default while a reply waits for it.
    sys.setswitchinterval(0.0005)
    if config.insecure:
        log.warning("--insecure: whoever reaches %s may ask anything, unauthenticated", config.listen)
    with _signalled(signal.SIGTERM, signal.SIGINT) as stop, serving(scenes, config):
        names = ", ".join(scene.name for scene in scenes)
        print(f"serving {names} at {config.listen}", flush=True)
        stop.recv(1)


@contextmanager
def _signalled(*numbers: signal.Signals) -> Iterator[socket.socket]:
    """A socket that has something to read once one of the signals came, in place of what they did before.

    Not an event that a handler sets: the system may hand the signal to one of zenoh's threads, and then a main
    thread that waits for a lock is not woken to run the handler.
    """
    reader, writer = socket.socketpair()
    with reader, writer:
        writer.setblocking(False)
        before = {number: signal.signal(number, lambda *_: None) for number in numbers}
        descriptor = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        try:
            yield reader
        finally:
            signal.set_wakeup_fd(descriptor)
            for number, handler in before.items():
                signal.signal(number, handler)
