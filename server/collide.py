"""`collide`: does an avatar touch the scene, one verdict a pose? One request -> one result."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..schemas.answers import CollideAnswers, Verdict
from ..schemas.errors import BadRequestError, BadTransformError, TooLargeError
from ..schemas.messages import make_poses
from ..schemas.voxel_grid import UNITS_PER_METRE
from .avatar import AvatarModel
from .kernels import placing
from .kernels.overlap import SceneArrays, overlap_poses
from .kernels.reach import voxels_in_reach
from .residency import Residency
from .store import Store

# Reach is compared in exact units whose squares must fit 63 bits (NUMERICS.md N5).
MAX_REACH_UNITS = 1 << 30
# Coordinates near a pose must be exact in float32, with a bit to spare (server/kernels/overlap.py).
MAX_FRAME_STEPS = 1 << 23

_POSE_FAULTS = {
    placing.BAD_LAST_ROW: "has a last row that is not 0 0 0 1: give row-major 4x4 poses",
    placing.MIRRORED: "mirrors (determinant {:g}): expected a rotation, with a uniform scale at most",
    placing.SHEARED: "shears, or scales its axes differently (by {:g}, relative): expected a rotation, "
    "with a uniform scale at most, within 1e-9: renormalise it",
    placing.BAD_SCALE: "scales by {:g}: expected 0.001 to 1000",
    placing.TOO_FAR: "translates by {:g} m: expected within 1e9 m",
}


class SceneData(NamedTuple):
    """What every question about one scene reads.

    store, residency: its voxels.  keys: (v,) uint64.  coordinates, low, high: (v, 3) int64: voxel coordinates, least
    and greatest lattice coordinates of a voxel's points.  radius_units: of every scan point, exact units.
    """

    store: Store
    residency: Residency
    keys: NDArray[np.uint64]
    coordinates: NDArray[np.int64]
    low: NDArray[np.int64]
    high: NDArray[np.int64]
    radius_units: int


class Reach(NamedTuple):
    """Poses checked, and the voxels each could touch; see `voxels_in_reach`.

    poses: (k, 4, 4).  scales: (k,).  units: (k,) int64.  starts: (k + 1,), rows: the voxels of each pose.
    boxes: (k, 2, 3) float64 [steps].  outside: (k,) bool.
    """

    poses: NDArray[np.float64]
    scales: NDArray[np.float64]
    units: NDArray[np.int64]
    starts: NDArray[np.int64]
    rows: NDArray[np.int64]
    boxes: NDArray[np.float64]
    outside: NDArray[np.bool_]


def to_units(metres: float, what: str) -> int:
    """A length in exact units, rounded once (NUMERICS.md N5). Raises BadRequestError for a negative or endless one."""
    if not (np.isfinite(metres) and metres >= 0):
        raise BadRequestError(f"{what} {metres!r}: expected zero or a positive length in metres")
    return int(np.rint(metres * UNITS_PER_METRE))


def check_poses(poses: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses (k, 4, 4) float64 and their scales (k,). Raises BadRequestError or BadTransformError naming the pose."""
    array = make_poses(poses)
    if not array.flags.writeable:
        array = array.copy()  # numba compiles a read-only array anew
    scales = np.empty(len(array))
    fault, pose, found = placing.check_poses(array, scales)
    if fault == placing.NOT_FINITE:
        raise BadRequestError(f"pose {pose} holds {found}: expected finite numbers")
    if fault != placing.GOOD:
        raise BadTransformError(f"pose {pose} {_POSE_FAULTS[fault].format(found)}")
    return array, scales


def find_reach(data: SceneData, avatar: AvatarModel, poses: ArrayLike, margin: float) -> Reach:
    """Check a request and find the voxels in reach of each pose. `avatar` is not empty."""
    array, scales = check_poses(poses)
    margin_units = to_units(margin, "margin")
    units = np.rint(scales * avatar.radius * UNITS_PER_METRE) + (data.radius_units + margin_units)
    lattice = data.store.archive.header.lattice
    if len(units) and units.max() > MAX_REACH_UNITS:
        raise BadRequestError(
            f"radii and margin add up to {units.max() / UNITS_PER_METRE:g} m: expected at most "
            f"{MAX_REACH_UNITS / UNITS_PER_METRE:g} m: give a smaller margin or radius"
        )
    root = float(avatar.arrays.radius[0])
    extent = (root * scales.max(initial=0.0) + units.max(initial=0) / UNITS_PER_METRE) / lattice.step
    if extent + lattice.voxel_steps > MAX_FRAME_STEPS:
        raise TooLargeError(
            f"the avatar with its reach extends {extent * lattice.step:g} m: this scene takes at most "
            f"{(MAX_FRAME_STEPS - lattice.voxel_steps) * lattice.step:g} m: split it"
        )
    k = len(array)
    starts, boxes, outside = np.empty(k + 1, np.int64), np.empty((k, 2, 3)), np.empty(k, bool)
    rows = np.empty(16 * k + 64, np.int64)
    header = data.store.archive.header
    reach_units = units.astype(np.int64)
    while True:
        needed = voxels_in_reach(
            array, scales, reach_units, avatar.arrays.center[0], root, np.array(lattice.origin), lattice.step,
            lattice.units_per_step, lattice.voxel_steps, data.keys, data.coordinates, data.low, data.high,
            header.low, header.high, starts, rows, boxes, outside,
        )  # fmt: skip
        if needed <= len(rows):
            return Reach(array, scales, reach_units, starts, rows[:needed], boxes, outside)
        rows = np.empty(needed, np.int64)


