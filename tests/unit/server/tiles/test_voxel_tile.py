"""Tiles: the points of a voxel, every so many of them, or the spheres of a level of its hierarchy."""

import shutil
from pathlib import Path

import archive_cases
import numpy as np
import pytest
from coloured_scans import Coloured, coloured, write_las
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.passes import level_pass
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import BadRequestError, CorruptError, TooLargeError
from solidcloud.schemas.wire.tile_messages import TileAnswer
from solidcloud.server.scene import Scene
from solidcloud.server.tiles import voxel_tile


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    """Points of a wavy floor in several voxels."""
    rng = np.random.default_rng(3)
    places = rng.uniform(-1.5, 1.5, (6000, 3))
    places[:, 2] = 0.2 * np.sin(3 * places[:, 0]) + rng.normal(0, 0.003, len(places))
    return archive_cases.build(tmp_path_factory.mktemp("tiles"), places, voxel=1.0, level=False)


@pytest.fixture(scope="module")
def leveled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Coloured]:
    """Coloured points with a level of detail, whose voxels are smaller than the archive's."""
    truth, folder = coloured(4, 30_000), tmp_path_factory.mktemp("level")
    scan = write_las(folder / "scan.las", truth)
    keep = frozenset({"rgb", "intensity", "classification"})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(level_pass, "LEVEL_VOXEL", 16)  # so that voxels are halved, as dense ones are
        build_archive([scan], folder / "archive", BuildConfig(voxel=1.0, resolution=1e-3, keep=keep, jobs=1))
    return folder / "archive", truth


def world(tile: TileAnswer) -> np.ndarray:
    """Return the places (n, 3) of a tile's points [m]."""
    pose = tile.pose[0]
    return tile.points * tile.step @ pose[:3, :3].T + pose[:3, 3]


def test_the_tiles_of_all_voxels_hold_all_points(case: archive_cases.Case) -> None:
    with Scene.open(case.archive) as scene:
        listed = scene.voxels((0, 0, 0))
        found = np.concatenate([world(scene.tile(0, voxel)) for voxel in listed.voxel])
        assert len(found) == scene.info().points == listed.points.sum()
        info = scene.info()
        lattice = [np.rint((each - info.origin) / info.lattice_step) for each in (found, case.points)]
        for one, other in zip(*(np.sort(each, axis=0).T for each in lattice), strict=True):
            np.testing.assert_array_equal(one, other)
        assert len(np.unique(lattice[0], axis=0)) == len(np.unique(lattice[1], axis=0))
        assert scene.residency.resident == 0, "tiles load nothing into memory"


@pytest.mark.parametrize("level", [0, 1, 2, 3, 50])
def test_spheres_of_a_level_enclose_the_points(case: archive_cases.Case, level: int) -> None:
    with Scene.open(case.archive) as scene:
        voxel = scene.voxels((0, 0, 0)).voxel[0]
        points, tile = world(scene.tile(0, voxel)), scene.tile(0, voxel, level=level)
        assert len(tile.spheres) == len(tile.points) and (level > 0 or len(tile.points) == 1)
        assert not len(tile.rgb) and not len(tile.intensity)
        apart = np.linalg.norm(points[:, None] - world(tile)[None], axis=2)
        assert (apart <= tile.spheres * tile.step + 1e-9).any(axis=1).all()
    with Archive(case.archive) as archive:
        row = int(np.flatnonzero((archive.coordinates == voxel).all(axis=1))[0])
        leaves = archive.read_voxel(row)[1].is_leaf.sum()
    assert level < 50 or len(tile.points) == leaves


def test_a_tile_that_does_not_exist_is_refused(case: archive_cases.Case) -> None:
    with Scene.open(case.archive) as scene:
        voxel = scene.voxels((0, 0, 0)).voxel[0]
        for wrong, message in (
            ((1, voxel), "archive 1"),
            ((0, (400, 0, 0)), "no points"),
            ((0, (1 << 30, 0, 0)), "expected within"),
            ((0, (0, 0)), "expected 3"),
        ):
            with pytest.raises(BadRequestError, match=message):
                scene.tile(*wrong)


