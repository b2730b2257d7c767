"""Level of detail of a scene: which of its poses need no voxel of the scene itself.

A level (schemas/archive/level.py) holds about a thirtieth of an archive's points. Where voxels of
the archive are not in memory, its representatives are asked first. All points lie within their
cover spheres, so a pose that is clear of these is clear. The representatives are points of the
archive, so a pair with one of them is a pair of the scene. Poses that this does not settle are
answered from the voxels themselves.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ...schemas.archive.level import cover_units, halvings_between
from ...schemas.archive.voxel_grid import voxel_keys
from ...schemas.errors import BadRequestError, TooLargeError
from ..avatars.avatar_model import AvatarModel
from ..kernels.core.reach import VoxelLists
from ..kernels.core.voxels_in_reach import VoxelsInReach
from ..residency.voxel_cache import VoxelCache
from ..runtime.stop_flag import StoppedError
from .request import QueryBudget, check_request
from .resolve import drop_entries
from .scene_data import LevelOfDetail, SceneData, make_scene_data, with_stop


class LevelData(NamedTuple):
    """Opened level, before a radius model is chosen.

    data: of its archive.  occurs: (32,) bool, cover classes that a representative has.
    settles_exact, parents: see `LevelOfDetail`.
    """

    data: SceneData
    occurs: NDArray[np.bool_]
    settles_exact: bool
    parents: NDArray[np.int64]


def open_level_data(
    archive: Archive, residency: VoxelCache, described: Archive, *, settles_exact: bool
) -> LevelData:
    """Return the data of a level whose voxels `residency` holds. described: the archive of the level."""
    halvings = halvings_between(archive.header.lattice, described.header.lattice)
    keys = voxel_keys(archive.coordinates >> halvings)
    parents = np.searchsorted(described.voxels["key"], keys)
    occurs = archive.header.radius_counts > 0
    return LevelData(make_scene_data(archive, residency), occurs, settles_exact, parents)


def with_level(data: SceneData, level: LevelData | None) -> SceneData:
    """Return the same scene with a level whose spheres are made for the scene's radii."""
    if level is None:
        return data
    largest = data.radius_units
    smallest = largest - int(data.arrays.radius_deficit.max())
    radii = largest + cover_units()
    top = int(radii[level.occurs].max())
    own = level.data.arrays
    covers = level.data._replace(
        arrays=own._replace(radius_deficit=np.maximum(top - radii, 0)), radius_units=top
    )
    points = level.data._replace(
        arrays=own._replace(radius_deficit=np.zeros(1, np.int64)), radius_units=smallest
    )
    return data._replace(level=LevelOfDetail(covers, points, level.settles_exact, level.parents))


def find_level(data: SceneData, budget: QueryBudget) -> LevelOfDetail | None:
    """Return the scene's level if a request with this budget asks it about absent voxels.

    An exact request that may wait asks it only if the level says so: its voxels would be read in
    addition to nearly all of the scene's.
    """
    level = None if data.nothing_clear else data.level
    if level is None:
        return None
    hurried = budget.deadline < math.inf or budget.late is not None
    if not (hurried or budget.tolerance > 0 or budget.relative > 0 or level.settles_exact):
        return None
    covers, points = (with_stop(each, budget.stop) for each in (level.covers, level.points))
    return level._replace(covers=covers, points=points)


def level_reach(
    data: SceneData, avatar: AvatarModel, poses: NDArray[np.float64], beyond: int
) -> VoxelsInReach | None:
    """Return the voxels of a level in reach of poses (k, 4, 4); None if its spheres reach too far.

    The scene has accepted the poses, but cover spheres are larger than its own.
    data: covers or points of a level.  beyond: the part of the reach that is not the radii, exact
    units.
    """
    try:
        return check_request(data, avatar, poses, data.radius_units + beyond)
    except (BadRequestError, TooLargeError, StoppedError):
        return None


def below(level: LevelOfDetail, lists: VoxelLists, rows: NDArray[np.int64]) -> VoxelLists:
    """Return the entries of lists of a level whose voxels divide one of the scene's voxels `rows`."""
    wanted: NDArray[np.bool_] = np.zeros(int(level.parents.max(initial=0)) + 1, bool)
    wanted[rows[rows < len(wanted)]] = True
    return drop_entries(lists, ~wanted[level.parents[lists.rows[: lists.starts[-1]]]])


def level_budget(budget: QueryBudget) -> QueryBudget:
    """Return the budget of an exact query of the level for a request with `budget`."""
    return budget._replace(tolerance=0.0, relative=0.0)
