"""Simulation: the frames of a scene, which move its users by the effects that the scene declares.

A frame takes a user from its pose towards that of its motion command, through the effects in their
order (`Pipeline`). `move` simulates one frame and keeps no state. `step` simulates one frame of all
users with a motion command, and keeps their bodies until they end. A `LocalSession` sends it the
commands of one user in this process. The same commands in the same order give the same poses, bit for
bit: a clock is read only to report how long a frame took. The caller of `step` limits its time
(zenoh_server/command_mailboxes.py): it sets the `stop` flag, and users that have not moved by then stay
where they are.

Files of effects that the scene does not declare are not imported (NUMERICS.md case 31).
"""

import importlib
import logging
import math
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from time import monotonic
from typing import TYPE_CHECKING, Any, Self

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
from ...schemas.scene.effect_table import ORDER, effect_name
from ...schemas.scene.scene_file import SceneFile, Spawn
from ...schemas.wire.answers import Verdict
from ...schemas.wire.key_expressions import User, public_id
from ...schemas.wire.motion_messages import (
    BOUNDS,
    FRAME_SECONDS,
    WAIT,
    Late,
    Moved,
    MoveRequest,
    State,
    Touched,
    Wish,
    checked_late,
)
from ...schemas.wire.stats import EffectStats
from ..archives.rigid_transform import transform_points
from ..avatars.avatar_model import AvatarModel
from ..queries.query_inputs import EXACT, LateVoxels, QueryBudget
from ..runtime.stop_flag import NO_STOP, StopFlag, StoppedError
from ..scene_interface import FrameCommand, FrameResult, Session, recording_avatars
from .replay_log import FrameLog, LoggedTurn, take_record
from .world.frame import (
    MAX_TOUCHED,
    Body,
    Frame,
    Hit,
    Pose,
    Run,
    Vec,
    multiply,
    norm,
    orthonormalize,
    rotation_matrix,
    translated,
    unit_vector,
)

if TYPE_CHECKING:  # a scene that is only queried imports neither
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
# The file of each effect.
_FILES = {
    "objects": "body_effects", "crowd": "body_effects", "stop": "motion_effects", "sweep": "motion_effects",
    "slide": "motion_effects", "step": "motion_effects", "ground": "motion_effects",
    "proximity": "report_effects", "contacts": "report_effects", "uncertainty": "uncertainty_effect",
}  # fmt: skip
# Effects that one call runs, in the order of `Frame.visits`.
_WALKING = ("sweep", "slide", "step", "ground")


class Simulation:
    """Frames of a scene. Thread-safe.

    scene: the `Scene` of the users.  file: scene file.  pipeline: the effects that it declares; its
    `bodies`, None if users cannot collide, are updated after each frame.
    """

    def __init__(self, scene: Any, file: SceneFile, pipeline: "Pipeline") -> None:
        self.scene, self.file, self._pipeline = scene, file, pipeline
        self._up = unit_vector(file.up)
        self._present: dict[User, Body] = {}
        self._bodies: Bodies | None = pipeline.bodies
        self._recorder: FrameLog | None = None
        self._frames, self._spent = 0, 0.0
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
        first; the time that frames take does not count, because commands wait for a frame that compiles
        or loads. None: no user is removed.
        stop: ends the frame early: users not yet simulated stay, with the outcome ExpiredError.
        logged: of each turn, for a replay. A result with a recorded body is taken without a
        simulation, and a turn that was stopped is stopped again. All others wait for voxels.
        """
        with self._frame:
            begun = time.monotonic()
            if now is not None:
                now -= self._spent
                self._remove([u for u, body in self._present.items() if now - body.heard > SILENT_SECONDS])
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
                body = self._present.get(turn.user)
                outcomes.append(
                    FrameResult(turn.user, state, b"".join(used) if body is None else body.avatar.digest)
                )
                if self._recorder is not None:
                    lacked = budget.late is not None and budget.late.count > 0
                    self._recorder.turn(turn, state, body, self._bodies, lacked=lacked)
            if self._recorder is not None:
                self._recorder.write(self._frames)
            self._spent += time.monotonic() - begun
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
        body, bodies = self._present.get(user) or self._enter(user, command), self._bodies
        with ExitStack() as undo:  # a command that is refused or stopped changes nothing
            if bodies is not None:
                undo.callback(bodies.restorer())
            if command.objects:
                if bodies is None:
                    raise BadRequestError(
                        f"{self.scene.name}: a wish moves objects: this scene has no objects"
                    )
                bodies.place_objects(command.objects, budget.stop)
            if logged is None or logged.body is None:
                durations = frame_durations(command, body.time)
                if len(durations) > 1:  # one that fails leaves the body as it was
                    body = replace(body, effect_state=dict(body.effect_state))
                moved = self._run_frames(body, command, durations, budget)
            else:
                moved = take_record(logged, body, self.world, bodies)
            undo.pop_all()
        body.time, body.heard = command.time, body.heard if now is None else now
        self._present[user] = body
        if bodies is not None:
            bodies.put_user(body)
        return moved

    def _run_frames(self, body: Body, command: Wish, durations: list[float], budget: QueryBudget) -> Moved:
        """Run the frames of a user's motion command, nearly always one. durations: as in `frame_durations`."""
        moves: list[Moved] = []
        for seconds in durations:
            if moves and self._bodies is not None:
                self._bodies.put_user(body)
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

    def _enter(self, user: User, command: Wish) -> Body:
        """Return the body of a new user. Raises BusyError if the scene is full."""
        if len(self._present) >= self.most_users:
            raise BusyError(
                f"{self.scene.name}: {len(self._present)} users are in it, the maximum of its limits: try again later"
            )
        avatar = self.scene.avatar(user.avatar, user.client)
        if self._recorder is not None:
            self._recorder.entered(user, avatar)
        return _make_body(user, avatar, first_pose(command, self.file.spawn, self._up))

    def _remove(self, users: list[User]) -> None:
        users = [user for user in users if user in self._present]
        for user in users:
            del self._present[user]
            if self._bodies is not None:
                self._bodies.remove_user(_public_name(user))
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

        Their motions lead onto a scan point from above, away from it and past it.
        """
        place, user = _find_scan_point(self.world), User(_WARM, "warm")
        self.scene.add_avatar("warm", [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]], 0.05, client=_WARM)
        across = np.roll(self._up, 1)
        far = min(0.5, self.file.limits.longest_move / 4)
        for way in (self._up, -self._up, across, self._up + across, 0 * across):
            for begin, end in ((way, -way), (-0 * way, way), (way, way + across)):
                first, last = (translated(np.eye(4), place + far * each) for each in (begin, end))
                with self._frame, suppress(SolidcloudError):  # such a frame may be impossible here
                    body = _make_body(user, self.scene.avatar("warm", _WARM), first)
                    for pose in (last, last, first):
                        self._pipeline.run(body, pose, FRAME_SECONDS)
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


def make_simulation(scene: Any, file: SceneFile) -> Simulation:
    """Return the simulation of a scene's frames, with the effects that `file` declares."""
    # Imported here, because a scene that is only queried needs neither effects nor their kernels.
    from .world.collision_world import World

    return Simulation(scene, file, make_pipeline(file, World(scene, file)))


