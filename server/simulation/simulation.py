"""Simulation: the frames of a scene, which move its users by the effects that the scene declares.

`move` simulates one frame and keeps no state. `step` simulates one frame of all users with a motion
command, and keeps their bodies until they end. The same commands in the same order give the same
poses, bit for bit: a clock is read only to report how long a frame took.
"""

import logging
import math
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from ...schemas.archive.pose_arrays import one_pose
from ...schemas.archive.rigid_pose import check_rigid
from ...schemas.errors import (
    BadRequestError,
    BusyError,
    ErrorCode,
    ExpiredError,
    InternalError,
    SolidcloudError,
    UnknownAvatarError,
)
from ...schemas.scene.scene_file import SceneFile, Spawn
from ...schemas.wire.answers import Verdict
from ...schemas.wire.key_expressions import User, public_id
from ...schemas.wire.motion_messages import (
    BOUNDS,
    FRAME_SECONDS,
    WAIT,
    Moved,
    MoveRequest,
    State,
    Wish,
    checked_late,
)
from ...schemas.wire.stats import EffectStats
from ..archives.rigid_transform import transform_points
from ..avatars.avatar_model import AvatarModel
from ..queries.query_inputs import LateVoxels, QueryBudget
from ..runtime.stop_flag import NO_STOP, StopFlag, StoppedError
from ..scene_interface import FrameCommand, FrameResult, recording_avatars
from .replay_log import FrameLog, LoggedTurn, take_record
from .world.frame import MAX_TOUCHED, Body, Pose, Vec, translated
from .world.vectors import multiply, norm, orthonormalize, rotation_matrix, unit_vector

if TYPE_CHECKING:  # a scene that is only queried imports neither
    from .effects.effect_pipeline import Pipeline
    from .world.bodies import Bodies
    from .world.collision_world import World

log = logging.getLogger(__name__)

# Limit on the duration of a frame [s]. A motion command that is due for longer takes several.
LONGEST_FRAME = 0.1
# After a pause of more than this, a viewer continues as after one of LONGEST_FRAME [s]: it stood
# still, and did not send two motion commands a second.
LONGEST_PAUSE = 0.5
# A user that has sent no motion command for this long is removed with its body [s].
SILENT_SECONDS = 30.0
# Stop flag of the turns of a replay that were stopped when they were logged.
_STOPPED = StopFlag()
_STOPPED.set("stopped when it was logged")
# Client of the avatars of `warm`; no real client has this name.
_WARM = "*warm"


@dataclass(slots=True)
class _Presence:
    """User in the scene.

    body: its body.  time, heard: time of its last command, on its own and on the server's clock
    [s].
    """

    body: Body
    time: float | None = None
    heard: float = 0.0


