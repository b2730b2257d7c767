"""Queries that are stopped at any look at their stop flag: bounds hold, and nothing is clear unseen.

python stopped_midway.py ARCHIVE, with NUMBA_DISABLE_JIT=1: only interpreted kernels let a test count.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import archive_cases
import naive_distance
import numpy as np
from judged_distance import judge_collide, judge_distance
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars import avatar_model
from solidcloud.server.runtime.stop_flag import StopFlag
from solidcloud.server.scene import Scene

MARGIN, REACH, TOLERANCE = 0.01, 1.0, 0.02
# Stops of each query, spread evenly over its looks at the flag.
STOPS = 40


def scan_and_avatar() -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a scan (n, 3) and of an avatar."""
    rng = np.random.default_rng(34)
    return rng.uniform(0, 1, (300, 3)) * [1, 1, 0.1], rng.uniform(-0.1, 0.1, (60, 3))


class Looks:
    """Stands for `stopped` in all kernels: sets the flag at one of the looks at it.

    made: number of looks.  at: number of the look that sets `stop`; 0: none does.
    """

    def __init__(self) -> None:
        self.made, self.at, self.stop = 0, 0, StopFlag()

    def __call__(self, flag: Any) -> bool:
        if flag is self.stop.flag:  # the prediction of users looks at another
            self.made += 1
            if self.made == self.at:
                self.stop.set("")
        return bool(flag[0] != 0)


def stops(looks: Looks, ask: Callable[..., Any]) -> list[Any]:
    """Return the whole answer of a query, then those of its stops."""
    looks.made, looks.at, looks.stop = 0, 0, StopFlag()
    found, made = [ask(stop=looks.stop)], looks.made
    for at in np.unique(np.linspace(1, made, STOPS).astype(int)).tolist():
        looks.made, looks.at, looks.stop = 0, at, StopFlag()
        answer = ask(stop=looks.stop)
        assert answer.stopped == ""
        if looks.stop:  # rarely, voxels come in an order that takes two looks fewer
            found.append(answer)
    assert len(found) > min(made, STOPS) * 0.9
    return found


def check_cold(looks: Looks, archive: Path, points: Any, body: Any, poses: Any) -> int:
    """Stop queries with half of the voxels in memory and a level that is asked about the others.

    Compare with brute force. Return the number of distances that are bounded but not exact.
    """
    bounded, wide = 0, 0.1

    def ask(query: str, length: float, stop: StopFlag) -> Any:
        with Scene.open(archive) as scene, scene.residency.hold(range(0, scene.info().voxels, 2)):
            scene.add_avatar("body", body, 0.01)
            return getattr(scene, query)("body", poses, length, tolerance=wide, stop=stop)

    with Scene.open(archive) as scene:
        info = scene.info()
    judged = naive_distance.distance(
        points, info.origin, info.lattice_step, info.radius, body, 0.01, poses, 5.0
    )
    signed = np.array([np.inf if each is None else each.signed for each in judged])
    for found in stops(looks, lambda stop: ask("distance", REACH, stop)):
        judge_distance(found, np.where(signed <= REACH, signed, np.inf), REACH, wide, False)
        bounded += int((np.isfinite(found.upper) & ~found.exact).sum())
    for found in stops(looks, lambda stop: ask("collide", MARGIN, stop)):
        judge_collide(found, signed, MARGIN, wide, False)
    return bounded


def check_body(looks: Looks, scene: Scene, points: Any, body: Any, poses: Any) -> int:
    """Compare `distance` and `collide` with brute force. Return how many distances were known in part."""
    info, partial = scene.info(), 0
    scan = (points, info.origin, info.lattice_step, info.radius)
    judged = naive_distance.distance(*scan, body, 0.01, poses, 5.0)
    signed = np.array([np.inf if each is None else each.signed for each in judged])
    for found in stops(looks, lambda **o: scene.distance("body", poses, REACH, **o)):
        judge_distance(found, np.where(signed <= REACH, signed, np.inf), REACH, 0.0, False)
        trivial = -(0.01 + info.radius)
        partial += int((~found.exact & np.isfinite(found.upper) & (found.lower > trivial + 1e-3)).sum())
    for tolerance in (0.0, TOLERANCE):
        for found in stops(
            looks, lambda t=tolerance, **o: scene.collide("body", poses, MARGIN, tolerance=t, **o)
        ):
            assert (signed[found.verdict == Verdict.CLEAR] > MARGIN).all()
            assert (signed[found.verdict == Verdict.CONTACT] <= MARGIN + tolerance).all()
            if tolerance:
                judge_collide(found, signed, MARGIN, tolerance, False)
    return partial


def check_others(looks: Looks, scene: Scene, poses: Any) -> None:
    """Compare the other queries with their whole answers."""
    full, *cut = stops(looks, lambda **o: scene.contacts("body", poses, 5, MARGIN, **o))
    for found in cut:
        assert (found.pairs_found <= full.pairs_found).all()
        assert not full.pairs_found[found.verdict == Verdict.CLEAR].any()
        for column in ("pairs_found", "pair_starts", "cluster_starts"):
            said, whole = (getattr(each, column) for each in (found, full))
            said, whole = (np.diff(each) if column.endswith("starts") else each for each in (said, whole))
            assert (said == whole)[found.exact].all(), column
    full, *cut = stops(looks, lambda **o: scene.sweep("body", poses[:-1], poses[1:], **o))
    for found in cut:
        assert (found.lower <= full.upper).all() and (found.upper >= full.lower).all()
        assert (full.verdict[found.verdict == Verdict.CLEAR] == Verdict.CLEAR).all()
    at = poses[:, :3, 3].copy()
    down = np.tile([0.0, 0.0, -1.0], (len(at), 1))
    for ask in (lambda **o: scene.within(at, 2.0, **o), lambda **o: scene.raycast(at, down, 5.0, **o)):
        full, *cut = stops(looks, ask)
        for found in cut:
            assert (found.lower <= full.distance).all() and (found.upper >= full.distance).all()
            assert (full.verdict[found.verdict == Verdict.CLEAR] == Verdict.CLEAR).all()


def check(archive: Path) -> None:
    """Stop every query at some looks, with an avatar whose front is its leaf nodes, or nodes above them."""
    points, body = scan_and_avatar()
    poses = archive_cases.near_poses(np.random.default_rng(1), points, body, 8, 0.4)
    looks, partial = Looks(), 0
    for name, module in list(sys.modules.items()):
        if name.startswith("solidcloud.server.kernels") and hasattr(module, "stopped"):
            module.stopped = looks
    for front in (2, avatar_model.MAX_FRONT):
        with Scene.open(archive) as scene, mock.patch.object(avatar_model, "MAX_FRONT", front):
            with scene.residency.hold(range(scene.info().voxels)):
                pass
            scene.add_avatar("body", body, 0.01)
            partial += check_body(looks, scene, points, body, poses)
            if front > 2:
                check_others(looks, scene, poses)
    assert check_cold(looks, archive, points, body, poses)
    assert partial, "no distance was stopped midway with bounds from its stack"


if __name__ == "__main__":
    check(Path(sys.argv[1]))
