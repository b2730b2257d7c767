"""One case of the walk, and its reference verdicts: scipy's k-d tree and brute force, both in float64."""

import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

# float64 decides nothing nearer to tangency than this [m]; tests/support/naive.py does.
FLOAT64_BAND = 1e-6
SHOWN = 20


@dataclass(frozen=True)
class Case:
    """Input of every side.

    points: (n, 3) [m], relative to `origin`.
    origin: world [m].
    avatar: (m, 3) [m].
    poses: (k, 4, 4), avatar to world.
    distance: a pair of centres at most this far apart touches [m].
    """

    points: NDArray[np.float64]
    origin: NDArray[np.float64]
    avatar: NDArray[np.float64]
    poses: NDArray[np.float64]
    distance: float

    def float32_band(self) -> float:
        """Return the distance from tangency within which a float32 side may differ [m].

        A scan point, a translation and the two sums of a transform are each rounded to a part in
        2^24 per axis.
        """
        return 4 * 3**0.5 * float(np.abs(self.points).max()) * 2.0**-24

    def local_poses(self) -> NDArray[np.float64]:
        """Return the poses (k, 4, 4) from avatar to the frame of `points`."""
        local = self.poses.copy()
        local[:, :3, 3] -= self.origin
        return local

    def placed(self, i: int) -> NDArray[np.float64]:
        """Return the avatar's points (m, 3) under pose i, in the frame of `points`."""
        pose = self.poses[i]
        return self.avatar @ pose[:3, :3].T + (pose[:3, 3] - self.origin)


def scipy_pass(tree: cKDTree, case: Case) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return which poses (k,) touch, by the nearest points within reach, and the times (k,) [us]."""
    bound = np.nextafter(case.distance, np.inf)  # scipy's bound is exclusive, ours is not
    touching, spent = np.zeros(len(case.poses), bool), np.zeros(len(case.poses))
    for i in range(len(case.poses)):
        start = time.perf_counter()
        touching[i] = np.isfinite(tree.query(case.placed(i), distance_upper_bound=bound)[0]).any()
        spent[i] = (time.perf_counter() - start) * 1e6
    return touching, spent


def differences(
    ours: NDArray[np.bool_], theirs: NDArray[np.bool_], tree: cKDTree, case: Case
) -> dict[str, Any]:
    """Count the poses that differ, and return the first ones' distances from tangency [um]."""
    poses = np.flatnonzero(ours != theirs)
    gaps = [tree.query(case.placed(i))[0].min() - case.distance for i in poses[:SHOWN]]
    return {"poses": len(poses), "shown": _rows(poses, gaps)}


def spot_check(ours: NDArray[np.bool_], case: Case, count: int = 24) -> dict[str, Any]:
    """Test all pairs of points on `count` poses, half of them in contact, spread along the walk."""
    kinds = [kind for kind in (np.flatnonzero(ours), np.flatnonzero(~ours)) if len(kind)]
    chosen = np.unique(np.concatenate([k[np.linspace(0, len(k) - 1, count // 2).astype(int)] for k in kinds]))
    gaps = np.array([_brute_distance(case, i) - case.distance for i in chosen])
    wrong = (np.abs(gaps) > FLOAT64_BAND) & ((gaps <= 0) != ours[chosen])
    return {"checked": len(chosen), "poses": int(wrong.sum()), "shown": _rows(chosen[wrong], gaps[wrong])}


def _rows(poses: Iterable[int], gaps: Iterable[float]) -> list[dict[str, Any]]:
    """Return one row per differing pose; gap: least distance of centres minus the contact distance."""
    return [{"pose": int(i), "gap_um": float(gap) * 1e6} for i, gap in zip(poses, gaps, strict=False)]


def _brute_distance(case: Case, i: int) -> float:
    """Return the least distance of centres under pose i [m], over all pairs.

    The result is inf beyond a box around the avatar.
    """
    placed = case.placed(i)
    low, high = placed.min(axis=0) - 2 * case.distance, placed.max(axis=0) + 2 * case.distance
    near = case.points[((case.points >= low) & (case.points <= high)).all(axis=1)]
    if not len(near):
        return np.inf
    blocks = np.array_split(placed, -(-len(placed) * len(near) // 4_000_000))  # 100 MB at a time
    return float(np.sqrt(min(((block[:, None] - near) ** 2).sum(axis=2).min() for block in blocks)))
