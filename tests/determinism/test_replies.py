"""Test that equal requests have equal reply bytes, on any number of threads."""

from collections import Counter
from pathlib import Path

import archive_cases
import mixed_requests
import numpy as np
import pytest
import synthetic_scans
from sample_sizes import sample
from solidcloud.schemas.archive.archive import Archive
from solidcloud.server.scene import Scene


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build an archive of many voxels and small trees, with points of several radii."""
    points = synthetic_scans.make_scan(*mixed_requests.SCAN)
    models = frozenset({"mean", "local", "border"})
    folder = tmp_path_factory.mktemp("mixed")
    return archive_cases.build(folder, points, voxel=0.3, leaf=8, cell_points=20, models=models).archive


@pytest.mark.case(
    25,
    "2,500 mixed requests on 1, 2 and 4 threads, with loads and evictions: the same reply bytes, except for costs",
)
@pytest.mark.timeout(900)  # the first run may have to compile everything
def test_threads_change_no_byte(archive: Path) -> None:
    count = sample(200, 2_500)
    asked = mixed_requests.requests(count)
    assert len(Counter(op for op, _ in asked)) == 8
    with Archive(archive) as opened, Scene.open(archive) as scene:
        whole = int(scene.residency.bytes_of(range(len(opened.voxels))))
    first = mixed_requests.checksums(archive, asked, 1, 1 << 26)
    assert len(first) == count
    told = [
        reply for reply, (op, _) in zip(first, asked[1:], strict=True) if op not in ("collide", "objects")
    ]
    assert len(set(told)) > len(told) * 0.8  # verdicts alone have few values
    for threads, budget in ((2, 1 << 26), (4, whole // 2)):
        found = mixed_requests.checksums(archive, asked, threads, budget)
        differ = np.flatnonzero(np.array(found) != first)
        assert not len(differ), (threads, budget, len(differ), asked[1 + int(differ[0])][0])
