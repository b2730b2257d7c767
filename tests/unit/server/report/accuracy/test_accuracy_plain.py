"""The plain descent that bounds and arithmetic are compared with: all its kinds against every pair of points."""

from pathlib import Path

import archive_cases
import naive
import numpy as np
import pytest
import synthetic_scans
from solidcloud.schemas.archive.archive import Archive
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.report.accuracy.accuracy_arithmetic import ARITHMETICS
from solidcloud.server.report.accuracy.accuracy_volumes import (
    PRIMITIVES,
    VOLUMES,
    Kind,
    Plain,
    ask,
    distances,
    make_plain,
)
from solidcloud.server.report.kernels.plain_descent import SLACK
from solidcloud.server.report.kernels.plain_pairs import CUBES, FLOAT32_WORLD, FLOAT64, INTEGERS

pytestmark = pytest.mark.interpreted
FARTHEST = 0.5
EVERY = (*VOLUMES, *(kind._replace(sift=False) for kind in VOLUMES), *ARITHMETICS, *PRIMITIVES)


class Made:
    """A small scan, an avatar, poses near it, and integers of all: what is judged."""

    def __init__(self, folder: Path, kind: str, *, radius: float = 0.01, voxel: float = 0.7) -> None:
        rng = np.random.default_rng(11)
        self.case = archive_cases.build(
            folder, synthetic_scans.make_scan(kind, 3, 150), radius=radius, degree=3, leaf=4, voxel=voxel
        )
        points = rng.uniform(-0.2, 0.2, (70, 3))
        self.avatar: AvatarModel = make_avatar(points, 0.02)
        self.poses = np.stack(list(archive_cases.near_poses(rng, self.case.points, points, 12, 0.15)))
        self.archive = Archive(self.case.archive)
        self.plain: Plain = make_plain(self.archive, self.avatar)
        lattice = self.archive.header.lattice
        steps = naive.lattice_of(self.case.points, lattice.origin, lattice.step)
        self.scan = naive.scan_units(steps, lattice.step)

    def apart(self, pose: np.ndarray) -> np.ndarray:
        """Differences (m, n, 3) of all pairs under a pose, exact units."""
        placed = naive.placed_units(self.avatar.points, pose, self.archive.header.lattice.origin)
        return self.scan[None] - placed[:, None]


@pytest.fixture(scope="module", params=["plane", "corner", "noise"])
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Made:
    return Made(tmp_path_factory.mktemp("made"), request.param)


@pytest.mark.parametrize("kind", EVERY, ids=lambda kind: f"{kind.name} {kind.sift}")
def test_every_kind_answers_as_every_pair_of_points_does(made: Made, kind: Kind) -> None:
    found = ask(made.plain, kind, made.poses)
    expected = []
    for pose in made.poses:
        apart = made.apart(pose)
        if kind.leaf == CUBES:
            expected.append(bool((np.abs(apart).max(axis=2) <= made.plain.units).any()))
        else:
            expected.append(bool(((apart * apart).sum(axis=2) <= made.plain.units**2).any()))
    assert 0 < sum(expected) < len(expected), "all poses alike: nothing is told apart"
    if kind.leaf != FLOAT32_WORLD:  # half a metre off: that is what it is there to show
        assert found.contact.tolist() == expected
    assert (found.node_tests >= 1).all() and found.pair_tests.max() > 0


@pytest.mark.parametrize("leaf", [FLOAT64, INTEGERS, CUBES])
def test_distances_are_those_of_the_nearest_pair(made: Made, leaf: int) -> None:
    found = distances(made.plain, Kind("", 0, leaf), made.poses, FARTHEST)
    for pose, distance in zip(made.poses, found, strict=True):
        apart = np.abs(made.apart(pose)) / 2.0**26
        reach = made.plain.units / 2.0**26
        if leaf == CUBES:
            gaps = apart - reach
            outside = np.sqrt((np.maximum(gaps, 0.0) ** 2).sum(axis=2))
            expected = np.where(gaps.max(axis=2) > 0, outside, gaps.max(axis=2)).min()
        else:
            expected = np.sqrt((apart * apart).sum(axis=2)).min() - reach
        assert distance == pytest.approx(min(expected, FARTHEST), abs=1e-7)


def test_map_coordinates_are_those_of_one_place_wherever_the_scan_is(made: Made) -> None:
    """A scan that has map coordinates already is not moved as far again."""
    there = np.array([691_000.0, 5_334_000.0, 520.0])
    lattice, poses = made.plain.lattice, made.poses.copy()
    poses[:, :3, 3] += there
    moved = made.plain._replace(lattice=lattice._replace(origin=lattice.origin + there))
    rough = Kind("", 0, FLOAT32_WORLD)
    found = distances(moved, rough, poses, FARTHEST)
    assert found.tolist() == distances(made.plain, rough, made.poses, FARTHEST).tolist()
    assert len(np.unique(found)) > 1


def test_boxes_are_those_of_the_points_below(made: Made) -> None:
    forest, step = made.plain.forest, made.plain.lattice.step
    lanes = (forest.low[:, :, None] + forest.steps.astype(np.int64)) * step

    def blocks(node: int) -> list[int]:
        first = int(forest.first[node])
        if first < 0:
            return [~first]
        return [block for child in range(first, first + forest.count[node]) for block in blocks(child)]

    for node in range(len(forest.first)):
        below = lanes[blocks(node)]
        assert forest.middle[node] - forest.half[node] == pytest.approx(below.min(axis=(0, 2)), abs=1e-12)
        assert forest.middle[node] + forest.half[node] == pytest.approx(below.max(axis=(0, 2)), abs=1e-12)
    held = np.concatenate([np.unique(blocks(int(root))) for root in forest.roots])
    assert sorted(held.tolist()) == list(range(len(forest.low))), "a block that no root leads to"


def test_at_a_tangent_the_certified_kind_and_the_integers_agree_to_the_unit(tmp_path: Path) -> None:
    made = Made(tmp_path, "plane", radius=0.0, voxel=4.0)
    exact = [kind for kind in (*ARITHMETICS, *VOLUMES) if kind.leaf in (2, INTEGERS)]
    assert len(exact) == 6
    for pose in made.poses:
        apart = made.apart(pose)
        least = (apart * apart).sum(axis=2).min()
        reach = int(np.ceil(np.sqrt(float(least))))
        for units in (reach - 1, reach):
            plain = made.plain._replace(units=units, reach=units / 2.0**26)
            said = {bool(ask(plain, kind, pose[None]).contact[0]) for kind in exact}
            assert said == {int(least) <= units**2}, (pose.tolist(), units)


def test_the_slack_of_node_tests_covers_the_rounding_to_exact_units() -> None:
    # Two points rounded by half a unit an axis each: sqrt(3) units in all; the radii by half a unit each.
    assert SLACK * 2.0**26 > 3**0.5 + 1
