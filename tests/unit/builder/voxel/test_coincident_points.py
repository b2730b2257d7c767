"""A heap is the cell that it would be of its points held at once, its columns in their order, and little is held."""

from pathlib import Path

import numpy as np
import pytest
import solidcloud.builder.build_limits as build_limits
from dense_voxels import KEY, assert_same, decoded, hashed, spooled
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.voxel import dense_record
from solidcloud.builder.voxel.dense_voxel import build_dense
from solidcloud.builder.voxel.voxel_octree import VoxelPoints, build_voxel

PLACE = (77, 5, 901)
BOTH = ("scan_index", "intensity")
DTYPE = np.dtype(
    [
        ("local", "<i4", (3,)),
        ("scan_index", "<u2"),
        ("intensity", "<f4"),
        ("rgb", "u1", (3,)),
        ("classification", "u1"),
    ]
)


def heap_of(count: int, *, scans: int = 1 << 16, names: tuple[str, ...] = BOTH) -> NDArray:
    """Rows of the spool of one place, of many different columns: of some values many, of others one."""
    rng = np.random.default_rng(8)
    rows = np.zeros(count, [("local", "<i4", (3,)), *((name, DTYPE[name]) for name in names)])
    rows["local"] = PLACE
    if "scan_index" in names:
        rows["scan_index"] = rng.integers(0, scans, count)
    if "intensity" in names:
        rows["intensity"] = rng.normal(0, 1e3, count).astype(np.float32)
        rows["intensity"][::3] = rng.choice(
            np.array([0, -1, 1e-40, np.inf, -np.inf, np.nan], np.float32), len(rows[::3])
        )
    for name in {"rgb", "classification"} & set(names):
        rows[name] = rng.choice(np.array([0, 1, 255], np.uint8), rows[name].shape)
    return rows


@pytest.mark.parametrize("classified", [True, False])
@pytest.mark.parametrize("names", [BOTH, ("scan_index",), ("intensity",), ()], ids=",".join)
def test_a_heap_of_many_pairs_is_the_voxel_built_at_once(
    names: tuple[str, ...], classified: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(build_limits, "DENSE_POINTS", 500)
    monkeypatch.setattr(dense_record, "WINDOW_POINTS", 70)
    heap = heap_of(5000, names=names)
    around = heap_of(300, names=names)
    around["local"] += np.random.default_rng(2).integers(-20, 20, (300, 3)).astype(np.int32) * [0, 0, 1]
    rows = np.random.default_rng(3).permutation(np.concatenate([heap, around]))
    config = BuildConfig(cell_points=60, leaf=8, degree=3)
    whole = VoxelPoints(
        rows["local"],
        rows["scan_index"] if "scan_index" in names else None,
        rows["intensity"] if "intensity" in names else None,
        hashed(rows["local"], range(0)) if classified else None,
    )
    asked, counted = [], 0

    def classify(local: NDArray[np.int32], codes: range, times: int) -> NDArray[np.uint8]:
        nonlocal counted
        asked.append(len(local))
        counted += times * len(local)
        return hashed(local, codes)

    spool = spooled(tmp_path / "spool", rows, 1000, [400, 410, 3000])
    built = build_dense(KEY, spool, config, bytes(16), tmp_path, classify if classified else None)
    found, expected = decoded(built, 1000), build_voxel(KEY, whole, 1000, config)
    if "intensity" in names:  # not equal where they are NaN
        assert found.intensity is not None and expected.intensity is not None
        assert found.intensity.tobytes() == expected.intensity.tobytes()
        found, expected = found._replace(intensity=None), expected._replace(intensity=None)
    assert_same(found, expected)
    assert counted == classified * len(rows)
    # The heap is asked once, by one point.
    assert max(asked, default=0) <= 500 and sum(asked) <= 1 + len(around)
