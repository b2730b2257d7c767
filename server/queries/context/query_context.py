"""Context of every query: the scene data it reads, checked poses, and its voxels in reach.

An answer relies on the index only where a load has proved it. If the cell of a voxel is in reach
and its box in the index is not, the voxel is loaded first (`find_proved_reach`). If its record
agrees with the index (index_proof.py), the voxel is not examined, and every answer and work count
is that of the index. If the record cannot be read, the voxel stays in reach and is missing. Each
voxel therefore costs at most one additional load, even if nothing comes near its points.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ....schemas.archive.archive import Archive
from ....schemas.archive.pose_arrays import make_poses
from ....schemas.archive.radius_model import class_radii
from ....schemas.archive.rigid_pose import RENORMALISE
from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.archive.voxel_grid import MAX_COORDINATE
from ....schemas.errors import BadRequestError, BadTransformError, SolidcloudError, TooLargeError
from ...avatars.avatar_model import AvatarModel
from ...kernels.core import voxels_in_reach as pose_checks
from ...kernels.core.array_references import SceneReferences
from ...kernels.core.scene_arrays import SceneArrays, block_words
from ...kernels.core.voxels_in_reach import SceneIndex, VoxelsInReach, find_reach
from ...residency.coarse_bounds import CoarseBounds
from ...residency.index_proof import ProvedBounds
from ...residency.voxel_cache import VoxelCache
from ...residency.voxel_states import HeldVoxels
from ...runtime.stop_flag import NO_STOP, StopFlag, StoppedError
from .query_budget import CostCounter, QueryBudget

# Limit on the voxels in reach of one request, summed over its poses: 128 MB of row numbers. Without
# it, 100,000 poses with thousands of voxels in reach each would take gigabytes.
MAX_ROWS = 1 << 24
# Rows processed between two checks of the stop flag.
_ROWS_AT_ONCE = 1 << 18

_POSE_FAULTS: dict[int, tuple[type[SolidcloudError], str]] = {
    pose_checks.NOT_FINITE: (BadRequestError, "holds {}: expected finite numbers"),
    pose_checks.BAD_LAST_ROW: (
        BadTransformError,
        "has a last row that is not 0 0 0 1: give row-major 4x4 poses",
    ),
    pose_checks.MIRRORED: (
        BadTransformError,
        "mirrors (determinant {:g}): expected a rotation, with a uniform scale at most",
    ),
    pose_checks.SHEARED: (
        BadTransformError,
        "shears, or scales its axes differently (by {:g}, relative): expected a rotation, with a uniform scale at "
        f"most, within 1e-9: {RENORMALISE}",
    ),
    pose_checks.BAD_SCALE: (BadTransformError, "scales by {:g}: expected 0.001 to 1000"),
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

    arrays: arrays that the kernels read.  bounds: boxes around the points of each voxel.
    broad: the index of `bounds`, which the broad phase reads.
    radius_units: of the largest sphere of a scan point, exact units.
    unknown: (u, 2, 3) int64, lattice boxes of scans that the build left out.
    unknown_everywhere: whether the build left out a scan with unknown bounds.
    keeps_scan: whether the arena stores the scan of each point.
    references: of the data with these radii, for kernels that are called once a pose.
    coarse: coarse bounds of voxels that are not in memory; None if the scene has none.
    level: its level of detail; None if it has none.
    """

    residency: VoxelCache
    arrays: SceneArrays
    bounds: ProvedBounds
    broad: SceneIndex
    radius_units: int
    unknown: NDArray[np.int64]
    unknown_everywhere: bool
    keeps_scan: bool
    references: SceneReferences
    coarse: CoarseBounds | None = None
    level: LevelOfDetail | None = None

    @property
    def nothing_clear(self) -> bool:
        """Return whether no place is known to be clear.

        True if a scan with unknown bounds was left out, or a load proved the index wrong.
        """
        return self.unknown_everywhere or self.residency.misled


def kernel_poses(poses: ArrayLike) -> NDArray[np.float64]:
    """Return poses, (4, 4) or (k, 4, 4), in a writable array (k, 4, 4). Raise BadRequestError.

    numba would compile the kernels again for a read-only array.
    """
    array = make_poses(poses)
    return array if array.flags.writeable else array.copy()


def to_units(metres: float, what: str) -> int:
    """Convert a length to exact units, rounded once (NUMERICS.md N5).

    Raise BadRequestError if it is negative or beyond MAX_COORDINATE.
    """
    if not 0 <= metres <= MAX_COORDINATE:  # rejects NaN too; kernels take the result as int64
        raise BadRequestError(f"{what} {metres!r}: expected zero or a positive length in metres")
    return round(metres * UNITS_PER_METRE)  # half to even


