"""Simulation: the frames of a scene, which move its users by the effects that the scene declares.

`move` simulates one frame and remembers nothing. `step` simulates one frame of all users with a
motion command, whose bodies are remembered until they end. The same commands in the same order give
the same poses, bit for bit: nothing here reads a clock but to say how long a frame took.
"""

import logging
import threading
import time
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack, suppress
from typing import Any, Protocol

import numpy as np

from ...schemas.errors import BadRequestError, BusyError, ExpiredError, InternalError, SolidcloudError
from ...schemas.scene.scene_file import SceneFile
from ...schemas.wire.answers import Verdict
from ...schemas.wire.key_expressions import User, public_id
from ...schemas.wire.messages import AvatarInfo, SceneInfo
from ...schemas.wire.motion_messages import FRAME_SECONDS, Moved, MoveRequest, State, Wish
from ...schemas.wire.requests import make_poses
from ..archives.placed_archive import PlacedArchive
from ..avatars.avatar_model import AvatarModel
from ..queries.context.query_budget import EXACT, QueryBudget
from ..runtime.stop_flag import NO_STOP, StopFlag, StoppedError
from ..scene_interface import FrameCommand, FrameResult, recording_avatars
from .world.frame import Body
from .world.motion_commands import Pose, check_rigid, first_pose, frame_seconds, wished_pose
from .world.vectors import size, unit

log = logging.getLogger(__name__)

# A user that wished nothing for so long has left: others may walk where it stood [s].
SILENT_SECONDS = 30.0
# No client's name either.
_WARM = "*warm"


class Pipeline(Protocol):
    """The effects that a scene declares, as simulation/effects/pipeline.py makes them."""

    def run(
        self,
        body: Body,
        wish: Pose,
        seconds: float,
        budget: QueryBudget = EXACT,
        *,
        skip: Collection[str] | None = None,
    ) -> Moved: ...


class Stage(Protocol):
    """The scene whose users are simulated."""

    name: str
    archives: list[PlacedArchive]

    def info(self) -> SceneInfo: ...
    def avatar(self, name: str, client: str) -> AvatarModel: ...
    def add_avatar(
        self, name: str, points: Any, radius: float | None = None, *, client: str = ""
    ) -> AvatarInfo: ...
    def forget_client(self, client: str) -> None: ...


class Bodies(Protocol):
    """All that moves and blocks, for effects that let users meet one another or objects.

    See simulation/effects/bodies.py.
    """

    def __setitem__(self, user: User, body: Body) -> None: ...
    def pop(self, user: User, default: None = None) -> Any: ...
    def tell(self, poses: dict[str, list[list[float]]], stop: StopFlag) -> Callable[[], None]: ...


class Recorder(Protocol):
    """Who is told of all that decides what comes of wishes, in order; see replay_log.py."""

    def entered(self, user: User, avatar: AvatarModel) -> None: ...
    def ended(self, users: list[User]) -> None: ...
    def dropped(self, client: str) -> None: ...
    def frame(
        self,
        number: int,
        turns: Sequence[FrameCommand],
        outcomes: Sequence[FrameResult],
        opened: Sequence[Sequence[int]],
    ) -> None: ...
    def reloaded(self, generation: int) -> None: ...


class _Presence:
    """A user who walks the scene: its body, when it wished last on its own clock and on the server's."""

    __slots__ = ("body", "heard", "time")

    def __init__(self, body: Body) -> None:
        self.body = body
        self.time: float | None = None
        self.heard = 0.0


