"""Level of detail of a scene: which of its poses need no voxel of the scene itself.

A level (schemas/archive/level.py) holds about a thirtieth of an archive's points. Where voxels of
the archive are not in memory, its representatives are asked first. All points lie within their
cover spheres, so a pose that is clear of these is clear. The representatives are points of the
archive, so a pair with one of them is a pair of the scene. Poses that this does not settle are
answered from the voxels themselves.
"""

import math

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.archive import Archive
from ...schemas.archive.level import cover_units, halvings_between
from ...schemas.archive.voxel_grid import voxel_keys
from ...schemas.errors import BadRequestError, TooLargeError
from ..kernels.core.reach import VoxelLists
from ..residency.voxel_cache import VoxelCache
from ..runtime.stop_flag import StoppedError
from .load_and_search import Search, drop_entries, load_and_search, run
from .query_inputs import (
    CostCounter,
    LevelOfDetail,
    PoseQuery,
    QueryBudget,
    SceneData,
    check_request,
    make_scene_data,
    with_stop,
)


def open_level_data(
    archive: Archive, residency: VoxelCache, described: Archive, *, settles_exact: bool
) -> LevelOfDetail:
    """Return a level whose voxels `residency` holds, for a scene of points without radius.

    described: the archive of the level.
    """
    halvings = halvings_between(archive.header.lattice, described.header.lattice)
    keys = voxel_keys(archive.coordinates >> halvings)
    parents = np.searchsorted(described.voxels["key"], keys)
    data, units = make_scene_data(archive, residency), cover_units()
    points = data._replace(radius_units=0)
    # Only classes that occur count.
    largest = int(units[archive.header.radius_counts > 0].max())
    arrays = data.arrays._replace(radius_deficit=np.maximum(largest - units, 0))
    covers = data._replace(arrays=arrays, radius_units=largest)
    return LevelOfDetail(covers, points, settles_exact, parents)


def with_level(data: SceneData, level: LevelOfDetail | None) -> SceneData:
    """Return the same scene with a level whose spheres are larger by those of the scene.

    level: by `open_level_data`.
    """
    if level is None:
        return data
    largest = data.radius_units
    smallest = largest - int(data.arrays.radius_deficit.max())
    covers = level.covers._replace(radius_units=level.covers.radius_units + largest)
    return data._replace(
        level=level._replace(covers=covers, points=level.points._replace(radius_units=smallest))
    )


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


def ask_level(query: PoseQuery, data: SceneData, which: NDArray[np.int64], beyond: int) -> PoseQuery | None:
    """Make the exact query of a level about some poses of a query, which the scene has accepted.

    data: covers or points of the level.  which: numbers of the poses.  beyond: the part of the reach
    that is not the radii, exact units.
    Return None if there are no poses, or the spheres of the level, larger than the scene's, reach too far.
    """
    if not len(which):
        return None
    poses = query.poses[which]
    try:
        around = check_request(data, query.avatar, poses, data.radius_units + beyond)
    except (BadRequestError, TooLargeError, StoppedError):
        return None
    return PoseQuery(data, query.avatar, poses, beyond, around, level_budget(query.budget), CostCounter(data))


def search_level(
    query: PoseQuery, asked: PoseQuery, lists: VoxelLists, search: Search
) -> NDArray[np.float64]:
    """Search voxels of the level, and return as `load_and_search`. asked: by `ask_level` for `query`."""
    left = run(load_and_search(asked.data, lists, search, asked.budget, asked.spent))
    query.spent.add_level(asked.spent)
    return left


def below(level: LevelOfDetail, lists: VoxelLists, rows: NDArray[np.int64]) -> VoxelLists:
    """Return the entries of lists of a level whose voxels divide one of the scene's voxels `rows`."""
    wanted: NDArray[np.bool_] = np.zeros(int(level.parents.max(initial=0)) + 1, bool)
    wanted[rows[rows < len(wanted)]] = True
    return drop_entries(lists, ~wanted[level.parents[lists.rows[: lists.starts[-1]]]])


def level_budget(budget: QueryBudget) -> QueryBudget:
    """Return the budget of an exact query of the level for a request with `budget`."""
    return budget._replace(tolerance=0.0, relative=0.0)
