"""Sessions in a made scene, simulated frame by frame, and what each frame touched."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.wire.motion_messages import State
from solidcloud.server.scene import Scene

from .made_shapes import SPACING, SPHERE, body, noisy

Floats = NDArray[np.float64]
Steering = Callable[[Floats, float], tuple[float, float]]

FRAME = 1 / 30
# What a frame touched: nothing, the scan, another user or an object; or the body fell in it.
CLEAR, SCAN, OTHER, FALL = range(4)
MOVER = ("stop", "sweep", "slide", "step", "ground")


class Walk(NamedTuple):
    """Frames of one user.

    places: (k + 1, 3), the middle of the body's base before and after each frame [m].
    touched: (k,), of each frame, one of CLEAR, SCAN, OTHER, FALL.
    objects: (k + 1, m, 3), origins of the scene's objects [m].
    """

    places: Floats
    touched: NDArray[np.int64]
    objects: Floats


class Ground(NamedTuple):
    """A scene of made scan points. points: (n, 3) [m]."""

    scene: Scene
    points: Floats

    def free_way(self, place: Floats, way: Sequence[float]) -> float:
        """Return how far the body can move from a place (3,) along a way (3,) without contact [m]."""
        begin, end = np.eye(4), np.eye(4)
        begin[:3, 3], end[:3, 3] = place, place + way
        return float(self.scene.sweep("visitor", begin, end).lower[0] * np.linalg.norm(way))

    def walk(
        self,
        start: Sequence[float],
        steering: Steering,
        seconds: float,
        objects: Mapping[str, Any] | None = None,
    ) -> Walk:
        """Simulate one user, alone. See `walks`."""
        return self.walks([start], [steering], seconds, objects)[0]

    def walks(
        self,
        starts: Sequence[Sequence[float]],
        steering: Sequence[Steering],
        seconds: float,
        objects: Mapping[str, Any] | None = None,
    ) -> list[Walk]:
        """Simulate users at the same time.

        starts: (x, y, z) of each.  steering: returns the horizontal velocity at a place and a time.
        objects: initial positions of the scene's objects, by name.
        """
        places = [[np.array(start, float)] for start in starts]
        touched: list[list[int]] = [[] for _ in starts]
        held = {name: np.array(at, float) for name, at in (objects or {}).items()}
        moved = [[np.array(list(held.values()))] for _ in starts]
        with ExitStack() as stack:
            sessions = [
                stack.enter_context(self.scene.session("visitor", client=f"user-{k}"))
                for k in range(len(starts))
            ]
            for session, start in zip(sessions, starts, strict=True):
                pose = np.eye(4)
                pose[:3, 3] = start
                session.wait(session.wish(pose=pose, time=0.0))
            for frame in range(round(seconds / FRAME)):
                for k, session in enumerate(sessions):
                    x, y = steering[k](places[k][-1], frame * FRAME)
                    state = session.wait(session.wish(velocity=(x, y, 0.0), time=(frame + 1) * FRAME))
                    places[k].append(state.pose[0, :3, 3].copy())
                    touched[k].append(_touched(state))
                    if state.objects is not None:
                        held |= {name: np.array(pose)[:3, 3] for name, pose in state.objects.poses.items()}
                    moved[k].append(np.array(list(held.values())))
        return [
            Walk(np.array(one), np.array(what), np.array(at))
            for one, what, at in zip(places, touched, moved, strict=True)
        ]


@contextmanager
def opened(
    folder: Path,
    points: Floats,
    options: Mapping[str, Mapping[str, Any]] | None = None,
    *,
    extra: Sequence[str] = (),
    objects: Sequence[Mapping[str, Any]] = (),
    shapes: Mapping[str, Floats] | None = None,
) -> Iterator[Ground]:
    """Build an archive of points (n, 3) in a new folder inside `folder`, and open it with the mover.

    options: fields of effects that differ from their defaults.  extra: further effects.
    objects: the tables of objects.  shapes: their avatars' centres of spheres, by name.
    """
    place = folder / str(sum(1 for _ in folder.iterdir()))
    place.mkdir()
    points = noisy(points, np.random.default_rng(5))
    np.savetxt(place / "scan.xyz", points, fmt="%.5f")
    build_archive(
        [place / "scan.xyz"],
        place / "archive",
        BuildConfig(voxel=8.0, resolution=1e-4, radius=SPACING / 2, jobs=1),
    )
    with entered(place, points, options, extra=extra, objects=objects, shapes=shapes) as scene:
        yield scene


@contextmanager
def entered(
    place: Path,
    points: Floats,
    options: Mapping[str, Mapping[str, Any]] | None = None,
    *,
    archive: str = "archive",
    extra: Sequence[str] = (),
    objects: Sequence[Mapping[str, Any]] = (),
    shapes: Mapping[str, Floats] | None = None,
) -> Iterator[Ground]:
    """Open the archive of a folder with the mover. points: (n, 3), of the archive; else as `opened`."""
    shapes = {"visitor": body(), **(shapes or {})}
    for name, centres in shapes.items():
        np.savetxt(place / f"{name}.xyz", centres, fmt="%.5f")
    file = {
        "format": 1,
        "archives": [{"path": archive}],
        "avatars": [{"name": name, "file": f"{name}.xyz", "radius": SPHERE} for name in shapes],
        "objects": [dict(each) for each in objects],
        "effects": [{"effect": name, **(options or {}).get(name, {})} for name in (*MOVER, *extra)],
    }
    (place / "scene.toml").write_text(tomli_w.dumps(file))
    with Scene.open(place / "scene.toml") as scene:
        yield Ground(scene, points)


def straight(x: float, y: float) -> Steering:
    """Return the steering of a constant velocity [m/s]."""
    return lambda _place, _time: (x, y)


def _touched(state: State) -> int:
    """Return what a frame touched."""
    if state.ground is not None and not state.ground.on_ground:
        return FALL
    pushed = state.objects is not None and state.objects.poses
    if pushed or any(each.what for each in state.touched):
        return OTHER
    return SCAN if state.touched else CLEAR
