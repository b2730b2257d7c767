"""Test places on the generated façade's walls: on them, visible, as sparse as stated, reproducible."""

import laspy
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from solidcloud.builder.synthetic.places import RING_RADIUS, SPACING_RATIO, WallPlaces, wall_places
from solidcloud.builder.synthetic.scenes import make_facade
from solidcloud.builder.synthetic.truth import SceneTruth, read_truth
from solidcloud.schemas.errors import BadDataError


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[SceneTruth, NDArray[np.float64], WallPlaces]:
    """A façade of 200,000 points: its truth, its points, 600 places."""
    scene = make_facade(tmp_path_factory.mktemp("facade") / "facade.laz", points=200_000)
    truth = read_truth(scene.truth)
    return truth, np.asarray(laspy.read(scene.paths[0]).xyz), wall_places(truth, 600)


def test_places_lie_on_the_walls_clear_of_their_edges(
    made: tuple[SceneTruth, NDArray[np.float64], WallPlaces],
) -> None:
    truth, _, places = made
    assert len(places.points) == len(places.normals) == len(places.spacing) == 600
    on = np.zeros(600, int)
    for wall in truth.facades[0].walls:
        axis = "xy".index(wall.axis)
        across, along, height = places.points[:, axis], places.points[:, 1 - axis], places.points[:, 2]
        inside = (
            (across == wall.offset) & (along >= wall.low + RING_RADIUS) & (along <= wall.high - RING_RADIUS)
        )
        inside &= (height >= wall.z_low + RING_RADIUS) & (height <= wall.z_high - RING_RADIUS)
        assert (places.normals[inside, axis] == wall.facing).all()
        on += inside
    assert (on >= 1).all()
    assert np.array_equal(np.abs(places.normals).sum(axis=1), np.ones(600))


def test_spacings_are_spread_evenly_by_logarithm(
    made: tuple[SceneTruth, NDArray[np.float64], WallPlaces],
) -> None:
    _, _, places = made
    share = np.log(places.spacing / places.spacing.min()) / np.log(SPACING_RATIO)
    assert share.max() <= 1.0
    counts = np.histogram(share, 4, (0, 1))[0]
    assert counts.min() > 100


def test_scan_has_the_spacing_that_is_said(made: tuple[SceneTruth, NDArray[np.float64], WallPlaces]) -> None:
    """Counted in circles of RING_RADIUS, over many places: the scan is 3 % thinner than its rays, by the thinning."""
    _, points, places = made
    tree = cKDTree(points)
    for part in np.array_split(np.argsort(places.spacing), 4):
        found = tree.query_ball_point(places.points[part], RING_RADIUS, return_length=True)
        expected = np.pi * RING_RADIUS**2 / places.spacing[part] ** 2
        assert found.sum() == pytest.approx(0.97 * expected.sum(), rel=0.08)


def test_nothing_but_the_wall_is_near(made: tuple[SceneTruth, NDArray[np.float64], WallPlaces]) -> None:
    """Within reach of the probe, 12 cm, points lie on the wall, five noises thick; mixed returns are rare."""
    _, points, places = made
    off = []
    for place, normal, near in zip(
        places.points, places.normals, cKDTree(points).query_ball_point(places.points, 0.12), strict=True
    ):
        off.append(np.abs((points[near] - place) @ normal))
    assert (np.concatenate(off) > 0.010).mean() < 0.002


def test_same_truth_same_places(made: tuple[SceneTruth, NDArray[np.float64], WallPlaces]) -> None:
    truth, _, places = made
    assert all(np.array_equal(a, b) for a, b in zip(places, wall_places(truth, 600), strict=True))
    assert not np.array_equal(places.points, wall_places(truth, 600, seed=1).points)


def test_too_many_places_are_refused(
    made: tuple[SceneTruth, NDArray[np.float64], WallPlaces], monkeypatch: pytest.MonkeyPatch
) -> None:
    truth, _, _ = made
    monkeypatch.setattr("solidcloud.builder.synthetic.places.WALL_SAMPLES", 50)
    with pytest.raises(BadDataError, match="expected 600"):
        wall_places(truth, 600)
