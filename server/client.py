"""Client: the queries of `Scene`, sent over zenoh to a server in another process.

An item that no server answers is `unknown`, never clear. A long list of poses is sent in several
requests; zenoh_client/server_connection.py sends them and reads the replies.
"""

import logging
import os
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import numpy as np
from msgspec import structs
from numpy.typing import ArrayLike

from ..schemas.archive.pose_arrays import make_poses, one_pose
from ..schemas.errors import BadRequestError, BusyError, InternalError, SolidcloudError, TooLargeError
from ..schemas.wire import key_expressions
from ..schemas.wire.answers import Cost, Part, Verdict
from ..schemas.wire.encoding import decode_answer, encode
from ..schemas.wire.motion_messages import FRAME_SECONDS, WAIT, Moved, MoveRequest, checked_late
from ..schemas.wire.overview_messages import OverviewAnswer, OverviewRequest
from ..schemas.wire.path_messages import PathRequest, answers_to_part, check_path_parameters
from ..schemas.wire.question_rules import Question, request_fields
from ..schemas.wire.question_table import QUESTIONS
from ..schemas.wire.request_limits import MAX_POSES
from ..schemas.wire.requests import make_positions
from ..schemas.wire.scene_messages import AvatarInfo, ReloadAnswer, SceneInfo
from ..schemas.wire.stats import StatsAnswer, StatsRequest
from ..schemas.wire.tile_messages import TileAnswer, VoxelsAnswer, tile_request, voxels_request
from .avatars.avatar_shape import MeshLike, avatar_shape
from .scene_interface import AvatarShape, QueryMethods, list_avatars
from .zenoh_client.client_identity import AddedAvatar
from .zenoh_client.client_session import ClientSession, CommandNumbers
from .zenoh_client.residency_stream import ResidencyStream
from .zenoh_client.server_connection import ServerConnection
from .zenoh_common.endpoints import DEFAULT_ENDPOINT

log = logging.getLogger(__name__)

# Poses in one request (512 KiB). A longer one would keep other clients waiting for seconds, and its
# answer might miss the timeout.
BATCH_POSES = 4096
# The same for queries that take up to milliseconds a pose.
SLOW_BATCH = 256
# Size of the answer to a batch, far below the largest message [bytes].
_BATCH_BYTES = 8 << 20

_A = TypeVar("_A", bound=Cost)


