"""`contacts`: what is listed and what a cluster is, what is missing, what is refused, and where it is stopped."""

import os
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from contact_cases import ScanCase, compare, open_case
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.errors import BadRequestError, BadTransformError, SolidcloudError, TooLargeError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.request_limits import MAX_CONTACTS
from solidcloud.server.archives.scene_info import describe
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries import contacts as contacts_module
from solidcloud.server.queries.contacts import contacts
from solidcloud.server.queries.query_inputs import make_scene_data
from solidcloud.server.residency.voxel_cache import VoxelCache
from solidcloud.server.residency.voxel_store import VoxelStore

CLEAR, CONTACT, UNKNOWN = Verdict


def at(*places: tuple[float, float, float]) -> NDArray[np.float64]:
    """Poses that move the avatar without turning it."""
    return np.array([archive_cases.pose_of(np.eye(3), np.array(place)) for place in places])


def row_of_points(count: int) -> NDArray[np.float64]:
    """Points (n, 3) 0.1 m apart along x."""
    return np.column_stack([np.arange(count) / 10, np.zeros((count, 2))])


@pytest.fixture(scope="module")
def row(tmp_path_factory: pytest.TempPathFactory) -> ScanCase:
    """40 points along x in four voxels, radius 0.01, on a lattice of 1 mm."""
    rng = np.random.default_rng(1)
    return open_case(
        tmp_path_factory.mktemp("row"), row_of_points(40), rng, scan_count=1, voxel=1.0, resolution=1e-3
    )


BALL = make_avatar([[0.0, 0, 0]], 0.04)
NOBODY = make_avatar(np.empty((0, 3)))


@pytest.mark.interpreted
def test_the_deepest_pairs_come_first_and_all_are_counted(row: ScanCase) -> None:
    poses = at((0.52, 0.0, 0.0), (9.0, 0, 0))
    answers = contacts(row.data, BALL, poses, 2, 0.2)
    assert answers.verdict.tolist() == [CONTACT, CLEAR] and answers.exact.all()
    # Within 0.04 + 0.01 + 0.2 of x = 0.52 lie 0.3, 0.4, 0.5, 0.6 and 0.7.
    assert answers.pairs_found.tolist() == [5, 0] and answers.pair_starts.tolist() == [0, 2, 2]
    assert np.allclose(answers.cloud_point[:, 0], [0.5, 0.6], atol=1e-12)
    assert np.allclose(answers.signed_distance, [0.02 - 0.05, 0.08 - 0.05], atol=3e-8)
    assert answers.avatar_index.tolist() == [0, 0] and answers.scan_index.tolist() == [0, 0]
    assert np.allclose(answers.avatar_point, [0.52, 0, 0], atol=1e-8)
    compare(row, np.zeros((1, 3)), 0.04, poses, 2, 0.2)


@pytest.mark.interpreted
def test_points_farther_apart_than_two_cells_are_two_clusters(row: ScanCase) -> None:
    """Two balls 1.2 m apart touch two and one points; a cluster distance that spans the gap makes one of them."""
    avatar = np.array([[0.55, 0.0, 0.0], [1.8, 0.0, 0.0]])
    answers = compare(row, avatar, 0.05, at((0, 0, 0)), 10, 0.0, 0.1)
    assert answers.cluster_count.tolist() == [1, 2] and answers.cluster.tolist() == [0, 1, 1]
    assert np.allclose(answers.cluster_low[:, 0], [1.8, 0.5]) and np.allclose(
        answers.cluster_high[:, 0], [1.8, 0.6]
    )
    assert compare(row, avatar, 0.05, at((0, 0, 0)), 10, 0.0, 1.2).cluster_count.tolist() == [3]
    # A cell a lattice step wide: every point is its own cluster.
    assert compare(row, avatar, 0.05, at((0, 0, 0)), 10, 0.0, 0.0).cluster_count.tolist() == [1, 1, 1]
    # 0.099 m is 99 steps: points 100 steps apart fall in cells that are neighbours, or else the next but one.
    compare(row, avatar, 0.05, at((0, 0, 0)), 0, 0.0, 0.099)
    nothing = compare(row, avatar, 0.05, at((0, 0, 0), (0, 5, 0)), 0)
    assert nothing.pairs_found.tolist() == [3, 0] and nothing.pair_starts.tolist() == [0, 0, 0]
    assert nothing.avatar_point.shape == (0, 3) and nothing.cluster_count.tolist() == [1, 2]


