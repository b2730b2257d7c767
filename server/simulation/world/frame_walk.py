"""Parts of a frame that move an avatar, by the kernel `walk_frame`, and its queries for Python.

The kernel asks Python if voxels have to be loaded, bodies are in the way, a scene is not a single
archive at the identity, or an avatar is too large (kernels/walk/walk_state.py).
"""

import math
import threading
from contextlib import nullcontext
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....schemas.scene.effect_table import Crowd, Ground, Slide, Step, Stop, Sweep
from ....schemas.scene.scene_file import SceneFile, sweep_tolerance
from ....schemas.wire.answers import Verdict
from ....schemas.wire.motion_messages import GroundReport
from ...kernels.core.array_references import Held
from ...kernels.core.normal_codes import MAX_NORMAL_REACH
from ...kernels.motion.sweep_resident import AVATAR, CLOUD, END, ENDED, LOWER, POINT
from ...kernels.walk import walk_state as state
from ...kernels.walk.slide_along import FLAT_REACH_FACTOR
from ...kernels.walk.walk_frame import walk_frame
from ...queries.request import EXACT
from ...queries.resident_fast_path import MAX_FAST_POINTS
from .collision_world import SPARSE_FACTOR, World, normals_of
from .frame import (
    Frame,
    Hit,
    Pose,
    Vec,
    find_touched,
    first_body_hit,
    is_clear,
    lowest_height,
    touches_bodies,
    translated,
)
from .leaving import find_first_hit
from .vectors import dot

# Parts of a frame that effects run.
FOLLOW, SLIDE, STEP, GROUND = state.FOLLOW, state.SLIDE, state.STEP, state.GROUND
_NO_SQUARES = np.zeros(3, np.int64)
# Points within this distance of the touched point determine the ground's normal [m], unless `slide`
# names another.
_NORMAL_REACH = 0.08
# The first search for ground extends this many clearances down.
_NEAR_CLEARANCES = 2.0
# Least distance to move off a bump [m].
_MIN_LIFT = 5e-4
# Error of a cosine that results from storing normals to a third of a degree.
_ROUNDING = 0.005
# Names under which `Body.effect_state` keeps the point and the normal of the plane that the avatar stands
# on, (6,), and the place where it was raised last, (3,).
GROUND_PLANE, RAISED = "ground", "ground raised"
# Rows of the tape at first; frames that need more double it.
_ROWS = 64
# A search for any landing place extends to this distance below the scene's lowest sphere [m]; the
# tolerance of that sweep [m].
_FALL_MARGIN, _FALL_TOLERANCE = 0.1, 1e-2
_VERDICTS = {int(verdict): verdict for verdict in Verdict}


def _settings(file: SceneFile, up: Vec) -> tuple[Any, float]:
    """Return the options of a scene's effects for the kernel, and the normal reach [m]."""
    declared: dict[type, Any] = {type(effect): effect for effect in file.effects}
    stop, slide = declared.get(Stop, Stop()), declared.get(Slide)
    ground, step = declared.get(Ground), declared.get(Step)
    reach = _NORMAL_REACH if slide is None else slide.normal_reach
    height = 0.0 if step is None else step.height
    walkable_slide, standing = -2.0, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    if ground is not None:
        walkable_slide = math.cos(math.radians(ground.slope))
        snap = height if ground.snap is None else ground.snap
        clearance = ground.clearance
        standing = (
            clearance, _NEAR_CLEARANCES * clearance, clearance + max(snap, clearance), ground.gravity,
            ground.fall_speed, walkable_slide - _ROUNDING,
        )  # fmt: skip
    made = state.make_settings(
        up, Sweep in declared, float(stop.skin), float(sweep_tolerance(file)), slide is not None,
        4 if slide is None else slide.surfaces, float(reach), max(stop.skin, _MIN_LIFT), walkable_slide,
        float(height), *(float(each) for each in standing),
    )  # fmt: skip
    return made, reach


def _only_obstacle(frame: Frame) -> Any:
    """Return the obstacle whose bodies the kernel may test: a `BodyObstacle` without others; or None."""
    obstacles = frame.obstacles
    return obstacles[0] if len(obstacles) == 1 and hasattr(obstacles[0], "reference") else None


