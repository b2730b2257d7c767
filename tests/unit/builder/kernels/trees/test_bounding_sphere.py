"""Prove in Python integers that bounds enclose. tests/hard_cases/test_bounds.py measures their size."""

import itertools

import minimal_ball
import numpy as np
import pytest
from solidcloud.builder.kernels.trees.bounding_sphere import (
    MOMENTS,
    _flat_direction,
    ceil_sqrt,
    join_moments,
    leaf_moments,
    least_variance,
)
from solidcloud.builder.kernels.trees.build_tree import build_tree, tree_rows, tree_workspace
from solidcloud.builder.voxel.point_hierarchy import Bounds, build_hierarchy
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
@pytest.mark.parametrize("value", [0, 1, 2, 3, 4, 2**52 + 1, 2**53 + 1, (2**31 - 1) ** 2, 2**62 - 1, 2**62])
def test_ceil_sqrt_is_exact(value: int) -> None:
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
@pytest.mark.parametrize("with_slab", [True, False])
def test_degenerate_sets_are_bounded(name: str, with_slab: bool) -> None:
    points = np.array(DEGENERATE[name])
    bounds = bound(points, with_slab=with_slab)
    assert_encloses(bounds, 0, points)
    assert bounds.normal.any() == (with_slab and len(points) >= 3)
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


def test_the_judge_of_minimal_balls_knows_the_known_ones() -> None:
    cube = np.array([list(itertools.product((0.0, 2.0), repeat=3))])
    assert minimal_ball.radius_bound(cube)[0] == pytest.approx(np.sqrt(3), rel=2e-3)
    triangle = np.array([[[0.0, 0, 0], [1, 0, 0], [0.5, np.sqrt(0.75), 0], [0.5, 0.3, 0]]])
    assert minimal_ball.radius_bound(triangle)[0] == pytest.approx(1 / np.sqrt(3), rel=2e-3)
    pair = np.array([[[0.0, 0, 0], [0, 6, 0], [0, 3, 0]]])
    assert minimal_ball.radius_bound(pair)[0] == pytest.approx(3, rel=2e-3)