def two_scans(folder: Path, **options: Any) -> tuple[VoxelStore, list[str]]:
    """An archive of two scans, whose middle points coincide, and a third that cannot be read; the sources' names."""
    points = row_of_points(10)
    synthetic_scans.write_ply(folder / "left.ply", points[:6])
    synthetic_scans.write_ply(folder / "right.ply", points[4:])
    (folder / "a broken one.las").write_bytes(b"LASF" + bytes(300))
    config = BuildConfig(skip_bad=True, jobs=1, resolution=1e-3, radius=0.01, voxel=0.3, **options)
    build_archive(
        [folder / name for name in ("a broken one.las", "left.ply", "right.ply")], folder / "archive", config
    )
    store = VoxelStore(folder / "archive")
    return store, [Path(source.path).name for source in describe(store, "").sources]


def test_a_pair_names_the_scan_it_came_from(tmp_path: Path) -> None:
    store, names = two_scans(tmp_path, keep=frozenset({"scan", "intensity"}))
    assert sorted(names) == ["left.ply", "right.ply"]
    data = make_scene_data(store.archive, VoxelCache(store, 1 << 20))
    answers = contacts(data, BALL, at((0.1, 0, 0), (0.4, 0, 0), (0.9, 0, 0)))
    assert answers.pairs_found.tolist() == [1, 2, 1]
    left, right = names.index("left.ply"), names.index("right.ply")
    # Of two coincident points, that of the scan listed first in SceneInfo.sources.
    assert answers.scan_index.tolist() == [left, 0, 1, right]
    assert answers.cluster_scan.tolist() == [left, 0, right]


def test_without_keep_scan_there_is_no_scan_and_no_room_for_it(tmp_path: Path) -> None:
    sizes = []
    for keep in (frozenset[str](), frozenset({"scan"})):
        folder = tmp_path / f"{len(keep)}"
        folder.mkdir()
        store, _ = two_scans(folder, keep=keep)
        data = make_scene_data(store.archive, VoxelCache(store, 1 << 20))
        answers = contacts(data, BALL, at((0.4, 0, 0)))
        assert answers.scan_index.tolist() == ([0, 1] if keep else [-1, -1])
        assert answers.cluster_scan.tolist() == ([0] if keep else [-1])
        sizes.append(store.sizes)
    leaves = store.archive.voxels["leaves"]
    assert (sizes[1] - sizes[0] == 64 * leaves).all()


def flip_a_byte(store: VoxelStore, voxel: tuple[int, int, int]) -> None:
    """Damage the points of one voxel's record."""
    row = int(np.flatnonzero((store.archive.coordinates == voxel).all(axis=1))[0])
    entry = store.archive.voxels[row]
    with open(store.archive.shard_path(int(entry["shard"])), "r+b") as file:
        offset = int(entry["frame_offset"][2]) + int(entry["frame_bytes"][2]) // 2
        byte = os.pread(file.fileno(), 1, offset)[0]
        os.pwrite(file.fileno(), bytes([byte ^ 1]), offset)


@pytest.mark.interpreted
def test_a_voxel_that_cannot_be_read_is_not_exact(tmp_path: Path, rng: np.random.Generator) -> None:
    case = open_case(tmp_path, row_of_points(40), rng, voxel=1.0, resolution=1e-3)
    flip_a_byte(case.store, (1, 0, 0))
    answers = contacts(case.data, BALL, at((0.5, 0, 0), (0.96, 0, 0), (1.5, 0, 0), (9, 9, 9)), 9, 0.02)
    assert answers.verdict.tolist() == [CONTACT, CONTACT, UNKNOWN, CLEAR]
    assert answers.exact.tolist() == [True, False, False, True]
    assert answers.voxels_missing.tolist() == [0, 1, 1, 0] and len(answers.faults) == 1
    assert answers.pairs_found.tolist() == [1, 1, 0, 0]


