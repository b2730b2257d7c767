"""Inputs of every query: the data of a scene, the budget and the cost of a request, its checked poses.

Every query takes a `SceneData` and a `QueryBudget`. Without a deadline the work ends when the answer is
exact, or known within the tolerance. A deadline is a stop flag that is set at that time: the same
kernels end, and the answer is still correct. See NUMERICS.md case 30.
"""

import math
import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...schemas.archive.archive import Archive
from ...schemas.archive.pose_arrays import make_poses
from ...schemas.archive.radius_model import class_radii
from ...schemas.archive.rigid_pose import RENORMALISE
from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.archive.voxel_grid import MAX_COORDINATE
from ...schemas.errors import BadRequestError, BadTransformError, SolidcloudError, TooLargeError
from ...schemas.wire.answers import Cost
from ...schemas.wire.requests import check_duration, check_length
from ..avatars.avatar_model import AvatarModel
from ..kernels.core import reach as pose_checks
from ..kernels.core.array_references import SceneReferences
from ..kernels.core.placed_avatar import MAX_REACH_UNITS
from ..kernels.core.reach import (
    VoxelsInReach,
    VoxelTree,
    check_poses,
    find_reach,
    make_reach,
    make_voxel_tree,
)
from ..kernels.core.scene_arrays import SceneArrays, block_words
from ..residency.voxel_cache import HeldVoxels, VoxelCache
from ..runtime.stop_flag import NO_STOP, StopFlag, StoppedError, stop_at

# Share of the remaining time that loads may take; the rest is for searching resident voxels.
LOAD_SHARE = 0.5
# Where a share of the distance is allowed, this is allowed at any distance: near contact a share
# would be less than the lattice resolves [m].
LEAST_RELATIVE = 1e-3
# Limit on the voxels in reach of one request, summed over its poses: 128 MB of row numbers. Without
# it, 100,000 poses with thousands of voxels in reach each would take gigabytes.
MAX_ROWS = 1 << 24
_POSE_FAULTS: dict[int, tuple[type[SolidcloudError], str]] = {
    pose_checks.NOT_FINITE: (BadRequestError, "holds {}: expected finite numbers"),
    pose_checks.BAD_LAST_ROW: (
        BadTransformError,
        "has a last row that is not 0 0 0 1: give row-major 4x4 poses",
    ),
    pose_checks.MIRRORED: (BadTransformError, "mirrors (determinant {:g}): expected a rotation"),
    pose_checks.SHEARED: (
        BadTransformError,
        "shears, or scales its axes differently (by {:g}, relative): expected a rotation, within 1e-9: "
        f"{RENORMALISE}",
    ),
    pose_checks.SCALED: (
        BadTransformError,
        "scales by {0:.10g}: expected a rigid pose, within 1e-9: add a scaled avatar, "
        f"add_avatar(..., scale={{0:.10g}}), or remove the scale: {RENORMALISE}",
    ),
    pose_checks.TOO_FAR: (BadTransformError, "translates by {:g} m: expected within 1e9 m"),
    pose_checks.LONG_REACH: (
        BadRequestError,
        "has radii and margin, or reach, that add up to {:g} m: expected at most 16 m: give a smaller one",
    ),
    pose_checks.LARGE_AVATAR: (
        TooLargeError,
        "makes the avatar with its reach extend {:g} m: more than this scene's lattice can place exactly: split it",
    ),
}


class LevelOfDetail(NamedTuple):
    """Representatives of a scene's points (schemas/archive/level.py), as data that queries read.

    covers: the representatives with spheres that contain all spheres of the scene: where these are
    clear, the scene is.
    points: the same with the scene's smallest spheres: a contact with one is a contact of the
    scene.
    settles_exact: whether requests without a tolerance use the level too.
    parents: (lv,) int64, for each voxel of the level, the row of the scene's voxel that it divides.
    """

    covers: "SceneData"
    points: "SceneData"
    settles_exact: bool
    parents: NDArray[np.int64]


