"""Coarse tops: what a slot holds, who gets one, and that what cannot be read, or was read before, changes nothing."""

import os
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import radius_class_archives
import synthetic_scans
from coarse_tops import ROOM, Made, build_scattered, open_made
from numpy.typing import NDArray
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.radius_model import LOCAL_CLASSES, RADIUS_CLASSES, class_radii
from solidcloud.schemas.errors import CorruptError
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.kernels.collide.coarse_clearance import MAX_SLOT_NODES
from solidcloud.server.kernels.core.scene_arrays import CLASS_SHIFT, COUNT, COUNTED, FIRST
from solidcloud.server.residency.coarse_bounds import SLOT_BYTES, CoarseBounds, drop_clear_pairs
from solidcloud.server.residency.voxel_store import VoxelStore

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"


@pytest.fixture(scope="module")
def scattered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build an archive of eight voxels."""
    return build_scattered(tmp_path_factory.mktemp("scattered"))


@pytest.fixture
def made(scattered: Path, tmp_path: Path) -> Made:
    """Open a copy of the archive, which the test may damage. Loaded and filled slots are the same."""
    return open_made(shutil.copytree(scattered, tmp_path / "archive"), boxes=False)


def enclosing(top: NDArray[np.int32], points: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which nodes (n,) of a top hold which points (p, 3) [voxel steps], both bounds: (p, n). Exact in float64."""
    words = top.view(np.float32).astype(np.float64)
    apart = points[:, None, :] - words[:, :3]
    along = (apart * words[:, 4:7]).sum(axis=2)
    in_slab = (along >= words[:, 8]) & (along <= words[:, 9])
    in_box = (np.abs(apart) <= words[:, 4:7]).all(axis=2)
    return ((apart**2).sum(axis=2) <= words[:, 3] ** 2) & np.where(words[:, 7] < 0, in_box, in_slab)


def damage(store: VoxelStore, row: int, dataset: int) -> None:
    """Turn a bit of a frame over, in the middle of it."""
    entry = store.archive.voxels[row]
    offset = int(entry["frame_offset"][dataset]) + int(entry["frame_bytes"][dataset]) // 2
    with open(store.archive.shard_path(int(entry["shard"])), "r+b") as file:
        byte = os.pread(file.fileno(), 1, offset)[0]
        os.pwrite(file.fileno(), bytes([byte ^ 0x10]), offset)


# --- what a slot holds ----------------------------------------------------------------------------------


@pytest.mark.interpreted
@pytest.mark.parametrize(
    ("kind", "voxel", "options"),
    [
        ("noise", 4.0, {"leaf": 2, "degree": 2, "cell_points": 16}),
        ("noise", 4.0, {"leaf": 1, "degree": 16, "cell_points": 4096}),
        ("plane", 2.0, {"resolution": 1e-6, "leaf": 3, "cell_points": 64}),
        ("one point", 0.5, {}),
        ("duplicates", 0.5, {"with_slab": False, "leaf": 1}),
    ],
)
def test_the_nodes_of_a_top_enclose_all_points(
    tmp_path: Path, kind: str, voxel: float, options: dict
) -> None:
    scan = synthetic_scans.make_scan(kind, 7, 300 if INTERPRETED else 700)
    made = open_made(archive_cases.build(tmp_path, scan, voxel=voxel, **options).archive)
    degree, leaves = options.get("degree", 16), made.store.archive.voxels["leaves"]
    for row in range(made.voxels):
        made.coarse.store_from_archive(made.store, row)
        top = made.top(row)
        points = voxel_points(*made.store.archive.read_voxel(row)).astype(np.int64)
        held = enclosing(top, points)
        assert held.any(axis=1).all()
        assert held.any(axis=0).all()  # no node is there in vain
        # All leaf nodes, or so many nodes that no inner one could be opened further, were it of the least degree.
        assert len(top) == leaves[row] or MAX_SLOT_NODES - degree + 1 < len(top) <= MAX_SLOT_NODES
        assert len(top) <= leaves[row]
        assert (top[:, FIRST] == -1).all() and not (top[:, COUNT] & COUNTED).any()


def test_the_widest_nodes_are_opened(tmp_path: Path) -> None:
    # A dense clump and a few points far apart: the clump is one node or a few, the others have one each.
    clump = np.random.default_rng(1).uniform(0.1, 0.101, (3000, 3))
    apart = np.stack(np.meshgrid(*[np.linspace(0.5, 3.9, 4)] * 3), axis=-1).reshape(-1, 3)
    scan = np.concatenate([clump, apart])
    made = open_made(
        archive_cases.build(tmp_path, scan, voxel=8.0, leaf=1, degree=2, cell_points=4096).archive
    )
    made.coarse.store_from_archive(made.store, 0)
    widest = made.top(0).view(np.float32)[:, 3].max()
    assert widest * 1e-4 < 0.01