class FrameMemory(threading.local):
    """State of a frame of each thread."""

    def __init__(self) -> None:
        self.use(state.make_arrays(_ROWS))

    def use(self, memory: state.WalkArrays) -> None:
        """Take other arrays."""
        self.memory, self.reference = memory, state.refer_to_memory(memory)

    def grow(self) -> None:
        """Double the rows of the tape."""
        old, rows = self.memory, len(self.memory.tape)
        larger = state.make_arrays(2 * rows)
        for name in state.WalkArrays._fields:
            part: NDArray[np.float64] = getattr(old, name)
            getattr(larger, name)[: len(part)] = part
        self.use(larger)


class WalkCall:
    """One call of the kernel for a frame: its state to and from arrays, and the answers to its queries."""

    def __init__(self, thread: FrameMemory, reaches: tuple[float, ...], frame: Frame) -> None:
        self._thread, self._reaches, self._frame = thread, reaches, frame
        if frame.walk_hits is None:
            frame.walk_hits = {}
        self._hits: dict[int, Hit] = frame.walk_hits

    def begin(self) -> None:
        """Write what the body keeps between frames, and the hits before the first part."""
        body, memory = self._frame.body, self._thread.memory
        plane, raised = body.effect_state.get(GROUND_PLANE), body.effect_state.get(RAISED)
        memory.inputs[state.HAD_PLANE] = plane is not None
        memory.inputs[state.WAS_RAISED] = raised is not None
        if plane is not None:
            memory.old_plane[:] = plane
        if raised is not None:
            memory.old_raised[:] = raised
        for row, hit in enumerate(self._frame.hits):
            self._write_hit(row, hit)
        memory.log[state.KNOWN] = len(self._frame.hits)

    def finish(self) -> None:
        """Read the state that a frame has reached."""
        frame, memory = self._frame, self._thread.memory
        numbers, values = memory.numbers.tolist(), memory.values.tolist()
        frame.pose = memory.poses[state.POSE].copy()
        frame.verdict = _VERDICTS[numbers[state.FRAME_VERDICT]]
        frame.clear = bool(numbers[state.IS_CLEAR])
        frame.remaining = memory.values[state.LEFT : state.LEFT + 3].copy()
        frame.hits = [self._read_hit(n) for n in range(numbers[state.HITS])]
        if not math.isnan(values[state.STEPPED]):
            frame.reports["stepped"] = values[state.STEPPED]
        if not numbers[state.GROUNDED]:
            return
        frame.on_ground, frame.fall_speed = bool(numbers[state.STANDS]), values[state.FALL_SPEED]
        normal = None
        if numbers[state.HAS_STOOD_ON]:
            x, y, z = values[state.STOOD_ON : state.STOOD_ON + 3]
            normal = x, y, z
        frame.reports["ground"] = GroundReport(frame.on_ground, frame.fall_speed, normal)
        if numbers[state.HAS_PLANE]:
            frame.effect_state[GROUND_PLANE] = memory.values[state.PLANE : state.RAISED_AT].copy()
        if numbers[state.RAISED]:
            frame.effect_state[RAISED] = memory.values[state.RAISED_AT :].copy()

    def answer(self) -> None:
        """Answer the query that the kernel asked."""
        memory, frame = self._thread.memory, self._frame
        query, row = int(memory.log[state.ASKED]), int(memory.log[state.KNOWN])
        if query == state.FULL:
            self._thread.grow()
            return
        asked = memory.asked.tolist()
        before, frame.pose = frame.pose, memory.asked_poses[0].copy()
        try:
            self._answer(query, row, asked, memory.asked_poses[1].copy())
        finally:
            frame.pose = before
        memory.log[state.KNOWN] = row + 1

    def _answer(self, query: int, row: int, asked: list[float], to: Pose) -> None:
        """Write the answer of a query to its row. asked, to: of the query, see walk_queries.py."""
        memory, frame = self._thread.memory, self._frame
        result, world, pose = memory.tape[row], frame.world, frame.pose
        if query == state.SWEPT:
            tolerance, skin, below = asked[:3]
            self._write_hit(row, find_first_hit(frame, to, tolerance, skin, below=below != 0.0))
        elif query == state.BODIES_SWEPT:
            until = math.inf if result[state.VERDICT] == int(Verdict.CLEAR) else float(result[LOWER])
            hit = first_body_hit(frame, to, asked[0], until, below=asked[2] != 0.0)
            if hit is not None:
                self._write_hit(row, hit)
        elif query == state.BODIES_HIT:
            self._name_hit(row, asked, to)
        elif query == state.CLEAR_AT:
            result[state.ANSWER] = is_clear(frame, pose, proved=asked[0] != 0.0)
        elif query == state.BODIES_AT:
            result[state.ANSWER] = not touches_bodies(frame, pose)
        elif query == state.TOUCHED:
            self._write_hit(row, find_touched(frame, pose))
        elif query == state.GIVES_WAY:
            hit = self._hits[int(asked[0])]
            result[state.ANSWER] = any(each.give_way(frame, hit, to) for each in frame.obstacles)
        elif query == state.NORMAL_AT:
            reach = self._reaches[int(asked[7])]
            cloud, toward = np.array(asked[:3]), np.array(asked[3:6])
            normal = world.normal_at(int(asked[6]), cloud, toward, reach, frame.budget)
            result[state.HAS_NORMAL] = normal is not None
            if normal is not None:
                result[state.NORMAL : state.NORMAL + 3] = normal
        elif query == state.HIGHEST:
            directions = np.array(asked[6 : 6 + 3 * int(asked[5])]).reshape(-1, 3)
            touched = Hit(0.0, Verdict.CONTACT, None, np.array(asked[:3]), archive=int(asked[3]))
            heights = world.highest(touched, directions, self._reaches[int(asked[4])], frame.budget)
            result[state.HEIGHTS : state.HEIGHTS + 3] = 0.0
            result[state.HEIGHTS : state.HEIGHTS + len(heights)] = heights
        elif query == state.NEAREST:
            found = world.nearest(np.array(asked[:3]), asked[3], frame.budget)
            result[state.HAS_PAIR] = found is not None
            if found is not None:
                result[CLOUD:ENDED], result[state.ARCHIVE] = found.cloud, found.archive
        else:
            assert query == state.LANDS
            self._write_landing(row, asked[0], stood=asked[1] != 0.0)

    def _name_hit(self, row: int, asked: list[float], to: Pose) -> None:
        """Write the hit of a body that the kernel found. asked, to: as for `_answer`."""
        at, block, lane = (int(asked[n]) for n in (state.HIT_ROW, state.HIT_POINT, state.HIT_POINT + 1))
        pair, obstacle = (
            np.array(asked[state.HIT_PAIR : state.HIT_POINT]).reshape(2, 3),
            self._frame.obstacles[0],
        )
        hit = obstacle.name_hit(at, asked[state.HIT_FRACTION], pair, (block, lane))
        if hit is None:
            self._answer(state.BODIES_SWEPT, row, asked, to)
            return
        self._write_hit(row, hit)
        if asked[1] >= 0.0:  # with a skin: the motion of an effect, which would ask next
            obstacle.give_way(self._frame, hit, to)
            self._thread.memory.tape[row, state.NAMED] = state.STAYS

    def _write_landing(self, row: int, reach: float, *, stood: bool) -> None:
        """Write whether an avatar without ground within `reach` [m] of its feet may land.

        stood: whether it stood in the last frame.
        """
        frame, result = self._frame, self._thread.memory.tape[row]
        world, avatar, up = frame.world, frame.body.avatar, frame.world.up
        result[state.ANSWER] = result[state.UNLOADED] = result[state.REST] = 0.0
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
            result[state.UNLOADED] = 1.0
        elif not touches:
            result[state.ANSWER] = swept is not None
        else:
            # The rim of a hole, or the ledge behind, stops the parts above the feet, which are wider.
            result[state.ANSWER] = not stood or dot(swept.cloud, up) < feet - reach

    def _write_hit(self, row: int, hit: Hit | None) -> None:
        """Write a hit, or None, to a row."""
        result = self._thread.memory.tape[row]
        result[:] = 0.0
        if hit is None:
            result[state.VERDICT] = int(Verdict.CLEAR)
            return
        self._hits[row] = hit
        result[LOWER], result[state.VERDICT], result[state.ARCHIVE] = (
            hit.fraction,
            int(hit.verdict),
            hit.archive,
        )
        result[state.UNLOADED], result[state.REST], result[state.NAMED] = (
            hit.unloaded,
            hit.rest,
            bool(hit.what),
        )
        parts: tuple[tuple[int, int, NDArray[np.float64] | None], ...] = (
            (state.HAS_NORMAL, state.NORMAL, hit.normal),
            (state.HAS_POINT, POINT, hit.point),
            (state.HAS_END, END, None if hit.end is None else hit.end.ravel()),
        )
        for has, at, part in parts:
            if part is not None:
                result[has], result[at : at + len(part)] = 1.0, part
        if hit.avatar is not None and hit.cloud is not None:
            result[state.HAS_PAIR] = 1.0
            result[AVATAR:CLOUD], result[CLOUD:ENDED] = hit.avatar, hit.cloud

    def _read_hit(self, number: int) -> Hit:
        """Return a recorded hit."""
        memory = self._thread.memory
        row = int(memory.hits[number])
        result = memory.tape[row]
        has_pair, normal = result[state.HAS_PAIR] != 0.0, None
        if memory.normals[number, 0] != 0.0:
            normal = memory.normals[number, 1:].copy()
        elif result[state.HAS_NORMAL] != 0.0:
            normal = result[state.NORMAL : state.NORMAL + 3].copy()
        known = self._hits.get(row)
        return Hit(
            float(result[LOWER]),
            _VERDICTS[int(result[state.VERDICT])],
            result[AVATAR:CLOUD].copy() if has_pair else None,
            result[CLOUD:ENDED].copy() if has_pair else None,
            "" if known is None else known.what,
            int(result[state.ARCHIVE]),
            normal,
            result[POINT:END].copy() if result[state.HAS_POINT] != 0.0 else None,
            bool(result[state.UNLOADED]),
            float(result[state.REST]),
        )


