"""Random integers, rotations, poses and avatars that are the same numbers on every machine.

Rotations are quotients of integers, and products of matrices are written out: the sums of a
library may be fused or reordered.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Unit of avatars and of the poses of walks, 2^-12 m: exact in float64, and so are sums of it.
UNIT = 2.0**-12
# Unit of the positions of random poses: exact, and finer than the integers of the definition (N5).
FINE = 2.0**-30


class Dice:
    """Random integers from PCG64's raw stream, which numpy guarantees to stay the same."""

    def __init__(self, *seed: int) -> None:
        """Start the stream of a seed."""
        self._stream = np.random.PCG64(seed)

    def integers(self, low: int, high: int, *shape: int) -> Integers:
        """Return integers of a shape, low <= value < high."""
        raw = self._stream.random_raw(int(np.prod(shape))) >> np.uint64(16)
        return (low + (raw % np.uint64(high - low)).astype(np.int64)).reshape(shape)


def rotations(quaternions: Integers) -> Floats:
    """Return the rotations (k, 3, 3) of integer quaternions (k, 4), of any length but 0."""
    w, x, y, z = quaternions.T
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return np.moveaxis(np.array(rows) / (w * w + x * x + y * y + z * z), -1, 0)


def turned(turns: Floats, points: Floats) -> Floats:
    """Return points (k, 3) or (3,) after rotations (k, 3, 3) or (3, 3)."""
    x, y, z = points[..., None, 0], points[..., None, 1], points[..., None, 2]
    return turns[..., 0] * x + turns[..., 1] * y + turns[..., 2] * z


def poses_of(turns: Floats, places: Floats) -> Floats:
    """Return poses (k, 4, 4) of rotations (k, 3, 3) and translations (k, 3)."""
    poses = np.zeros((len(places), 4, 4))
    poses[:, :3, :3], poses[:, :3, 3], poses[:, 3, 3] = turns, places, 1.0
    return poses


def upright(places: Floats, heading: tuple[int, int] = (1, 0)) -> Floats:
    """Return poses (k, 4, 4) at places (k, 3), turned about z.

    heading: integers (w, z) of the quaternion.
    """
    turn = rotations(np.array([[heading[0], 0, 0, heading[1]]]))
    return poses_of(np.repeat(turn, len(places), axis=0), places)


def along(corners: list[tuple[float, float, float]], step: float) -> Floats:
    """Return places (k, 3) along straight lines between corners, at most `step` [m] apart."""
    places = [np.array(corners[:1], float)]
    for begin, end in zip(np.array(corners[:-1], float), np.array(corners[1:], float), strict=True):
        way = end - begin
        count = max(1, int(np.ceil(np.sqrt((way * way).sum()) / step)))
        places.append(begin + way * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(places)


class Avatar(NamedTuple):
    """Avatar of spheres. points: (n, 3) [m].  radius: of all [m]."""

    points: Floats
    radius: float


def make_avatars(figure: Integers) -> dict[str, Avatar]:
    """Return the avatars by name. figure: (n, 3), points of a human figure [UNIT]."""
    ring = np.array([(250, 0), (217, 125), (125, 217)]) / 1000
    ring = np.concatenate([ring, ring[:, ::-1] * (-1, 1), -ring, ring[:, ::-1] * (1, -1)])
    heights = np.arange(70, 1700, 130) / 1000
    person = [(x, y, z) for z in heights for x, y in ring]
    person += [(x / 10, y / 10, z) for z in (heights[0], heights[-1]) for x in (-1, 0, 1) for y in (-1, 0, 1)]
    cube = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    shell = cube[np.abs(cube).max(axis=1) == 2] * 0.0625
    box = np.stack(np.meshgrid(*[np.arange(5)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) * 0.125
    return {
        "figure": Avatar(figure * UNIT, 0.03),
        "shell": Avatar(shell, 0.04),
        "rod": Avatar(np.arange(-8, 9)[:, None] * np.array([[0.125, 0.0, 0.0]]), 0.05),
        "dot": Avatar(np.zeros((1, 3)), 0.0),
        "person": Avatar(np.array(person), 0.07),
        "box": Avatar(box, 0.06),
    }
