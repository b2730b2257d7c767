"""One call of the kernel `walk_frame` for a frame: its state to and from arrays, and answers to its queries."""

import math
import threading

import numpy as np
from numpy.typing import NDArray

from ....schemas.wire.answers import Verdict
from ....schemas.wire.motion_messages import GroundReport
from ...kernels.motion.sweep_resident import AVATAR, CLOUD, END, ENDED, LOWER, POINT
from ...kernels.walk import walk_state as state
from ...queries.resident_fast_path import MAX_FAST_VOXELS
from .frame import (
    Frame,
    Hit,
    Pose,
    find_first_hit,
    find_touched,
    first_body_hit,
    is_clear,
    lowest_height,
    touches_bodies,
    translated,
)
from .vectors import dot

# Names under which `Body.effect_state` keeps the point and the normal of the plane that the avatar stands
# on, (6,), and the place where it was raised last, (3,).
GROUND_PLANE, RAISED = "ground", "ground raised"
# Rows of the tape at first; frames that need more double it.
_ROWS = 64
# A search for any landing place extends to this distance below the scene's lowest sphere [m]; the
# tolerance of that sweep [m].
_FALL_MARGIN, _FALL_TOLERANCE = 0.1, 1e-2


class FrameMemory(threading.local):
    """State of a frame of each thread."""

    def __init__(self) -> None:
        self.use(state.make_arrays(_ROWS, MAX_FAST_VOXELS))

    def use(self, memory: state.WalkArrays) -> None:
        """Take other arrays."""
        self.memory, self.reference = memory, state.refer_to_memory(memory)

    def grow(self) -> None:
        """Double the rows of the tape."""
        old, rows = self.memory, len(self.memory.tape)
        larger = state.make_arrays(2 * rows, MAX_FAST_VOXELS)
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
        hit = obstacle.name_hit(at, asked[state.HIT_FRACTION], pair, (block, lane))  # type: ignore[attr-defined]
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
        if frame.lacked > lacked and not (swept.verdict == Verdict.CONTACT and swept.exact):
            result[state.UNLOADED] = 1.0
        elif swept.verdict != Verdict.CONTACT:
            result[state.ANSWER] = swept.verdict == Verdict.UNKNOWN
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


_VERDICTS = {int(verdict): verdict for verdict in Verdict}