def make_scene_data(
    archive: Archive,
    residency: VoxelCache,
    bounds: ProvedBounds | None = None,
    coarse: CoarseBounds | None = None,
) -> SceneData:
    """Make the data of an archive whose voxels `residency` holds, with the archive's single radius.

    bounds: proved bounds shared with other data of the archive; None: new ones. Each load from now
    on proves the bounds of its voxel.
    """
    bounds = ProvedBounds(archive) if bounds is None else bounds
    residency.on_proved = bounds.prove
    header = archive.header
    lattice = header.lattice
    arrays = SceneArrays(
        *residency.buffer.arena,
        residency.where,
        archive.coordinates,
        np.array(lattice.origin),
        lattice.step,
        lattice.units_per_step,
        lattice.voxel_steps,
        block_words(header.radius_class),
        np.zeros(1, np.int64),
        NO_STOP.flag,
    )
    return SceneData(
        residency, arrays, bounds, bounds.index, to_units(header.radius, "radius of the archive"), header.unknown,
        header.unknown_everywhere, header.scan_index, SceneReferences(), coarse,
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


def _empty_reach(k: int, rows: int) -> VoxelsInReach:
    """Return an empty `VoxelsInReach` for k poses with capacity for `rows` voxel rows."""
    return VoxelsInReach(
        np.empty(k), np.empty(k, np.int64), np.zeros(k + 1, np.int64), np.empty(rows, np.int64), np.empty((k, 2, 3)),
        np.zeros(k, bool),
    )  # fmt: skip


def refuse(fault: int, pose: int, found: float) -> None:
    """Raise the error for a fault reported by `find_reach`; do nothing if there is none."""
    if fault != pose_checks.VALID:
        error, text = _POSE_FAULTS[fault]
        raise error(f"pose {pose} {text.format(found)}")


def check_request(
    data: SceneData, avatar: AvatarModel, poses: NDArray[np.float64], other_units: int
) -> VoxelsInReach:
    """Check poses (k, 4, 4) and return the voxels in reach of each; none for an empty avatar.

    Raise BadRequestError, BadTransformError or TooLargeError naming the pose, TooLargeError for
    more than MAX_ROWS voxels in reach of all poses, and StoppedError.
    """
    needed = 16 * len(poses) + 64
    while True:
        reach = _empty_reach(len(poses), needed)
        fault, pose, found, needed = find_reach(
            poses, avatar.arrays, avatar.radius, other_units, data.arrays, data.broad, reach
        )
        refuse(fault, pose, found)
        if needed < 0:
            raise StoppedError
        if needed <= len(reach.rows):
            return reach
        if needed > MAX_ROWS:
            raise TooLargeError(
                f"{needed} voxels in reach of {len(poses)} poses: at most {MAX_ROWS} in a request: ask about fewer "
                "poses, or with a smaller margin or reach"
            )


def parts_that_fit(residency: VoxelCache, rows: Sequence[int], budget_bytes: int) -> Iterator[list[int]]:
    """Split rows, in order, into parts of at most `budget_bytes` or of one larger row."""
    part: list[int] = []
    taken = 0
    for row in rows:
        size = residency.bytes_of([row])
        if part and taken + size > budget_bytes:
            yield part
            part, taken = [], 0
        part.append(row)
        taken += size
    if part:
        yield part


def prove(data: SceneData, rows: Sequence[int], budget: QueryBudget, spent: CostCounter) -> None:
    """Load voxels of distinct rows in order, as many at a time as fit, within the budget's time.

    The voxels are not held afterwards. Add the cost to `spent`, without late voxels: the request
    finds those itself.
    """
    residency = data.residency
    for part in parts_that_fit(residency, rows, int(residency.buffer.total_bytes * budget.share)):
        if budget.stop or budget.late is not None:
            return
        with residency.hold(part, budget.loads_until(), scan=True, stop=budget.stop) as held:
            pass
        spent.add(held._replace(late=()))


def find_proved_reach(
    data: SceneData,
    avatar: AvatarModel,
    poses: NDArray[np.float64],
    other_units: int,
    budget: QueryBudget,
    spent: CostCounter,
    settled: Callable[[VoxelsInReach], VoxelsInReach] = lambda reach: reach,
) -> VoxelsInReach:
    """Return the reach of poses (k, 4, 4) with only voxels that are proved or unreadable.

    Otherwise the same as `check_request`, errors included.
    settled: function that removes pairs of pose and voxel that need not be examined from a reach.
    """
    bounds, stop = data.bounds, budget.stop
    unproved = bounds.unproved
    reach = settled(check_request(data, avatar, poses, other_units))
    if budget.late is not None:  # what is not proved is not in memory: it is bounded by its cell
        return reach
    doubted = bounds.rows_to_prove(reach, unproved, stop)
    if not doubted:
        return reach
    likely = _likely(data, reach, doubted, budget)
    prove(data, [*likely, *(row for row in doubted if not bounds.proved[row])], budget, spent)
    reach = settled(check_request(data, avatar, poses, other_units))
    left = distinct_rows(reach.rows[: reach.starts[-1]], len(bounds.proved), stop)
    loaded = [*doubted, *(row for row in likely if data.residency.is_resident(row))]
    spent.loaded += len(np.intersect1d(loaded, left))
    return reach


def _likely(data: SceneData, reach: VoxelsInReach, doubted: list[int], budget: QueryBudget) -> list[int]:
    """Return the rows to load before doubted ones: with a deadline, those in reach by the index.

    Proofs may take half of the time, and voxels that are likely to be touched matter more. If the
    likely voxels do not fit together, return none: they are loaded later, piece by piece.
    """
    if budget.deadline == np.inf:
        return []
    residency = data.residency
    rows = distinct_rows(reach.rows[: reach.starts[-1]], len(data.bounds.proved), budget.stop)
    if residency.bytes_of(rows.tolist()) > residency.buffer.total_bytes * budget.share:
        return []
    likely: list[int] = np.setdiff1d(rows, doubted, assume_unique=True).tolist()
    return [row for row in likely if not residency.is_resident(row)]


def pieces(
    reach: VoxelsInReach, residency: VoxelCache, share: float = 1.0, stop: StopFlag = NO_STOP
) -> Iterator[tuple[NDArray[np.int64], list[int], VoxelsInReach]]:
    """Split a request into pieces whose voxels fit in the budget: (pose numbers, rows, reach) each.

    share: of the budget, for each piece; a single larger voxel is allowed.
    stop: once it is set, the last piece has all remaining poses and no voxels.

    There is nearly always one piece. A pose whose voxels exceed the budget by themselves appears in
    several pieces, each with a run of its voxels (NUMERICS.md case 23).
    """
    k = len(reach.scales)
    rows = reach.rows[: reach.starts[k]]
    everything = (distinct_rows(rows, len(residency.where), stop) if k > 1 else rows).tolist()
    capacity = int(residency.buffer.total_bytes * share)
    if residency.bytes_of(everything) <= capacity:
        yield np.arange(k), everything, reach
        return
    which: list[int] = []
    held: dict[int, None] = {}
    held_bytes = 0
    for pose in range(k):
        if stop:
            yield np.concatenate([np.array(which, np.int64), np.arange(pose, k)]), [], reach
            return
        own = reach.rows[reach.starts[pose] : reach.starts[pose + 1]].tolist()
        fresh = [row for row in own if row not in held]
        if which and held_bytes + residency.bytes_of(fresh) > capacity:
            yield np.array(which), list(held), reach
            which, held, held_bytes, fresh = [], {}, 0, own
        if residency.bytes_of(own) <= capacity:
            which.append(pose)
            held.update(dict.fromkeys(fresh))
            held_bytes += residency.bytes_of(fresh)
            continue
        for part in parts_that_fit(residency, own, capacity):
            yield np.array([pose]), part, _only(reach, pose, part)
    if which:
        yield np.array(which), list(held), reach


def with_voxels(reach: VoxelsInReach, which: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return those of the poses `which` that have a voxel in reach."""
    return which[reach.starts[which + 1] > reach.starts[which]]


def distinct_rows(rows: NDArray[np.int64], voxels: int, stop: StopFlag) -> NDArray[np.int64]:
    """Return the distinct values of `rows`, ascending; perhaps not all after a stop."""
    if len(rows) <= _ROWS_AT_ONCE:
        return np.unique(rows)  # a sort in numpy lets other threads run
    met = np.zeros(voxels, bool)
    for begin in range(0, len(rows), _ROWS_AT_ONCE):
        if stop:
            break
        met[rows[begin : begin + _ROWS_AT_ONCE]] = True
    return np.flatnonzero(met)


def _only(reach: VoxelsInReach, pose: int, rows: list[int]) -> VoxelsInReach:
    """Return the reach with the voxels of one pose replaced by some of them."""
    starts = np.zeros_like(reach.starts)
    starts[pose + 1 :] = len(rows)
    return reach._replace(starts=starts, rows=np.array(rows, np.int64))


def as_held(data: SceneData, held: HeldVoxels, budget: QueryBudget) -> SceneData:
    """Return what a kernel may read during a hold: late voxels appear as not resident.

    They may become resident during the hold. The kernel ends at the deadline of `budget`, the broad
    phase does not: a request whose time is up still knows what is out of reach.
    """
    data = with_stop(data, budget.stop)
    if not held.late:
        return data
    where = data.arrays.where.copy()  # other threads write only rows that are late or not held
    where[list(held.late)] = -1
    return data._replace(arrays=data.arrays._replace(where=where))


def in_unknown(boxes: NDArray[np.float64], unknown: NDArray[np.int64], everywhere: bool) -> NDArray[np.bool_]:
    """Return which boxes (k, 2, 3) of reach meet a region (u, 2, 3) of a scan left out."""
    if everywhere:
        return np.ones(len(boxes), bool)
    met = np.zeros(len(boxes), bool)
    for low, high in unknown:
        met |= ((boxes[:, 0] <= high) & (boxes[:, 1] >= low)).all(axis=1)
    return met
