"""An index whose bounds of a voxel are smaller than its points: nothing is clear from the first load that shows it."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from forged_archives import Columns, forge
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import MisleadingIndexError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.scene import Scene

BALL = np.zeros((1, 3))


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray, np.ndarray]:
    """An archive with a voxel cut short in the index, the places of its hidden points (n, 3) [m], and of one left."""
    folder = archive_cases.build(
        tmp_path_factory.mktemp("cut"), synthetic_scans.make_scan("noise", 3, 2000)
    ).archive
    with Archive(folder) as archive:
        row = int(np.flatnonzero(archive.voxels["rows"][:, 2] > 20)[0])
        local = points_of(archive, row)
        axis = int(np.argmax(local.max(axis=0) - local.min(axis=0)))
        others = archive.coordinates[:, axis] != archive.coordinates[row, axis]
        outermost = archive.coordinates[row, axis] >= archive.coordinates[:, axis].max()
        side = "low" if outermost else "high"  # the side that is not the scene's own bound
        assert others.any()
        middle = int(np.median(local[:, axis]))
        hidden = local[:, axis] < middle - 300 if side == "low" else local[:, axis] > middle + 300
        base = archive.coordinates[row] * archive.header.lattice.voxel_steps
        world = archive.header.lattice.to_world(local + base)
        left = np.argmin(np.abs(local[:, axis] - middle))

    def cut(columns: Columns) -> None:
        columns["voxels"][side][row, axis] = middle

    forge(folder, cut)
    return folder, world[hidden], world[[left]]


def points_of(archive: Archive, row: int) -> np.ndarray:
    """The points of a voxel (n, 3) [voxel steps]."""
    from solidcloud.builder.voxel.record_points import voxel_points

    return voxel_points(*archive.read_voxel(row)).astype(np.int64)


def poses_at(places: np.ndarray) -> np.ndarray:
    """Poses (n, 4, 4) at some places."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    return poses


@pytest.fixture
def scene(places: tuple[Path, np.ndarray, np.ndarray]) -> Iterator[Scene]:
    """The scene of it, with an avatar of one point."""
    with Scene.open(places[0]) as scene:
        scene.add_avatar("ball", BALL, 0.001)
        yield scene


def test_a_load_says_what_the_index_said(places: tuple[Path, np.ndarray, np.ndarray]) -> None:
    (fault,) = verify_archive(places[0]).faults
    assert "points from [" in fault and "the index says from [" in fault
    with Archive(places[0]) as archive:
        faults = 0
        for row in range(len(archive.voxels)):
            try:
                archive.read_voxel(row)
            except MisleadingIndexError as error:
                faults += 1
                assert archive.where(row) in str(error)
        assert faults == 1


QUESTIONS: dict[str, Callable[[Scene, np.ndarray], Any]] = {
    "collide": lambda scene, at: scene.collide("ball", poses_at(at)),
    "collide, one by one": lambda scene, at: [scene.collide("ball", pose[None]) for pose in poses_at(at)],
    "distance": lambda scene, at: scene.distance("ball", poses_at(at), 0.001),
    "contacts": lambda scene, at: scene.contacts("ball", poses_at(at)),
    "sweep": lambda scene, at: scene.sweep("ball", poses_at(at), poses_at(at + 1e-4)),
    "raycast": lambda scene, at: scene.raycast(at, np.tile([1.0, 0.0, 0.0], (len(at), 1)), 0.001),
    "within": lambda scene, at: scene.within(at, 0.001),
    "objects": lambda scene, at: scene.objects([("ball", pose) for pose in poses_at(at)]),
}


@pytest.mark.parametrize("name", QUESTIONS)
def test_no_pose_of_the_request_that_finds_the_index_wrong_is_clear(
    name: str, scene: Scene, places: tuple[Path, np.ndarray, np.ndarray]
) -> None:
    _, hidden, left = places
    assert len(hidden) > 3
    found = QUESTIONS[name](scene, np.concatenate([left, hidden]))
    verdicts = np.concatenate([one.verdict for one in found]) if isinstance(found, list) else found.verdict
    assert len(verdicts) == 1 + len(hidden) and (verdicts != Verdict.CLEAR).all()
    assert scene.residency.misled
    # And whatever is asked after.
    assert (scene.collide("ball", poses_at(hidden + 50.0)).verdict == Verdict.UNKNOWN).all()
    answers = scene.collide("ball", poses_at(hidden[:1]))
    assert answers.verdict[0] == Verdict.UNKNOWN
