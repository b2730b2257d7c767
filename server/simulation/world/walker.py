"""Parts of a frame that move an avatar, by the kernel `walk_frame`, and its queries for Python.

The kernel asks Python if voxels have to be loaded, bodies are in the way, a scene is not a single
archive at the identity, or an avatar is too large (kernels/walk/state.py).
"""

import math
import threading
from collections import namedtuple
from contextlib import nullcontext
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....schemas.scene.effect_table import Ground, Slide, Step, Stop, Sweep
from ....schemas.scene.scene_file import SceneFile, sweep_tolerance
from ....schemas.wire.answers import Verdict
from ....schemas.wire.motion_messages import GroundReport
from ...kernels.core.array_references import Held
from ...kernels.core.normal_codes import MAX_NORMAL_REACH
from ...kernels.walk import state
from ...kernels.walk.slide import FLAT_REACH_FACTOR
from ...kernels.walk.walk_frame import walk_frame
from ...queries.context.query_budget import EXACT
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


_State: Any = namedtuple("_State", state.STATE.names or ())
_Log: Any = namedtuple("_Log", state.LOG.names or ())


def _settings(file: SceneFile, up: Vec) -> NDArray[np.void]:
    """Return the options of a scene's effects for the kernel, one record."""
    declared: dict[type, Any] = {type(effect): effect for effect in file.effects}
    stop, slide = declared.get(Stop, Stop()), declared.get(Slide)
    ground, step = declared.get(Ground), declared.get(Step)
    height = 0.0 if step is None else step.height
    made = np.zeros(1, state.SETTINGS)
    made["up"], made["continuous"], made["slides"] = up, Sweep in declared, slide is not None
    made["skin"], made["tolerance"], made["step"] = stop.skin, sweep_tolerance(file), height
    made["surfaces"] = 4 if slide is None else slide.surfaces
    made["normal_reach"] = _NORMAL_REACH if slide is None else slide.normal_reach
    made["lift"], made["walkable_slide"] = max(stop.skin, _MIN_LIFT), -2.0
    if ground is not None:
        walkable, clearance = math.cos(math.radians(ground.slope)), ground.clearance
        snap = height if ground.snap is None else ground.snap
        made["walkable_slide"], made["walkable"] = walkable, walkable - _ROUNDING
        made["clearance"], made["near_reach"] = clearance, _NEAR_CLEARANCES * clearance
        made["down"] = clearance + max(snap, clearance)
        made["gravity"], made["max_speed"] = ground.gravity, ground.fall_speed
    return made


class _NoBodies:
    """What `Walker.run` reads of `Bodies`, in a scene without them."""

    lock = nullcontext()
    bounds, kinds, origin = np.empty((0, 2, 3)), np.empty(0, np.uint8), np.zeros(3)

    def row_of(self, name: str, *, user: bool) -> int:
        """Return -1."""
        return -1


