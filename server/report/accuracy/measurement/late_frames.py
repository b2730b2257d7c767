"""Walks of session frames that do not wait for voxels, with a share of the scene in memory."""

import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .....schemas.runtime.new_file import new_file
from .....schemas.wire.answers import Verdict
from .....schemas.wire.motion_messages import FRAME_SECONDS
from ....scene import Scene
from ...common.paired_times import Floats
from .cold_curve import drop_cache
from .frame_curve import scene_text, towards
from .measured_scene import AVATAR

CONTINUOUS = ("stop", "sweep")
WALKING = (*CONTINUOUS, "slide", "step", "ground")


class FrameWalk(NamedTuple):
    """Frames along one walk.

    share: of the decoded scene in memory.  memory_bytes: the same.  level_only: whether all of it is for
    the level of detail; otherwise for voxels and level, by default.  late: of the session.
    effects: of the scene.  frames: number.
    slow: frames longer than FRAME_SECONDS.  longest_ms, median_ms: of a frame.
    longest_cpu_ms, median_cpu_ms: of the processor for a frame, which other programs delay less.
    stopped: share of the frames whose commanded motion ended at voxels not in memory.
    behind: farthest distance from the pose of the walk at that time [m].
    false_clear: frames whose pose touches the scan; with continuous motion alone, also those whose
    straight motion crosses it. After sliding, the way is not straight.
    """

    share: float
    memory_bytes: int
    level_only: bool
    late: str
    effects: str
    frames: int
    slow: int
    longest_ms: float
    median_ms: float
    longest_cpu_ms: float
    median_cpu_ms: float
    stopped: float
    behind: float
    false_clear: int


def late_walk(
    archive: Path,
    avatar: Floats,
    walk: Floats,
    share: float,
    *,
    level_only: bool,
    late: str,
    effects: tuple[str, ...],
    folder: Path,
) -> FrameWalk:
    """Move an avatar along the poses (k, 4, 4) of a walk, a frame each, in real time.

    A frame that is over early is followed by a pause until the next is due: the prefetcher's thread
    loads meanwhile. The files are dropped from the system's cache first.
    folder: receives the scene file.
    """
    text = scene_text(archive, 1e-5).split("[[effects]]")[0]
    target = folder / "late.toml"
    with new_file(target) as file:
        file.write((text + "".join(f'[[effects]]\neffect = "{each}"\n\n' for each in effects)).encode())
    with Scene.open(target, level_bytes=0) as judge:
        judge.add_avatar(AVATAR, avatar)
        judge.collide(AVATAR, walk)
        decoded = judge.info().resident_bytes
        memory = int(decoded * share)
        level = memory if level_only else None
        with Scene.open(target, budget_bytes=memory, policy="lru+prefetch", level_bytes=level) as scene:
            scene.add_avatar(AVATAR, avatar)
            scene.warm()  # as a server does
            drop_cache(archive)
            poses, times, used, stopped = _go(scene, walk, late)
        verdict = judge.collide(AVATAR, poses).verdict
        swept = judge.sweep(AVATAR, poses[:-1], poses[1:]).verdict
    crossed = verdict[1:] == Verdict.CONTACT
    if effects == CONTINUOUS:
        crossed |= swept == Verdict.CONTACT
    behind = float(np.linalg.norm(poses[1:, :3, 3] - walk[:, :3, 3], axis=1).max())
    return FrameWalk(
        share, memory, level_only, late, "+".join(effects), len(times), int((times > FRAME_SECONDS).sum()),
        float(times.max()) * 1e3, float(np.median(times)) * 1e3,
        float(used.max()) * 1e3, float(np.median(used)) * 1e3, float(stopped.mean()), behind,
        int((crossed & (verdict[:-1] == Verdict.CLEAR)).sum()),
    )  # fmt: skip


def _go(scene: Scene, walk: Floats, late: str) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the poses (k + 1, 4, 4), and of each frame (k,) its duration, its processor time [s], and
    whether it ended at voxels not in memory.
    """
    poses, times, used, stopped = [walk[0]], [], [], []
    with scene.session(AVATAR, late=late) as session:
        due = time.perf_counter()
        for at, target in enumerate(walk):
            begin, own = time.perf_counter(), time.thread_time()
            session.wish(pose=towards(poses[-1], target), time=at * FRAME_SECONDS)
            times.append(time.perf_counter() - begin)
            used.append(time.thread_time() - own)
            state = session.latest()
            assert state is not None
            poses.append(state.pose[0])
            stopped.append(state.unloaded > 0.0)
            due = max(due + FRAME_SECONDS, time.perf_counter())
            time.sleep(due - time.perf_counter() if due > time.perf_counter() else 0.0)
    return np.array(poses), np.array(times), np.array(used), np.array(stopped, float)


class FrameVisits(NamedTuple):
    """Cost of frames by the tolerance of their sweeps [m].

    visits: of nodes, a frame.  apart_mm: farthest distance from the place with the first tolerance.
    """

    tolerance: float
    frames: int
    visits: float
    apart_mm: float


def tolerance_visits(
    archive: Path, avatar: Floats, walk: Floats, tolerances: tuple[float, ...], folder: Path
) -> list[FrameVisits]:
    """Move an avatar along the poses (k, 4, 4) of a walk with each tolerance, all in memory.

    folder: receives scene files.
    """
    rows: list[FrameVisits] = []
    first = None
    for tolerance in tolerances:
        target = folder / f"tolerance-{tolerance:g}.toml"
        with new_file(target) as file:
            file.write(scene_text(archive, tolerance).encode())
        with Scene.open(target) as scene:
            scene.add_avatar(AVATAR, avatar)
            world = scene.simulation.world
            before, places, pose = world.visits, np.empty((len(walk), 3)), walk[0]
            with scene.session(AVATAR) as session:
                for at, wanted in enumerate(walk):
                    session.wish(pose=towards(pose, wanted), time=at * FRAME_SECONDS)
                    state = session.latest()
                    assert state is not None
                    pose = state.pose[0]
                    places[at] = pose[:3, 3]
            visits = (world.visits - before) / len(walk)
        first = places if first is None else first
        apart = float(np.linalg.norm(places - first, axis=1).max()) * 1e3
        rows.append(FrameVisits(tolerance, len(walk), visits, apart))
    return rows
