"""Data of a scene that every query reads: its arrays, the tree of its voxels, its radii and its level."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ...schemas.archive.radius_model import class_radii
from ...schemas.archive.units import UNITS_PER_METRE
from ...schemas.archive.voxel_grid import MAX_COORDINATE
from ...schemas.errors import BadRequestError
from ..kernels.core.array_references import SceneReferences
from ..kernels.core.reach import VoxelTree, make_voxel_tree
from ..kernels.core.scene_arrays import SceneArrays, block_words
from ..residency.voxel_cache import VoxelCache
from ..runtime.stop_flag import NO_STOP, StopFlag


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
