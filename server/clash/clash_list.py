"""Clashes: poses in contact that follow one another, and the clusters of their contacts.

The poses are the places of a checked path's track, by their index: its poses, and further ones on
motions that are in contact between two poses.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.wire.answers import ContactsAnswers, Verdict

Floats = NDArray[np.float64]

# Clusters of consecutive poses whose boxes are at most this far apart are one [m]: a body that slides
# along an edge touches other points of it at each pose.
CLUSTER_GAP = 0.1


class Cluster(NamedTuple):
    """Contacts of one clash that belong together, over its poses.

    first, last: poses at which they occur.  deepest: pose of the greatest depth.
    depth: how far two spheres overlap there [m], at least 0.
    place: (3,), scan point of that pair, world [m].  normal: (3,), unit vector from it to the
    avatar's point; zero if they coincide.
    contacts: most pairs in contact at one pose.
    low, high: (3,), bounding box of the scan points, world [m].
    """

    first: int
    last: int
    deepest: int
    depth: float
    place: Floats
    normal: Floats
    contacts: int
    low: Floats
    high: Floats


class Clash(NamedTuple):
    """Consecutive poses in contact.

    first, last: its poses.  contacts: most pairs in contact at one pose.
    clusters: deepest first; the clash has the depth and the place of the first.
    """

    first: int
    last: int
    contacts: int
    clusters: tuple[Cluster, ...]

    @property
    def depth(self) -> float:
        """Return the greatest depth [m]."""
        return self.clusters[0].depth

    @property
    def place(self) -> Floats:
        """Return the scan point of the deepest pair, world [m]."""
        return self.clusters[0].place

    @property
    def normal(self) -> Floats:
        """Return the contact normal of the deepest pair."""
        return self.clusters[0].normal

    @property
    def deepest(self) -> int:
        """Return the pose of the greatest depth."""
        return self.clusters[0].deepest


def runs(chosen: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first and last index of each run of true items."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(np.int8)))
    return [(int(begin), int(end) - 1) for begin, end in edges.reshape(-1, 2)]


def list_clashes(poses: NDArray[np.int64], answers: ContactsAnswers) -> list[Clash]:
    """Return the clashes of a path, deepest first, those of equal depth in order of their poses.

    poses: (m,), ascending, number of the pose of each answer; poses without an answer are not in
    contact.
    """
    touching = np.asarray(answers.verdict) == Verdict.CONTACT
    starts = answers.cluster_starts
    # Poses that are not neighbours are not in one run.
    chosen = np.zeros(int(poses[-1]) + 1 if len(poses) else 0, bool)
    chosen[poses[touching]] = True
    row = np.full(len(chosen), -1)
    row[poses] = np.arange(len(poses))
    found = []
    for first, last in runs(chosen):
        own = row[first : last + 1]
        rows = np.arange(starts[own[0]], starts[own[-1] + 1])
        of_pose = np.repeat(np.arange(first, last + 1), np.diff(starts)[own])
        groups = _linked(of_pose, answers.cluster_low[rows], answers.cluster_high[rows])
        clusters = [_cluster(of_pose[group], rows[group], answers) for group in groups]
        clusters.sort(key=lambda each: (-each.depth, each.first, each.place.tolist()))
        most = int(answers.pairs_found[own].max())
        found.append(Clash(first, last, most, tuple(clusters)))
    return sorted(found, key=lambda each: (-each.depth, each.first))


def _linked(pose: NDArray[np.int64], low: Floats, high: Floats) -> list[NDArray[np.int64]]:
    """Return groups of clusters that are linked from pose to pose, as rows.

    pose: (c,), ascending, of each cluster.  low, high: (c, 3), their boxes.
    """
    parent = list(range(len(pose)))

    def root(item: int) -> int:
        while parent[item] != item:
            parent[item] = item = parent[parent[item]]
        return item

    begins = np.searchsorted(pose, np.arange(pose[0], pose[-1] + 3)) if len(pose) else np.zeros(0, int)
    for before, middle, after in zip(begins, begins[1:], begins[2:], strict=False):
        apart = np.maximum(
            low[middle:after, None] - high[None, before:middle],
            low[None, before:middle] - high[middle:after, None],
        )
        near = (np.maximum(apart, 0.0) ** 2).sum(axis=-1) <= CLUSTER_GAP**2
        for one, other in np.argwhere(near).tolist():
            parent[root(int(middle) + one)] = root(int(before) + other)
    groups: dict[int, list[int]] = {}
    for item in range(len(pose)):
        groups.setdefault(root(item), []).append(item)
    return [np.array(group) for group in groups.values()]


def _cluster(pose: NDArray[np.int64], rows: NDArray[np.int64], answers: ContactsAnswers) -> Cluster:
    """Return clusters of consecutive poses as one. rows: among the clusters of the answers."""
    deepest = int(np.argmin(answers.cluster_deepest[rows]))
    pair = rows[deepest]
    cloud = answers.cluster_cloud[pair]
    way = answers.cluster_avatar[pair] - cloud
    length = float(np.linalg.norm(way))
    counts = np.bincount(pose - pose[0], answers.cluster_count[rows])
    return Cluster(
        int(pose[0]),
        int(pose[-1]),
        int(pose[deepest]),
        max(0.0, -float(answers.cluster_deepest[pair])),
        cloud.copy(),
        way / length if length else np.zeros(3),
        int(counts.max()),
        answers.cluster_low[rows].min(axis=0),
        answers.cluster_high[rows].max(axis=0),
    )
