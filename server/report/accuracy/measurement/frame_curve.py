"""Time of a simulated frame against its tolerance, that of the effect `sweep`."""

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from .....schemas.runtime.new_file import new_file
from ....scene import Scene
from ...common.paired_times import Floats, mean_ratio
from .accuracy_results import REPEATS, FrameRow
from .cold_curve import along
from .measured_scene import AVATAR

PASSES, PAIRS = 2, 4
# Maximum distance of a motion command's target from the avatar [m]. Without it, an avatar that waits
# before an obstacle would have ever longer motions swept.
AHEAD = 0.25
SPACING, MOST = 1.4 / 30.0, 300  # of the targets: 1.4 m/s at 30 frames a second


def scene_text(archive: Path, tolerance: float) -> str:
    """Return a scene file with the effects of a walk, and this tolerance of `sweep` [m]."""
    path = str(archive.resolve()).replace("\\", "\\\\").replace('"', '\\"')
    effects = [f'effect = "sweep"\ntolerance = {tolerance!r}']
    effects += [f'effect = "{name}"' for name in ("stop", "slide", "step", "ground")]
    lines = "\n\n".join(f"[[effects]]\n{each}" for each in effects)
    return f'format = 1\n\n[[archives]]\npath = "{path}"\n\n{lines}\n'


def frame_rows(
    archive: Path,
    avatar: Floats,
    walk: Floats,
    contact: NDArray[np.bool_],
    tolerances: tuple[float, ...],
    folder: Path,
    tick: Callable[[], None],
) -> list[FrameRow]:
    """Move an avatar along a walk, frame by frame, with each tolerance of the effect `sweep`.

    walk: (k, 4, 4).  contact: (k,), poses that touch. The frames follow the longest part that does not.

    Pairs of walks, with the first tolerance and with another, are timed in turn. Times are those of
    the first tolerance, measured once, times the ratio of the pairs: a machine's speed changes between
    two rows.
    folder: receives scene files.  tick: called after each tolerance.
    """
    walk = along(walk[longest_run(~contact)], SPACING)[:MOST]
    rows: list[FrameRow] = []
    base: tuple[float, float] | None = None
    with ExitStack() as stack:
        first = stack.enter_context(_scene(archive, avatar, tolerances[0], folder))
        _go(first, walk)
        for tolerance in tolerances:
            with _scene(archive, avatar, tolerance, folder) as scene:
                _go(scene, walk)
                spent = [np.empty((PAIRS, 2)) for _ in range(PASSES)]
                frames = np.empty((2, PASSES * PAIRS, len(walk)))
                for number, pairs in enumerate(spent):
                    for at, pair in enumerate(pairs):
                        frames[0, number * PAIRS + at] = _go(first, walk)[0]
                        frames[1, number * PAIRS + at], places = _go(scene, walk)
                        pair[:] = frames[:, number * PAIRS + at].sum(axis=1)
                apart = _apart(first, scene, walk)
            passes = [mean_ratio(pairs[:, 1] / pairs[:, 0]) for pairs in spent]
            both = np.concatenate(spent)
            low, high = sorted(each.ratio for each in passes)
            ratio = mean_ratio(both[:, 1] / both[:, 0])
            best = np.median(frames, axis=1)
            p99 = np.quantile(best, 0.99, axis=1)
            base = base or (float(best[0].mean()) * 1e6, float(p99[0]) * 1e6)
            rows.append(
                FrameRow(
                    tolerance, base[0] * ratio.ratio, base[1] * float(p99[1] / p99[0]), *ratio, high <= REPEATS * low,
                    float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum()), apart,
                )
            )  # fmt: skip
            tick()
    return rows


def longest_run(wanted: NDArray[np.bool_]) -> slice:
    """Return the longest run of True in (k,); all if there is none."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], wanted, [False]])))
    if not len(edges):
        return slice(0, len(wanted))
    begin, end = edges[::2], edges[1::2]
    at = int(np.argmax(end - begin))
    return slice(int(begin[at]), int(end[at]))


def _scene(archive: Path, avatar: Floats, tolerance: float, folder: Path) -> Scene:
    """Return the open scene of a tolerance, with the avatar added."""
    target = folder / f"sweep-{tolerance:g}.toml"
    with new_file(target) as file:
        file.write(scene_text(archive, tolerance).encode())
    scene = Scene.open(target)
    scene.add_avatar(AVATAR, avatar)
    return scene


def _go(scene: Scene, walk: Floats) -> tuple[Floats, Floats]:
    """Return the duration of each frame (k,) [s], and the places (k, 3) reached [m]."""
    times, places = np.empty(len(walk)), np.empty((len(walk), 3))
    pose = walk[0]
    with scene.session(AVATAR) as session:
        for at, target in enumerate(walk):
            wish = towards(pose, target)
            begin = perf_counter()
            session.wish(pose=wish, time=at / 30.0)
            times[at] = perf_counter() - begin
            latest = session.latest()
            assert latest is not None
            pose = latest.pose[0]
            places[at] = pose[:3, 3]
    return times, places


def _apart(first: Scene, scene: Scene, walk: Floats) -> float:
    """Return how far a frame of a scene ends at most from the same frame of the first scene [mm]."""
    pose, most = walk[0].copy(), 0.0
    for target in walk:
        wish = towards(pose, target)
        other = scene.move(AVATAR, pose, wish).pose[0]
        pose = first.move(AVATAR, pose, wish).pose[0]
        most = max(most, float(np.linalg.norm(other[:3, 3] - pose[:3, 3])))
    return most * 1e3


def towards(pose: Floats, wish: Floats) -> Floats:
    """Return the target (4, 4) of a motion command, no farther than AHEAD from a pose (4, 4)."""
    way = wish[:3, 3] - pose[:3, 3]
    far = float(np.linalg.norm(way))
    if far <= AHEAD:
        return wish
    nearer = wish.copy()
    nearer[:3, 3] = pose[:3, 3] + way * (AHEAD / far)
    return nearer