class Walker:
    """Moves the avatars of one scene. Thread-safe.

    native: whether the kernel answers queries itself; tests compare both.
    """

    def __init__(self, world: Any) -> None:
        """Prepare the effects of the world's scene file."""
        self.native = True
        self._world = world
        self._settings, reach = _settings(world.file, world.up)
        farther = min(FLAT_REACH_FACTOR * reach, MAX_NORMAL_REACH)
        # By the level of `scan_normal`.
        self._reaches = (reach, farther, min(SPARSE_FACTOR * farther, MAX_NORMAL_REACH))
        self._has_normals = any(isinstance(effect, (Slide, Ground)) for effect in world.file.effects)
        self._thread = FrameMemory()
        self._no_bodies = None
        if any(isinstance(each, Crowd) for each in world.file.effects):
            from ...kernels.walk.walk_bodies import no_bodies

            self._no_bodies = no_bodies()
        self._code = Held(None)

    def run(self, frame: Frame, parts: int) -> None:
        """Run parts of a frame (bits of FOLLOW to GROUND), each once and in their order.

        Raise the errors of queries and StoppedError; the frame is then undefined.
        """
        thread, world, body, budget = self._thread, frame.world, frame.body, frame.budget
        call = WalkCall(thread, self._reaches, frame)
        starts, frame.walks = not frame.walks, True
        if starts:
            call.begin()
        # Of the types that the kernel is compiled for; poses are C-contiguous float64 (`Pipeline.run`).
        begin, target, pose = body.pose, frame.target, frame.pose
        seconds, fell, tolerance = float(frame.seconds), float(body.fall_speed), float(budget.tolerance)
        stood, clear, bodies = bool(body.on_ground), bool(frame.clear), bool(frame.obstacles)
        verdict = int(frame.verdict)
        blocking = _only_obstacle(frame) if self.native and self._no_bodies is not None else None
        standing, own = self._no_bodies, state.ASKS
        with world as seen:
            each, alone, avatar = seen[0], world.is_alone, body.avatar
            data, residency = each.data, each.data.residency
            native = self.native and alone and 0 < len(avatar.points) <= MAX_FAST_POINTS
            squares = normals_of(each).squares(self._reaches) if self._has_normals else _NO_SQUARES
            held = data.references.to(data.arrays, data.tree)
            thread.memory.log[state.REPEATS] = 0
            while True:
                try:
                    # The bodies' lock comes first, as where an object is pushed through the scan.
                    with nullcontext() if blocking is None else blocking.lock, residency.frozen():
                        if blocking is not None:
                            standing, own = blocking.reference(body.avatar) or (self._no_bodies, state.ASKS)
                        self._code.call(
                            walk_frame, parts, starts, begin, target, pose, seconds, fell, stood, verdict, clear,
                            self._settings, avatar.reference, thread.reference, held.reference, data.arrays.stop,
                            data.nothing_clear, alone, native, bodies, data.radius_units,
                            tolerance, budget.tolerance_units, squares, standing, own,
                        )  # fmt: skip
                        log = thread.memory.log.tolist()
                        if used := log[state.USED]:
                            rows = thread.memory.used[:used]
                            if log[state.REPEATS]:  # answering a query may have evicted some of them
                                rows = rows[data.arrays.where[rows, 0] >= 0]
                            residency.use(rows.tolist())
                    break
                except state.AskedError:
                    call.answer()
                    thread.memory.log[state.REPEATS] = 1
        frame.visits, frame.apart = log[state.VISITS :], own != state.ASKS and log[state.APART] != 0
        world.count(sum(frame.visits), log[state.MISSED])
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
