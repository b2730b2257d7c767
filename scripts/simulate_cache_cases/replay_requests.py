"""Requests of a replay: the town's voxels, and those that each request of a trace needs."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from solidcloud.schemas.archive.archive import Archive
from solidcloud.server.kernels.core.reach import VoxelTree
from solidcloud.server.queries.query_inputs import make_tree
from solidcloud.server.report.load.users.user_traces import Centers
from solidcloud.server.residency.prefetch import PREFETCH_OPTIONS, PrefetchOptions, UserTracks

# User id of sweeps, which belong to no user and have no position; duration of one sweep through all
# voxels [s].
NOBODY, SWEEP_SECONDS = -1, 10.0
# Requests whose voxels one call lists.
AT_ONCE = 1000


class Town(NamedTuple):
    """Data of an archive that a simulation needs.

    tree: boxes around the points of its voxels.
    origin (3,), step: of the lattice [m].
    sizes: (v,) int64, bytes of each decoded voxel.
    radius: of its largest sphere [m].
    """

    tree: VoxelTree
    origin: NDArray[np.float64]
    step: float
    sizes: NDArray[np.int64]
    radius: float

    def user_tracks(self, ahead: PrefetchOptions = PREFETCH_OPTIONS) -> UserTracks:
        """Return a new motion prediction, without any user."""
        return UserTracks(self.tree, self.origin, self.step, ahead)


def town_of(archive: Archive, sizes: NDArray[np.int64]) -> Town:
    """Return the data of an archive whose decoded voxels take `sizes` (v,) bytes."""
    lattice = archive.header.lattice
    return Town(make_tree(archive), np.array(lattice.origin), lattice.step, sizes, archive.header.radius)


class Requests(NamedTuple):
    """n requests and the voxels each needs.

    asked: user, time and position of each.
    rows: (n,) lists.
    flat: all of them, in order.
    request: the number of the request of each of `flat`.
    first: (n,) bool, in the user's first second.
    """

    asked: Centers
    rows: list[list[int]]
    flat: NDArray[np.int64]
    request: NDArray[np.int64]
    first: NDArray[np.bool_]


def requests_of(town: Town, asked: Centers) -> Requests:
    """Return the voxels that each request of a trace needs."""
    tracks, every, of = town.user_tracks(), [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for begin in range(0, len(asked.center), AT_ONCE):
        some = slice(begin, begin + AT_ONCE)
        ball, found = tracks.rows_in_reach(asked.center[some], asked.reach[some])
        every.append(found)
        of.append(begin + ball)
    flat, request = np.concatenate(every), np.concatenate(of)
    bounds = np.searchsorted(request, np.arange(len(asked.center) + 1)).tolist()
    rows = [flat[a:b].tolist() for a, b in pairwise(bounds)]
    users, who = np.unique(asked.user, return_inverse=True)
    began = np.full(len(users), np.inf)
    np.minimum.at(began, who, asked.time)
    return Requests(asked, rows, flat, request, asked.time < began[who] + 1.0)


def with_sweeps(town: Town, asked: Centers, sweeps: int) -> Centers:
    """Add sweeps through all voxels to a trace, evenly over its time.

    Sweeps are scans in row order, by the user NOBODY.
    """
    voxels, seconds = len(town.sizes), float(asked.time[-1] - asked.time[0])
    middle = (town.tree.low[:voxels] + town.tree.high[:voxels]) / 2 * town.step + town.origin
    begin = asked.time[0] + seconds * (np.arange(sweeps) + 1) / (sweeps + 1)
    time = (begin[:, None] + np.arange(voxels) * SWEEP_SECONDS / voxels).ravel()
    swept = Centers(
        np.full(len(time), NOBODY), time, np.tile(middle, (sweeps, 1)), np.zeros(len(time)),
        np.ones(len(time), bool),
    )  # fmt: skip
    both = [np.concatenate(columns) for columns in zip(asked, swept, strict=True)]
    order = np.argsort(both[1], kind="stable")
    return Centers(*(column[order] for column in both))
