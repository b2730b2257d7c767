"""Parts of a frame that move an avatar, by the kernel `walk_frame`, and its queries for Python.

The kernel asks Python if voxels have to be loaded, bodies are in the way, a scene is not a single
archive at the identity, or an avatar is too large (kernels/walk/state.py).
"""

import math
import threading
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....schemas.scene.effect_table import Ground, Slide, Step, Stop, Sweep
from ....schemas.scene.scene_file import SceneFile, sweep_tolerance
from ....schemas.wire.answers import Verdict
from ....schemas.wire.motion_messages import GroundReport
from ...avatars.avatar_model import AvatarModel
from ...kernels.core.array_references import Held
from ...kernels.core.normal_codes import MAX_NORMAL_REACH
from ...kernels.motion.sweep_resident import make_scratch
from ...kernels.walk import state
from ...kernels.walk.motions import FLAT_REACH_FACTOR
from ...kernels.walk.walk_frame import walk_frame
from ...queries.collide import MAX_FAST_POINTS
from ...queries.query_inputs import EXACT
from .collision_world import SPARSE_FACTOR, VERDICTS, World, normals_of
from .first_hits import find_first_hit, find_touched, first_body_hit, is_clear, touches_bodies
from .frame import GROUND_PLANE, RAISED, Frame, Hit, Pose, Vec, dot, lowest_height, translated

# Parts of a frame that effects run.
FOLLOW, SLIDE, STEP, GROUND = state.FOLLOW, state.SLIDE, state.STEP, state.GROUND
_NO_SQUARES = np.zeros(3, np.int64)
# The first search for ground extends this many clearances down.
_NEAR_CLEARANCES = 2.0
# Least distance to move off a bump [m].
_MIN_LIFT = 5e-4
# Error of a cosine that results from storing normals to a third of a degree.
_ROUNDING = 0.005
# This many consecutive frames in the same voxels count as one use of them: recording one takes a tenth
# of a query.
_FRAMES_PER_USE = 16
# Rows of the tape at first; frames that need more double it.
_ROWS = 64
# A search for any landing place extends to this distance below the scene's lowest sphere [m]; the
# tolerance of that sweep [m].
_FALL_MARGIN, _FALL_TOLERANCE = 0.1, 1e-2


def _fields_of(records: NDArray[np.void]) -> Any:
    """Return an object with the fields of records, as arrays: Python reads these faster than a record."""
    return SimpleNamespace(**{name: records[name] for name in records.dtype.names or ()})


def _settings(file: SceneFile, up: Vec) -> NDArray[np.void]:
    """Return the options of a scene's effects for the kernel, one record."""
    declared: dict[type, Any] = {type(effect): effect for effect in file.effects}
    stop, slide = declared.get(Stop, Stop()), declared.get(Slide, Slide())
    ground, step = declared.get(Ground), declared.get(Step)
    height = 0.0 if step is None else step.height
    made = np.zeros(1, state.SETTINGS)
    made["up"], made["continuous"], made["slides"] = up, Sweep in declared, Slide in declared
    made["skin"], made["tolerance"], made["step"] = stop.skin, sweep_tolerance(file), height
    made["surfaces"], made["normal_reach"] = slide.surfaces, slide.normal_reach  # the latter for `ground` too
    made["lift"], made["walkable_slide"] = max(stop.skin, _MIN_LIFT), -2.0
    if ground is not None:
        walkable, clearance = math.cos(math.radians(ground.slope)), ground.clearance
        snap = height if ground.snap is None else ground.snap
        made["walkable_slide"], made["walkable"] = walkable, walkable - _ROUNDING
        made["clearance"], made["near_reach"] = clearance, _NEAR_CLEARANCES * clearance
        made["down"] = clearance + max(snap, clearance)
        made["gravity"], made["max_speed"] = ground.gravity, ground.fall_speed
    return made


# Stands for `Bodies` in a scene without them.
_NO_BODIES: Any = SimpleNamespace(
    lock=nullcontext(), bounds=np.empty((0, 2, 3)), kinds=np.empty(0, np.uint8), origin=np.zeros(3),
    row_of=lambda name, *, user: -1,
)  # fmt: skip