class Simulation:
    """Frames of a scene. Thread-safe.

    scene: the `Scene` of the users.  file: scene file.  pipeline: the effects that it declares; its
    `bodies`, None if users cannot collide, are updated after each frame.
    """

    def __init__(self, scene: Any, file: SceneFile, pipeline: "Pipeline") -> None:
        self.scene, self.file, self._pipeline = scene, file, pipeline
        self._up = unit_vector(file.up)
        self._present: dict[User, _Presence] = {}
        self._bodies: Bodies | None = pipeline.bodies
        self._recorder: FrameLog | None = None
        self._frames = 0
        self._frame = threading.Lock()  # held for a frame; bodies change only while it is held

    @property
    def most_users(self) -> int:
        """Return the largest number of users at a time."""
        return self.file.limits.users

    @property
    def users(self) -> list[User]:
        """Return the users that are present."""
        return list(self._present)

    @property
    def world(self) -> "World":
        """Return the world that the frames query."""
        return self._pipeline.world

    def effect_stats(self) -> list[EffectStats]:
        """Return what each effect has cost so far, in the order in which they run."""
        return self._pipeline.stats()

    def record(self, recorder: FrameLog | None) -> None:
        """Record every frame from now on with `recorder`; None ends it. Call it before users enter."""
        with self._frame:
            self._recorder = recorder

    def move(
        self,
        name: str,
        pose_from: Any,
        pose_to: Any,
        seconds: float = FRAME_SECONDS,
        *,
        late: str = WAIT,
        client: str = "",
        stop: StopFlag = NO_STOP,
    ) -> Moved:
        """Move avatar `name` from one pose towards another for one frame; keep no state.

        pose_from, pose_to: (4, 4) or (1, 4, 4) float64, avatar to world, rigid.
        seconds: duration of the frame [s].  late: as in `MoveRequest`.  stop: ends the frame early:
        the avatar stays, and its verdict is unknown.
        Raises BadRequestError, BadTransformError, UnknownAvatarError.
        """
        request = MoveRequest(
            avatar=name,
            pose_from=one_pose(pose_from, "pose_from")[None],
            pose_to=one_pose(pose_to, "pose_to")[None],
            seconds=float(seconds),
            late=checked_late(late),
        )
        user = User(client, name)
        begin = check_rigid(request.pose_from[0].copy(), "pose_from")
        target = check_rigid(request.pose_to[0], "pose_to")
        body = _make_body(user, self.scene.avatar(name, client), begin)
        try:
            return self._pipeline.run(body, target, request.seconds, _frame_budget(request.late, stop))
        except StoppedError:
            left = norm(target[:3, 3] - begin[:3, 3])
            return Moved(pose=begin[None], verdict=int(Verdict.UNKNOWN), left=left, unknown=True)

    def step(
        self,
        turns: Sequence[FrameCommand],
        now: float | None = None,
        stop: StopFlag = NO_STOP,
        logged: Sequence[LoggedTurn] | None = None,
    ) -> list[FrameResult]:
        """Simulate one frame: the motion commands of `turns`, in order. Return their outcomes.

        A user's first command places its body at the scene's spawn, or without one at the commanded
        pose. The outcome of a refused command is its error; the others are simulated.
        now: time on the caller's clock [s]. Users without a command for SILENT_SECONDS are removed
        first; None: no user is removed.
        stop: ends the frame early: users not yet simulated stay, with the outcome ExpiredError.
        logged: of each turn, for a replay. A result with a recorded body is taken without a
        simulation, and a turn that was stopped is stopped again. All others wait for voxels.
        """
        with self._frame:
            if now is not None:
                self._remove([u for u, there in self._present.items() if now - there.heard > SILENT_SECONDS])
            self._frames += 1
            outcomes = []
            for number, turn in enumerate(turns):
                was = None if logged is None else logged[number]
                late = turn.wish.late
                if was is not None:
                    # A frame without a record lacked nothing: it gives what a wait would give. When a
                    # frame is stopped depended on a clock.
                    late, stop = WAIT, _STOPPED if was.error == ErrorCode.EXPIRED else NO_STOP
                budget = _frame_budget(late, stop)
                used: list[bytes] = []
                with recording_avatars(used):
                    state = self._simulate_turn(turn, now, budget, was)
                there = self._present.get(turn.user)
                body = None if there is None else there.body
                outcomes.append(
                    FrameResult(turn.user, state, b"".join(used) if body is None else body.avatar.digest)
                )
                if self._recorder is not None:
                    lacked = budget.late is not None and budget.late.count > 0
                    self._recorder.turn(turn, state, body, self._bodies, lacked=lacked)
            if self._recorder is not None:
                self._recorder.write(self._frames)
            return outcomes

    def _simulate_turn(
        self,
        turn: FrameCommand,
        now: float | None,
        budget: QueryBudget,
        logged: LoggedTurn | None,
    ) -> State | SolidcloudError:
        """Simulate the frame of one user; return its state, or the error of a refused command."""
        begin = time.perf_counter()
        try:
            moved = self._simulate_command(turn.user, turn.wish, now, budget, logged)
        except SolidcloudError as error:
            return error
        except StoppedError:
            return ExpiredError(f"{budget.stop.reason}: the user stays where it was")
        except Exception as error:  # the frames of the other users must continue
            log.exception("a frame of %s in %s", _public_name(turn.user), self.scene.name)
            return InternalError(f"{type(error).__name__} in the server: see the server's log")
        command = turn.wish
        return State(
            **{name: getattr(moved, name) for name in Moved.__struct_fields__},
            seq=command.seq,
            time=command.time,
            frame=self._frames,
            late=turn.late,
            seconds=time.perf_counter() - begin,
        )

    def _simulate_command(
        self,
        user: User,
        command: Wish,
        now: float | None,
        budget: QueryBudget,
        logged: LoggedTurn | None,
    ) -> Moved:
        """Move a user by one command; a new user enters with it, unless the command is refused."""
        present = self._present.get(user) or self._enter(user, command)
        body, bodies = present.body, self._bodies
        with ExitStack() as undo:  # a command that is refused or stopped changes nothing
            if bodies is not None:
                undo.callback(bodies.restore, bodies.snapshot())
            if command.objects:
                if bodies is None:
                    raise BadRequestError(
                        f"{self.scene.name}: a wish moves objects: this scene has no objects"
                    )
                undo.callback(bodies.place_objects(command.objects, budget.stop))
            if logged is None or logged.body is None:
                durations = frame_durations(command, present.time)
                if len(durations) > 1:
                    undo.callback(_restore, body, replace(body, effect_state=dict(body.effect_state)))
                moved = self._run_frames(body, command, durations, budget)
            else:
                moved = take_record(logged, body, self.world, bodies)
            undo.pop_all()
        present.time = command.time
        present.heard = present.heard if now is None else now
        self._present[user] = present
        if bodies is not None:
            bodies[user] = body
        return moved

    def _run_frames(self, body: Body, command: Wish, durations: list[float], budget: QueryBudget) -> Moved:
        """Run the frames of a user's motion command, nearly always one. durations: as in `frame_durations`."""
        moves: list[Moved] = []
        for seconds in durations:
            if moves and self._bodies is not None:
                self._bodies[body.user] = body
            target = target_pose(command, body.pose, seconds, self._up)
            moves.append(self._pipeline.run(body, target, seconds, budget))
        last = moves[-1]
        if len(moves) == 1:
            return last
        touched = {(each.what, each.place): each for moved in moves for each in moved.touched}
        return msgspec.structs.replace(
            last,
            left=last.left if command.velocity is None else sum(moved.left for moved in moves),
            touched=list(touched.values())[:MAX_TOUCHED],
            stepped=sum(moved.stepped for moved in moves),
            unknown=any(moved.unknown for moved in moves),
        )

    def _enter(self, user: User, command: Wish) -> _Presence:
        """Return the presence of a new user. Raises BusyError if the scene is full."""
        if len(self._present) >= self.most_users:
            raise BusyError(
                f"{self.scene.name}: {len(self._present)} users are in it, the maximum of its limits: try again later"
            )
        avatar = self.scene.avatar(user.avatar, user.client)
        if self._recorder is not None:
            self._recorder.entered(user, avatar)
        return _Presence(_make_body(user, avatar, first_pose(command, self.file.spawn, self._up)))

    def _remove(self, users: list[User]) -> None:
        """Remove the bodies of users."""
        users = [user for user in users if user in self._present]
        for user in users:
            del self._present[user]
            if self._bodies is not None:
                self._bodies.pop(user)
        if users and self._recorder is not None:
            self._recorder.frame.ended += users

    def end(self, user: User) -> None:
        """Remove a user and its body. Its next command is again a first one."""
        with self._frame:
            self._remove([user])

    def drop_client(self, client: str) -> None:
        """Remove the bodies and avatars of a client that disconnected; see `Scene.drop_client`."""
        with self._frame:
            self._remove([user for user in self._present if user.client == client])
            self.scene.forget_client(client)
            if self._recorder is not None:
                self._recorder.dropped(client)

    def warm(self) -> None:
        """Simulate some frames, so that no user waits for compilation. Nobody else may use this simulation.

        Their motions lead onto a scan point from above, away from it, past it, and into another
        user.
        """
        place = _find_scan_point(self.world)
        user, other = User(_WARM, "warm"), User(_WARM, "other")
        self.scene.add_avatar("warm", [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], 0.05, client=_WARM)
        across = np.roll(self._up, 1)
        far = min(0.5, self.file.limits.longest_move / 4)
        for way in (self._up, -self._up, across, self._up + across, 0 * across):
            for begin, end in ((way, -way), (-0 * way, way), (way, way + across)):
                first, last = (translated(np.eye(4), place + far * each) for each in (begin, end))
                with self._frame, suppress(SolidcloudError):  # such a frame may be impossible here
                    body = _make_body(user, self.scene.avatar("warm", _WARM), first)
                    if self._bodies is not None:
                        self._bodies[other] = _make_body(other, body.avatar, (first + last) / 2)
                    for pose in (last, last, first):
                        self._pipeline.run(body, pose, FRAME_SECONDS)
        if self._bodies is not None:
            self._bodies.pop(other)
        self.scene.forget_client(_WARM)


