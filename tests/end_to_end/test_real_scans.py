"""Test real scans with default options, against the definition and against known sizes in a building.

The scans lie in the folder that SOLIDCLOUD_SCANS names; without it, the tests are skipped.
"""

from pathlib import Path

import archive_cases
import naive
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.sources.scan_files import find_scan_files, open_scans
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.scene import Scene


def source_points(path: Path) -> NDArray[np.float64]:
    """Return all points of a scan or a folder of scans, world [m], as the readers give them."""
    scans = [scan for file in find_scan_files([path]) for scan in open_scans(file)]
    points = np.concatenate([block.xyz for scan in scans for block in scan.blocks()])
    return points[np.isfinite(points).all(axis=1)]


@pytest.mark.parametrize(
    ("name", "part", "farthest"),
    [("pumpA.e57", 20, 0.25), ("cupola_las", 80, 2.0), ("campus_scan_a.ply", 20, 0.25)],
    ids=["E57", "LAS in map coordinates", "PLY"],
)
def test_poses_near_surfaces_by_the_definition(
    tmp_path: Path, real_scans: Path, rng: np.random.Generator, name: str, part: int, farthest: float
) -> None:
    build_archive([real_scans / name], tmp_path / "archive", BuildConfig(jobs=1))
    points = source_points(real_scans / name)
    size = float(np.ptp(points, axis=0).max()) / part
    avatar = rng.uniform(-size, size, (150, 3)) * [0.3, 0.3, 1.0]
    poses = archive_cases.near_poses(rng, points, avatar, 60, size * farthest)
    with Scene.open(tmp_path / "archive") as scene:
        info = scene.info()
        scene.add_avatar("avatar", avatar, size / 100)
        verdicts = scene.collide("avatar", poses).verdict
        scene.residency.check()
    assert info.points == len(points)
    expected = naive.collide(points, info.origin, info.lattice_step, info.radius, avatar, size / 100, poses)
    assert verdicts.tolist() == expected.astype(int).tolist()
    assert 6 <= expected.sum() <= 54, "the poses should be a mixture"


FLOOR = -1.32  # y of the floor [m]; y is up
LOW, HIGH = 0.2, 1.8  # height range of the cylinder above the floor [m]
CORRIDOR = [(-14.04, 1.5), (-12.8, 1.85), (-11.1, 2.05), (-9.9, 2.75), (-8.5, 3.25), (-6.7, 3.35), (-3, 3.5)]
PASSAGE = [(-3, 3.5), (-3.84, 3.15), (-2.74, 2.6), (-1.94, 1.75), (-0.69, 1.35), (0.21, 2.1), (1.31, 2.65),
           (1.01, 3.8), (0.26, 4.7)]  # fmt: skip
# Rotation from z up, as avatars are made, to y up.
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def route(corners: list[tuple[float, float]]) -> NDArray[np.float64]:
    """Return places (k, 2), x and z [m], every 5 cm along a route."""
    legs = []
    for a, b in zip(np.array(corners[:-1]), np.array(corners[1:]), strict=True):
        count = int(np.ceil(np.linalg.norm(b - a) / 0.05))
        legs.append(a + (b - a) * np.linspace(0, 1, count, endpoint=False)[:, None])
    return np.concatenate([*legs, np.array(corners[-1:])])


