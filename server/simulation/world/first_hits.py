"""First hits of a frame's motions with the scan and other bodies, and motions that begin in contact.

The rule for the latter is in schemas/SCENE.md, "A user in contact".
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.wire.answers import Verdict
from ...archives.ask_archives import HeldArchive
from ...archives.rigid_transform import transform_points
from ...kernels.bodies import leave_contact as kernel
from ...kernels.motion.sweep_resident import MAX_SKIN_FACTOR, MAX_UNDECIDED, MIN_MOTION, skin_fraction
from ...queries.load_and_search import parts_that_fit
from ...queries.query_inputs import QueryBudget
from .frame import (
    Frame,
    Hit,
    Pose,
    Vec,
    dot,
    frobenius_norm,
    is_translation,
    norm,
    rotate,
    rotate_back,
    translated,
)

# Points this much farther than a motion reaches are gathered with it, for the next motions [m].
_MORE = 0.25
# Name under which `Body.effect_state` keeps the avatar's heights along `kernel.DIRECTIONS`.
_HULL = "hull"
# A motion leaves a surface if its direction has at least this part away from the plane, and ignores the
# points up to `kernel.THICK` beyond it. In a corner, a body more than a third of its radius deep
# touches new points of both walls on every way out, although it leaves both.
_LEAVES = 0.2
# A motion may lead over a plane by this share of its length, which is rounding.
_ROUNDING = 1e-8
# First step back from a pose that turns out not to be clear [m], and its growth factor, as in
# kernels/walk/motions.py.
_FIRST_STEP_BACK, _STEP_GROWTH = 1e-7, 4.0


class LeavingPose:
    """Pose in contact with the scan, and the motions that may leave it.

    Scan points that the avatar holds, by touching them or inside, bound these motions by planes
    between them and its core. All other points stop a motion at their first contact.

    reach: translations of `pose` by up to this length may meet the gathered points [m].
    lacks: whether part of the scan there is unknown.  late: whether voxels are not in memory.
    """

    def __init__(self, frame: Frame, reach: float) -> None:
        """Gather the points that translations of frame.pose by up to `reach` [m] may meet."""
        self.pose, self.reach, self.lacks, self.late = frame.pose, reach, False, False
        avatar, self._body = frame.body.avatar, frame.body.avatar.reference
        with frame.world as seen:
            self._seen = list(seen)
            found = [self._gather(each, reach + avatar.radius, frame.budget) for each in seen]
        frame.world.count(0, self.lacks)
        points = np.concatenate(found)
        self._archive = np.repeat(np.arange(len(found)), [len(each) for each in found])
        units = np.array([each.data.radius_units for each in self._seen])[self._archive]
        self._reach = avatar.radius + (units - points[:, kernel.DEFICIT]) / UNITS_PER_METRE
        self._points = np.ascontiguousarray(points[:, : kernel.LATTICE])
        self._lattice = points[:, kernel.LATTICE : kernel.DEFICIT]
        hull = frame.body.effect_state.get(_HULL)
        if hull is None:
            hull = frame.body.effect_state[_HULL] = self._heights(kernel.DIRECTIONS)
        self._box = np.array([-hull[:3], hull[5:2:-1]])
        self._held = held = np.zeros(len(points), bool)
        kernel.find_held(kernel.DIRECTIONS, hull, self._points, self._reach, held)
        held |= self._meet(np.empty((0, kernel.PLANE)), np.zeros(3))[0] == 0.0
        planes = np.empty((kernel.MAX_PLANES, kernel.PLANE))
        count = kernel.separate_core(self._box, self._points[held], planes)
        self._planes = planes[: max(count, 0)]
        self._blocked = count < 0

    def _gather(self, seen: HeldArchive, far: float, budget: QueryBudget) -> NDArray[np.float64]:
        """Return the points of an archive, as `gather_points`, whose spheres are within `far` of centres [m]."""
        data, residency, pose = seen.data, seen.data.residency, seen.placed.poses_in(self.pose[None])[0]
        arrays, tree = data.arrays, data.tree
        more = far + data.radius_units / UNITS_PER_METRE + 1e-6
        axes, shift = np.empty((6, 3)), pose[:3, 3] - arrays.origin
        axes[:3], axes[3:] = -pose[:3, :3], pose[:3, :3]
        heights = self._heights(axes)
        low, high = shift - heights[:3] - more, shift + heights[3:] + more
        box = np.array([np.floor(low / arrays.step), np.ceil(high / arrays.step)]).astype(np.int64)
        nothing = np.empty((0, kernel.GATHERED))
        if data.nothing_clear or _meets(box, tree.unknown[:, 0], tree.unknown[:, 1]).any():
            self.lacks = True
            return nothing
        rows = np.flatnonzero(_meets(box, tree.low[: tree.voxels], tree.high[: tree.voxels])).tolist()
        held = data.references.to(arrays, tree)
        found, count = np.empty((4096, kernel.GATHERED)), 0
        for part in parts_that_fit(residency, rows, residency.buffer.total_bytes):
            with residency.hold(part, budget.loads_until(), stop=budget.stop) as loaded:
                if loaded.late or loaded.faults:
                    budget.lacked(len(loaded.late))
                    self.lacks, self.late = True, self.late or bool(loaded.late)
                    return nothing
                for row in part:
                    while True:
                        with residency.frozen():
                            now = held.call(
                                kernel.gather_points, held.reference, row, box, pose, found, count
                            )
                        if now <= len(found):
                            break
                        found = np.concatenate([found[:count], np.empty((now, kernel.GATHERED))])
                    count = now
        return found[:count]

    def _heights(self, directions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the greatest heights (k,) of the avatar's centres along directions (k, 3) of its frame [m]."""
        heights = np.empty(len(directions))
        kernel.find_heights(self._body, directions, heights)
        return heights

    def _meet(self, behind: NDArray[np.float64], way: Vec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return when a translation, avatar frame, meets points, and the avatar's touching centres.

        Points that are held, and those of surfaces behind planes (k, PLANE), are left out.
        """
        times, own = np.empty(len(self._points)), np.zeros((len(self._points), 3))
        kernel.meet_points(
            self._body, self._box, self._points, self._reach, self._held, behind, way, times, own
        )
        return times, own

    def _in_world(self, place: Vec) -> Vec:
        """Return a place (3,) of the avatar's frame in the world."""
        return rotate(self.pose, place) + self.pose[:3, 3]

    @property
    def out(self) -> Vec | None:
        """Return the unit direction (3,) away from all planes together; None if there is none."""
        total = np.zeros(3)
        for plane in self._planes:
            total -= plane[: kernel.OFFSET]
        length = norm(total)
        return rotate(self.pose, total / length) if length > _ROUNDING else None

    def sweep(self, to: Pose, skin: float) -> Hit | None:
        """Return the hit that ends the translation to a pose, as `find_first_hit`, or None."""
        if self.lacks:
            return Hit(0.0, Verdict.UNKNOWN, None, None, unloaded=self.late)
        way = to[:3, 3] - self.pose[:3, 3]
        local, length = rotate_back(self.pose, way), norm(way)
        if self._blocked:
            return Hit(0.0, Verdict.CONTACT, None, None, end=self.pose)
        deepest, hit = _ROUNDING * length, None
        for plane in self._planes:
            into = dot(plane[: kernel.OFFSET], local)
            if into > deepest:
                deepest = into
                nearest, core = plane[kernel.NEAREST : kernel.CORE], plane[kernel.CORE :]
                at = int(np.flatnonzero((self._points == nearest).all(axis=1))[0])
                hit = Hit(
                    0.0, Verdict.CONTACT, self._in_world(core), self._in_world(nearest), "", int(self._archive[at]),
                    -rotate(self.pose, plane[: kernel.OFFSET]), end=self.pose,
                )  # fmt: skip
        if hit is not None:
            return hit
        behind = [plane for plane in self._planes if dot(plane[: kernel.OFFSET], local) <= -_LEAVES * length]
        times, own = self._meet(np.array(behind).reshape(-1, kernel.PLANE), local)
        at = int(times.argmin()) if len(times) else -1
        if at < 0 or times[at] == np.inf:
            return None
        fraction, avatar = float(times[at]), self._in_world(own[at])
        end = self._end(to, fraction, local, own[at] - self._points[at], skin) if skin >= 0.0 else None
        number = int(self._archive[at])
        arrays = self._seen[number].data.arrays
        cloud, pose = self._lattice[at] * arrays.step + arrays.origin, self._seen[number].placed.pose
        if pose is not None:
            cloud = transform_points(pose, cloud[None])[0]
        return Hit(
            fraction, Verdict.CONTACT, avatar + fraction * way, cloud, "", number, None, own[at], end=end
        )

    def _end(self, to: Pose, fraction: float, way: Vec, begin: Vec, skin: float) -> Pose:
        """Return the pose `skin` [m] before a contact. begin: from the touched to the touching centre."""
        out, length = begin + fraction * way, norm(way)
        into = -dot(way, out) / norm(out) if norm(out) > 0.0 else length
        fraction -= skin / max(into, length / MAX_SKIN_FACTOR)
        if not fraction * length >= MIN_MOTION:
            return self.pose
        return translated(self.pose, fraction * (to[:3, 3] - self.pose[:3, 3]))


def _meets(box: NDArray[np.int64], low: NDArray[Any], high: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which of the boxes low, high (k, 3) meet a box (2, 3)."""
    return ((low <= box[1]) & (high >= box[0])).all(axis=1)


def leaving_pose(frame: Frame, far: float) -> LeavingPose:
    """Return frame.pose, in contact, for translations of up to `far` [m]."""
    known: LeavingPose | None = frame.leaving
    if known is None or far > known.reach or known.pose.tobytes() != frame.pose.tobytes():
        known = frame.leaving = LeavingPose(frame, far + _MORE)
    return known


def leave(frame: Frame, to: Pose, skin: float = -1.0) -> Hit | None:
    """Return the hit that ends the translation from frame.pose, in contact, to a pose; or None.

    skin: distance to keep from the hit [m], for `Hit.end`; negative: not requested.
    """
    return leaving_pose(frame, norm(to[:3, 3] - frame.pose[:3, 3])).sweep(to, skin)


def find_first_hit(
    frame: Frame, to: Pose, tolerance: float, skin: float = -1.0, *, below: bool = False
) -> Hit | None:
    """Return the first hit of the motion from frame.pose to a pose with scene or obstacles.

    skin: distance to keep from the hit [m], for `Hit.end`; negative: not requested.
    below: for a search for ground, leave out bodies beside the avatar.
    """
    lacked = frame.lacked
    found: Hit | None = frame.world.sweep(frame.body.avatar, frame.pose, to, tolerance, frame.budget)
    if found is not None:
        if frame.verdict == Verdict.CONTACT and found.upper == 0.0 and is_translation(frame.pose, to):
            found = leave(frame, to, skin)
        elif found.verdict == Verdict.UNKNOWN or not (
            found.exact or max_displacement(frame, to) * (found.upper - found.fraction) <= MAX_UNDECIDED
        ):
            found = Hit(found.fraction, Verdict.UNKNOWN, None, None, unloaded=frame.lacked > lacked)
    until = math.inf if found is None else found.fraction
    return first_body_hit(frame, to, tolerance, until, below=below) or found


def first_body_hit(frame: Frame, to: Pose, tolerance: float, until: float, *, below: bool) -> Hit | None:
    """Return the first hit of the motion from frame.pose to a pose with obstacles, before `until`.

    until: fraction of the motion.  below: as for `find_first_hit`.
    """
    found = None
    for obstacle in frame.obstacles:
        hit = obstacle.sweep(frame.pose, to, tolerance, below=below)
        if hit is not None and hit.fraction < until:
            found, until = hit, hit.fraction
    return found


def find_touched(frame: Frame, pose: Pose) -> Hit | None:
    """Return a hit with fraction 0 if a pose touches something or is unknown, or None."""
    avatar, lacked = frame.body.avatar, frame.lacked
    verdict = frame.world.collide(avatar, pose, frame.budget)
    if verdict == Verdict.CONTACT:
        return frame.world.deepest(avatar, pose, frame.budget) or Hit(0.0, verdict, None, None)
    if verdict == Verdict.UNKNOWN:
        return Hit(0.0, verdict, None, None, unloaded=frame.lacked > lacked)
    return next((hit for each in frame.obstacles if (hit := each.touches(pose))), None)


def is_clear(frame: Frame, pose: Pose, *, proved: bool = False) -> bool:
    """Return whether it is known that nothing is touched at a pose.

    proved: whether this is already proved for the scene; then only obstacles are tested.
    """
    avatar = frame.body.avatar
    if not proved and frame.world.collide(avatar, pose, frame.budget) != Verdict.CLEAR:
        return False
    return not touches_bodies(frame, pose)


def touches_bodies(frame: Frame, pose: Pose) -> bool:
    """Return whether an obstacle is touched at a pose."""
    return any(each.touches(pose) for each in frame.obstacles)


def max_displacement(frame: Frame, to: Pose) -> float:
    """Return an approximate bound of the distance that any avatar point moves to a pose [m].

    The motion begins at frame.pose.
    """
    avatar, begin = frame.body.avatar, frame.pose
    if not len(avatar.points):
        return 0.0
    way = to[:3, 3] - begin[:3, 3]
    if is_translation(begin, to):
        return norm(way)
    turn = to[:3, :3] - begin[:3, :3]
    center = way + rotate(turn, avatar.arrays.center[0])
    return norm(center) + frobenius_norm(turn) * float(avatar.arrays.radius[0])


def settle_before(frame: Frame, to: Pose, hit: Hit, skin: float) -> None:
    """Move to the pose the skin before a hit on the way to a pose (4, 4), or to a clear one before it.

    The avatar stays if the way is shorter than MIN_MOTION. The kernel `walk_frame` does the same.
    """
    way, avatar, begin = max_displacement(frame, to), frame.body.avatar, frame.pose
    share = 0.0
    if way > 0.0 and skin > 0.0:
        share = skin / way
        if hit.avatar is not None and hit.cloud is not None:
            there = frame.world.between(avatar, begin, to, min(hit.fraction, 1.0))[0]
            point = rotate_back(there, hit.avatar - there[:3, 3])
            share = skin_fraction(begin, to, hit.avatar, hit.cloud, point, way, skin)
    fraction, back = hit.fraction - share, 0.0
    while (fraction - back) * way >= MIN_MOTION:
        pose, same = frame.world.between(avatar, begin, to, fraction - back)
        if is_clear(frame, pose, proved=same and fraction - back < hit.fraction):
            frame.pose = pose
            return
        back = max(_STEP_GROWTH * back, _FIRST_STEP_BACK / way)


def record_hit(frame: Frame, hit: Hit) -> None:
    """Record a hit where the frame begins."""
    frame.hits.append(hit)
    if hit.verdict == Verdict.UNKNOWN and frame.verdict == Verdict.CLEAR:
        frame.verdict = Verdict.UNKNOWN