def plain_center(points: np.ndarray, steps: int) -> np.ndarray:
    """The centre guessed: the box's, then so many steps toward the farthest point.

    By distances of 16 bits, as their float32 begins; of equal ones in a block of 256 the last, of blocks the first.
    """
    center = (points.min(axis=0) + points.max(axis=0)) * 0.5
    single = points.astype(np.float32)
    for step in range(steps):
        d = single - center.astype(np.float32)
        distance = (d[:, 0] * d[:, 0] + d[:, 1] * d[:, 1] + d[:, 2] * d[:, 2]).view(np.int32) // 256
        far = max(range(len(points)), key=lambda i: (distance[i], -(i // 256), i))
        center = center + (points[far] - center) * (1 / (step + 4))
    return center


@pytest.mark.interpreted
@pytest.mark.parametrize(("n", "steps"), [(1, 32), (2, 32), (30, 32), (256, 32), (257, 8)])
def test_a_bound_is_as_tight_as_its_guess(n: int, steps: int) -> None:
    """Centre to the step, radius and slab exactly against numpy's, the direction against its eigenvectors."""
    rng = np.random.default_rng(n)
    for _ in range(4):
        # Three lengths well apart along directions of no axis, so that the least variance is without doubt.
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        points = np.rint((rng.uniform(-1, 1, (n, 3)) * [9000, 5000, 700]) @ turn + 20_000).astype(np.int64)
        found = build_hierarchy(points.astype(np.int32), leaf=32, degree=16)
        bounds, points = found.bounds, found.points.astype(np.int64)
        assert bounds.center[0].tolist() == np.rint(plain_center(points, steps)).tolist()
        apart = points - bounds.center[0]
        assert bounds.radius[0] == int(ceil_sqrt(np.int64((apart**2).sum(axis=1).max())))
        normal = bounds.normal[0].astype(np.int64)
        if n < 3:
            assert not normal.any()
        else:
            direction = np.linalg.eigh(np.cov(points.T))[1][:, 0] * 127
            direction = direction if direction @ normal > 0 else -direction
            assert np.abs(normal - direction).max() <= 0.5 + 1e-6
        along = apart @ normal
        assert bounds.slab[0].tolist() == [along.min(), along.max()]


@pytest.mark.interpreted
def test_a_guess_whose_radius_does_not_fit_is_given_up_for_the_box() -> None:
    # Four corners of a cube: toward them the centre leaves the box's, and the radius grows beyond the highest.
    rng = np.random.default_rng(3)
    given_up = 0
    for _ in range(60):
        points = rng.integers(0, 2, (5, 3)) * 255 + rng.integers(0, 2, (5, 3))
        for highest in (160, 220):
            found = build_hierarchy(points.astype(np.int32), leaf=8, degree=2, highest=highest)
            bounds, points = found.bounds, found.points.astype(np.int64)
            guess = np.clip(np.rint(plain_center(points, 32)), 0, highest).astype(np.int64)
            fits = ((points - guess) ** 2).sum(axis=1).max() <= highest**2
            box = np.clip(np.rint(plain_center(points, 0)), 0, highest).astype(np.int64)
            assert bounds.center[0].tolist() == (guess if fits else box).tolist()
            given_up += not fits
    assert 5 < given_up < 115


@pytest.mark.interpreted
def test_what_stood_in_the_arrays_before_is_not_read() -> None:
    points = make_steps("noise", 5, 40, 500)
    found = []
    for stale in (0, 77):
        own = np.stack([*points.T, np.arange(40)]).astype(np.int32)
        space, rows = tree_workspace(40, 8, 4), tree_rows(40, 8)
        for column in rows:
            column[:] = stale
        total, height = build_tree(own, 40, 8, 4, True, 65535, space, rows, np.full(MOMENTS, stale))
        found.append([total, height, own.tolist(), *(column[:total].tolist() for column in rows)])
    assert found[0] == found[1]
    assert found[0][0] > 5


def plain_spread(points: np.ndarray) -> np.ndarray:
    """How points (n, 3) are spread, by numpy."""
    off = points - points.mean(axis=0)
    products = off.T @ off
    return np.array([len(points), *points.mean(axis=0), *products[np.triu_indices(3)]])


@pytest.mark.interpreted
def test_spreads_of_parts_join_to_that_of_all() -> None:
    rng = np.random.default_rng(4)
    parts = [rng.integers(0, high, (n, 3)) + low for n, high, low in ((1, 9, 0), (20, 300, 65000), (7, 2, 5))]
    own = np.concatenate(parts).T.astype(np.int32).copy()
    ends = np.cumsum([len(part) for part in parts]).astype(np.uint64)
    spreads, joined = np.empty((3, MOMENTS)), np.empty(MOMENTS)
    for i, part in enumerate(parts):
        leaf_moments(own, ends[i] - np.uint64(len(part)), ends[i], spreads[i])
        assert np.allclose(spreads[i], plain_spread(part), rtol=1e-12, atol=1e-9)
    join_moments(spreads, 0, 3, joined)
    assert np.allclose(joined, plain_spread(np.concatenate(parts)), rtol=1e-12, atol=1e-6)


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


@pytest.mark.interpreted
@pytest.mark.parametrize("scale", [0.02, 1.0, 1e6])
@pytest.mark.parametrize(
    ("lengths", "found"),
    [
        # Whichever axis is the thinnest: each pair of rows of the matrix gives the direction of one.
        ([9, 5, 1], True), ([1, 9, 5], True), ([5, 1, 9], True), ([9, 8, 0], True), ([0, 9, 8], True),
        ([9, 1, 1], False), ([1, 1, 1], False), ([3, 0, 0], False), ([0, 0, 0], False),
    ],
)  # fmt: skip
def test_a_direction_is_found_at_once_where_one_variance_is_the_least(
    scale: float, lengths: list[float], found: bool
) -> None:
    """Along the axes and turned, of variances of any size."""
    rng = np.random.default_rng(8)
    for turn in (np.eye(3), np.linalg.qr(rng.normal(size=(3, 3)))[0]):
        matrix = turn @ np.diag(np.square(np.array(lengths) * scale)) @ turn.T
        spread, direction = np.array([9, 0, 0, 0, *matrix[np.triu_indices(3)]], float), np.empty(3)
        assert _flat_direction(spread, direction) == found
        if found:
            assert abs(direction @ turn[:, np.argmin(lengths)]) == pytest.approx(1, abs=1e-9)
