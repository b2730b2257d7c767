"""Bounds of voxels: which boxes are settled, and which voxels are loaded to prove the index."""

from collections.abc import Iterator
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from solidcloud.server.archives.archive_generation import ArchiveGeneration
from solidcloud.server.kernels.core.voxels_in_reach import VoxelsInReach
from solidcloud.server.residency.index_proof import ProvedBounds
from solidcloud.server.residency.voxel_store import VoxelStore

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
        np.zeros(poses, np.int64), np.arange(poses + 1) * v, np.tile(np.arange(v), poses),
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
