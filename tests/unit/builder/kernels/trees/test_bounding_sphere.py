"""Prove in Python integers that bounds enclose. tests/hard_cases/test_bounds.py measures their size."""

import itertools

import numpy as np
import pytest
from point_hierarchy import Bounds, build_hierarchy
from solidcloud.builder.kernels.trees.bounding_sphere import ceil_sqrt, least_variance
from synthetic_scans import WITH_POINTS, make_steps


def assert_encloses(bounds: Bounds, i: int, points: np.ndarray) -> None:
    """Sphere and slab i hold every point (n, 3), in integers without bound."""
    xyz = points.astype(object)  # Python integers
    apart = xyz - bounds.center[i].astype(object)
    assert max((apart * apart).sum(axis=1)) <= int(bounds.radius[i]) ** 2
    normal = bounds.normal[i].astype(object)
    if any(normal):
        along = (apart * normal).sum(axis=1)
        assert int(bounds.slab[i, 0]) <= min(along)
        assert max(along) <= int(bounds.slab[i, 1])


def bound(points: np.ndarray, with_slab: bool = True, highest: int = 65535) -> Bounds:
    """The bounds of a tree over the points; the first is of all of them."""
    options = {"leaf": 32, "degree": 16, "with_slab": with_slab, "highest": highest}
    return build_hierarchy(points.astype(np.int32), **options).bounds


@pytest.mark.interpreted
def test_ceil_sqrt_is_exact() -> None:
    for value in (0, 1, 2, 3, 4, 2**52 + 1, 2**53 + 1, (2**31 - 1) ** 2, 2**62 - 1, 2**62):
        root = int(ceil_sqrt(np.int64(value)))
        assert root * root >= value
        assert root == 0 or (root - 1) ** 2 < value


DEGENERATE = {
    "one": [[7, 8, 9]],
    "two": [[0, 0, 0], [65535, 65535, 65535]],
    "equal": [[5, 5, 5]] * 40,
    "collinear": [[i, 2 * i, 3 * i] for i in range(30)],
    "coplanar": [[i % 6, i // 6, 4] for i in range(36)],
    "cospherical": [[50 + sx * x, 50 + sy * y, 50 + sz * z] for x, y, z in [(15, 20, 0), (0, 7, 24), (25, 0, 0)]
                    for sx, sy, sz in itertools.product((-1, 1), repeat=3)],
    "corners": list(itertools.product((0, 65535), repeat=3)),
    "many corners": list(itertools.product((0, 65535), repeat=3)) * 50,
}  # fmt: skip


@pytest.mark.interpreted
@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_sets_are_bounded(name: str) -> None:
    points = np.array(DEGENERATE[name])
    bounds = bound(points)
    assert_encloses(bounds, 0, points)
    assert bounds.normal.any() == (len(points) >= 3)
    if name in ("one", "equal"):
        assert bounds.radius[0] == 0


@pytest.mark.interpreted
@pytest.mark.parametrize("name", ["collinear", "coplanar"])
def test_a_flat_set_has_a_thin_slab(name: str) -> None:
    bounds = bound(np.array(DEGENERATE[name]))
    # A plane through lattice points whose normal is stored rounded: thinner than two steps.
    assert (bounds.slab[0, 1] - bounds.slab[0, 0]) / np.linalg.norm(bounds.normal[0]) < 2


@pytest.mark.parametrize("kind", WITH_POINTS)
def test_bounds_of_scans_enclose(kind: str) -> None:
    points = make_steps(kind, 2, 300, 65536)
    assert_encloses(bound(points), 0, points)


def test_a_radius_fits_sixteen_bits_for_any_points_of_a_cell() -> None:
    # sqrt(3) / 2 * 65535 = 56,755 for the least ball; a guess 15 % worse would wrap around in uint16.
    rng = np.random.default_rng(0)
    corners = np.array(list(itertools.product((0, 65535), repeat=3)))
    for _ in range(300):
        chosen = corners[rng.choice(8, rng.integers(2, 9), replace=False)]
        chosen = np.clip(chosen + rng.integers(-9000, 9000, chosen.shape), 0, 65535)
        points = np.repeat(chosen, rng.choice([1, 200]), axis=0)
        assert bound(points).radius[0] < 1 << 16


@pytest.mark.interpreted
def test_the_direction_of_least_variance_is_an_eigenvector() -> None:
    """Where Newton finds it, and where it hands over: two variances alike, or all points on a line."""
    rng = np.random.default_rng(7)
    kinds = ([900, 500, 70], [900, 890, 0], [900, 71, 70], [900, 1e-3, 0], [5, 5, 5], [3, 0, 0], [9, 1, 1])
    for lengths in kinds * 15:
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        matrix = turn @ np.diag(np.square(lengths)) @ turn.T
        spread, direction = np.array([9, 0, 0, 0, *matrix[np.triu_indices(3)]], float), np.empty(3)
        least_variance(spread, direction)
        assert np.linalg.norm(direction) == pytest.approx(1, abs=1e-9)
        # Its variance is the least there is, to rounding.
        assert direction @ matrix @ direction <= min(lengths) ** 2 + 1e-9 * max(lengths) ** 2