def _pieces(reach: Reach, residency: Residency) -> Iterator[tuple[NDArray[np.int64], list[int], Reach]]:
    """Cut a request into pieces whose voxels fit the budget: (pose numbers, voxel rows, reach) each.

    Nearly always one piece. A pose that alone reaches more than the budget is looked at voxel by voxel run
    (NUMERICS.md case 23), and so appears in several pieces.
    """
    everything = np.unique(reach.rows)
    budget = residency.buffer.total_bytes
    if residency.bytes_of(everything.tolist()) <= budget:
        yield np.arange(len(reach.poses)), everything.tolist(), reach
        return
    which: list[int] = []
    held: dict[int, None] = {}
    for pose in range(len(reach.poses)):
        own = reach.rows[reach.starts[pose] : reach.starts[pose + 1]].tolist()
        fresh = [row for row in own if row not in held]
        if which and residency.bytes_of(list(held)) + residency.bytes_of(fresh) > budget:
            yield np.array(which), list(held), reach
            which, held = [], {}
        if residency.bytes_of(own) <= budget:
            which.append(pose)
            held.update(dict.fromkeys(own))
            continue
        part: list[int] = []
        for row in [*own, -1]:
            if row < 0 or residency.bytes_of([*part, row]) > budget:
                yield np.array([pose]), part, _only(reach, pose, part)
                part = []
            part.append(row)
    if which:
        yield np.array(which), list(held), reach


def _only(reach: Reach, pose: int, rows: list[int]) -> Reach:
    """The same request with the voxels of one pose replaced by some of them."""
    starts = np.zeros_like(reach.starts)
    starts[pose + 1 :] = len(rows)
    return reach._replace(starts=starts, rows=np.array(rows, np.int64))


def collide(data: SceneData, avatar: AvatarModel, poses: ArrayLike, margin: float = 0.0) -> CollideAnswers:
    """Whether the avatar touches the scene under each pose.

    poses: (k, 4, 4) float64, avatar to world, rigid or with a uniform scale, bits used as given.
    margin: distance below or at which two spheres are called in contact [m].
    CONTACT, CLEAR or UNKNOWN (a voxel in reach cannot be read, or a scan was left out there, and no contact was
    found elsewhere); the definition is NUMERICS.md N5. Raises BadRequestError, BadTransformError, TooLargeError.
    """
    residency, header = data.residency, data.store.archive.header
    if not len(avatar.points):
        k = len(check_poses(poses)[0])
        to_units(margin, "margin")
        zeros = np.zeros(k, np.uint32)
        return CollideAnswers(np.zeros(k, np.uint8), np.zeros(k, bool), zeros, zeros.copy(), zeros.copy())
    reach = find_reach(data, avatar, poses, margin)
    k = len(reach.poses)
    total = np.zeros((4, k), np.uint32)  # verdict, missing, visits, tests
    hits = misses = 0
    faults: dict[str, None] = {}
    lattice = header.lattice
    scene = SceneArrays(
        *residency.buffer.arena, residency.where, data.coordinates, np.array(lattice.origin), lattice.step,
        lattice.units_per_step, lattice.voxel_steps,
    )  # fmt: skip
    for which, rows, part in _pieces(reach, residency):
        verdict, found = np.zeros(k, np.uint8), np.zeros((3, k), np.uint32)
        with residency.hold(rows) as held:
            overlap_poses(
                part.poses,
                part.scales,
                part.units,
                avatar.arrays,
                scene,
                which,
                part.starts,
                part.rows,
                verdict,
                *found,
            )
        total[0, which] |= verdict[which]
        total[1:, which] += found[:, which]
        hits, misses = hits + held.hits, misses + held.misses
        faults.update(dict.fromkeys(held.faults))
    unseen = (total[1] > 0) | _in_unknown(reach.boxes, header.unknown, header.unknown_everywhere)
    verdict = np.where(
        total[0] == Verdict.CONTACT, Verdict.CONTACT, np.where(unseen, Verdict.UNKNOWN, Verdict.CLEAR)
    )
    return CollideAnswers(
        verdict.astype(np.uint8), reach.outside, total[1], total[2], total[3],
        hits=hits, misses=misses, resident=residency.resident, resident_bytes=residency.resident_bytes,
        faults=tuple(faults),
    )  # fmt: skip


def _in_unknown(
    boxes: NDArray[np.float64], unknown: NDArray[np.int64], everywhere: bool
) -> NDArray[np.bool_]:
    """Which boxes (k, 2, 3) of reach meet a region (u, 2, 3) whose scan was left out."""
    if everywhere:
        return np.ones(len(boxes), bool)
    met = np.zeros(len(boxes), bool)
    for low, high in unknown:
        met |= ((boxes[:, 0] <= high) & (boxes[:, 1] >= low)).all(axis=1)
    return met
