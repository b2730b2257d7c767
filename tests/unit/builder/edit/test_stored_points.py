"""Stored points spooled again: what is counted of them, and what is held meanwhile."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import solidcloud.builder.build_limits as build_limits
from dense_voxels import KEY, rows_of, spooled
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.edit import stored_points
from solidcloud.builder.edit.stored_points import CappedUnit, count_capped
from solidcloud.builder.passes.radius_classes import voxel_classes


def test_points_with_too_few_neighbours_are_counted_a_part_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a heap, too, more points of one place than a part may hold."""
    monkeypatch.setattr(build_limits, "DENSE_POINTS", 500)
    config = BuildConfig(models=frozenset({"mean", "local"}), cell_points=100)
    rng = np.random.default_rng(3)
    points = np.concatenate([np.full((2600, 3), 900), rng.integers(0, 300, (400, 3))]).astype(np.int32)
    spool = spooled(tmp_path / "spool", rows_of(points, "scan_index"), 1000, [700, 2000])
    expected = voxel_classes(KEY, points, config.models, spool, 1 << 16).capped
    assert 2600 <= expected < 3000
    held, gather = [], stored_points.gather_voxel

    def noted(parts: Any) -> Any:
        held.append(sum(map(len, parts)))
        return gather(parts)

    monkeypatch.setattr(stored_points, "gather_voxel", noted)
    assert count_capped(CappedUnit((KEY,), len(points), spool, config, 1 << 16)) == expected
    assert held and max(held) <= 500