_NO_BODIES: Any = _NoBodies()


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
        plane, raised, before = (
            body.effect_state.get(GROUND_PLANE),
            body.effect_state.get(RAISED),
            memory.before,
        )
        before["has_plane"], before["was_raised"] = plane is not None, raised is not None
        if plane is not None:
            before["plane_point"], before["plane_normal"] = plane[:3], plane[3:]
        if raised is not None:
            before["raised_at"] = raised
        for row, hit in enumerate(self._frame.hits):
            self._write_hit(row, hit)
        memory.log["known"] = len(self._frame.hits)

    def finish(self) -> None:
        """Read the state that a frame has reached."""
        frame, memory = self._frame, self._thread.memory
        now = _State(*memory.state[0].item())
        frame.pose = memory.poses[0].copy()
        frame.verdict, frame.clear, frame.remaining = _VERDICTS[now.verdict], now.clear, now.left.copy()
        frame.hits = [self._read_hit(hit) for hit in memory.hits[: now.hits]]
        if not math.isnan(now.stepped):
            frame.reports["stepped"] = now.stepped
        if not now.grounded:
            return
        frame.on_ground, frame.fall_speed = now.stands, now.fall_speed
        x, y, z = now.ground.tolist()
        frame.reports["ground"] = GroundReport(
            now.stands, now.fall_speed, (x, y, z) if now.has_ground else None
        )
        if now.has_plane:
            frame.effect_state[GROUND_PLANE] = np.concatenate([now.plane_point, now.plane_normal])
        if now.raised:
            frame.effect_state[RAISED] = now.raised_at.copy()

    def answer(self) -> None:
        """Answer the query that the kernel asked."""
        memory, frame = self._thread.memory, self._frame
        query, row = int(memory.log["asked"][0]), int(memory.log["known"][0])
        if query == state.FULL:
            self._thread.grow()
            return
        before, frame.pose = frame.pose, memory.asked_poses[0].copy()
        try:
            self._answer(query, row, memory.question[0], memory.asked_poses[1].copy())
        finally:
            frame.pose = before
        memory.log["known"] = row + 1

    def _answer(self, query: int, row: int, question: Any, to: Pose) -> None:
        """Write the answer of a query to its row. question: its `QUESTION`.  to: end of its motion."""
        frame, result = self._frame, self._thread.memory.tape[row]
        world, pose, tolerance, below = frame.world, frame.pose, question["tolerance"], question["below"]
        if query == state.SWEPT_TO:
            self._write_hit(row, find_first_hit(frame, to, tolerance, question["skin"], below=below))
        elif query == state.BODIES_SWEPT:
            until = math.inf if result["verdict"] == int(Verdict.CLEAR) else result["lower"]
            hit = first_body_hit(frame, to, tolerance, until, below=below)
            if hit is not None:
                self._write_hit(row, hit)
        elif query == state.CLEAR_AT:
            result["answer"] = is_clear(frame, pose, proved=question["proved"])
        elif query == state.BODIES_AT:
            result["answer"] = not touches_bodies(frame, pose)
        elif query == state.TOUCHED:
            self._write_hit(row, find_touched(frame, pose))
        elif query == state.GIVES_WAY:
            hit = self._hits[int(question["hit"])]
            result["answer"] = any(each.give_way(frame, hit, to) for each in frame.obstacles)
        elif query == state.NORMAL_AT:
            normal = world.normal_at(
                question["archive"], question["place"].copy(), question["toward"].copy(),
                self._reaches[question["level"]], frame.budget,
            )  # fmt: skip
            result["has_normal"] = normal is not None
            if normal is not None:
                result["normal"] = normal
        elif query == state.HIGHEST:
            touched = Hit(
                0.0, Verdict.CONTACT, None, question["place"].copy(), archive=int(question["archive"])
            )
            directions, reach = question["directions"][: question["count"]], self._reaches[question["level"]]
            heights = world.highest(touched, directions, reach, frame.budget)
            result["heights"] = 0.0
            result["heights"][: len(heights)] = heights
        elif query == state.NEAREST:
            found = world.nearest(question["place"].copy(), float(question["reach"]), frame.budget)
            result["has_pair"] = found is not None
            if found is not None:
                result["cloud"], result["archive"] = found.cloud, found.archive
        else:
            assert query == state.LANDS
            self._write_landing(row, question["reach"], stood=question["stood"])

    def _write_landing(self, row: int, reach: float, *, stood: bool) -> None:
        """Write whether an avatar without ground within `reach` [m] of its feet may land.

        stood: whether it stood in the last frame.
        """
        frame, result = self._frame, self._thread.memory.tape[row]
        world, avatar, up = frame.world, frame.body.avatar, frame.world.up
        result["answer"], result["unloaded"], result["rest"] = False, False, 0.0
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
            result["unloaded"] = True
        elif not touches:
            result["answer"] = swept is not None
        else:
            # The rim of a hole, or the ledge behind, stops the parts above the feet, which are wider.
            result["answer"] = not stood or dot(swept.cloud, up) < feet - reach

    def _write_hit(self, row: int, hit: Hit | None) -> None:
        """Write a hit, or None, to a row."""
        tape = self._thread.memory.tape
        tape[row] = np.zeros((), tape.dtype)
        result = tape[row]
        if hit is None:
            result["verdict"] = int(Verdict.CLEAR)
            return
        self._hits[row] = hit
        result["lower"], result["verdict"], result["archive"] = hit.fraction, int(hit.verdict), hit.archive
        result["unloaded"], result["rest"], result["named"] = hit.unloaded, hit.rest, bool(hit.what)
        for name, part in (("normal", hit.normal), ("point", hit.point), ("end", hit.end)):
            if part is not None:
                result[f"has_{name}"], result[name] = True, part
        if hit.avatar is not None and hit.cloud is not None:
            result["has_pair"], result["avatar"], result["cloud"] = True, hit.avatar, hit.cloud

    def _read_hit(self, recorded: Any) -> Hit:
        """Return a recorded hit, a `HIT`."""
        row = int(recorded["row"])
        result, normal = self._thread.memory.tape[row], None
        if recorded["has_normal"]:
            normal = recorded["normal"].copy()
        elif result["has_normal"]:
            normal = result["normal"].copy()
        known, has_pair = self._hits.get(row), result["has_pair"]
        return Hit(
            float(result["lower"]),
            _VERDICTS[int(result["verdict"])],
            result["avatar"].copy() if has_pair else None,
            result["cloud"].copy() if has_pair else None,
            "" if known is None else known.what,
            int(result["archive"]),
            normal,
            result["point"].copy() if result["has_point"] else None,
            bool(result["unloaded"]),
            float(result["rest"]),
        )


