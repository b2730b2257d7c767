"""Prepare what every query reads: the data of a scene, checked poses, and the voxels in reach."""

from collections.abc import Iterator, Sequence
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
from ...kernels.core.reach import VoxelTree, make_voxel_tree
from ...kernels.core.scene_arrays import SceneArrays, block_words
from ...kernels.core.voxels_in_reach import VoxelsInReach, find_reach, make_reach
from ...residency.voxel_cache import VoxelCache
from ...runtime.stop_flag import NO_STOP, StopFlag, StoppedError

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

    arrays: arrays that the kernels read.  tree: boxes around the points of each voxel, as the index
    states them.  keys: (v,) uint64, of the voxels, sorted.
    radius_units: of the largest sphere of a scan point, exact units.
    unknown: (u, 2, 3) int64, lattice boxes of scans that the build left out.
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
    unknown: NDArray[np.int64]
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
        to_units(header.radius, "radius of the archive"), header.unknown, header.unknown_everywhere,
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


def in_unknown(boxes: NDArray[np.float64], unknown: NDArray[np.int64], everywhere: bool) -> NDArray[np.bool_]:
    """Return which boxes (k, 2, 3) of reach meet a region (u, 2, 3) of a scan left out."""
    if everywhere:
        return np.ones(len(boxes), bool)
    met = np.zeros(len(boxes), bool)
    for low, high in unknown:
        met |= ((boxes[:, 0] <= high) & (boxes[:, 1] >= low)).all(axis=1)
    return met
