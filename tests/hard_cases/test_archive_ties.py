"""Hard case of ties between archives; a test's number is its row in NUMERICS.md."""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.schemas.wire.answers import Cost, Verdict
from solidcloud.schemas.wire.arrays import array_fields
from solidcloud.server.scene import Scene
from split_scans import several

Floats = NDArray[np.float64]
STEP = archive_cases.BINARY_STEP
OPTIONS: dict[str, Any] = {"resolution": STEP, "keep": frozenset({"scan"})}
# Columns of scans, which are numbered in the order of the archives.
SCANS = ("scan_index", "cluster_scan")


def build(folder: Path, *scans: list[list[float]], radius: float = 0.0625) -> list[Path]:
    """Build an archive of each scan."""
    found = []
    for number, points in enumerate(scans):
        own = folder / f"{number} {radius}"
        own.mkdir()
        found.append(archive_cases.build(own, np.array(points), radius=radius, **OPTIONS).archive)
    return found


def in_any_order(placed: list[tuple[Path, Any]], *asks: Callable[[Scene], Cost]) -> list[Any]:
    """Return the answers of a scene of these archives, which must be the same in any order of them."""
    found = []
    for order in itertools.permutations(placed):
        with several(*order) as scene:
            for name, points, radius in BODIES:
                scene.add_avatar(name, np.array(points), radius)
            found.append([ask(scene) for ask in asks])
    for other in found[1:]:
        for one, same in zip(found[0], other, strict=True):
            for name in array_fields(type(one)):
                if name not in SCANS:
                    assert getattr(one, name).tobytes() == getattr(same, name).tobytes(), (name, one, same)
    return found[0]


def at(*places: tuple[float, float, float]) -> Floats:
    """Return poses without a rotation."""
    return np.array([archive_cases.pose_of(np.eye(3), np.array(place)) for place in places])


BODIES: list[tuple[str, list[list[float]], float]] = [
    ("one", [[0.0, 0.0, 0.0]], 0.0625),
    ("wide", [[0.0, 0.0, 0.0]], 1.0),
    ("two", [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], 0.0625),
    ("pair", [[0.0625, 0.0, 0.0], [-0.0625, 0.0, 0.0]], 0.125),
]
# Points at one distance from the origin, the least (x, y, z) last.
AROUND = [(0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, -1.0, 0.0)]
TURN = archive_cases.pose_of(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([4.0, -2.0, 1.0]))


@pytest.mark.case(
    36,
    "four archives, each with a sphere equally far: in any order the least, for distance, rays, points and sweeps",
)
@pytest.mark.parametrize("pose", [None, TURN], ids=["identity", "placed"])
def test_case_36_the_least_scan_point_is_named(tmp_path: Path, pose: Any) -> None:
    points = AROUND if pose is None else [pose[:3, :3].T @ (np.array(a) - pose[:3, 3]) for a in AROUND]
    placed = [(path, pose) for path in build(tmp_path, *([list(point)] for point in points))]
    near, within, rays, touch, swept, started, objects = in_any_order(
        placed,
        lambda scene: scene.distance("one", at((0, 0, 0)), 2.0),
        lambda scene: scene.within(np.zeros((1, 3)), 2.0),
        # Larger spheres: a ray hits one, another two at once, and the last none.
        lambda scene: scene.raycast(
            np.array([[-3.0, 0, 1], [-3.0, -0.5, -0.5], [-3.0, 0, 0]]), np.array([[1.0, 0, 0]] * 3), 9.0,
            radius_model="fixed:0.75",
        ),
        lambda scene: scene.collide("wide", at((0, 0, 0), (0, 0, 0.5), (9, 9, 9)), tolerance=0.01),
        lambda scene: scene.sweep("two", at((-4, 0, 0)), at((4, 0, 0))),
        lambda scene: scene.sweep("wide", at((0, 0, 0)), at((4, 0, 0))),
        # Tangent to one another and to the spheres of two archives.
        lambda scene: scene.objects([("wide", each, 1, 0xFFFFFFFF) for each in at((0, 0, 0), (0, 0, 2))]),
    )  # fmt: skip
    least = list(min(AROUND))
    assert near.signed_distance[0] == 1.0 - 0.125 and near.exact[0]
    assert near.witness_cloud[0].tolist() == least and near.normal[0].tolist() == [0.0, 1.0, 0.0]
    assert within.distance[0] == 1.0 and within.cloud_point[0].tolist() == least
    assert rays.verdict.tolist() == [Verdict.CONTACT, Verdict.CONTACT, Verdict.CLEAR]
    assert rays.cloud_point[:2].tolist() == [[0.0, 0.0, 1.0], least] and rays.exact.all()
    assert touch.verdict.tolist() == [Verdict.CONTACT, Verdict.CONTACT, Verdict.CLEAR]
    # Both spheres of the body meet one at the same time.
    assert swept.verdict[0] == Verdict.CONTACT and swept.exact[0]
    assert swept.witness_cloud[0].tolist() == [0.0, 0.0, -1.0]
    assert started.upper[0] == 0.0 and started.witness_cloud[0].tolist() == least
    assert objects.verdict.tolist() == [1, 1] and objects.pairs.tolist() == [[0, 1]]