class Simulation:
    """The frames of a scene. Thread-safe.

    scene: whose users are simulated.  file: what it declares.  pipeline: its effects.
    bodies: updated where users meet.  place: returns some scan point, (3,) world [m].
    """

    def __init__(
        self,
        scene: Stage,
        file: SceneFile,
        pipeline: Pipeline,
        bodies: Bodies | None = None,
        place: Callable[[], Any] | None = None,
    ) -> None:
        self.scene, self.file, self._pipeline = scene, file, pipeline
        self._up = unit(file.up)
        self._present: dict[User, _Presence] = {}
        self._bodies, self._place = bodies, place
        self._recorder: Recorder | None = None
        self._frames = 0
        self._frame = threading.Lock()  # held for a frame: bodies change under it alone

    @property
    def most_users(self) -> int:
        """How many may walk it at a time."""
        return self.file.limits.users

    @property
    def users(self) -> list[User]:
        """Who walks it now."""
        return list(self._present)

    def record(self, recorder: Recorder | None) -> None:
        """Tell `recorder` of every frame from now on, before anybody walks the scene; None: nobody."""
        with self._frame:
            self._recorder = recorder

    def move(
        self,
        name: str,
        pose_from: Any,
        pose_to: Any,
        seconds: float = FRAME_SECONDS,
        *,
        client: str = "",
        stop: StopFlag = NO_STOP,
    ) -> Moved:
        """Where avatar `name` gets from one pose (1, 4, 4) towards another in a frame; nothing is remembered.

        seconds: that the frame lasts [s].  stop: ends the frame early: the avatar stays, and its verdict is unknown.
        Raises BadRequestError, BadTransformError, UnknownAvatarError.
        """
        asked = MoveRequest(
            avatar=name,
            pose_from=make_poses(pose_from, "pose_from"),
            pose_to=make_poses(pose_to, "pose_to"),
            seconds=float(seconds),
        )
        user = User(client, name)
        begin = check_rigid(asked.pose_from[0].copy(), "pose_from")
        wish = check_rigid(asked.pose_to[0], "pose_to")
        body = _body(user, self.scene.avatar(name, client), begin)
        try:
            return self._pipeline.run(body, wish, asked.seconds, QueryBudget(stop=stop))
        except StoppedError:
            left = size(wish[:3, 3] - begin[:3, 3])
            return Moved(pose=begin[None], verdict=int(Verdict.UNKNOWN), left=left, unknown=True)

    def step(
        self,
        turns: Sequence[FrameCommand],
        now: float | None = None,
        skips: Sequence[Collection[str]] | None = None,
        stops: Sequence[StopFlag] | None = None,
    ) -> list[FrameResult]:
        """One frame of everybody who wished, one after the other in the order of `turns`; what came of each.

        A user's first wish puts its body where the scene's spawn is, or else where it wishes to be. What a wish is
        refused for is its outcome; the others go on.
        now: on a clock of the caller's [s]; who has not wished for SILENT_SECONDS of it ends first; None: nobody does.
        skips: of each turn, the effects to be left out, as a frame recorded says; None: as the frame's budget has it.
        stops: of each turn, what ends it early: its user stays where it was, and the outcome is ExpiredError.
        """
        with self._frame:
            if now is not None:
                self._leave([u for u, there in self._present.items() if now - there.heard > SILENT_SECONDS])
            self._frames += 1
            outcomes, opened = [], []
            for number, turn in enumerate(turns):
                skip = None if skips is None else skips[number]
                stop = NO_STOP if stops is None else stops[number]
                used: list[bytes] = []
                with recording_avatars(used):
                    said = self._turn(turn, now, skip, stop)
                there = self._present.get(turn.user)
                about = b"".join(used) if there is None else there.body.avatar.digest
                outcomes.append(FrameResult(turn.user, said, about))
                opened.append(() if there is None else there.body.generations)
            if self._recorder is not None:
                self._recorder.frame(self._frames, turns, outcomes, opened)
            return outcomes

    def _turn(
        self, turn: FrameCommand, now: float | None, skip: Collection[str] | None, stop: StopFlag
    ) -> State | SolidcloudError:
        """One user's frame; what it is refused for is returned."""
        begin = time.perf_counter()
        try:
            moved = self._moved(turn.user, turn.wish, now, skip, stop)
        except SolidcloudError as error:
            return error
        except StoppedError:
            return ExpiredError(f"{stop.reason}: the user stays where it was")
        except Exception as error:  # of this user alone: the others' frames go on
            log.exception("a frame of %s in %s", _public_name(turn.user), self.scene.name)
            return InternalError(f"{type(error).__name__} in the server: its log says more")
        wish = turn.wish
        return State(
            **{name: getattr(moved, name) for name in Moved.__struct_fields__},
            seq=wish.seq,
            time=wish.time,
            frame=self._frames,
            late=turn.late,
            seconds=time.perf_counter() - begin,
        )

    def _moved(
        self, user: User, wish: Wish, now: float | None, skip: Collection[str] | None, stop: StopFlag
    ) -> Moved:
        """What comes of one wish; its user's body is begun with it, and not where it is refused."""
        there = self._present.get(user)
        present = self._begun(user, wish) if there is None else there
        seconds = frame_seconds(wish, present.time)
        aim = wished_pose(wish, present.body.pose, seconds, self._up)
        with ExitStack() as refused:
            if wish.objects:
                if self._bodies is None:
                    raise BadRequestError(f"{self.scene.name}: a wish moves objects: this scene has none")
                refused.callback(self._bodies.tell(wish.objects, stop))
            moved = self._pipeline.run(present.body, aim, seconds, QueryBudget(stop=stop), skip=skip)
            refused.pop_all()
        present.time = wish.time
        present.heard = present.heard if now is None else now
        self._present[user] = present
        if self._bodies is not None:
            self._bodies[user] = present.body
        return moved

    def _begun(self, user: User, wish: Wish) -> _Presence:
        """A user who comes in; BusyError where the scene is full."""
        if len(self._present) >= self.most_users:
            raise BusyError(
                f"{self.scene.name}: {len(self._present)} users walk it, as many as its limits allow: come again later"
            )
        avatar = self.scene.avatar(user.avatar, user.client)
        if self._recorder is not None:
            self._recorder.entered(user, avatar)
        return _Presence(_body(user, avatar, first_pose(wish, self.file.spawn, self._up)))

    def _leave(self, users: list[User]) -> None:
        """End bodies."""
        users = [user for user in users if user in self._present]
        for user in users:
            del self._present[user]
            if self._bodies is not None:
                self._bodies.pop(user)
        if users and self._recorder is not None:
            self._recorder.ended(users)

    def end(self, user: User) -> None:
        """A user leaves the scene: others may walk where it stood. Its next wish is a first one."""
        with self._frame:
            self._leave([user])

    def end_client(self, client: str) -> None:
        """All users of a client leave the scene."""
        with self._frame:
            self._leave([user for user in self._present if user.client == client])

    def drop_client(self, client: str) -> None:
        """Forget the bodies and avatars of a client that is gone; see `Scene.drop_client`."""
        with self._frame:
            self._leave([user for user in self._present if user.client == client])
            self.scene.forget_client(client)
            if self._recorder is not None:
                self._recorder.dropped(client)

    def warm(self) -> None:
        """Simulate some frames, so that no user waits for compilation.

        They go at a scan point from above, out of it and past it, and at another user.
        """
        place = np.array(self.scene.info().bounds[0]) if self._place is None else self._place()
        user, other = User(_WARM, "warm"), User(_WARM, "other")
        self.scene.add_avatar("warm", [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], 0.05, client=_WARM)
        across = np.roll(self._up, 1)
        far = min(0.5, self.file.limits.longest_move / 4)
        for way in (self._up, -self._up, across, self._up + across, 0 * across):
            for begin, end in ((way, -way), (-0 * way, way), (way, way + across)):
                poses = np.tile(np.eye(4), (2, 1, 1, 1))
                poses[:, 0, :3, 3] = place + far * begin, place + far * end
                with self._frame, suppress(SolidcloudError):  # of a place where a frame makes no sense
                    body = _body(user, self.scene.avatar("warm", _WARM), poses[0, 0])
                    if self._bodies is not None:
                        there = _body(other, body.avatar, poses[:, 0].mean(axis=0))
                        self._bodies[other] = there
                    for pose in (poses[1, 0], poses[1, 0], poses[0, 0]):
                        self._pipeline.run(body, pose, FRAME_SECONDS)
        if self._bodies is not None:
            self._bodies.pop(other)
        self.scene.forget_client(_WARM)

    def reloaded(self, generation: int) -> None:
        """Record that the archives were reloaded."""
        if self._recorder is not None:
            with self._frame:
                self._recorder.reloaded(generation)


def _body(user: User, avatar: AvatarModel, pose: Pose) -> Body:
    """Return a user's body where it begins."""
    return Body(_public_name(user), avatar, pose, user=user)


def _public_name(user: User) -> str:
    """Return a name that others may be told, and logs: the client's id is a secret."""
    return f"{public_id(user.client)}/{user.avatar}"