def _find_scan_point(world: "World") -> Vec:
    """Return a scan point of a world, (3,) [m]; the least corner of a voxel's points if none is near it."""
    with world as held:
        arrays, tree, pose = held[0].data.arrays, held[0].data.tree, held[0].placed.pose
        low, high = (side[0] * arrays.step + arrays.origin for side in (tree.low, tree.high))
        place: Vec = low if pose is None else transform_points(pose, low[None])[0]
        hit = world.nearest(place, min(16.0, norm(high - low) + arrays.step))
    return place if hit is None or hit.cloud is None else hit.cloud


class Pipeline:
    """Effects of one scene in their order. Thread-safe, except for two frames of one body.

    world: of the scene.  runs: the effects in order, the names of those that one call runs and the call.
    """

    def __init__(self, world: "World", runs: Sequence[tuple[Sequence[str], Run]]) -> None:
        """Create a pipeline; callers use `make_pipeline`."""
        self.world, self.runs = world, runs
        self._counts = {name: [0, 0.0] for names, _ in runs for name in names}
        self._counting = threading.Lock()
        self._stops = "stop" in self._counts

    @property
    def bodies(self) -> Any:
        """Return the `Bodies` of the scene, which the simulation updates; None if no effect needs them."""
        return self.world.bodies

    def stats(self) -> list[EffectStats]:
        """Return the frames and seconds of each effect so far, in the order in which they run."""
        with self._counting:
            return [EffectStats(name, *count) for name, count in self._counts.items()]  # type: ignore[arg-type]

    def run(
        self,
        body: Body,
        target: Pose,
        seconds: float = FRAME_SECONDS,
        budget: QueryBudget = EXACT,
    ) -> Moved:
        """Run one frame of a body: move it towards a commanded pose (4, 4), rigid.

        seconds: duration of the frame.
        Raise BadRequestError for a pose farther than limits.longest_move, the errors of queries, or
        StoppedError. The body is then unchanged; objects that it pushed are not.
        """
        body.pose = np.ascontiguousarray(body.pose, np.float64)
        target = np.array(target, np.float64, order="C")
        far, longest = norm(target[:3, 3] - body.pose[:3, 3]), self.world.file.limits.longest_move
        if not far <= longest:
            raise BadRequestError(
                f"the commanded pose is {far:g} m away: expected within {longest:g} m, the scene's longest_move: "
                "send a nearer pose, or enter the scene there"
            )
        frame = Frame(body, target, seconds, self.world, budget, body.pose)
        frame.fall_speed, frame.on_ground = body.fall_speed, body.on_ground
        self.world.begin(budget.stop)
        self._simulate(frame)
        body.pose, body.clear, body.generations = frame.pose, frame.clear, frame.generations
        body.fall_speed, body.on_ground = frame.fall_speed, frame.on_ground
        body.effect_state.update(frame.effect_state)
        return _moved(frame, self.world.unknown)

    def _simulate(self, frame: Frame) -> None:
        """Run the effects of a frame. Raise StoppedError."""
        body, budget, world = frame.body, frame.budget, self.world
        with world as seen:
            frame.generations = tuple([each.opened.number for each in seen])
            if not self._stops:
                frame.pose = frame.target
            took: list[tuple[str, float]] = []
            now = time.perf_counter()
            for names, run in self.runs:
                if budget.stop:
                    raise StoppedError
                report = run(frame)
                if report is not None:
                    frame.reports[names[0]] = report
                frame.simulated += names
                before, now = now, time.perf_counter()
                took += _shared_time(names, now - before, frame.visits)
            with self._counting:
                for name, seconds in took:
                    count = self._counts[name]
                    count[0] += 1
                    count[1] += seconds
            if not self._stops:
                frame.verdict = world.collide(body.avatar, frame.pose, budget)
            # Bodies that overlap the avatar since the frame's start, such as a placed object, do
            # not block it, but the verdict reports them.
            if not frame.apart and any([each.overlaps(frame.pose) for each in frame.obstacles]):
                frame.verdict = Verdict.CONTACT
            if budget.stop:  # results of effects from incomplete answers are discarded
                raise StoppedError
            world.saw(body.user, body.avatar, frame.pose)


