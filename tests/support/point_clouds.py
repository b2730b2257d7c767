"""Point clouds that give trees of all shapes, and options that shape trees, for property tests."""

from itertools import permutations, product

import archive_cases
import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

KINDS = ("cluster", "plane", "line", "sphere", "corners", "duplicates", "noise", "one point")
TREES = st.fixed_dictionaries(
    {
        "degree": st.sampled_from([2, 3, 8, 16]),
        "leaf": st.sampled_from([1, 2, 31, 32]),
        "cell_points": st.sampled_from([1, 20, 4096]),
        "with_slab": st.booleans(),
    }
)
# Parameters of tests against naive answers: points of a scan; the step of its lattice [m]; the edge
# of a voxel [steps]; the distance of the scan from the origin [m]; the distance of an avatar from
# its own origin [m].
COUNTS = st.sampled_from([1, 2, 33, 300])
STEPS = st.sampled_from([1e-6, archive_cases.BINARY_STEP, 1e-4, 1e-2, 0.3])
VOXEL_STEPS = st.sampled_from([1, 7, 1000, 70_000, 1 << 21])
FAR = st.sampled_from([0.0, 5e5, 6.4e6, 1e8])
OFF = st.sampled_from([0.0, 0.0, 1e3, 1e5])


def cloud(rng: np.random.Generator, kind: str, count: int) -> NDArray[np.float64]:
    """Return points (n, 3) in [-1, 1]^3."""
    if kind == "one point":
        count = 1
    points = rng.uniform(-1, 1, (count, 3))
    if kind == "cluster":
        centers = rng.uniform(-1, 1, (max(1, count // 40), 3))
        points = centers[rng.integers(len(centers), size=count)] + points * 10.0 ** rng.uniform(-6, -1)
    elif kind == "plane":
        points = points * [1, 1, 1e-5] @ archive_cases.random_rotation(rng)
    elif kind == "line":
        points = points[:, :1] * rng.uniform(-1, 1, 3)
    elif kind == "sphere":
        points /= np.linalg.norm(points, axis=1)[:, None]
    elif kind == "corners":
        points = np.sign(points)
    elif kind == "grid":
        points = np.rint(points * 3) / 3
    elif kind == "duplicates":
        points = points[rng.integers(0, max(1, count // 10), count)]
    return points


def signed_permutations() -> list[NDArray[np.float64]]:
    """Return the 24 rotations that map the axes onto themselves."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.zeros((3, 3))
        turn[range(3), order] = signs
        if np.linalg.det(turn) > 0:
            found.append(turn)
    return found