class SceneData(NamedTuple):
    """Data of one scene that every query reads; made once, by `make_scene_data`.

    arrays: arrays that the kernels read.  tree: boxes around the points of each voxel and of scans that
    the build left out, as the index states them.  keys: (v,) uint64, of the voxels, sorted.
    radius_units: of the largest sphere of a scan point, exact units.
    unknown_everywhere: whether the build left out a scan with unknown bounds.
    keeps_scan: whether the arena stores the scan of each point.
    references: of the data with these radii, for kernels that are called once a pose.
    level: its level of detail; None if it has none.
    """

    residency: VoxelCache
    arrays: SceneArrays
    tree: VoxelTree
    keys: NDArray[np.uint64]
    radius_units: int
    unknown_everywhere: bool
    keeps_scan: bool
    references: SceneReferences
    level: LevelOfDetail | None = None

    @property
    def nothing_clear(self) -> bool:
        """Return whether no place is known to be clear.

        True if a scan with unknown bounds was left out, or a load proved the index wrong.
        """
        return self.unknown_everywhere or self.residency.misled


def has_unknown(data: SceneData) -> bool:
    """Return whether a scan was left out anywhere, or a load proved the index wrong."""
    return data.nothing_clear or len(data.tree.unknown) > 0


def to_units(metres: float, what: str) -> int:
    """Convert a length to exact units, rounded once (NUMERICS.md N5).

    Raise BadRequestError if it is negative or beyond MAX_COORDINATE.
    """
    if not 0 <= metres <= MAX_COORDINATE:  # rejects NaN too; kernels take the result as int64
        raise BadRequestError(f"{what} {metres!r}: expected zero or a positive length in metres")
    return round(metres * UNITS_PER_METRE)  # half to even


