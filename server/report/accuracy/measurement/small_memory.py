"""A walk at 5 m/s with a share of the scene in memory: exact, which waits for voxels, and by bounds."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from .....schemas.errors import BadRequestError
from .....schemas.wire.answers import Verdict
from ....scene import Scene
from ...common.paired_times import Floats
from .accuracy_results import WalkRow
from .cold_curve import along, bytes_read, drop_cache
from .measured_scene import AVATAR

SPEED, RATE = 5.0, 30.0  # [m/s], poses a second
FRAME = 1.0 / RATE


def walk_rows(
    archive: Path,
    avatar: Floats,
    walk: Floats,
    shares: tuple[float, ...],
    most: int,
    tick: Callable[[], None],
) -> list[WalkRow]:
    """Ask `collide` frame by frame along a walk (k, 4, 4), with shares of the decoded scene in memory.

    "exact": all memory is for voxels, and an answer waits until those in reach are loaded.
    "bounds": all memory is for the level of detail, and a pose that it does not settle is unknown: a
    motion would stop there. Each verdict is compared with that of a scene with enough memory.
    most: maximum number of frames.  tick: called after each row.
    """
    poses = along(walk, SPEED / RATE)[:most]
    with Scene.open(archive, level_bytes=0) as scene:
        scene.add_avatar(AVATAR, avatar)
        truly = scene.collide(AVATAR, poses).verdict
        decoded = scene.info().resident_bytes
    rows = []
    for share in shares:
        for kind in ("exact", "bounds"):
            rows.append(_walk(archive, avatar, poses, truly, WalkRow(share, int(decoded * share), kind)))
            tick()
    return rows


def _walk(archive: Path, avatar: Floats, poses: Floats, truly: np.ndarray, row: WalkRow) -> WalkRow:
    """Return the row of one walk, measured."""
    try:
        scene = Scene.open(
            archive,
            budget_bytes=row.memory_bytes,
            level_bytes=row.memory_bytes if row.kind == "bounds" else 0,
        )
    except BadRequestError:
        return row._replace(note="the largest voxel does not fit")
    with scene:
        with scene.archives[0].take() as opened:
            if row.kind == "bounds" and opened.level is None:
                return row._replace(note="the largest voxel of the level of detail does not fit")
        scene.add_avatar(AVATAR, avatar)
        drop_cache(archive)
        before, times, said = bytes_read(), [], []
        for pose in poses:
            begin = time.perf_counter()
            said.append(scene.collide(AVATAR, pose[None]).verdict[0])
            times.append(time.perf_counter() - begin)
        after = bytes_read()
    verdict, spent = np.array(said), np.array(times)
    clear = truly == Verdict.CLEAR
    return row._replace(
        frames=len(poses),
        stalls=int((spent > FRAME).sum()),
        longest_ms=float(spent.max()) * 1e3,
        median_ms=float(np.median(spent)) * 1e3,
        read_bytes=None if after is None or before is None else after - before,
        early=float((verdict[clear] != Verdict.CLEAR).mean()) if clear.any() else 0.0,
        false_clear=int(((verdict == Verdict.CLEAR) & ~clear).sum()),
    )
