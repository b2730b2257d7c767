"""Bytes a point, by packing some blocks of points as a build packs them."""

from pathlib import Path

import plan_kinds
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.plan import packed_sample
from solidcloud.builder.plan.build_plan import MEASURED_WITHIN
from solidcloud.builder.plan.scan_sample import plan_build

POINTS = 60_000
ONE = BuildConfig(jobs=1)


def archive_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in (folder / "index.h5", *(folder / "shards").iterdir()))


@pytest.mark.parametrize("kind", plan_kinds.KINDS)
def test_bytes_are_those_of_a_build_within_15_percent(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All points packed; some blocks, of scans read whole; some blocks, of scans read in part."""
    (folder := tmp_path / kind).mkdir()
    plan_kinds.KINDS[kind](folder, POINTS)
    build_archive([folder], tmp_path / "hall", ONE)
    found = archive_bytes(tmp_path / "hall")
    whole = plan_build([folder], ONE, tmp_path)
    assert whole.archive_bytes == pytest.approx(found, rel=0.05)
    assert whole.archive_within == MEASURED_WITHIN
    monkeypatch.setattr(packed_sample, "ALL_POINTS", 0)
    monkeypatch.setattr(packed_sample, "BLOCK_POINTS", 2500)
    blocks = plan_build([folder], ONE, tmp_path)
    assert blocks.archive_bytes == pytest.approx(found, rel=MEASURED_WITHIN - 1)
    assert blocks.voxels == whole.voxels
    monkeypatch.setattr(packed_sample, "_share", lambda *_: 0.5)
    part = plan_build([folder], ONE, tmp_path)
    assert any("of all were read" in line for line in part.assumed)
    assert 1 / 1.3 < part.archive_bytes / found < 1.3
