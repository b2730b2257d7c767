"""Bounds of voxels: which boxes are settled, and which voxels are loaded to prove the index."""

import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from solidcloud.server.archives.archive_generation import ArchiveGeneration
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.kernels.core.voxels_in_reach import VoxelsInReach
from solidcloud.server.queries.collide import collide
from solidcloud.server.queries.context import front_to_back as rounds
from solidcloud.server.queries.context.query_budget import make_budget
from solidcloud.server.residency.index_proof import ProvedBounds
from solidcloud.server.residency.voxel_store import VoxelStore
from solidcloud.server.runtime.stop_flag import StopFlag

pytestmark = pytest.mark.interpreted


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An archive of some dozens of voxels."""
    made = archive_cases.build(
        tmp_path_factory.mktemp("proof"), synthetic_scans.make_scan("noise", 3, 1000), voxel=0.9
    )
    return made.archive


@pytest.fixture
def opened(folder: Path) -> Iterator[ArchiveGeneration]:
    """The archive, nothing of it loaded."""
    opened = ArchiveGeneration(VoxelStore(folder), 1 << 24)
    yield opened
    opened.release()


def reach_of(bounds: ProvedBounds, poses: int, rng: np.random.Generator) -> VoxelsInReach:
    """Poses at random, each with every voxel in reach."""
    v = len(bounds.proved)
    center = rng.uniform(bounds.index.low.min(), bounds.index.high.max(), (poses, 1, 3))
    span = rng.uniform(1.0, 5000.0, (poses, 1, 1))
    return VoxelsInReach(
        np.ones(poses), np.zeros(poses, np.int64), np.arange(poses + 1) * v, np.tile(np.arange(v), poses),
        np.concatenate([center - span, center + span], axis=1), np.zeros(poses, bool),
    )  # fmt: skip


def test_rows_to_prove_are_those_the_index_hides(opened: ArchiveGeneration, rng: np.random.Generator) -> None:
    bounds = opened.data.bounds
    v = len(bounds.proved)
    before = bounds.unproved
    for row in range(0, v, 3):
        bounds.prove(row)
    for poses in (1, 3, 40):
        reach = reach_of(bounds, poses, rng)
        for unproved in (before, bounds.unproved):
            expected = set()
            for box in reach.boxes:
                center, span = box.mean(axis=0), (box[1, 0] - box[0, 0]) / 2
                low, high = bounds.index_boxes.low, bounds.index_boxes.high
                gap = np.maximum(np.maximum(low - center, center - high), 0.0)
                expected |= set(np.flatnonzero((gap * gap).sum(axis=1) > span * span).tolist())
            if unproved < before:
                expected -= set(range(0, v, 3))
            assert bounds.rows_to_prove(reach, unproved) == sorted(expected)
    assert bounds.rows_to_prove(reach, 0) == []


def test_rows_to_prove_of_many_poses_take_little_memory_and_look_at_the_stop(
    opened: ArchiveGeneration, rng: np.random.Generator
) -> None:
    bounds = opened.data.bounds
    reach = reach_of(bounds, 400_000 // len(bounds.proved), rng)
    tracemalloc.start()
    try:
        assert bounds.rows_to_prove(reach, bounds.unproved)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 16 << 20
    stop = StopFlag()
    stop.set("the client is gone")
    assert bounds.rows_to_prove(reach, bounds.unproved, stop) == []


def test_a_voxel_proved_meanwhile_is_not_settled(opened: ArchiveGeneration) -> None:
    bounds = opened.data.bounds
    rows = np.arange(5)
    assert bounds.unsettled(rows, bounds.unproved).all()
    bounds.prove(1)
    before = bounds.unproved
    bounds.prove(3)
    assert bounds.unsettled(rows, before).tolist() == [True, False, True, True, True]
    assert bounds.unsettled(rows, bounds.unproved).tolist() == [True, False, True, False, True]


def test_a_ray_begins_again_where_another_request_proves_a_voxel_meanwhile(
    opened: ArchiveGeneration, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The voxel's box may have been read half: by the time its proof is looked at, all are proved."""
    from solidcloud.server.queries.raycast import raycast

    lists, next_rows, listed = rounds._list, rounds._next_rows, 0

    def counted(*what: Any) -> Any:
        nonlocal listed
        listed += 1
        return lists(*what)

    def proving(data: Any, *what: Any) -> Any:
        rows = next_rows(data, *what)
        for row in rows.tolist():
            data.bounds.prove(row)
        return rows

    monkeypatch.setattr(rounds, "_list", counted)
    monkeypatch.setattr(rounds, "_next_rows", proving)
    header = opened.store.archive.header
    place = header.lattice.to_world((header.low + header.high) // 2)[None]
    raycast(opened.data, place, np.array([[1.0, 0.0, 0.0]]), 10.0)
    assert listed == 2


def test_what_the_index_has_in_reach_is_loaded_first_where_there_is_a_deadline(
    opened: ArchiveGeneration, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, loads = opened.data, list[int]()
    bounds, load = data.bounds, data.residency._store.load

    def noting(row: int, *what: Any) -> Any:
        loads.append(row)
        return load(row, *what)

    monkeypatch.setattr(data.residency._store, "load", noting)
    header = opened.store.archive.header
    avatar = make_avatar([[0.0, 0, 0]], 0.05)
    center = (bounds.index_boxes.low + bounds.index_boxes.high) // 2
    for row in range(len(center)):
        pose = np.eye(4)[None]
        pose[0, :3, 3] = header.lattice.to_world(bounds.index_boxes.low[row])
        from solidcloud.server.queries.context.query_context import check_request

        reach = check_request(data, avatar, pose, data.radius_units)
        doubted = bounds.rows_to_prove(reach, bounds.unproved)
        likely = sorted(set(reach.rows[: reach.starts[-1]].tolist()) - set(doubted))
        if doubted and likely:
            break
    else:
        raise AssertionError("no pose has both")
    collide(data, avatar, pose, 0.0, make_budget(budget_ms=1e6))
    assert loads == [*likely, *doubted]


def test_warming_compiles_what_a_proof_takes(
    opened: ArchiveGeneration, monkeypatch: pytest.MonkeyPatch
) -> None:
    from solidcloud.server.residency import index_proof as proof

    tightened, tighten = list[int](), proof.tighten

    def noting(tree: Any, row: int, *what: Any) -> None:
        tightened.append(row)
        tighten(tree, row, *what)

    monkeypatch.setattr(proof, "tighten", noting)
    opened.warm()
    assert tightened
