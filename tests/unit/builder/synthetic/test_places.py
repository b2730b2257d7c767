"""Test that places on the generated façade's walls lie on them, clear of their edges."""

import laspy
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.builder.synthetic.places import RING_RADIUS, WallPlaces, wall_places
from solidcloud.builder.synthetic.scenes import make_facade
from solidcloud.builder.synthetic.truth import SceneTruth, read_truth


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