class Client(QueryMethods):
    """Scene served by another process; a context manager, thread-safe, with the methods of `Scene`.

    endpoint: endpoint of the server, such as tcp/127.0.0.1:7447.
    scene: name under which the server serves the scene.
    timeout: time limit of one request [s]; a long list of poses is sent in several requests.
    key_file: file with the server's key, as given to `solidcloud serve --key-file`; None: the key
    that a server of the same user on the same host has stored. With a key, replies that are not
    sealed with it are ignored.

    Entering raises UnknownSceneError if servers answer and none serves this scene. It succeeds
    without a server: queries then return `UNKNOWN` until there is a server.
    The client remembers its avatars and adds them again to a server that does not know them. If a
    sealed answer is about avatars that differ from those the client added, another program uses the
    client's id: the answer is ignored, and the client takes a new id that no other program knows.

    The query methods raise the errors of the server: BadRequestError, BadTransformError,
    UnknownAvatarError, BusyError and others.

    unanswered: number of poses, rays, points, motions and objects so far that are `UNKNOWN` because
    no server answered.
    """

    own_options = frozenset[str]()

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
        self._connection = ServerConnection(endpoint, self.name, timeout, key_file)
        self._numbers: dict[str, CommandNumbers] = {}  # by avatar
        self._lock = threading.Lock()
        self.unanswered = 0

    def __enter__(self) -> Self:
        self._connection.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        """Return the scene, the server's endpoint, the state and the avatars in one line."""
        lost = f", {self.unanswered:,} items unanswered" if self.unanswered else ""
        connection = self._connection
        return (
            f"<Client of {self.name!r} at {connection!r}, {list_avatars(connection.avatars.names())}{lost}>"
        )

    def close(self) -> None:
        """Disconnect; the server then drops this client's avatars. Closing twice is allowed."""
        self._connection.close()

    def info(self) -> SceneInfo:
        """Return the description of the scene. Raise BusyError if no server answers."""
        return decode_answer(SceneInfo, self._connection.require("info"))

    def reload(self) -> ReloadAnswer:
        """Make the server reload the archives' folders; later requests use the new content.

        Raise BusyError if no server answers, or the generation before the served one is still in
        use. Raise FormatError and others if the folder's content is invalid; the server then
        continues with the old one.
        """
        return decode_answer(ReloadAnswer, self._connection.require("reload"))

    def stats(self, keys: bool = False) -> StatsAnswer:
        """Return the statistics of the scene's cache and users.

        Raise BusyError if no server answers. keys: also list the resident voxels.
        """
        return decode_answer(StatsAnswer, self._connection.require("stats", encode(StatsRequest(keys))))

    def overview(self, limit: int = 100_000) -> OverviewAnswer:
        """Return a sample of the scene's points; see `OverviewAnswer`. Raise BusyError if no server answers."""
        request = encode(OverviewRequest(limit))
        return decode_answer(OverviewAnswer, self._connection.require("overview", request))

    def voxels(self, place: ArrayLike, reach: float | None = None, limit: int = 4096) -> VoxelsAnswer:
        """Return the voxels near a place (3,) [m], nearest first; see `VoxelsRequest`.

        Raise BusyError if no server answers.
        """
        request = voxels_request(place, reach, limit)
        return decode_answer(VoxelsAnswer, self._connection.require("voxels", encode(request)))

    def tile(
        self, archive: int, voxel: Sequence[int], detail: int = 0, level: int | None = None
    ) -> TileAnswer:
        """Return points or spheres of a voxel; see `TileRequest`. Raise BusyError if no server answers."""
        request = tile_request(archive, voxel, detail, level)
        return decode_answer(TileAnswer, self._connection.require("tile", encode(request)))

    def residency_changes(self) -> ResidencyStream:
        """Return the changes of what is resident of the scene from now on, for a `with`.

        It yields a `ResidencyChanges` at least every half second while a server answers.
        """
        self._connection.check_open()
        return ResidencyStream(self._connection, self.name)

    def silence(self, operation: str) -> str:
        """Return a message on why no server answered an operation, and what to do."""
        return self._connection.explain_silence(operation)

    def add_avatar(
        self,
        name: str,
        points: "ArrayLike | str | os.PathLike[str] | MeshLike | AvatarShape",
        radius: float | None = None,
        *,
        up: str | None = None,
        units: str | None = None,
        scale: float = 1.0,
        hollow: bool = False,
    ) -> AvatarInfo:
        """Add an avatar of this client: points (n, 3), the path of a file, or a mesh object.

        Arguments are as in `Scene.add_avatar`. This process reads the file, and needs the
        extra `readers` for some formats.
        If no server answers, the avatar is remembered and added later; the answer then has `radius`
        as given here and no `bounding_radius`. Raise BadRequestError if another avatar has the name
        or this one is invalid or without points, ScanError if the file cannot be read,
        TooLargeError beyond the server's limits.
        """
        shape = avatar_shape(points, radius, up=up, units=units, scale=scale, hollow=hollow)
        avatar = AddedAvatar(make_positions(shape.points).copy(), shape.radius, shape.inner_points)
        request = avatar.request(name)
        avatars = self._connection.avatars
        new = avatars.add(name, avatar)
        try:
            payload = self._connection.ask("add_avatar", request)
        except BusyError:
            payload = None  # remembered, and added with the first query about it
        except SolidcloudError:
            if new:
                avatars.remove(name)
            raise
        if payload is None:
            info = AvatarInfo(name, len(avatar.points), avatar.radius, None, avatar.inner_points)
        else:
            info = avatars.accepted(name, payload)
        return structs.replace(info, description=shape.description)

    def ask(self, question: Question[_A], *arguments: Any, **options: Any) -> _A:
        """Answer a question, in several requests if it has many items.

        arguments, options: as for `QueryMethods.ask`.
        Items that no server answers are `UNKNOWN`. If no server answers `objects`, every pair is
        listed as `UNKNOWN`.
        """
        fields = request_fields(question, arguments, options)
        self.check_options(question, options)
        return self._ask_in_batches(question, fields, options)

    def _ask_in_batches(
        self, question: Question[_A], fields: Mapping[str, Any], options: Mapping[str, Any]
    ) -> _A:
        """Send requests of at most one batch of items each, and join their answers.

        fields: of the request for all items.  options: query options; the time that earlier
        requests took is subtracted from the time budget of later ones. If an answer exceeds the
        largest message, its items are sent again in smaller requests, unless the question is about
        all items together.
        """
        k, arrays = len(fields[question.counted]), question.arrays
        batch = SLOW_BATCH if question.slow else BATCH_POSES
        batch = max(1, k) if question.whole else question.most_items(batch, _BATCH_BYTES, fields)
        names = [item.avatar for item in fields.get("objects", ())]
        if "avatar" in fields:
            names = [fields["avatar"]]
        parts: list[_A] = []
        begin = time.monotonic()
        start, budget, left = 0, options.get("budget_ms"), options
        while not parts or start < k:
            stop = min(start + batch, k)
            try:
                own = {name: value[start:stop] if name in arrays else value for name, value in fields.items()}
                request = question.request(**own, **left)
                payload = self._connection.ask_about(question.name, encode(request), names)
            except TooLargeError:
                if stop - start <= 1 or question.whole:
                    raise
                batch = (stop - start + 1) // 2
                continue
            finally:
                if budget is not None:
                    rest = max(0.0, budget - (time.monotonic() - begin) * 1e3)
                    left = {**options, "budget_ms": rest}
            if payload is None:
                # Skip the remaining batches: with a frozen server each would cost a timeout.
                self._count_unanswered(k - start)
                parts.append(question.unknown(k - start, bounded=bool(options.get("tolerance"))))
                break
            parts.append(question.check(decode_answer(question.answers, payload), stop - start))
            start = stop
        return question.join(parts)

    def _count_unanswered(self, count: int) -> None:
        """Count items that no server answered."""
        with self._lock:
            self.unanswered += count

    def move(
        self,
        name: str,
        pose_from: Any,
        pose_to: Any,
        seconds: float = FRAME_SECONDS,
        *,
        late: str = WAIT,
    ) -> Moved:
        """Return the pose that an avatar reaches from one pose to another in a frame.

        pose_from, pose_to: (4, 4) or (1, 4, 4) float64, avatar to world.
        The scene's effects apply, and nothing is stored. seconds: duration of the frame.
        late: "wait" for voxels that are not in memory, or answer by "bounds": WIRE.md, "Sessions".
        If no server answers, the result is `pose_from` with the verdict `UNKNOWN`.
        """
        request = MoveRequest(
            avatar=name,
            pose_from=one_pose(pose_from, "pose_from")[None],
            pose_to=one_pose(pose_to, "pose_to")[None],
            seconds=float(seconds),
            late=checked_late(late),
        )
        payload = self._connection.ask_about("move", encode(request), [name])
        if payload is None:
            self._count_unanswered(1)
            way = request.pose_to[0, :3, 3] - request.pose_from[0, :3, 3]
            left = float(np.linalg.norm(way))
            return Moved(pose=request.pose_from, verdict=int(Verdict.UNKNOWN), left=left, unknown=True)
        return decode_answer(Moved, payload)

    def path(self, name: str, poses: Any, op: str = "collide", **parameters: Any) -> Iterator[Part]:
        """Answer `op` (collide, distance, contacts, sweep) along up to 100,000 poses, in a request.

        name: of the avatar.  poses: (k, 4, 4) or (4, 4), avatar to world. A sweep has k - 1
        motions, each from one pose to the next; the others examine the poses only.
        parameters: of `op` besides the poses, including tolerance and budgets; `budget_ms` is for
        the whole path.
        Yield answers for items [first, first + n) of `total` as they arrive, in order and without
        gaps. If no part arrives for `timeout`, the remaining items are `UNKNOWN`.
        """
        array = make_poses(poses)
        check_path_parameters(op, parameters)
        if len(array) > MAX_POSES:
            raise TooLargeError(f"path of {len(array)} poses: at most {MAX_POSES}: ask for it in pieces")
        request = PathRequest(name, array, op, **parameters)  # type: ignore[arg-type]
        question = QUESTIONS[op]
        total = question.items_along(len(array))
        return self._parts(question, encode(request), name, total, bool(parameters.get("tolerance")))

    def _parts(
        self, question: Question[Any], request: bytes, name: str, total: int, bounded: bool
    ) -> Iterator[Part]:
        """Yield the parts of a path, each once and in order; items of missing parts are unknown."""

        def missing(stop: int) -> Part:
            self._count_unanswered(stop - expected)
            none = question.unknown(stop - expected, bounded=bounded)
            part: Part = answers_to_part(none, expected, total)
            return part

        expected, complete = 0, False
        for payload in self._connection.stream_about("path", request, [name]):
            part = decode_answer(question.part, payload)
            question.check(part, len(part))
            if part.total != total or part.first < 0 or part.first + len(part) > total:
                raise InternalError(
                    f"part of a path for {part.first} to {part.first + len(part)} of {part.total}: "
                    f"expected some of {total}"
                )
            if part.first < expected or (len(part) == 0 and total):
                log.warning(
                    "part of a path at %d of %d arrived twice or too late: ignored", part.first, total
                )
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

    def session(self, avatar: str, *, late: str = WAIT) -> ClientSession:
        """Return a session of an avatar of this client or of the scene, for a `with`.

        It sends motion commands and receives the resulting states. The server simulates the scene's
        effects. avatar: 1 to 64 of A-Z, a-z, 0-9, '.', '_' and '-'.
        late: what frames do about voxels that are not in memory: "wait" until they are loaded, or
        go only as far as "bounds" of these voxels prove the way clear.
        """
        connection = self._connection
        connection.check_open()
        key_expressions.check_name(avatar, "avatar of a session")
        with self._lock:
            numbers = self._numbers.setdefault(avatar, CommandNumbers())
        return ClientSession(connection, self.name, avatar, numbers, checked_late(late))