def _shared_time(names: Sequence[str], seconds: float, visits: Sequence[int]) -> list[tuple[str, float]]:
    """Return the time of each effect of a call [s], divided by node visits. visits: by _WALKING."""
    if len(names) == 1:
        return [(names[0], seconds)]
    counts = [visits[_WALKING.index(name)] for name in names]
    total = sum(counts)
    shares = [count / total for count in counts] if total else [1.0 / len(names)] * len(names)
    return [(name, seconds * share) for name, share in zip(names, shares, strict=True)]


def _vector(place: Vec) -> tuple[float, float, float]:
    x, y, z = place.tolist()
    return x, y, z


def _touched(hits: list[Hit], there: Vec) -> list[Touched]:
    """Return the obstacles that stopped a frame's motions, each position once.

    there: (3,), position of hits without one, world [m].
    """
    found: dict[Any, Touched] = {}
    for hit in hits:
        place = _vector(there if hit.cloud is None else hit.cloud)
        normal = None if hit.normal is None else _vector(hit.normal)
        unknown = hit.verdict == Verdict.UNKNOWN
        found[hit.what, place] = Touched(place, normal, hit.what, unknown, hit.unloaded)
    return list(found.values())[:MAX_TOUCHED]


def _moved(frame: Frame, unknown: bool) -> Moved:
    """Return the answer for a frame. unknown: as in `Moved`."""
    left = norm(frame.remaining)
    return Moved(
        pose=frame.pose[None].copy(),
        verdict=int(frame.verdict),
        left=left,
        touched=_touched(frame.hits, frame.pose[:3, 3]) if frame.hits else [],
        simulated=frame.simulated,
        **frame.reports,
        unknown=unknown,
        unloaded=min(left, max(hit.rest for hit in frame.hits)) if frame.hits else 0.0,
    )


def make_pipeline(file: SceneFile, world: "World") -> Pipeline:
    """Create the pipeline of a scene: import the file of each declared effect and create the effect."""
    declared = {effect_name(effect): effect for effect in file.effects}
    walking = [name for name in _WALKING if name in declared]
    runs: list[tuple[Sequence[str], Run]] = []
    for name in ORDER:
        if name in declared and name not in walking[1:]:
            make = importlib.import_module(f".effects.{_FILES[name]}", __package__).make
            runs.append((walking if name in walking else [name], make(declared[name], world)))
    return Pipeline(world, runs)


class LocalSession(Session):
    """One avatar's session, made by `Scene.session`. A context manager, thread-safe."""

    def __init__(self, simulation: Simulation, user: User, late: Late = "wait") -> None:
        """Create a session; entering it begins it. late: of its motion commands, as in `Wish`."""
        super().__init__(simulation.scene.name, user.avatar, late)
        self._simulation, self._user, self._seq = simulation, user, 0

    def __enter__(self) -> Self:
        """Begin the session."""
        self._open = True
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the scene."""
        self.close()

    def close(self) -> None:
        """Leave the scene: others may walk where the avatar stood. Closing twice is allowed."""
        with self._commands:
            was_open, self._open = self._open, False
            if was_open:
                self._simulation.end(self._user)
        with self._changed:
            self._changed.notify_all()

    def _next_number(self) -> int:
        self._seq += 1
        return self._seq

    def _send(self, wish: Wish) -> None:
        """Simulate a frame with a motion command."""
        (outcome,) = self._simulation.step([FrameCommand(self._user, wish)], monotonic())
        self._keep(outcome.state)