class Walker:
    """Moves the avatars of one scene. Thread-safe.

    native: whether the kernel answers queries itself; tests compare both.
    """

    def __init__(self, world: Any) -> None:
        """Prepare the effects of the world's scene file."""
        self.native = True
        self._world = world
        self._settings = _settings(world.file, world.up)
        reach = float(self._settings["normal_reach"][0])
        farther = min(FLAT_REACH_FACTOR * reach, MAX_NORMAL_REACH)
        # By the level of `scan_normal`.
        self._reaches = (reach, farther, min(SPARSE_FACTOR * farther, MAX_NORMAL_REACH))
        self._has_normals = any(isinstance(effect, (Slide, Ground)) for effect in world.file.effects)
        self._thread = FrameMemory()
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
        stood, clear, verdict = bool(body.on_ground), bool(frame.clear), int(frame.verdict)
        blocks, bodies = bool(frame.obstacles), frame.obstacles[0].bodies if frame.obstacles else _NO_BODIES
        wanted = 0
        for obstacle in frame.obstacles:
            wanted |= obstacle.wanted
        with world as seen:
            each, alone, avatar = seen[0], world.is_alone, body.avatar
            data, residency = each.data, each.data.residency
            native = self.native and alone and 0 < len(avatar.points) <= MAX_FAST_POINTS
            squares = normals_of(each).squares(self._reaches) if self._has_normals else _NO_SQUARES
            held = data.references.to(data.arrays, data.tree)
            thread.memory.log["repeats"] = False
            while True:
                try:
                    # The bodies' lock comes first, as where an object is pushed through the scan.
                    with bodies.lock, residency.frozen():
                        self._code.call(
                            walk_frame, parts, starts, begin, target, pose, seconds, fell, stood, verdict, clear,
                            self._settings, avatar.reference, thread.reference, held.reference, data.arrays.stop,
                            data.nothing_clear, alone, native, blocks, data.radius_units, tolerance,
                            budget.tolerance_units, squares, bodies.bounds, bodies.kinds, bodies.origin, wanted,
                            bodies.row_of(body.name, user=True),
                            max([each.margin for each in frame.obstacles], default=0.0),
                        )  # fmt: skip
                        log = _Log(*thread.memory.log[0].item())
                        if log.used:
                            rows = thread.memory.used[: log.used]
                            if log.repeats:  # answering a query may have evicted some of them
                                rows = rows[data.arrays.where[rows, 0] >= 0]
                            residency.use(rows.tolist())
                    break
                except state.AskedError:
                    call.answer()
                    thread.memory.log["repeats"] = True
        frame.visits, frame.apart = log.visits.tolist(), log.apart > 0
        world.count(sum(frame.visits), log.missed)
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
