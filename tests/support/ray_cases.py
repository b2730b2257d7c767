"""Scenes, rays of every kind, and expected answers, for tests of `raycast` and `within`."""

from collections.abc import Iterator
from contextlib import contextmanager

import archive_cases
import naive_rays
import numpy as np
from numpy.typing import ArrayLike, NDArray
from solidcloud.schemas.wire.answers import RaycastAnswers, WithinAnswers
from solidcloud.server.queries.query_inputs import SceneData, make_scene_data, with_radius_model
from solidcloud.server.residency.voxel_cache import VoxelCache
from solidcloud.server.residency.voxel_store import VoxelStore

KINDS = ("cluster", "plane", "line", "grid", "duplicates", "noise", "one point")


@contextmanager
def opened(case: archive_cases.Case, budget: int = 64 << 20, model: str | None = None) -> Iterator[SceneData]:
    """Return the arguments that the queries take from an archive, with a radius model."""
    store = VoxelStore(case.archive)
    try:
        yield with_radius_model(
            make_scene_data(store.archive, VoxelCache(store, budget)), store.archive, model
        )
    finally:
        store.close()


def some_rays(
    rng: np.random.Generator, points: NDArray[np.float64], extent: float, radii: ArrayLike, count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rays: free, along an axis, from point to point, grazing, from inside, from far away.

    radii: of all spheres or of each of the points (n, 3) [m].
    """
    radii = np.broadcast_to(np.asarray(radii, np.float64), len(points))
    origins, directions = [], []
    for number in range(count):
        which = rng.integers(len(points))
        at, radius = points[which], radii[which]
        free = rng.normal(size=3)
        free /= np.linalg.norm(free)
        origin = at + rng.normal(size=3) * extent
        kind = number % 7
        if kind == 0:
            direction = free
        elif kind == 1:  # along an axis, through a point
            direction = np.zeros(3)
            direction[rng.integers(3)] = rng.choice([-1.0, 1.0])
            origin = at - direction * rng.uniform(0, 3) * extent
        elif kind == 2:  # from one point to another, along scan lines
            direction = points[rng.integers(len(points))] - at
            origin = at - direction * rng.integers(0, 2)
        elif kind == 3:  # tangent, as closely as float64 allows
            across = np.cross(at - origin, free)
            across /= max(np.linalg.norm(across), 1e-300)
            direction = at + across * radius - origin
        elif kind == 4:  # from inside a sphere, or from its centre
            origin, direction = at + free * radius * rng.choice([0.0, 0.5, 1.0]), rng.normal(size=3)
        elif kind == 5:  # from far away
            origin = at - free * extent * 10.0 ** rng.uniform(0, 4)
            direction = at - origin
        else:
            direction = (at - origin) * 10.0 ** rng.uniform(-300, 300)
        if not np.abs(direction).max() > 0:
            direction = free
        origins.append(origin)
        directions.append(direction)
    return np.clip(origins, -1e9, 1e9), np.array(directions)


def same_rays(answers: RaycastAnswers, expected: naive_rays.Hits, lattice: NDArray[np.float64]) -> None:
    """Assert that the answers equal the expected ones, bit for bit.

    lattice: (n, 3) scan points, world, as stored.
    """
    hit = expected.row >= 0
    assert answers.distance.tolist() == expected.distance.tolist()
    assert answers.upper.tolist() == expected.distance.tolist()
    assert answers.verdict.tolist() == hit.astype(int).tolist()
    assert answers.exact.all()
    assert answers.outside.tolist() == expected.outside.tolist()
    np.testing.assert_array_equal(answers.cloud_point[hit], lattice[expected.row[hit]])
    assert np.isnan(answers.cloud_point[~hit]).all() and np.isnan(answers.normal[~hit]).all()


def same_points(answers: WithinAnswers, expected: naive_rays.Hits, lattice: NDArray[np.float64]) -> None:
    """Assert that the answers equal the expected ones, bit for bit."""
    near = expected.row >= 0
    assert answers.distance.tolist() == expected.distance.tolist()
    assert answers.verdict.tolist() == near.astype(int).tolist()
    assert answers.exact.all()
    assert answers.outside.tolist() == expected.outside.tolist()
    np.testing.assert_array_equal(answers.cloud_point[near], lattice[expected.row[near]])
