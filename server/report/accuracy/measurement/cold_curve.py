"""Wait and bytes of a question with nothing in memory, against the error allowed."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .....schemas.errors import BadDataError
from .....schemas.wire.answers import CollideAnswers, Verdict
from ....scene import Scene
from ...common.machine import drop_from_page_cache
from ...common.paired_times import Floats
from .accuracy_results import ColdRow
from .measured_scene import AVATAR, SEED

# Of address space, for voxels and level: memory that is not used costs nothing.
BUDGET = 16 << 30
RESAMPLED = 2000


# Asks a scene about a place (4, 4) within a tolerance [m]; all answers have verdicts and misses.
Query = Callable[[Scene, Floats, float], Any]


def collide_at(scene: Scene, pose: Floats, tolerance: float) -> CollideAnswers:
    """Ask whether the avatar touches the scene at a pose (4, 4)."""
    return scene.collide(AVATAR, pose[None], tolerance=tolerance)


def bytes_read() -> int | None:
    """Return the bytes that this process has read so far; None where the system does not count them."""
    try:
        lines = Path("/proc/self/io").read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    return next(int(line.split()[1]) for line in lines if line.startswith("rchar"))


def drop_cache(folder: Path) -> bool:
    """Drop the files of an archive from the system's cache; return whether this is possible."""
    return all([drop_from_page_cache(path) for path in folder.rglob("*.h5")])


def cold_curve(
    archive: Path,
    avatar: Floats,
    places: Floats,
    tolerances: tuple[float, ...],
    tick: Callable[[], None],
    query: Query = collide_at,
) -> list[ColdRow]:
    """Ask about one pose (k, 4, 4) at a time, of a scene that was opened just before.

    The system's cache of the files is dropped before each question, where the system can. The
    settings are asked in random order at each place: exact without the level of detail, exact with
    it, and each tolerance.
    tick: called after each place.  query: asks a scene about a place (4, 4) within a tolerance [m].
    """
    settings = (None, 0.0, *tolerances)
    rng = np.random.default_rng([SEED, 0xC0])
    for tolerance in settings:  # untimed: the first questions of a process may compile
        _ask(archive, avatar, places[0], tolerance, query)
    spent = np.zeros((len(places), len(settings), 3))
    for at, pose in enumerate(places):
        for number in rng.permutation(len(settings)):
            spent[at, number] = _ask(archive, avatar, pose, settings[number], query)
        tick()
    picks = rng.integers(0, len(places), (RESAMPLED, len(places)))
    counted = bytes_read() is not None
    rows = []
    for number, tolerance in enumerate(settings):
        read, wait, _ = spent[:, number].mean(axis=0).tolist()
        row = ColdRow(
            tolerance, wait * 1e3, *_share(spent[:, :, 1], number, picks), None, None, None, None, 0.0
        )
        if counted:
            ratio, low, high = _share(spent[:, :, 0], number, picks)
            row = row._replace(read_bytes=read, bytes_ratio=ratio, bytes_low=low, bytes_high=high)
        rows.append(row._replace(loaded=float((spent[:, number, 2] > 0).mean())))
    return rows


def _share(spent: Floats, number: int, picks: NDArray[np.int64]) -> tuple[float, float, float]:
    """Return a setting's total relative to that of the first setting, and its 95 % interval.

    spent: (places, settings).  picks: (times, places), resampled places.
    """
    first = spent[:, 0]
    some = spent[picks, number].sum(axis=1) / first[picks].sum(axis=1).clip(1e-12)
    low, high = np.quantile(some, [0.025, 0.975]).tolist()
    return float(spent[:, number].sum() / max(first.sum(), 1e-12)), low, high


def _ask(
    archive: Path, avatar: Floats, pose: Floats, tolerance: float | None, query: Query
) -> tuple[int, float, int]:
    """Ask about one pose with nothing in memory: bytes read, wait [s], voxels loaded."""
    level = 0 if tolerance is None else BUDGET // 16
    with Scene.open(archive, budget_bytes=BUDGET, level_bytes=level) as scene:
        scene.add_avatar(AVATAR, avatar)
        drop_cache(archive)
        before, begin = bytes_read() or 0, time.perf_counter()
        answers = query(scene, pose, tolerance or 0.0)
        taken = time.perf_counter() - begin
        if (answers.verdict == Verdict.UNKNOWN).any():
            raise BadDataError(
                "a pose is unknown, expected none: check the archive with `solidcloud validate`"
            )
        return (bytes_read() or 0) - before, taken, answers.misses


def along(poses: Floats, spacing: float) -> Floats:
    """Return the poses of a walk (k, 4, 4) that are about `spacing` metres apart along the way."""
    step = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(step)])
    at = np.searchsorted(way, np.arange(0.0, way[-1], spacing))
    return poses[np.minimum(at, len(poses) - 1)]


def can_drop() -> bool:
    """Return whether the system can drop its cache of a file."""
    return hasattr(os, "posix_fadvise")