def upright(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return poses (k, 4, 4) of an avatar that stands on the floor at places (k, 2)."""
    return np.array([archive_cases.pose_of(UPRIGHT, np.array([x, FLOOR, z])) for x, z in places])


def grid(radius: float, low: float, high: float, gap: float) -> NDArray[np.float64]:
    """Return points (n, 3) of a cylinder about the z axis, including its edge.

    They are at most `gap` [m] apart on each axis.
    """
    across = np.linspace(-radius, radius, int(np.ceil(2 * radius / gap)) + 1)
    up = np.linspace(low, high, int(np.ceil((high - low) / gap)) + 1)
    x, y, z = (c.ravel() for c in np.meshgrid(across, across, up, indexing="ij"))
    return np.column_stack([x, y, z])[np.hypot(x, y) <= radius + gap]


def inner(radius: float) -> tuple[NDArray[np.float64], float]:
    """Return spheres that lie inside the cylinder: if they touch a point, the point is in the cylinder."""
    size = 0.04
    points = grid(radius - size, LOW + size, HIGH - size, 0.04)
    return points[np.hypot(points[:, 0], points[:, 1]) <= radius - size], size


def outer(radius: float, gap: float) -> tuple[NDArray[np.float64], float]:
    """Return spheres that cover the cylinder: if they touch nothing, no point is in the cylinder.

    No place in it is farther than half a cell's diagonal from a point of the grid.
    """
    return grid(radius, LOW, HIGH, gap), gap * np.sqrt(3) / 2


@pytest.fixture(scope="module")
def atrium(real_scans: Path, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Open the atrium with points of radius zero, so that the cylinder has exactly its nominal width."""
    target = tmp_path_factory.mktemp("atrium") / "archive"
    build_archive([real_scans / "indoor_atrium.laz"], target, BuildConfig(jobs=1, radius=0.0))
    return Scene.open(target)


@pytest.fixture(scope="module")
def atrium_points(real_scans: Path) -> NDArray[np.float64]:
    """Return the atrium's points, world [m]."""
    return source_points(real_scans / "indoor_atrium.laz")


def ask(scene: Scene, spheres: tuple[NDArray[np.float64], float], places: NDArray[np.float64]) -> list[int]:
    """Return the verdicts of an avatar of these spheres at these places."""
    points, radius = spheres
    name = f"{len(points)}-{radius}"
    scene.add_avatar(name, points, radius)
    return scene.collide(name, upright(places)).verdict.tolist()


def within(points: NDArray[np.float64], places: NDArray[np.float64], radius: float, rim: float = 1e-9) -> int:
    """Return the number of scan points in the cylinder, enlarged by `rim` [m], at some of the places."""
    up = points[:, 1] - FLOOR
    standing = points[(up >= LOW - rim) & (up <= HIGH + rim)][:, [0, 2]]
    found = np.zeros(len(standing), bool)
    for place in places:
        found |= np.hypot(*(standing - place).T) <= radius + rim
    return int(found.sum())


def test_the_corridor_is_free_to_a_metre_and_no_wider(
    atrium: Scene, atrium_points: NDArray[np.float64]
) -> None:
    places = route(CORRIDOR)
    assert atrium.info().moved_max < 1e-6, "the lattice is the scan's own"
    for radius, gap in ((0.3, 0.05), (0.6, 0.08), (1.0, 0.1)):
        assert within(atrium_points, places, radius) == 0
        assert set(ask(atrium, outer(radius, gap), places)) == {Verdict.CLEAR}
    assert within(atrium_points, places, 1.4) > 0
    assert Verdict.CONTACT in ask(atrium, inner(1.4), places)


def test_the_passage_takes_a_slim_visitor(atrium: Scene, atrium_points: NDArray[np.float64]) -> None:
    places = route(PASSAGE)
    assert [within(atrium_points, places, r) for r in (0.3, 0.4)] == [0, 2]
    assert set(ask(atrium, outer(0.3, 0.03), places)) == {Verdict.CLEAR}
    assert Verdict.CONTACT in ask(atrium, inner(0.6), places)


@pytest.mark.parametrize(("place", "count"), [((-14, -0.25), 1608), ((-14, 3.2), 585)])
def test_who_stands_in_the_wall_is_in_contact(
    atrium: Scene, atrium_points: NDArray[np.float64], place: tuple[float, float], count: int
) -> None:
    places = np.array([place])
    # The scan lies on a grid of 1 cm, and so do the ends and the rim of the cylinder. Rounding in
    # float64 decides which of these points count.
    assert within(atrium_points, places, 0.3, -1e-9) <= count <= within(atrium_points, places, 0.3)
    assert ask(atrium, inner(0.3), places) == [Verdict.CONTACT]
