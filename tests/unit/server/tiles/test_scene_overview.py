"""Overview: a sample of all points of a scene, from previews, else from some voxels."""

import shutil
from pathlib import Path

import archive_cases
import h5py
import numpy as np
import pytest
from scipy.spatial import cKDTree
from solidcloud.schemas.archive.vtkhdf import PREVIEW_NAME
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.wire.overview_messages import MAX_OVERVIEW_POINTS, OverviewAnswer
from solidcloud.server.scene import Scene
from solidcloud.server.tiles import scene_overview

COUNT, KEY = 30_000, bytes(range(32))


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    """Points in many voxels, all at different places of the lattice."""
    places = np.random.default_rng(8).uniform(-3, 3, (COUNT, 3))
    return archive_cases.build(tmp_path_factory.mktemp("overview"), places, voxel=1.0)


def copied(case: archive_cases.Case, folder: Path) -> Path:
    """Return a copy of an archive whose preview may be changed."""
    shutil.copytree(case.archive, folder / "copy")
    return folder / "copy"


def world(found: OverviewAnswer, number: int = 0) -> np.ndarray:
    """Return the points (n, 3) of one archive of an overview, world [m]."""
    begin, end = found.starts[number : number + 2]
    places = found.points[begin:end] + found.low[number]
    return places @ found.poses[number, :3, :3].T + found.poses[number, :3, 3]


def check_sampled(found: OverviewAnswer, points: np.ndarray) -> None:
    """Assert that an overview holds places of points (n, 3), each at most as often as they do."""
    distance, nearest = cKDTree(points).query(world(found))
    assert distance.max() < 4e-4, "lattice, rounding of the preview, float32"
    assert len(np.unique(nearest)) == len(nearest)


def test_an_overview_is_a_sample_of_the_preview(case: archive_cases.Case) -> None:
    with Scene.open(case.archive) as scene:
        found = scene.overview()
        assert found.previewed.tolist() == [True] and found.total == COUNT == found.archive_points[0]
        assert 0 < len(found.points) <= COUNT and found.starts.tolist() == [0, len(found.points)]
        check_sampled(found, case.points)
        info = scene.info()
        np.testing.assert_allclose(np.stack([found.low[0], found.high[0]]), info.bounds)
        assert found.archive_voxels[0] == info.voxels and found.archive_scans[0] == len(info.sources)
        for limit in (1, 7, 5000):
            fewer = scene.overview(limit)
            assert len(fewer.points) == limit
            check_sampled(fewer, case.points)
        assert scene.residency.resident == 0


@pytest.mark.parametrize("fault", ["missing", "cut", "stamp", "large", "deflate", "nan"])
def test_without_a_usable_preview_voxels_are_sampled(
    case: archive_cases.Case, tmp_path: Path, fault: str
) -> None:
    folder = copied(case, tmp_path)
    preview = folder / PREVIEW_NAME
    if fault == "missing":
        preview.unlink()
    elif fault == "cut":
        preview.write_bytes(preview.read_bytes()[:-5000])
    else:
        with h5py.File(preview, "r+") as file:
            points = file["VTKHDF/Points"]
            if fault == "stamp":
                file.attrs["generation"] = np.uint32(3)
            elif fault == "large":
                points.resize((1 << 30, 3))
            elif fault == "deflate":
                points.id.write_direct_chunk((0, 0), b"no deflated bytes")
            else:
                points[:] = np.nan
    with Scene.open(folder) as scene:
        found = scene.overview()
    assert found.previewed.tolist() == [False] and len(found.points) == COUNT
    check_sampled(found, case.points)


def test_voxels_are_sampled_up_to_a_number_of_points(
    case: archive_cases.Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scene_overview, "_READ_POINTS", 4000)
    folder = copied(case, tmp_path)
    (folder / PREVIEW_NAME).unlink()
    with Scene.open(folder) as scene:
        reads = 0
        with scene.archives[0].take() as opened:
            archive = opened.store.archive
        read, counts = archive.read_voxel, archive.voxels["rows"][:, 2]

        def counted(row: int):
            nonlocal reads
            reads += int(counts[row])
            return read(row)

        monkeypatch.setattr(archive, "read_voxel", counted)
        found = scene.overview()
    assert 2000 < len(found.points) <= reads <= 4000
    check_sampled(found, case.points)
    octants = (world(found) > 0) @ [1, 2, 4]
    assert (np.bincount(octants, minlength=8) > 0).sum() >= 6, "the voxels are spread"


def test_a_limit_out_of_range_is_refused(case: archive_cases.Case) -> None:
    with Scene.open(case.archive) as scene:
        for limit in (0, -1, MAX_OVERVIEW_POINTS + 1):
            with pytest.raises(BadRequestError, match="limit"):
                scene.overview(limit)
