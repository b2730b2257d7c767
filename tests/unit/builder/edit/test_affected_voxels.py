"""Which voxels are near others."""

import numpy as np
from archive_edits import built as built  # the fixtures
from archive_edits import files as files
from solidcloud.builder.edit.affected_voxels import within_reach


def test_within_reach_is_what_every_pair_says() -> None:
    rng = np.random.default_rng(1)
    low = rng.integers(-50, 50, (60, 3))
    held = np.stack([low, low + rng.integers(0, 20, (60, 3))], axis=1)
    low = rng.integers(-60, 60, (5, 3))
    boxes = np.stack([low, low + rng.integers(0, 20, (5, 3))], axis=1)
    for reach2, least in ((0, 0), (1, 0), (30, 1), (200, 2), (900, 5)):
        expected = [
            any(
                sum(max(0, int(a[0][k] - b[1][k]), int(b[0][k] - a[1][k])) ** 2 for k in range(3)) <= reach2
                for b in boxes
            )
            for a in held
        ]
        assert within_reach(held, boxes, reach2).tolist() == expected
        assert least <= sum(expected) < 50
    # Many blocks of many boxes each.
    low, at = rng.integers(-2500, 2500, (3000, 3)), rng.integers(-2500, 2500, (400, 3))
    held = np.stack([low, low + rng.integers(0, 300, (3000, 3))], axis=1)
    boxes = np.stack([at, at + rng.integers(0, 300, (400, 3))], axis=1)
    gaps = np.maximum(np.maximum(held[:, None, 0] - boxes[:, 1], boxes[:, 0] - held[:, None, 1]), 0)
    near = ((gaps**2).sum(axis=2) <= 100**2).any(axis=1)
    assert 500 < near.sum() < 2500
    assert np.array_equal(within_reach(held, boxes, 100**2), near)
    # Far apart, where squares of gaps would not fit 64 bits.
    far = np.array([[[1 << 40] * 3, [1 << 40] * 3]])
    assert within_reach(far, -far, 900).tolist() == [False]