class FrameMemory(threading.local):
    """State of a frame of each thread.

    memory: its arrays.  reference: to them, for the kernel.  tape, log, question, before, state, hits:
    the fields of each record of them.  state_bytes: `state` as bytes.
    """

    def __init__(self) -> None:
        self._take(state.make_arrays(_ROWS))
        self._scratch: tuple[Any, Any] = (None, None)  # the last avatar's arrays, and theirs
        self._used: list[int] = []
        self._again = 0

    def scratch_of(self, avatar: AvatarModel) -> Any:
        """Return the scratch of an avatar's motions, kept until another avatar moves."""
        if self._scratch[0] is not avatar.arrays:
            self._scratch = avatar.arrays, make_scratch(avatar.arrays)
        return self._scratch[1]

    def use_voxels(self, residency: Any, rows: list[int]) -> None:
        """Record a use of voxels, once for _FRAMES_PER_USE consecutive frames in the same voxels."""
        if rows != self._used or not self._again:
            residency.use(rows)
            self._used, self._again = rows, _FRAMES_PER_USE
        self._again -= 1

    def _take(self, memory: state.WalkArrays) -> None:
        """Take other arrays."""
        self.memory, self.reference = memory, state.refer_to_memory(memory)
        self.tape, self.log, self.question = map(_fields_of, (memory.tape, memory.log, memory.question))
        self.before, self.state, self.hits = map(_fields_of, (memory.before, memory.state, memory.hits))
        self.state_bytes = memory.state.view(np.uint8)

    def grow(self) -> None:
        """Double the rows of the tape."""
        old, rows = self.memory, len(self.memory.tape)
        larger = state.make_arrays(2 * rows)
        for name in state.WalkArrays._fields:
            part: NDArray[np.float64] = getattr(old, name)
            getattr(larger, name)[: len(part)] = part
        self._take(larger)


