"""Test generated scenes: exact counts, the same points in every format, and no partial file."""

from pathlib import Path

import laspy
import numpy as np
import pye57
import pytest
from numpy.typing import NDArray
from solidcloud.builder.synthetic.scanner import LATTICE, NOISE
from solidcloud.builder.synthetic.scenes import GeneratedScene, make_facade, make_town
from solidcloud.builder.synthetic.truth import SceneTruth, read_truth
from solidcloud.schemas.runtime.new_file import is_temporary


def points_of(scene: GeneratedScene) -> NDArray[np.float64]:
    """All points of LAZ or LAS files, in the order of the files."""
    return np.concatenate([np.asarray(laspy.read(path).xyz) for path in scene.paths])


@pytest.fixture(scope="module")
def facade(
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[GeneratedScene, NDArray[np.float64], SceneTruth]:
    """The façade in 150,000 points, as one LAZ file."""
    scene = make_facade(tmp_path_factory.mktemp("facade") / "hall.laz", points=150_000)
    return scene, points_of(scene), read_truth(scene.truth)


@pytest.mark.parametrize("points", [1_000, 5_003])
def test_count_is_exact(tmp_path: Path, points: int) -> None:
    scene = make_facade(tmp_path / "hall.las", points=points)
    assert scene.points == len(points_of(scene)) == points


def test_truth_lies_beside_the_scan_and_reads_back(facade) -> None:
    scene, xyz, truth = facade
    assert scene.truth == scene.paths[0].with_name("hall.truth.json")
    assert truth.points == len(xyz) and truth.seed == 2012 and truth.noise == NOISE
    assert truth.facades[0].door("main").width == pytest.approx(1.60, abs=1e-12)
    assert sum(station.points for station in truth.stations) == len(xyz)


def test_same_seed_same_bytes_and_another_seed_others(tmp_path: Path) -> None:
    one, two = (make_facade(tmp_path / name, points=3_000, seed=5) for name in ("a.laz", "b.laz"))
    other = make_facade(tmp_path / "c.laz", points=3_000, seed=6)
    assert one.paths[0].read_bytes() == two.paths[0].read_bytes()
    assert one.truth.read_bytes() == two.truth.read_bytes()
    assert not np.array_equal(points_of(one), points_of(other))


def test_every_format_holds_the_same_points(tmp_path: Path) -> None:
    laz = points_of(make_facade(tmp_path / "hall.laz", points=5_000))
    las = points_of(make_facade(tmp_path / "plain.las", points=5_000))
    folder = make_facade(tmp_path / "stations", points=5_000)
    e57 = make_facade(tmp_path / "hall.e57", points=5_000)
    assert np.array_equal(laz, las)
    assert len(folder.paths) == 5 and np.array_equal(laz, points_of(folder))
    file = pye57.E57(str(e57.paths[0]))
    scans = [file.read_scan(k, ignore_missing_fields=True, transform=True) for k in range(file.scan_count)]
    posed = np.concatenate([np.column_stack([s[f"cartesian{axis}"] for axis in "XYZ"]) for s in scans])
    local = file.read_scan_raw(0)
    file.close()
    assert len(scans) == 5
    assert np.abs(posed - laz).max() < LATTICE / 50
    # Stored in the scanner's own frame: turned and moved.
    assert np.abs(local["cartesianX"] - laz[: len(local["cartesianX"]), 0]).max() > 1


@pytest.mark.parametrize("name", ["hall.laz", "hall.e57", "hall"])
def test_stopped_in_the_middle_leaves_nothing(tmp_path: Path, name: str) -> None:
    def stop(done: int, whole: int) -> None:
        assert all(is_temporary(path) for path in tmp_path.iterdir())
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_facade(tmp_path / name, points=2_000, progress=stop)
    assert list(tmp_path.iterdir()) == []


def test_town_has_its_count_and_every_facade_its_own_place(tmp_path: Path) -> None:
    town = make_town(tmp_path / "town", points=4_001)
    truth = read_truth(town.truth)
    assert town.points == len(points_of(town)) == 4_001
    assert len(truth.facades) == 2 and len(town.paths) == len(truth.stations) == 10
    assert truth.facades[0].seed != truth.facades[1].seed
    for station, path in zip(truth.stations, town.paths, strict=True):
        las = laspy.read(path)
        assert len(las.points) == station.points
        assert set(np.asarray(las.point_source_id)) == {station.number}
        origin = np.asarray(truth.facades[(station.number - 1) // 5].origin)
        spot = np.asarray(station.position) - origin
        assert abs(spot[0]) < 9 and -16 < spot[1] < 10
        assert abs(np.median(np.asarray(las.xyz)[:, 0]) - origin[0]) < 9
