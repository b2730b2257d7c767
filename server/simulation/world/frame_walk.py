"""Parts of a frame that move an avatar, by the kernel `walk_frame`, and its queries for Python.

The kernel asks Python if voxels have to be loaded, bodies are in the way, a scene is not a single
archive at the identity, or an avatar is too large (kernels/walk/walk_state.py).
"""

import math
from contextlib import nullcontext
from typing import Any

import numpy as np

from ....schemas.scene.effect_table import Crowd, Ground, Slide, Step, Stop, Sweep
from ....schemas.scene.scene_file import SceneFile, sweep_tolerance
from ....schemas.wire.answers import Verdict
from ...kernels.core.array_references import Held
from ...kernels.core.normal_codes import MAX_NORMAL_REACH
from ...kernels.walk import walk_state as state
from ...kernels.walk.slide_along import FLAT_REACH_FACTOR
from ...kernels.walk.walk_frame import walk_frame
from ...queries.context.query_budget import EXACT
from .frame import Frame, Vec
from .held_archive import SPARSE_FACTOR, normals_of
from .walk_call import FrameMemory, WalkCall

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
            each, probe = seen[0], world.probe(body.avatar)
            data, residency = each.data, each.data.residency
            alone = world.is_alone
            native = self.native and alone and probe.is_small
            squares = normals_of(each).squares(self._reaches) if self._has_normals else _NO_SQUARES
            held = data.references.to(data.arrays, data.broad)
            thread.memory.log[state.REPEATS] = 0
            while True:
                try:
                    # The bodies' lock comes first, as where an object is pushed through the scan.
                    with nullcontext() if blocking is None else blocking.lock, residency.frozen():
                        if blocking is not None:
                            standing, own = blocking.reference(body.avatar) or (self._no_bodies, state.ASKS)
                        self._code.call(
                            walk_frame, parts, starts, begin, target, pose, seconds, fell, stood, verdict, clear,
                            self._settings, probe.walking, thread.reference, held.reference, data.arrays.stop,
                            data.unknown, data.nothing_clear, alone, native, bodies, data.radius_units,
                            tolerance, budget.tolerance_units, squares, standing, own,
                        )  # fmt: skip
                        log = thread.memory.log.tolist()
                        if used := log[state.USED]:
                            rows = thread.memory.used[:used]
                            if log[state.REPEATS]:  # answering a query may have evicted some of them
                                rows = rows[data.arrays.where[rows, 0] >= 0]
                            probe.use(residency, rows.tolist())
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