class WalkCall:
    """One call of the kernel for a frame: its state to and from arrays, and the answers to its queries."""

    def __init__(self, walker: "Walker", thread: FrameMemory, frame: Frame) -> None:
        self._walker, self._thread, self._frame, self._hits = walker, thread, frame, frame.walk_hits

    def begin(self) -> None:
        """Write how the frame begins: what the body keeps between frames, and the hits before the first part."""
        frame, body, thread, memory = self._frame, self._frame.body, self._thread, self._thread.memory
        before, now, count = thread.before, thread.state, len(frame.hits)
        memory.begin[:], memory.target[:], memory.poses[0] = body.pose, frame.target, frame.pose
        thread.state_bytes.fill(0)
        now.row[0], now.hits[0], now.blocked[0], now.stepped[0] = count, count, -1, math.nan
        now.verdict[0], now.clear[0] = int(frame.verdict), frame.clear
        before.seconds[0], before.fall_speed[0], before.stood[0] = (
            frame.seconds,
            body.fall_speed,
            body.on_ground,
        )
        plane, raised = body.effect_state.get(GROUND_PLANE), body.effect_state.get(RAISED)
        before.has_plane[0], before.was_raised[0] = plane is not None, raised is not None
        if plane is not None:
            before.plane[0] = plane.reshape(2, 3)
        if raised is not None:
            before.raised_at[0] = raised
        for row, hit in enumerate(frame.hits):
            thread.hits.row[row], thread.hits.has_normal[row] = row, False
            self._write_hit(row, hit)
        thread.log.known[0] = count

    def finish(self) -> None:
        """Read the state that a frame has reached."""
        frame, now = self._frame, self._thread.state
        frame.pose = self._thread.memory.poses[0].copy()
        frame.verdict, frame.clear = VERDICTS[now.verdict.item()], now.clear.item()
        frame.remaining = now.left[0].copy()
        frame.hits = [self._read_hit(number) for number in range(now.hits.item())]
        stepped = now.stepped.item()
        if not math.isnan(stepped):
            frame.reports["stepped"] = stepped
        if not now.grounded.item():
            return
        frame.on_ground, frame.fall_speed = now.stands.item(), now.fall_speed.item()
        normal = tuple(now.ground[0].tolist()) if now.has_ground.item() else None
        frame.reports["ground"] = GroundReport(frame.on_ground, frame.fall_speed, normal)
        if now.has_plane.item():
            frame.effect_state[GROUND_PLANE] = now.plane[0].flatten()
        if now.raised.item():
            frame.effect_state[RAISED] = now.raised_at[0].copy()

    def answer(self) -> None:
        """Answer the query that the kernel asked."""
        thread, frame = self._thread, self._frame
        query, row = thread.log.asked.item(), thread.log.known.item() - 1
        if query == state.FULL:
            thread.grow()
            return
        poses = thread.memory.asked_poses.copy()
        before, frame.pose = frame.pose, poses[0]
        try:
            self._answer(query, row, poses[1])
        finally:
            frame.pose = before

    def _answer(self, query: int, row: int, to: Pose) -> None:
        """Write the answer of a query to its row. to: end of its motion."""
        frame, tape, question = self._frame, self._thread.tape, self._thread.question
        world, pose, below = frame.world, frame.pose, question.below.item()
        tolerance, skin = self._walker.tolerance, -1.0 if below else self._walker.skin
        place, level, archive = question.place[0].copy(), question.level.item(), question.archive.item()
        if query == state.SWEPT_TO:
            self._write_hit(row, find_first_hit(frame, to, tolerance, skin, below=below))
        elif query == state.BODIES_SWEPT:
            until = math.inf if tape.verdict[row] == int(Verdict.CLEAR) else tape.lower.item(row)
            hit = first_body_hit(frame, to, tolerance, until, below=below)
            if hit is not None:
                self._write_hit(row, hit)
        elif query == state.CLEAR_AT:
            tape.answer[row] = is_clear(frame, pose, proved=question.proved.item())
        elif query == state.BODIES_AT:
            tape.answer[row] = not touches_bodies(frame, pose)
        elif query == state.TOUCHED:
            self._write_hit(row, find_touched(frame, pose))
        elif query == state.GIVES_WAY:
            hit = self._hits[question.hit.item()]
            tape.answer[row] = hit.obstacle is not None and hit.obstacle.give_way(frame, hit, to)
        elif query == state.NORMAL_AT:
            toward, reach = question.toward[0].copy(), self._walker.reaches[level]
            normal = world.normal_at(archive, place, toward, reach, frame.budget)
            tape.has_normal[row] = normal is not None
            if normal is not None:
                tape.normal[row] = normal
        elif query == state.HIGHEST:
            directions = question.directions[0, : question.count.item()].copy()
            heights = world.highest(archive, place, directions, self._walker.reaches[level], frame.budget)
            tape.heights[row] = 0.0
            tape.heights[row, : len(heights)] = heights
        elif query == state.NEAREST:
            found = world.nearest(place, question.reach.item(), frame.budget)
            tape.has_pair[row] = found is not None
            if found is not None:
                tape.cloud[row], tape.archive[row] = found.cloud, found.archive
        else:
            assert query == state.LANDS
            self._write_landing(row, question.reach.item(), stood=question.stood.item())

    def _write_landing(self, row: int, reach: float, *, stood: bool) -> None:
        """Write whether an avatar without ground within `reach` [m] of its feet may land.

        stood: whether it stood in the last frame.
        """
        frame, tape = self._frame, self._thread.tape
        world, avatar, up = frame.world, frame.body.avatar, frame.world.up
        self._write_hit(row, None)  # the kernel may record it as a hit
        if not len(avatar.points):
            return
        feet = lowest_height(avatar, frame.pose, up)
        deep = feet - world.lowest_height() + _FALL_MARGIN
        if deep <= reach:
            return
        lacked = frame.lacked
        swept = world.sweep(
            avatar, frame.pose, translated(frame.pose, -deep * up), _FALL_TOLERANCE, frame.budget
        )
        touches = swept is not None and swept.verdict == Verdict.CONTACT
        if frame.lacked > lacked and not (touches and swept.exact):
            tape.unloaded[row] = True
        elif not touches:
            tape.answer[row] = swept is not None
        else:
            # The rim of a hole, or the ledge behind, stops the parts above the feet, which are wider.
            tape.answer[row] = not stood or dot(swept.cloud, up) < feet - reach

    def _write_hit(self, row: int, hit: Hit | None) -> None:
        """Write a hit, or None, to a row."""
        records, tape = self._thread.memory.tape, self._thread.tape
        records[row] = np.zeros((), records.dtype)
        if hit is None:
            tape.verdict[row] = int(Verdict.CLEAR)
            return
        self._hits[row] = hit
        tape.lower[row], tape.verdict[row], tape.archive[row] = hit.fraction, int(hit.verdict), hit.archive
        tape.unloaded[row], tape.rest[row], tape.named[row] = hit.unloaded, hit.rest, bool(hit.what)
        if hit.normal is not None:
            tape.has_normal[row], tape.normal[row] = True, hit.normal
        if hit.point is not None:
            tape.has_point[row], tape.point[row] = True, hit.point
        if hit.end is not None:
            tape.has_end[row], tape.end[row] = True, hit.end
        if hit.avatar is not None and hit.cloud is not None:
            tape.has_pair[row], tape.avatar[row], tape.cloud[row] = True, hit.avatar, hit.cloud

    def _read_hit(self, number: int) -> Hit:
        """Return a recorded hit."""
        hits, tape = self._thread.hits, self._thread.tape
        row, normal = hits.row.item(number), None
        if hits.has_normal.item(number):
            normal = hits.normal[number].copy()
        elif tape.has_normal.item(row):
            normal = tape.normal[row].copy()
        known, has_pair = self._hits.get(row), tape.has_pair.item(row)
        return Hit(
            tape.lower.item(row),
            VERDICTS[tape.verdict.item(row)],
            tape.avatar[row].copy() if has_pair else None,
            tape.cloud[row].copy() if has_pair else None,
            "" if known is None else known.what,
            tape.archive.item(row),
            normal,
            tape.point[row].copy() if tape.has_point.item(row) else None,
            tape.unloaded.item(row),
            tape.rest.item(row),
        )


