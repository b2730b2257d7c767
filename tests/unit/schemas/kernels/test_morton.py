"""Compare Morton codes with bits moved one by one."""

import numpy as np
import pytest
from solidcloud.schemas.kernels.morton import morton_code, morton_decode, morton_encode

pytestmark = pytest.mark.interpreted


def plain_code(x: int, y: int, z: int) -> int:
    """Bit b of axis a goes to bit 3 b + a."""
    return sum((v >> b & 1) << (3 * b + a) for a, v in enumerate((x, y, z)) for b in range(21))


def coordinates(count: int) -> np.ndarray:
    """Random coordinates, every single bit, and the extremes, (n, 3) uint64."""
    rng = np.random.default_rng(0)
    bits = np.concatenate([np.eye(3, dtype=np.int64) << b for b in range(21)])
    edges = np.array([[0, 0, 0], [2**21 - 1] * 3, [2**21 - 1, 0, 2**20]])
    return np.concatenate([rng.integers(0, 2**21, (count, 3)), bits, edges]).astype(np.uint64)


def test_codes_are_interleaved_bits() -> None:
    xyz = coordinates(200)
    expected = [plain_code(*row) for row in xyz.tolist()]
    assert morton_encode(xyz).tolist() == expected
    assert [int(morton_code(*row)) for row in xyz[:20]] == expected[:20]


def test_decoding_gives_the_coordinates_back() -> None:
    xyz = coordinates(200)
    assert np.array_equal(morton_decode(morton_encode(xyz)), xyz)


def test_no_points_have_no_codes() -> None:
    assert morton_encode(np.empty((0, 3), np.uint64)).shape == (0,)
    assert morton_decode(np.empty(0, np.uint64)).shape == (0, 3)