@pytest.mark.interpreted
def test_where_a_scan_was_left_out_nothing_is_exact(row: ScanCase) -> None:
    """A region x >= 2 m is unknown; and then everywhere is."""
    region = np.array([[[2000.0, -9, -9], [9000, 9, 9]]])
    poses = at((0.5, 0, 0), (0.55, 0.1, 0), (2.1, 0, 0), (2.15, 0.04, 0))
    answers = contacts(row.data._replace(tree=row.data.tree._replace(unknown=region)), BALL, poses)
    assert answers.verdict.tolist() == [CONTACT, CLEAR, CONTACT, UNKNOWN]
    assert answers.exact.tolist() == [True, True, False, False]
    everywhere = row.data._replace(unknown_everywhere=True)
    assert contacts(everywhere, BALL, poses).verdict.tolist() == [CONTACT, UNKNOWN, CONTACT, UNKNOWN]
    nobody = contacts(everywhere, NOBODY, poses)
    assert nobody.verdict.tolist() == [CLEAR] * 4 and nobody.exact.all()


@pytest.mark.interpreted
@pytest.mark.parametrize("limit", [-1, MAX_CONTACTS + 1, 1.5, "9", None, True, np.float64(3), 1 << 70])
def test_a_limit_that_is_no_number_of_pairs_is_refused(row: ScanCase, limit: Any) -> None:
    for avatar in (BALL, NOBODY):
        with pytest.raises(BadRequestError, match="limit"):
            contacts(row.data, avatar, at((0, 0, 0)), limit)


@pytest.mark.interpreted
@pytest.mark.parametrize("length", [-1e-12, np.nan, np.inf, -np.inf, 1e300])
def test_lengths_that_are_none_are_refused(row: ScanCase, length: float) -> None:
    for avatar in (BALL, NOBODY):
        with pytest.raises(BadRequestError, match="margin"):
            contacts(row.data, avatar, at((0, 0, 0)), 1, length)
        with pytest.raises(BadRequestError, match="cluster_distance"):
            contacts(row.data, avatar, at((0, 0, 0)), 1, 0.0, length)


@pytest.mark.interpreted
@pytest.mark.parametrize(
    ("poses", "error"),
    [
        (np.eye(3), BadRequestError),
        (np.full((1, 4, 4), np.nan), BadRequestError),
        (np.diag([1.0, 1, 2, 1])[None], BadTransformError),
        (at((2e9, 0, 0)), BadTransformError),
    ],
)
def test_bad_poses_are_refused_as_by_every_question(
    row: ScanCase, poses: NDArray[np.float64], error: type[SolidcloudError]
) -> None:
    with pytest.raises(error):
        contacts(row.data, BALL, poses)
    with pytest.raises(BadRequestError, match="at most 16 m"):
        contacts(row.data, BALL, at((0, 0, 0)), 1, 16.1)
    with pytest.raises(TooLargeError, match="split it"):
        contacts(row.data, make_avatar([[0.0, 0, 0], [2e4, 0, 0]], 0.1), at((0, 0, 0)))


def test_more_than_a_request_may_list_is_refused_before_it_is_kept(
    row: ScanCase, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By pairs, and by clusters where no pair is listed; what is kept by then is what one pose adds."""
    kept = []
    room = contacts_module._check_room
    monkeypatch.setattr(contacts_module, "_check_room", lambda memory: kept.append(memory) or room(memory))
    monkeypatch.setattr(contacts_module, "MAX_BYTES", 100_000)
    poses = at(*((0.05 * i, 0.0, 0.0) for i in range(60))).repeat(20, axis=0)
    avatar = make_avatar(row_of_points(8), 0.06)
    for limit in (MAX_CONTACTS, 0):
        kept.clear()
        few = contacts(row.data, avatar, poses[:10], limit, 0.0, 0.0)
        assert few.pairs_found.all() and (np.diff(few.cluster_starts) > 1).all()
        with pytest.raises(TooLargeError, match="clusters listed"):
            contacts(row.data, avatar, poses, limit, 0.0, 0.0)
        assert kept[-1].pairs.nbytes + kept[-1].clusters.nbytes < 4 * 100_000
