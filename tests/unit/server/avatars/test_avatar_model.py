"""An avatar's hierarchy: what it bounds, the radius it takes, what is refused."""

from fractions import Fraction

import numpy as np
import pytest
import synthetic_scans
from solidcloud.schemas.errors import BadRequestError, TooLargeError
from solidcloud.schemas.wire.request_limits import MAX_AVATAR_POINTS
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.kernels.core.scene_arrays import LANES

pytestmark = pytest.mark.interpreted


def leaf_points(model: AvatarModel, node: int) -> np.ndarray:
    """The points below a node (n, 3), fillers left out."""
    first, count = int(model.arrays.first[node]), int(model.arrays.count[node])
    if first < 0:
        return model.arrays.points[~first, :, :count].T
    return np.concatenate([leaf_points(model, child) for child in range(first, first + count)])


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


def test_radius_is_half_the_mean_closest_point_distance(rng: np.random.Generator) -> None:
    distinct = rng.uniform(-1, 1, (60, 3))
    apart = np.linalg.norm(distinct[:, None] - distinct[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    model = make_avatar(np.concatenate([distinct, distinct[:20]]))
    # On a lattice of 2^-20 m: each point less than two steps off.
    assert model.radius == pytest.approx(apart.min(axis=1).mean() / 2, abs=2.0**-18)
    assert make_avatar(distinct[::-1]).radius == make_avatar(distinct).radius


@pytest.mark.parametrize("count", [1, 5])
def test_a_single_distinct_point_needs_a_radius(count: int) -> None:
    points = np.tile([[1.0, 2.0, 3.0]], (count, 1))
    with pytest.raises(BadRequestError, match="give a radius"):
        make_avatar(points)
    assert make_avatar(points, 0.0).radius == 0.0
    assert make_avatar(points, 0.5).bounding_radius == pytest.approx(0.5, abs=1e-5)


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


def test_too_many_points_are_refused_before_any_work() -> None:
    with pytest.raises(TooLargeError, match="thin it out"):
        make_avatar(np.broadcast_to(np.zeros(3), (MAX_AVATAR_POINTS + 1, 3)), 0.1)