def test_coarse_details_are_read_from_the_level(
    leveled: tuple[Path, Coloured], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, truth = leveled
    rows = zip(np.rint(truth.xyz * 1e3).astype(int).tolist(), truth.rgb.tolist(), truth.classes, strict=True)
    expected = {(*place, *rgb, int(kind)) for place, rgb, kind in rows}
    with Scene.open(folder) as scene, scene.archives[0].take() as opened:
        level = opened.level and opened.level.store.archive
        assert level is not None
        monkeypatch.setattr(opened.store.archive, "read_voxel", None)
        found, counts = set(), [0] * 6
        for voxel in scene.voxels((0, 0, 0)).voxel:
            before: set[tuple[int, ...]] | None = None
            for detail in (3, 4, 5):
                tile = scene.tile(0, voxel, detail)
                places = np.rint(world(tile) * 1e3).astype(int).tolist()
                assert len(tile.rgb) == len(tile.intensity) == len(tile.classification) == len(tile.points)
                assert not len(tile.scan) and not len(tile.spheres)
                own = {
                    (*place, *rgb, int(kind))
                    for place, rgb, kind in zip(places, tile.rgb.tolist(), tile.classification, strict=True)
                }
                assert own <= expected
                low = np.array(voxel) * 1000 + np.rint(np.array(scene.info().origin) * 1e3)
                assert ((places >= low) & (places < low + 1000)).all(), "in its voxel"
                assert before is None or own <= before, "of the finer detail"
                before = own
                counts[detail] += len(tile.points)
                found |= own if detail == 3 else set()
        assert counts[3] == pytest.approx(level.header.points / 2, abs=0.5 * len(level.voxels) + 9)
        assert counts[3] > counts[4] > counts[5] > 0
        monkeypatch.setattr(voxel_tile, "_MAX_LEVEL_POINTS", 3)
        with pytest.raises(TooLargeError, match="level of detail"):
            scene.tile(0, scene.voxels((0, 0, 0)).voxel[0], 3)


def test_tiles_evict_nothing(case: archive_cases.Case) -> None:
    with Scene.open(case.archive) as whole, whole.archives[0].take() as opened:
        budget = int(opened.store.sizes.max() * 1.2)
    with Scene.open(case.archive, budget_bytes=budget) as scene:
        scene.add_avatar("ball", [[0.0, 0.0, 0.0]], 0.1)
        scene.collide("ball", np.eye(4))
        held, stats = scene.residency.recent(), scene.stats()
        assert held
        for voxel in scene.voxels((0, 0, 0)).voxel:
            scene.tile(0, voxel, 2)
            scene.tile(0, voxel, level=3)
        scene.overview()
        after = scene.stats()
        assert scene.residency.recent() == held
        assert (after.hits, after.misses, after.evicted) == (stats.hits, stats.misses, stats.evicted)


def test_a_damaged_record_is_said_to_be_corrupt(case: archive_cases.Case, tmp_path: Path) -> None:
    shutil.copytree(case.archive, tmp_path / "copy")
    with Scene.open(tmp_path / "copy") as scene:
        voxel = scene.voxels((0, 0, 0)).voxel[0]
        with scene.archives[0].take() as opened:
            archive = opened.store.archive
            row = int(np.flatnonzero((archive.coordinates == voxel).all(axis=1))[0])
            entry, shard = archive.voxels[row], archive.shard_path(int(archive.voxels["shard"][row]))
        data = bytearray(shard.read_bytes())
        data[int(entry["frame_offset"][2]) + int(entry["frame_bytes"][2]) // 2] ^= 0xFF
        shard.write_bytes(data)
        with pytest.raises(CorruptError, match="voxel"):
            scene.tile(0, voxel)
        assert len(scene.tile(0, voxel, level=4).spheres), "its hierarchy is whole"


def test_tiles_of_a_placed_archive_are_in_the_world(case: archive_cases.Case, tmp_path: Path) -> None:
    file = tmp_path / "scene.toml"
    pose = [[0.0, -1.0, 0.0, 10.0], [1.0, 0.0, 0.0, 20.0], [0.0, 0.0, 1.0, 5.0], [0.0, 0.0, 0.0, 1.0]]
    file.write_text(f'format = 1\n[[archives]]\npath = "{case.archive}"\npose = {pose}\n')
    with Scene.open(file) as scene:
        listed = scene.voxels((10.0, 20.0, 5.0), reach=0.4)
        assert 0 < len(listed.voxel) < scene.info().voxels
        matrix = np.array(pose)
        moved = case.points @ matrix[:3, :3].T + matrix[:3, 3]
        for place in world(scene.tile(0, listed.voxel[0], 3)):
            assert np.linalg.norm(moved - place, axis=1).min() < 1e-3
