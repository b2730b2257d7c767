"""An avatar's hierarchy: what it bounds, its spacing by brute force, the radius it takes, what is refused."""

import itertools
import math
from fractions import Fraction

import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.builder.kernels.trees.pack_tree import pack_tree
from solidcloud.schemas.errors import BadRequestError, TooLargeError
from solidcloud.schemas.wire.request_limits import MAX_AVATAR_POINTS
from solidcloud.server.avatars import avatar_model
from solidcloud.server.avatars.avatar_model import (
    DEGREE,
    AvatarModel,
    bound_nodes,
    make_avatar,
    mean_spacing,
    pack_points,
)
from solidcloud.server.kernels.core.scene_arrays import LANES


def leaf_points(model: AvatarModel, node: int) -> np.ndarray:
    """The points below a node (n, 3), fillers left out."""
    first, count = int(model.arrays.first[node]), int(model.arrays.count[node])
    if first < 0:
        return model.arrays.points[~first, :, :count].T
    return np.concatenate([leaf_points(model, child) for child in range(first, first + count)])


@pytest.mark.interpreted
@pytest.mark.parametrize("kind", synthetic_scans.WITH_POINTS)
@pytest.mark.parametrize(("shift", "scale"), [(1e6, 1e-3), (-1e9, 1.0)])
def test_every_node_encloses_its_points_exactly(kind: str, shift: float, scale: float) -> None:
    points = np.clip(synthetic_scans.make_scan(kind, 3, 150) * scale + shift, -1e9, 1e9)
    model = make_avatar(points, 0.1)
    for node in range(len(model.arrays.radius)):
        center = [Fraction(v) for v in model.arrays.center[node].tolist()]
        most = Fraction(float(model.arrays.radius[node])) ** 2
        for point in np.unique(leaf_points(model, node), axis=0).tolist():
            assert sum((Fraction(a) - b) ** 2 for a, b in zip(point, center, strict=True)) <= most


@pytest.mark.interpreted
def test_points_are_kept_bit_for_bit_and_blocks_are_filled(rng: np.random.Generator) -> None:
    points = rng.normal(size=(77, 3)) * 1e3
    model = make_avatar(points, 0.1)
    held = leaf_points(model, 0)
    assert sorted(map(tuple, held.tolist())) == sorted(map(tuple, points.tolist()))
    leaves = np.flatnonzero(model.arrays.first < 0)
    for node in leaves:
        block, count = model.arrays.points[~model.arrays.first[node]], model.arrays.count[node]
        assert block.shape == (3, LANES) and (block[:, count:] == block[:, count - 1 : count]).all()
    assert (model.arrays.first[leaves] == ~np.arange(len(leaves))).all()


