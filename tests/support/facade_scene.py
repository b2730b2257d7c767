"""The generated façade as a scene with effects, served over zenoh, and a user who walks in it."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.synthetic.scenes import make_facade
from solidcloud.builder.synthetic.truth import FacadeTruth, read_truth
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.motion_messages import Moved
from solidcloud.server.client import Client
from solidcloud.server.scene import Scene
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig

WALKING = ("stop", "sweep", "slide", "step", "ground")
FRAME = 1 / 30


def build_facade_archive(
    folder: Path, points: int, *, door: float = 1.6, models: tuple[str, ...] = ("mean",)
) -> tuple[Path, FacadeTruth]:
    """Build the archive of a façade of this many points; return it with its ground truth."""
    made = make_facade(folder / "facade.laz", points=points, door=door)
    build_archive([folder / "facade.laz"], folder / "facade", BuildConfig(jobs=1, models=frozenset(models)))
    return folder / "facade", read_truth(made.truth).facades[0]


def scene_text(archive: Path, effects: tuple[str, ...] = WALKING, **top: Any) -> str:
    """Return a scene file with these effects, with default options.

    top: other top-level keys, as TOML.
    """
    lines = ["format = 1", *(f"{key} = {value}" for key, value in top.items())]
    lines += ["", "[[archives]]", f"path = '{archive}'"]
    for effect in effects:
        lines += ["", "[[effects]]", f'effect = "{effect}"']
    return "\n".join(lines) + "\n"


def cylinder(
    width: float, height: float = 1.75, radius: float = 0.02, spacing: float = 0.03
) -> NDArray[np.float64]:
    """Return points of an upright cylinder on z = 0, of diameter `width` including its spheres [m]."""
    inner = width / 2 - radius
    around = np.linspace(0, 2 * np.pi, max(8, round(2 * np.pi * inner / spacing)), endpoint=False)
    heights = np.linspace(radius, height - radius, round(height / spacing))
    side = [
        np.column_stack([inner * np.cos(around), inner * np.sin(around), np.full(around.size, z)])
        for z in heights
    ]
    grid = np.arange(-inner, inner + 1e-9, spacing)
    x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
    inside = np.hypot(x, y) < inner - spacing / 2
    caps = [
        np.column_stack([x[inside], y[inside], np.full(inside.sum(), z)]) for z in (radius, height - radius)
    ]
    return np.concatenate(side + caps)


def standing(x: float, y: float, z: float, heading: float = 0.0) -> NDArray[np.float64]:
    """Return the pose (4, 4) of a standing body, rotated about z [rad]."""
    pose = np.eye(4)
    c, s = np.cos(heading), np.sin(heading)
    pose[:2, :2] = [[c, -s], [s, c]]
    pose[:3, 3] = x, y, z
    return pose


class Walker:
    """A user who sends one motion command at a time and waits for its result."""

    def __init__(self, session: Any) -> None:
        self.session, self.states = session, []

    def wish(self, **wish: Any) -> Moved:
        """Simulate one frame."""
        seq = self.session.wish(**wish)
        state = self.session.wait(seq, timeout=20.0)
        self.states.append(state)
        return state

    def to(self, start: NDArray[np.float64], end: NDArray[np.float64], speed: float = 1.5) -> Moved:
        """Move along the straight line between two poses of equal heading, one frame at a time."""
        way = end[:3, 3] - start[:3, 3]
        frames = max(1, int(np.ceil(np.linalg.norm(way) / (speed * FRAME))))
        for number in range(1, frames + 1):
            pose = start.copy()
            pose[:3, 3] += way * (number / frames)
            self.wish(pose=pose, time=(len(self.states) + 1) * FRAME)
        return self.states[-1]

    def go(self, velocity: tuple[float, float, float], seconds: float) -> Moved:
        """Move on at this velocity for this long."""
        for _ in range(round(seconds / FRAME)):
            self.wish(velocity=velocity, time=(len(self.states) + 1) * FRAME)
        return self.states[-1]

    @property
    def places(self) -> NDArray[np.float64]:
        """Return the position of the body after each frame (k, 3) [m]."""
        return np.array([state.pose[0, :3, 3] for state in self.states])


class Served(NamedTuple):
    """A served scene and a client of it."""

    client: Client

    @contextmanager
    def walking(self, name: str, start: NDArray[np.float64]) -> Iterator[Walker]:
        """Return a user whose body begins at `start`."""
        with self.client.session(name) as session:
            walker = Walker(session)
            walker.wish(pose=start, time=0.0)
            yield walker

    def assert_clear(self, name: str, walker: Walker, **options: Any) -> None:
        """Assert that no pose among the results is in contact."""
        poses = np.concatenate([state.pose for state in walker.states])
        verdicts = self.client.collide(name, poses, **options).verdict
        assert (verdicts == Verdict.CLEAR).all(), f"frames {np.flatnonzero(verdicts).tolist()}"


@contextmanager
def serving_scene(folder: Path, text: str) -> Iterator[Served]:
    """Serve a scene file with this text over zenoh on loopback."""
    (folder / "scene.toml").write_text(text)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
    with (
        Scene.open(folder / "scene.toml") as scene,
        serving([scene], ServerConfig(listen=endpoint)),
        Client(endpoint, scene=scene.name) as client,
    ):
        yield Served(client)