def to_world(data: SceneData, lattice: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return world positions (n, 3) [m] of lattice points, as `Lattice.to_world` computes them."""
    return np.asarray(lattice * data.arrays.step + data.arrays.origin)


def make_tree(archive: Archive) -> VoxelTree:
    """Make the boxes around the points of an archive's voxels, as the index states them."""
    header, voxels = archive.header, archive.voxels
    base = archive.coordinates * header.lattice.voxel_steps
    bounds = np.array([header.low, header.high])
    return make_voxel_tree(base + voxels["low"], base + voxels["high"], bounds, header.unknown)


def make_scene_data(archive: Archive, residency: VoxelCache, tree: VoxelTree | None = None) -> SceneData:
    """Make the data of an archive whose voxels `residency` holds, with the archive's single radius.

    tree: `make_tree` of the archive; None: make it.
    """
    header = archive.header
    tree = make_tree(archive) if tree is None else tree
    lattice = header.lattice
    arrays = SceneArrays(
        *residency.buffer.arena,
        residency.where,
        archive.coordinates * lattice.voxel_steps,
        np.array(lattice.origin),
        lattice.step,
        lattice.units_per_step,
        lattice.voxel_steps,
        block_words(header.radius_class),
        np.zeros(1, np.int64),
        NO_STOP.flag,
    )
    return SceneData(
        residency, arrays, tree, archive.voxels["key"].astype(np.uint64),
        to_units(header.radius, "radius of the archive"), header.unknown_everywhere,
        header.scan_index, SceneReferences(),
    )  # fmt: skip


def with_radius_model(data: SceneData, archive: Archive, text: str | None) -> SceneData:
    """Return the same scene with the radii of a model (schemas/archive/radius_model.py).

    text: the model; None: the archive's single radius. Raise BadRequestError for an invalid model,
    or one that the archive does not contain.
    """
    header = archive.header
    radii = class_radii(text, header.radius, header.models)
    # Only classes that occur count: on a dense scan all are small, which keeps the reach small. A
    # node may have a class that no point has, but no sphere of its points is larger than these.
    largest = int(radii[header.radius_counts > 0].max()) if len(radii) > 1 else int(radii[0])
    radius_deficit = np.maximum(largest - radii, 0)
    arrays = data.arrays._replace(radius_deficit=radius_deficit)
    return data._replace(arrays=arrays, radius_units=largest, references=SceneReferences())


def with_stop(data: SceneData, stop: StopFlag) -> SceneData:
    """Return the same scene for kernels that `stop` ends early."""
    return (
        data if data.arrays.stop is stop.flag else data._replace(arrays=data.arrays._replace(stop=stop.flag))
    )


class LateVoxels:
    """Voxels that a frame needs and does not wait for, because they are not in memory.

    count: number of voxels, counted by each query of the frame that lacks them. 0: all answers are
    those of a frame that waits.
    """

    __slots__ = ("count",)

    def __init__(self) -> None:
        self.count = 0


class QueryBudget(NamedTuple):
    """Limits on the cost of one request.

    tolerance: separation up to which contact may be reported, and allowed distance between bounds
    [m]. The default 0 means exact.
    relative: allowed distance between the bounds of a distance, as a share of the distance between
    the centres; a millimetre is allowed at any distance if it is above 0.
    deadline: on time.perf_counter()'s clock [s], inf for none. It sets `stop`.
    scan: voxels are used in passing, as on a sweep along a path, and should not displace others in
    the cache (`EvictionPolicy`).
    stop: ends the work early once it is set; what was not examined by then is unknown.
    request: the flag of the whole request, which its deadline does not set: for its broad phase.
    late: None: voxels that are not in memory are loaded. Otherwise no load is waited for: such
    voxels are bounded, their loads are owed, and they are counted here.
    """

    tolerance: float = 0.0
    deadline: float = math.inf
    scan: bool = False
    stop: StopFlag = NO_STOP
    relative: float = 0.0
    late: LateVoxels | None = None
    request: StopFlag = NO_STOP

    @property
    def stopped(self) -> str:
        """Return why something else than its deadline stopped the request; "" if nothing did."""
        return self.stop.reason or self.request.reason

    @property
    def between_bounds(self) -> float:
        """Return the distance that two bounds may lie apart, however small the distance [m]."""
        return max(self.tolerance, LEAST_RELATIVE if self.relative > 0.0 else 0.0)

    @property
    def tolerance_units(self) -> int:
        """Return the tolerance in exact units, rounded down; at most the longest reach."""
        return math.floor(min(self.tolerance * UNITS_PER_METRE, float(MAX_REACH_UNITS)))

    def loads_until(self) -> float:
        """Return the deadline of loads that begin now, on the same clock [s]; inf if none.

        -inf: no load begins, and none is waited for.
        """
        if self.late is not None:
            return -math.inf
        if self.deadline == math.inf:
            return math.inf
        now = time.perf_counter()
        return now + (self.deadline - now) * LOAD_SHARE

    def lacked(self, voxels: int) -> None:
        """Count voxels that a query of a frame lacked, if it does not wait for them."""
        if self.late is not None:
            self.late.count += voxels


EXACT = QueryBudget()


def make_budget(
    tolerance: float = 0.0,
    relative_tolerance: float = 0.0,
    budget_ms: float | None = None,
    stop: StopFlag = NO_STOP,
) -> QueryBudget:
    """Make the budget of a request that starts now.

    tolerance: [m], finite and >= 0.  relative_tolerance: finite and >= 0.
    budget_ms: time limit including waits for loads; None: no limit.
    stop: the request's stop flag; a time limit sets a part of it. Raise BadRequestError.
    """
    check_length("tolerance", tolerance)
    if not 0 <= relative_tolerance < math.inf:
        raise BadRequestError(
            f"relative_tolerance is {relative_tolerance}: expected a finite share, 0 or more, as 0.3 for 30 %"
        )
    budget = QueryBudget(float(tolerance), stop=stop, relative=float(relative_tolerance), request=stop)
    if budget_ms is None:
        return budget
    check_duration("budget_ms", budget_ms)
    budget = budget._replace(deadline=time.perf_counter() + budget_ms / 1e3, stop=stop.part())
    stop_at(budget.stop, budget.deadline, "")
    return budget


class CostCounter:
    """Cost of one request, summed over its holds: the fields of `Cost`. Not thread-safe."""

    def __init__(self, data: SceneData) -> None:
        """Begin now with zero cost. data: of the scene that is queried."""
        self._begin, self._residency, self._keys = time.perf_counter(), data.residency, data.keys
        self.hits = self.misses = 0
        self.loaded = 0  # voxels that the request loaded for later holds: they are not hits
        self.wait_seconds = 0.0
        self.faults: dict[str, None] = {}
        self.late: dict[int, None] = {}

    def add(self, held: HeldVoxels, again: int = 0) -> None:
        """Add a hold. again: number of its hits on voxels that the request has held before."""
        found = held.hits - again - self.loaded
        self.hits, self.loaded = self.hits + max(0, found), max(0, -found)
        self.misses += held.misses
        self.wait_seconds += held.waited
        self.faults.update(dict.fromkeys(held.faults))
        self.late.update(dict.fromkeys(held.late))

    def add_cost(self, cost: Cost) -> None:
        """Add the cost of another query of the same data."""
        rows = [int(self._keys.searchsorted(key)) for key in cost.late]
        self.add(HeldVoxels(cost.hits, cost.misses, cost.faults, tuple(rows), cost.wait_seconds))

    def add_level(self, cost: "CostCounter | Cost") -> None:
        """Add the waits and faults of a query of the level. Its voxels are not those of the scene."""
        self.wait_seconds += cost.wait_seconds
        self.faults.update(dict.fromkeys(cost.faults))

    def fields(self) -> dict[str, Any]:
        """Return the fields of `Cost`; call it when the answer is complete."""
        return {
            "engine_seconds": time.perf_counter() - self._begin,
            "hits": self.hits,
            "misses": self.misses,
            "resident": self._residency.resident,
            "resident_bytes": self._residency.resident_bytes,
            "faults": tuple(self.faults),
            "wait_seconds": self.wait_seconds,
            "late": tuple(self._keys[list(self.late)].tolist()) if self.late else (),
        }


def kernel_poses(poses: ArrayLike) -> NDArray[np.float64]:
    """Return poses, (4, 4) or (k, 4, 4), in a writable array (k, 4, 4). Raise BadRequestError.

    numba would compile the kernels again for a read-only array.
    """
    array = make_poses(poses)
    return array if array.flags.writeable else array.copy()


def refuse(fault: int, pose: int, found: float) -> None:
    """Raise the error for a fault reported by `find_reach`; do nothing if there is none."""
    if fault != pose_checks.VALID:
        error, text = _POSE_FAULTS[fault]
        raise error(f"pose {pose} {text.format(found)}")


def check_avatar(
    data: SceneData,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    other_units: int,
    numbers: NDArray[np.int64] | None = None,
) -> NDArray[np.int64]:
    """Check poses (k, 4, 4) of an avatar; return the reach (k,) of each, the avatar's radius plus other_units.

    other_units: in exact units.  numbers: (k,) of the poses in the request, for messages; None: their rows.
    A stop may leave some reaches zero. Raise BadRequestError, BadTransformError or TooLargeError.
    """
    units = np.zeros(len(poses), np.int64)
    fault, pose, found = check_poses(
        poses, avatar.arrays.radius, avatar.radius, other_units, data.arrays, units
    )
    refuse(fault, pose if numbers is None else int(numbers[pose]), found)
    return units


def check_request(
    data: SceneData, avatar: AvatarModel, poses: NDArray[np.float64], other_units: int
) -> VoxelsInReach:
    """Check poses (k, 4, 4) and return the voxels in reach of each; none for an empty avatar.

    Raise BadRequestError, BadTransformError or TooLargeError naming the pose, TooLargeError for
    more than MAX_ROWS voxels in reach of all poses, and StoppedError.
    """
    needed = 16 * len(poses) + 64
    while True:
        reach = make_reach(len(poses), needed)
        fault, pose, found, needed = find_reach(
            poses, avatar.arrays, avatar.radius, other_units, data.arrays, data.tree, reach
        )
        refuse(fault, pose, found)
        if needed < 0:
            raise StoppedError
        if needed <= len(reach.lists.rows):
            return reach
        if needed > MAX_ROWS:
            raise TooLargeError(
                f"{needed} voxels in reach of {len(poses)} poses: at most {MAX_ROWS} in a request: ask about fewer "
                "poses, or with a smaller margin or reach"
            )


class PoseQuery(NamedTuple):
    """Query about k poses of an avatar, whose arguments are checked.

    poses: (k, 4, 4) float64, C order.  beyond: margin or reach, exact units.  around: the voxels in
    reach of each pose.  spent: the cost so far.
    """

    data: SceneData
    avatar: AvatarModel
    poses: NDArray[np.float64]
    beyond: int
    around: VoxelsInReach
    budget: QueryBudget
    spent: CostCounter

    @property
    def radii(self) -> NDArray[np.int64]:
        """Return the sum (k,) of the largest radii of avatar and scan, exact units."""
        return self.around.units - self.beyond

    @property
    def unseen(self) -> NDArray[np.float64]:
        """Return lower bounds (k,) of the distance of centres from scans that the build left out [steps].

        inf: no such scan is in reach. Read it after all loads: one may have proved the index wrong.
        """
        if self.data.nothing_clear and len(self.avatar.points):
            return np.zeros(len(self.poses))
        return self.around.lists.unseen


def make_query(
    data: SceneData, avatar: AvatarModel, poses: ArrayLike, beyond: int, budget: QueryBudget
) -> PoseQuery:
    """Check a query about poses, and list the voxels in their reach; raise as `check_request`.

    beyond: margin or reach, exact units.
    """
    spent, array = CostCounter(data), kernel_poses(poses)
    around = check_request(data, avatar, array, data.radius_units + beyond)
    # Only from here on a deadline ends the kernels.
    return PoseQuery(with_stop(data, budget.stop), avatar, array, beyond, around, budget, spent)