class Walker:
    """Moves the avatars of one scene. Thread-safe.

    native: whether the kernel answers queries itself; tests compare both.
    skin, tolerance: of sweeps [m].  reaches: of normals, by the level of `scan_normal` [m].
    """

    def __init__(self, world: Any) -> None:
        """Prepare the effects of the world's scene file."""
        self.native = True
        self._world = world
        self._settings = _settings(world.file, world.up)
        self.skin, self.tolerance = float(self._settings["skin"][0]), float(self._settings["tolerance"][0])
        reach = float(self._settings["normal_reach"][0])
        farther = min(FLAT_REACH_FACTOR * reach, MAX_NORMAL_REACH)
        self.reaches = (reach, farther, min(SPARSE_FACTOR * farther, MAX_NORMAL_REACH))
        self._has_normals = any(isinstance(effect, (Slide, Ground)) for effect in world.file.effects)
        self._thread = FrameMemory()
        self._code = Held(None)

    def run(self, frame: Frame, parts: int) -> None:
        """Run parts of a frame (bits of FOLLOW to GROUND), each once and in their order.

        Raise the errors of queries and StoppedError; the frame is then undefined.
        """
        thread, world, body, budget = self._thread, frame.world, frame.body, frame.budget
        call = WalkCall(self, thread, frame)
        if not frame.walks:
            frame.walks = True
            call.begin()
        obstacles, bodies, wanted, margin = frame.obstacles, _NO_BODIES, 0, 0.0
        blocks = bool(obstacles)
        if blocks:
            bodies = obstacles[0].bodies
            for obstacle in obstacles:
                wanted |= obstacle.wanted
        with world as seen:
            each, alone, avatar = seen[0], world.is_alone, body.avatar
            data, residency, scratch = each.data, each.data.residency, thread.scratch_of(avatar)
            native = self.native and alone and 0 < len(avatar.points) <= MAX_FAST_POINTS
            squares = normals_of(each).squares(self.reaches) if self._has_normals else _NO_SQUARES
            held = data.references.to(data.arrays, data.tree)
            thread.log.repeats[0] = False
            while True:
                try:
                    # The bodies' lock comes first, as where an object is pushed through the scan.
                    if blocks:
                        margin = max([each.margin for each in obstacles])
                    with bodies.lock, residency.frozen():
                        given = (
                            self._settings, avatar.reference, scratch, thread.reference, held.reference,
                            data.arrays.stop, data.nothing_clear, alone, native, blocks, data.radius_units,
                            float(budget.tolerance), budget.tolerance_units, squares, bodies.bounds, bodies.kinds,
                            bodies.origin, wanted, bodies.row_of(body.name, user=True), margin,
                        )  # fmt: skip
                        self._code.call(walk_frame, parts, given)
                        log, used = thread.log, thread.log.used.item()
                        if used:
                            rows = thread.memory.used[:used]
                            if log.repeats.item():  # answering a query may have evicted some of them
                                rows = rows[data.arrays.where[rows, 0] >= 0]
                            thread.use_voxels(residency, rows.tolist())
                    break
                except state.AskedError:
                    call.answer()
                    thread.log.repeats[0] = True
        frame.visits, frame.apart = log.visits[0].tolist(), log.apart.item() > 0
        world.count(sum(frame.visits), log.missed.item())
        call.finish()
        if frame.verdict == Verdict.CONTACT and not frame.clear:  # it began in contact
            frame.verdict = world.collide(body.avatar, frame.pose, budget)
            frame.clear = frame.verdict == Verdict.CLEAR

    def warm(self) -> None:
        """Compile the kernel before the first frame needs it."""
        from ...avatars.avatar_model import make_avatar
        from .frame import Body

        body = Body("", make_avatar([[0.0, 0.0, 0.0]], 0.1), np.eye(4))
        frame = Frame(body, np.eye(4), 0.0, self._world, EXACT, body.pose)
        with self._world:
            self.run(frame, 0)


def walker_of(world: World) -> Walker:
    """Return the `Walker` that the effects of a scene share."""
    if world.walker is None:
        world.walker = Walker(world)
    walker: Walker = world.walker
    return walker
