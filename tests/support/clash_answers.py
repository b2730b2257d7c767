"""Answers of `contacts` with invented clusters, for tests of what is made of them."""

from typing import NamedTuple

import numpy as np
from solidcloud.schemas.wire.answers import ContactsAnswers, Verdict


class Found(NamedTuple):
    """An invented cluster. way: from the scan point to the avatar's point [m]."""

    depth: float
    place: np.ndarray
    way: np.ndarray
    pairs: int
    low: np.ndarray
    high: np.ndarray


def invented(rng: np.random.Generator, most: int = 3, room: float = 1.0) -> list[Found]:
    """Return the clusters of one pose, deepest first, in a cube with edges of `room`."""
    found = []
    for _ in range(int(rng.integers(1, most + 1))):
        low = rng.uniform(0, room, 3)
        high = low + rng.uniform(0, 0.2, 3)
        place = rng.uniform(low, high)
        found.append(
            Found(float(rng.uniform(0, 0.1)), place, rng.normal(size=3), int(rng.integers(1, 40)), low, high)
        )
    return sorted(found, key=lambda each: -each.depth)


def answers_of(poses: list[list[Found] | None]) -> ContactsAnswers:
    """Return the answers for poses with these clusters, None for poses that are clear."""
    every = [each for pose in poses for each in pose or []]
    counts = [len(pose or []) for pose in poses]
    k, none = len(poses), np.zeros(len(poses), np.uint32)
    clouds = np.array([each.place for each in every]).reshape(-1, 3)
    return ContactsAnswers(
        verdict=np.array([Verdict.CONTACT if pose else Verdict.CLEAR for pose in poses], np.uint8),
        exact=np.ones(k, bool),
        pairs_found=np.array([sum(each.pairs for each in pose or []) for pose in poses], np.int64),
        pair_starts=np.zeros(k + 1, np.int64),
        avatar_point=np.empty((0, 3)),
        cloud_point=np.empty((0, 3)),
        signed_distance=np.empty(0),
        avatar_index=np.empty(0, np.int32),
        scan_index=np.empty(0, np.int32),
        cluster=np.empty(0, np.int32),
        cluster_starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        cluster_count=np.array([each.pairs for each in every], np.int64),
        cluster_deepest=np.array([-each.depth for each in every], np.float64),
        cluster_avatar=clouds + np.array([each.way for each in every]).reshape(-1, 3),
        cluster_cloud=clouds,
        cluster_scan=np.zeros(len(every), np.int32),
        cluster_low=np.array([each.low for each in every]).reshape(-1, 3),
        cluster_high=np.array([each.high for each in every]).reshape(-1, 3),
        outside=np.zeros(k, bool),
        voxels_missing=none,
        node_visits=none,
        point_tests=none,
    )