def _frame_budget(late: str, stop: StopFlag) -> QueryBudget:
    """Return the budget of a frame's queries. late: as in `Wish`."""
    return QueryBudget(stop=stop, request=stop, late=LateVoxels() if late == BOUNDS else None)


def _make_body(user: User, avatar: AvatarModel, pose: Pose) -> Body:
    """Return a new body of a user."""
    return Body(_public_name(user), avatar, pose, user=user)


def _public_name(user: User) -> str:
    """Return a name that other users and logs may see: the client's id is a secret."""
    return f"{public_id(user.client)}/{user.avatar}"


def frame_durations(command: Wish, before: float | None) -> list[float]:
    """Return how long each of the frames of a motion command lasts [s]; there is at least one.

    before: time of the user's previous command, on its clock; None: it is the first.
    """
    if before is None:
        return [FRAME_SECONDS]
    seconds = max(command.time - before, 0.0)
    if seconds > LONGEST_PAUSE:
        seconds = LONGEST_FRAME
    count = max(1, math.ceil(seconds / LONGEST_FRAME - 1e-9))  # times of clients are rounded
    return [min(seconds / count, LONGEST_FRAME)] * count


def target_pose(command: Wish, pose: Pose, seconds: float, up: Vec) -> Pose:
    """Return the target pose (4, 4) of a motion command given at `pose`. up: (3,) unit vector.

    A velocity applies for the duration of the frame.
    """
    if command.velocity is None:
        return check_rigid(command.pose[0], "pose")
    there = pose.copy()
    there[:3, 3] += np.array(command.velocity) * seconds
    if command.turn and seconds:
        there[:3, :3] = orthonormalize(multiply(rotation_matrix(up, command.turn * seconds), pose))
    return there