@pytest.mark.interpreted
def test_filled_and_remembered_are_the_same_rows(made: Made) -> None:
    filled = CoarseBounds(made.voxels, ROOM)
    for row in range(made.voxels):
        filled.store_from_archive(made.store, row)
    for row in reversed(range(made.voxels)):  # other slots, other places in the arena
        made.remember(row)
        assert made.top(row).tolist() == made.top(row, filled).tolist()
    assert filled.stored == made.coarse.stored == made.voxels > 1
    sizes = made.coarse.arrays.count
    assert sizes.min() < MAX_SLOT_NODES - 3 < sizes.max()


@pytest.mark.interpreted
@pytest.mark.parametrize("voxel", [4.0, 1.0])
def test_no_point_has_a_larger_sphere_than_its_node_says(tmp_path: Path, voxel: float) -> None:
    with radius_class_archives.any_classes():
        case = archive_cases.build(
            tmp_path,
            synthetic_scans.make_scan("noise", 5, 300 if INTERPRETED else 900),
            voxel=voxel,
            leaf=2,
            degree=2,
            models=radius_class_archives.STORED,
        )
    made = open_made(case.archive, boxes=False)
    header, filled = made.store.archive.header, CoarseBounds(made.voxels, ROOM)
    tables = [class_radii(model, header.radius, header.models) for model in radius_class_archives.MODELS]
    for row in range(made.voxels):
        made.remember(row)
        filled.store_from_archive(made.store, row)
        top, plain = made.top(row), made.top(row, filled)
        data, links = made.store.archive.read_voxel(row)
        held = enclosing(top, voxel_points(data, links).astype(np.int64))
        assert data.radius_class is not None
        for table in (table for table in tables if len(table) > 1):
            radii = table[top[:, COUNT] >> CLASS_SHIFT & (RADIUS_CLASSES - 1)]
            # Nodes overlap, so it is some node that holds the point; another may hold it by chance.
            assert (np.where(held, radii, -1).max(axis=1) >= table[data.radius_class]).all()
            assert (radii <= table[LOCAL_CLASSES - 1]).all()
        assert (plain[:, COUNT] == (LOCAL_CLASSES - 1) << CLASS_SHIFT).all()
        plain[:, COUNT] = top[:, COUNT]
        assert plain.tolist() == top.tolist()
        assert len(np.unique(top[:, COUNT])) > 1


# --- who gets one ---------------------------------------------------------------------------------------


@pytest.mark.interpreted
def test_slots_go_to_those_who_come_first_and_stay_theirs(made: Made) -> None:
    table = 4 * made.voxels
    assert made.voxels > 3
    coarse = CoarseBounds(made.voxels, table + 3 * SLOT_BYTES - 1)
    assert coarse.bytes == table + 2 * SLOT_BYTES
    assert list(coarse.rows_without_bounds()) == list(range(made.voxels))
    for row in (3, 1):
        coarse.store_from_archive(made.store, row)
    before = [made.top(row, coarse).tolist() for row in (3, 1)]
    assert coarse.stored == 2 and list(coarse.rows_without_bounds()) == []
    for row in range(made.voxels):
        coarse.store_from_archive(made.store, row)
        coarse.store_from_arena(row, made.arena, made.loaded[row])
    assert np.flatnonzero(coarse.arrays.slot >= 0).tolist() == [1, 3]
    assert [made.top(row, coarse).tolist() for row in (3, 1)] == before


@pytest.mark.interpreted
@pytest.mark.parametrize("short", [0, 1, 40])
def test_a_budget_for_no_slot_is_none(made: Made, short: int) -> None:
    coarse = CoarseBounds(made.voxels, max(0, 4 * made.voxels + SLOT_BYTES - 1 - short * SLOT_BYTES))
    assert coarse.bytes == 0 and coarse.stored == 0
    assert list(coarse.rows_without_bounds()) == []
    coarse.store_from_archive(made.store, 0)
    coarse.store_from_arena(0, made.arena, made.loaded[0])
    avatar, poses = make_avatar([[0.0, 0, 0]], 0.01), np.eye(4)[None]
    reach = made.reach(avatar, poses, 1 << 26)
    found, settled = drop_clear_pairs(made.arrays, coarse.arrays, avatar.arrays, poses, reach)
    assert found is reach and settled == 0 and reach.starts[1] > 0


@pytest.mark.interpreted
def test_a_slot_that_is_taken_is_not_written_again(made: Made) -> None:
    made.coarse.store_from_archive(made.store, 0)
    before = made.coarse.arrays.ints.tobytes()
    made.coarse.store_from_arena(
        0, made.arena, made.loaded[1]
    )  # what another voxel's rows say must not get in
    assert made.coarse.arrays.ints.tobytes() == before and made.coarse.stored == 1


@pytest.mark.interpreted
def test_missing_names_each_once_while_they_are_filled(made: Made) -> None:
    made.remember(2)
    damage(made.store, 4, 1)
    named = []
    for row in made.coarse.rows_without_bounds():
        named.append(row)
        if row == 4:
            with pytest.raises(CorruptError):
                made.coarse.store_from_archive(made.store, row)
        else:
            made.coarse.store_from_archive(made.store, row)
    assert named == [row for row in range(made.voxels) if row != 2]
    assert list(made.coarse.rows_without_bounds()) == [4]
    assert made.coarse.stored == made.voxels - 1