@pytest.mark.case(
    36,
    "archives of unequal radii whose spheres are equally far: in any order the one with the least scan point",
)
def test_case_36_spheres_of_unequal_size(tmp_path: Path) -> None:
    small = build(tmp_path, [[1.0, 0, 0], [0.0, 8, 0]], [[-1.0, 0, 0], [0.0, 16, 0]])
    large = build(tmp_path, [[0.0, 1.25, 0], [0.25, 8, 0]], [[0.0, -1.25, 0], [-0.25, 16, 0]], radius=0.3125)
    near, deep, listed, rays = in_any_order(
        [(path, None) for path in (*small, *large)],
        lambda scene: scene.distance("one", at((0, 0, 0)), 2.0),
        lambda scene: scene.distance("wide", at((0, 0, 0)), 2.0),
        lambda scene: scene.contacts("wide", at((0, 0, 0)), 3),
        # Two spheres of unequal size begin at the same place of a ray.
        lambda scene: scene.raycast(
            np.array([[-3.0, 8, 0], [3.0, 16, 0]]), np.array([[1.0, 0, 0], [-1.0, 0, 0]]), 9.0
        ),
    )
    for found, depth in ((near, 0.875), (deep, -0.0625)):
        assert found.signed_distance[0] == depth and found.exact[0]
        assert found.witness_cloud[0].tolist() == [-1.0, 0.0, 0.0]
    assert listed.cloud_point.tolist() == [[-1.0, 0, 0], [0.0, -1.25, 0], [0.0, 1.25, 0]]
    assert listed.pairs_found[0] == 4
    assert rays.distance.tolist() == [3.0 - 0.0625] * 2 and rays.exact.all()
    assert rays.cloud_point.tolist() == [[0.0, 8, 0], [-0.25, 16, 0]]


@pytest.mark.case(
    36, "three archives that share points: pairs and clusters of equal depth in any order, whatever the limit"
)
def test_case_36_contacts_of_equal_depth(tmp_path: Path) -> None:
    """Points of one archive are also in the others, which have other neighbours beside them."""
    shared = [[0.0, 0.0, 0.0], [0.0, 0.5, 0.0]]
    more = [
        [[0.0, 0.0, 0.0625]], [[0.0, 0.0, -0.0625], [0.0, 0.0, -0.125]], [[0.0, 0.0, 0.0625], [0.0, 0.0, 0.125]],
    ]  # fmt: skip
    placed = [(path, None) for path in build(tmp_path, *(shared + rest for rest in more))]
    # The two points of the body are equally far from each of these.
    poses = at((0, 0, 0), (0, 0.5, 0), (0, 0.25, 0))
    limits = (100, 0, 1, 2, 3, 5)
    whole, *cut = in_any_order(
        placed, *(lambda scene, n=limit: scene.contacts("pair", poses, n, 0.0, 0.1) for limit in limits)
    )
    assert whole.pairs_found.tolist() == [16, 6, 0] and whole.exact.all()
    # The clusters of the first pose have the same deepest pair: they are in the order of their numbers of pairs.
    assert whole.cluster_starts.tolist() == [0, 3, 6, 6]
    assert whole.cluster_deepest[:3].tolist() == [0.0625 - 0.1875] * 3
    assert whole.cluster_cloud[:3].tolist() == [[0.0] * 3] * 3
    assert whole.cluster_count[:3].tolist() == [4, 6, 6]
    for limit, few in zip(limits[1:], cut, strict=True):
        for name in ("avatar_point", "cloud_point", "signed_distance", "avatar_index", "cluster"):
            for i in range(len(poses)):
                own, all_of = (
                    getattr(each, name)[each.pair_starts[i] : each.pair_starts[i + 1]]
                    for each in (few, whole)
                )
                assert own.tolist() == all_of[:limit].tolist()
