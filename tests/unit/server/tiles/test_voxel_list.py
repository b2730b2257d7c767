"""List of voxels near a place: by brute force, in order, bounded, and with what is in memory."""

from pathlib import Path

import archive_cases
import numpy as np
import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.server.scene import Scene


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    """Points in many voxels."""
    places = np.random.default_rng(5).uniform(-2, 2, (3000, 3))
    return archive_cases.build(tmp_path_factory.mktemp("list"), places, voxel=0.5)


def test_voxels_are_listed_by_the_distance_of_their_boxes(case: archive_cases.Case) -> None:
    place = np.array([0.3, -0.2, 1.1])
    with Scene.open(case.archive) as scene:
        every = scene.voxels(place)
        assert every.total == len(every.voxel) == scene.info().voxels
        apart = np.maximum(np.maximum(every.low - place, place - every.high), 0)
        distances = np.linalg.norm(apart, axis=1)
        assert (np.diff(distances) >= 0).all()
        for low, high, voxel, count in zip(every.low, every.high, every.voxel, every.points, strict=True):
            corner = voxel * every.edges[0] + scene.info().origin
            step = scene.info().lattice_step
            inside = ((case.points >= low - step) & (case.points <= high + step)).all(axis=1)
            assert inside.sum() >= count > 0
            assert (low >= corner - 1e-9).all() and (high <= corner + every.edges[0] + 1e-9).all()
        near = scene.voxels(place, reach=0.6, limit=5)
        assert near.total == (distances <= 0.6).sum() > 5
        np.testing.assert_array_equal(near.voxel, every.voxel[:5])


def test_voxels_of_two_archives_are_listed_together(case: archive_cases.Case, tmp_path: Path) -> None:
    file = tmp_path / "scene.toml"
    pose = [[1.0, 0.0, 0.0, 0.25], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
    tables = f'[[archives]]\npath = "{case.archive}"\n'
    file.write_text(f"format = 1\n{tables}{tables}pose = {pose}\n")
    with Scene.open(file) as scene:
        listed = scene.voxels((0, 0, 0), limit=40)
        assert set(listed.archive.tolist()) == {0, 1} and len(listed.poses) == 2
        distances = []
        for number, low, high in zip(listed.archive, listed.low, listed.high, strict=True):
            place = -listed.poses[number, :3, 3]
            distances.append(np.linalg.norm(np.maximum(np.maximum(low - place, place - high), 0)))
        assert (np.diff(distances) >= 0).all()


@pytest.mark.parametrize("place", [(0, 0), (np.nan, 0, 0), (np.inf, 0, 0)])
def test_a_place_that_is_none_is_refused(case: archive_cases.Case, place: tuple[float, ...]) -> None:
    with Scene.open(case.archive) as scene, pytest.raises(BadRequestError, match="place"):
        scene.voxels(place)