# --- what cannot be read --------------------------------------------------------------------------------


@pytest.mark.interpreted
def test_points_are_not_read(made: Made, monkeypatch: pytest.MonkeyPatch) -> None:
    damage(made.store, 0, 2)
    asked: list[int] = []
    read = os.pread
    monkeypatch.setattr(os, "pread", lambda file, size, at: asked.append(at) or read(file, size, at))
    made.coarse.store_from_archive(made.store, 0)
    assert asked == made.store.archive.voxels["frame_offset"][0][:2].tolist()
    assert made.coarse.stored == 1
    with pytest.raises(CorruptError):
        made.store.load(0, made.arena, 0)


@pytest.mark.interpreted
@pytest.mark.parametrize("dataset", [0, 1])
def test_a_damaged_record_has_no_slot_and_takes_no_room(made: Made, dataset: int) -> None:
    coarse = CoarseBounds(made.voxels, 4 * made.voxels + SLOT_BYTES)
    damage(made.store, 1, dataset)
    for _ in range(2):
        with pytest.raises(CorruptError, match=("voxel .*, cells", "voxel .*, nodes")[dataset]) as caught:
            coarse.store_from_archive(made.store, 1)
    assert made.store.archive.where(1) in str(caught.value)
    assert coarse.stored == 0 and (coarse.arrays.slot == -1).all()
    damage(made.store, 1, dataset)  # the bit as it was
    coarse.store_from_archive(made.store, 1)
    assert made.top(1, coarse).tolist() == _remembered(made, 1)


def _remembered(made: Made, row: int) -> list:
    made.remember(row)
    return made.top(row).tolist()


def test_a_record_of_another_shape_than_the_index_says_has_no_slot(made: Made) -> None:
    made.store.archive.voxels["leaves"][1] += 1
    with pytest.raises(CorruptError, match=r"leaf nodes, the index says \d+"):
        made.coarse.store_from_archive(made.store, 1)
    made.store.archive.voxels["rows"][2][2] += 1
    with pytest.raises(CorruptError, match="points"):
        made.coarse.store_from_archive(made.store, 2)
    assert made.coarse.stored == 0


def test_a_disk_that_fails_is_an_error_and_may_be_tried_again(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> bytes:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patch:
        patch.setattr(os, "pread", fail)
        with pytest.raises(OSError, match="Input/output"):
            made.coarse.store_from_archive(made.store, 0)
    assert made.coarse.stored == 0
    made.coarse.store_from_archive(made.store, 0)
    assert made.coarse.stored == 1


# --- threads --------------------------------------------------------------------------------------------


@contextmanager
def running(jobs: list[threading.Thread]) -> Iterator[None]:
    """Threads that run while what is inside does, and are waited for."""
    for job in jobs:
        job.start()
    try:
        yield
    finally:
        for job in jobs:
            job.join(60.0)
        assert not any(job.is_alive() for job in jobs)


def test_readers_see_whole_slots_or_none(made: Made, rng: np.random.Generator) -> None:
    avatar = make_avatar(rng.uniform(-0.1, 0.1, (40, 3)), 0.01)
    poses = np.array(
        [archive_cases.pose_of(archive_cases.random_rotation(rng), at) for at in rng.uniform(0, 2, (60, 3))]
    )
    made.fill()
    everything, most = made.settled(avatar, poses)
    assert 0 < sum(map(len, most)) < sum(map(len, everything))
    rounds = [made._replace(coarse=CoarseBounds(made.voxels, ROOM)) for _ in range(20)]
    wrong: list[object] = []
    done = threading.Event()

    def read() -> None:
        """Whatever is known by now, it settles nothing that all of it does not; and at last as much."""
        settled: list[list[list[int]]] = []
        while not (done.is_set() and settled):
            finished = done.is_set()
            settled = [coarse.settled(avatar, poses)[1] for coarse in rounds]
            for gone in settled:
                if not all(set(some) <= set(all_rows) for some, all_rows in zip(gone, most, strict=True)):
                    wrong.append(gone)
            if finished and any(gone != most for gone in settled):
                wrong.append(settled)

    def write(number: int) -> None:
        order = np.random.default_rng(number).permutation(made.voxels).tolist()
        for coarse in rounds:
            for row in order:
                if number % 2:
                    coarse.coarse.store_from_archive(coarse.store, row)
                else:
                    coarse.remember(row)

    with running([threading.Thread(target=read) for _ in range(2)]):
        try:
            with running([threading.Thread(target=write, args=(number,)) for number in range(4)]):
                pass
        finally:
            done.set()
    assert wrong == []
    for coarse in rounds:
        assert coarse.coarse.stored == made.voxels
        assert sorted(coarse.coarse.arrays.slot.tolist()) == list(range(made.voxels))
        for row in range(made.voxels):
            assert coarse.top(row).tobytes() == made.top(row).tobytes()