@pytest.mark.interpreted
def test_radius_is_half_the_mean_closest_point_distance(rng: np.random.Generator) -> None:
    distinct = rng.uniform(-1, 1, (60, 3))
    apart = np.linalg.norm(distinct[:, None] - distinct[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    model = make_avatar(np.concatenate([distinct, distinct[:20]]))
    # On a lattice of 2^-20 m: each point less than two steps off.
    assert model.radius == pytest.approx(apart.min(axis=1).mean() / 2, abs=2.0**-18)
    assert make_avatar(distinct[::-1]).radius == make_avatar(distinct).radius


@pytest.mark.interpreted
@pytest.mark.parametrize("count", [1, 5])
def test_a_single_distinct_point_needs_a_radius(count: int) -> None:
    points = np.tile([[1.0, 2.0, 3.0]], (count, 1))
    with pytest.raises(BadRequestError, match="give a radius"):
        make_avatar(points)
    assert make_avatar(points, 0.0).radius == 0.0
    assert make_avatar(points, 0.5).bounding_radius == pytest.approx(0.5, abs=1e-5)


@pytest.mark.interpreted
@pytest.mark.parametrize(
    ("points", "radius", "message"),
    [
        ([[0.0, 0, np.nan]], 0.1, "finite"),
        ([[0.0, np.inf, 0]], 0.1, "finite"),
        ([[0.0, 0, 1.1e9]], 0.1, "within 1e"),
        ([[0.0, 0]], 0.1, "expected"),
        ([0.0, 0, 0], 0.1, "expected"),
        ("body", 0.1, "expected an array of numbers"),
        ([[0.0, 0, 0]], -1e-9, "zero or a positive length"),
        ([[0.0, 0, 0]], np.nan, "zero or a positive length"),
        ([[0.0, 0, 0]], np.inf, "zero or a positive length"),
        (np.empty((0, 3)), -1.0, "zero or a positive length"),
    ],
)
def test_what_is_refused_says_what_was_expected(points: object, radius: float, message: str) -> None:
    with pytest.raises(BadRequestError, match=message):
        make_avatar(points, radius)  # type: ignore[arg-type]


@pytest.mark.interpreted
def test_too_many_points_are_refused_before_any_work() -> None:
    with pytest.raises(TooLargeError, match="thin it out"):
        make_avatar(np.broadcast_to(np.zeros(3), (MAX_AVATAR_POINTS + 1, 3)), 0.1)


def clouds(rng: np.random.Generator) -> list[NDArray[np.float64]]:
    """Points with ties, dense and sparse parts, and outliers."""
    return [
        *(synthetic_scans.make_scan(kind, 8, 3000) for kind in synthetic_scans.WITH_POINTS),
        rng.integers(0, 12, (5000, 3)) / 64,
        np.exp(-10 * rng.random((3000, 3))),
        np.concatenate([rng.random((2000, 3)) * 1e-3, 1e3 * rng.normal(size=(70, 3))]),
    ]


def test_the_tree_is_that_of_a_voxel(rng: np.random.Generator) -> None:
    for points in clouds(rng):
        tree = pack_points(points)
        steps = np.floor((points - tree.low) / tree.step).astype(np.int32)
        order, begin, end, _, levels = pack_tree(steps, LANES, DEGREE)
        for number, starts in enumerate(tree.levels):
            assert starts[:-1].tolist() == begin[levels[number] : levels[number + 1]].tolist()
        assert np.array_equal(tree.steps, steps[tree.order])
        for a, b in zip(begin[levels[-2] :], end[levels[-2] :], strict=True):
            assert sorted(tree.order[a:b]) == sorted(order[a:b])


def test_every_node_encloses_its_points(rng: np.random.Generator) -> None:
    for points in clouds(rng):
        tree = pack_points(points)
        center, radius = (column.astype(np.int64) for column in bound_nodes(tree))
        node = 0
        for starts in tree.levels:
            for a, b in itertools.pairwise(starts):
                square = ((tree.steps[a:b].astype(np.int64) - center[node]) ** 2).sum(axis=1).max()
                assert radius[node] ** 2 >= square > (radius[node] - 1) ** 2 or radius[node] == 0 == square
                node += 1
        assert node == len(radius)


@pytest.mark.parametrize("pairs", [1 << 18, 1 << 11])
def test_the_spacing_is_that_of_brute_force(
    pairs: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(avatar_model, "_PAIRS", pairs)
    for points in clouds(rng):
        tree = pack_points(points)
        steps = np.unique(tree.steps, axis=0)
        closest = []
        for k in range(len(steps)):
            squares = ((steps - steps[k]) ** 2).sum(axis=1)
            squares[k] = np.inf
            closest.append(squares.min())
        expected = math.fsum(np.sqrt(closest) * tree.step) / len(steps) if len(steps) > 1 else 0.0
        assert mean_spacing(tree) == expected


@pytest.mark.parametrize("points", [[[1.0, 2, 3]], [[1.0, 2, 3]] * 50])
def test_one_distinct_point_has_no_spacing(points: list[list[float]]) -> None:
    assert mean_spacing(pack_points(np.array(points))) == 0


@pytest.mark.parametrize("extent", [1e-9, 1.0, 4.0, 4.1, 1e9])
def test_points_of_any_extent_fit_their_lattice(extent: float) -> None:
    points = np.array([[0.0, 0, 0], [extent, 0, 0], [0, extent / 3, 0]])
    tree = pack_points(points)
    assert 0 <= tree.steps.min() <= tree.steps.max() <= avatar_model.MAX_STEPS
    assert math.log2(tree.step).is_integer()
    apart = points[tree.order] - (tree.low + tree.steps * tree.step)
    assert (apart >= 0).all() and (apart < 2 * tree.step).all()