def first_pose(command: Wish, spawn: Spawn | None, up: Vec) -> Pose:
    """Return the pose at which a user enters with its first command.

    Raise UnknownAvatarError if neither the scene's spawn nor the command gives one.
    """
    if spawn is not None:
        pose = np.eye(4)
        pose[:3, :3] = rotation_matrix(up, math.radians(spawn.heading))
        pose[:3, 3] = spawn.position
        return pose
    if command.velocity is not None:
        raise UnknownAvatarError("the avatar has no pose yet, and the scene has no spawn: begin with a pose")
    return check_rigid(command.pose[0].copy(), "pose")


def _restore(body: Body, before: Body) -> None:
    """Restore the state of a body."""
    for each in fields(body):
        setattr(body, each.name, getattr(before, each.name))


def make_simulation(scene: Any, file: SceneFile) -> Simulation:
    """Return the simulation of a scene's frames, with the effects that `file` declares."""
    # Imported here, because a scene that is only queried needs neither effects nor their kernels.
    from .effects.effect_pipeline import make_pipeline
    from .world.collision_world import World

    return Simulation(scene, file, make_pipeline(file, World(scene, file)))


def _find_scan_point(world: "World") -> Vec:
    """Return a scan point of a world, (3,) [m]; the least corner of a voxel's points if none is near it."""
    with world as held:
        archive, pose = held[0].opened.store.archive, held[0].placed.pose
        lattice = archive.header.lattice
        corner = archive.coordinates[0] * lattice.voxel_steps + archive.voxels["low"][0]
        places = lattice.to_world(corner[None])
        place: Vec = (places if pose is None else transform_points(pose, places))[0]
        hit = world.nearest(place, min(16.0, 2 * lattice.voxel_size))
    return place if hit is None or hit.cloud is None else hit.cloud
