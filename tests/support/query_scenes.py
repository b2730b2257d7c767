"""Small fixed scenes, avatars and poses for tests of queries at the unit of the definition.

They are computed from integers, square roots and sums in a fixed order, and are therefore the same
bits on any machine.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import archive_cases
import numpy as np
from numpy.typing import NDArray
from solidcloud.server.avatars import avatar_model as avatar
from solidcloud.server.scene import Scene


def wall(count: int) -> NDArray[np.float64]:
    """Return points (count, 3) [m] of a floor, a wall and a bump.

    They lie on a lattice of 1/1024 m and are computed in integers.
    """
    i = np.arange(1, count + 1, dtype=np.int64)
    u, v = i * 7919 % 2039, i * 104729 % 2029
    steps = np.stack([u, v, i * i % 13], axis=1)
    steps[i % 3 == 0] = np.stack([i * 31 % 11, u, v], axis=1)[i % 3 == 0]
    steps[i % 7 == 0] = np.stack([u // 8 + 900, v // 8 + 700, (u * v) % 250], axis=1)[i % 7 == 0]
    return steps / 1024.0


def shell(count: int, radius: float) -> NDArray[np.float64]:
    """Return points (count, 3) [m] on a sphere elongated along z, no two at equal distance."""
    i = np.arange(1, count + 1, dtype=np.int64)
    whole = np.stack([i * 7919 % 2003 - 1001, i * 104729 % 1999 - 999, i * 1299709 % 1997 - 998], axis=1)
    own = whole.astype(np.float64)
    size = np.sqrt(own[:, 0] * own[:, 0] + own[:, 1] * own[:, 1] + own[:, 2] * own[:, 2])
    return own / size[:, None] * radius * np.array([1.0, 1.0, 1.5])


def turned(w: int, x: int, y: int, z: int) -> NDArray[np.float64]:
    """Return the rotation (3, 3) of a quaternion of integers."""
    n = float(w * w + x * x + y * y + z * z)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), w * w - x * x + y * y - z * z, 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), w * w - x * x - y * y + z * z],
    ]
    return np.array(rows) / n


def poses() -> NDArray[np.float64]:
    """Return poses (k, 4, 4) in, on, near and far from the scene of `wall`, one beside it."""
    places = [
        (3, 1, 0, 0, (0.5, 0.5, 0.3)), (5, 1, -2, 1, (1.25, 0.75, 0.3)), (1, 0, 0, 0, (1.0, 0.75, 0.55)),
        (2, 3, 1, -1, (0.22, 1.5, 0.9)), (7, 0, 2, 3, (1.7, 1.6, 0.345)), (4, -1, 1, 2, (1.0, 1.0, 0.9)),
        (1, 2, 3, 4, (1.2, 1.2, 0.1)), (9, 1, 1, 1, (-0.26, 1.0, 1.0)), (1, 1, 0, 0, (9.0, 9.0, 9.0)),
        (1, 3, 0, 1, (0.9, 0.7, 0.2)),
    ]  # fmt: skip
    return np.array([archive_cases.pose_of(turned(*q), np.array(at)) for *q, at in places])


def loose() -> NDArray[np.float64]:
    """Return points (k, 3) near and far from the scene."""
    i = np.arange(24)
    found = np.stack([(i * 37 % 23) / 10, (i * 17 % 29) / 12, (i * 7 % 11) / 9 - 0.1], axis=1)
    found[4] = wall(300)[40]
    return found


def scene_points(kind: str) -> NDArray[np.float64]:
    """Return the points of a scene."""
    return wall(300 if kind == "fine" else 500)


def build(folder: Path, kind: str) -> Path:
    """Build the archive of a kind, in an empty folder."""
    return archive_cases.build(
        folder, scene_points(kind), resolution=2.0**-10, radius=0.01, **KINDS[kind]
    ).archive


# Small cells and nodes in many voxels; a few large nodes in one voxel.
KINDS: dict[str, dict[str, Any]] = {
    "fine": {"voxel": 0.5, "leaf": 4, "degree": 3, "cell_points": 24},
    "flat": {"voxel": 4.0},
}
# Points and radius of two avatars: one is a single leaf node, the other a tree.
AVATARS = {"small": (shell(20, 0.25), 0.02), "deep": (shell(300, 0.3), 0.01)}


@contextmanager
def opened(archive: Path, question: str) -> Iterator[Scene]:
    """Open a scene and add the avatars.

    With a deadline, how much of a level is loaded by then depends on the clock: these questions have
    no level.
    """
    with Scene.open(archive, level_bytes=0 if "bounded" in question else None) as scene:
        # Like an avatar of 8,000 points and more, whose leaf nodes are too many for a front, "deep"
        # has a front of inner nodes.
        for name, most in (("small", avatar.MAX_FRONT), ("deep", 3)):
            with mock.patch.object(avatar, "MAX_FRONT", most):
                scene.add_avatar(name, *AVATARS[name])
        yield scene
