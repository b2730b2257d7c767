"""Test data of a chaos run: two generations of a generated façade, and requests with their true answers.

The true answers come from scenes in this process, of private copies of the archives, with caches
that hold them whole.
"""

import json
import os
import pickle
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.edit.edit_archive import add_scans
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.synthetic.figure import figure_points
from solidcloud.builder.synthetic.scenes import make_facade
from solidcloud.schemas.archive.index import INDEX_NAME
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.report.common.thinned_points import read_thinned
from solidcloud.server.scene import Scene

SCENE = "chaos"
VOXEL = 0.5  # small, so that a small cache loads all the time [m]
GENERATIONS = 2
AVATARS = {"figure": (figure_points(300, 2012, 1.75), 0.05), "ball": (np.zeros((1, 3)), 0.12)}
ROOM = 1 << 30
# The server's cache, as a share of all decoded voxels.
CACHE_SHARE = 0.25

Arrays = NDArray[np.float64]


class Request(NamedTuple):
    """One request of the pool. truths: the true answer of each generation."""

    op: str
    arguments: tuple[Any, ...]
    parameters: dict[str, Any]
    truths: tuple[Any, ...]


class Fixture(NamedTuple):
    """Folders of a run. live: what the server reads.  kept: an intact copy.  cache: of the server [bytes]."""

    live: Path
    kept: Path
    pool: Path
    cache: int

    def index(self, generation: int) -> Path:
        """Return the intact index of a generation."""
        return self.kept / f"index-{generation}.h5"

    def put(self, generation: int) -> None:
        """Replace the live folder's index by that of a generation. The folder has the shards of all."""
        beside = self.live.with_name("index.new")
        shutil.copyfile(self.index(generation), beside)
        os.replace(beside, self.live / INDEX_NAME)

    def mend(self) -> None:
        """Replace every shard of the live folder by an intact copy."""
        for path in sorted((self.kept / "shards").iterdir()):
            beside = self.live.with_name("shard.new")
            shutil.copyfile(path, beside)
            os.replace(beside, self.live / "shards" / path.name)

    def shards(self) -> list[Path]:
        """Return the live shards."""
        return sorted((self.live / "shards").iterdir())


def make_fixture(folder: Path, points: int, requests: int, seed: int) -> Fixture:
    """Build both generations, and compute the true answers of the pool for each."""
    rng = np.random.default_rng(seed)
    made = make_facade(folder / "facade.laz", points=points)
    config = BuildConfig(voxel=VOXEL, keep=frozenset(["scan"]))
    build_archive([folder / "facade.laz"], folder / "first", config)
    np.savetxt(folder / "wall.xyz", _wall(), fmt="%.3f")
    shutil.copytree(folder / "first", folder / "second")
    add_scans(folder / "second", [folder / "wall.xyz"])
    fixture = Fixture(folder / "live", folder / "kept", folder / "pool.pickle", 0)
    (fixture.kept / "shards").mkdir(parents=True)
    for generation, name in enumerate(("first", "second")):
        shutil.copyfile(folder / name / INDEX_NAME, fixture.index(generation))
        for shard in (folder / name / "shards").iterdir():
            shutil.copyfile(shard, fixture.kept / "shards" / shard.name)
    (fixture.live / "shards").mkdir(parents=True)
    fixture.mend()
    fixture.put(0)
    with (
        Scene.open(folder / "first", budget_bytes=ROOM) as one,
        Scene.open(folder / "second", budget_bytes=ROOM) as two,
    ):
        size = one.info().resident_bytes
        # A third of the requests concern the wall that only generation 1 has.
        scan = read_thinned([folder / "facade.laz"], points, 2000)
        places = np.concatenate([scan, rng.choice(_wall(), len(scan) // 2)])
        pool = make_pool((one, two), requests, places, rng)
    fixture.pool.write_bytes(pickle.dumps(pool))
    assert made.points == points
    return fixture._replace(cache=int(size * CACHE_SHARE))


def judge_claims(folder: Path) -> tuple[int, int]:
    """Return the number of frames reported clear with something unknown, and how many of them touch."""
    claims = [json.loads(line) for path in folder.glob("claims-*.jsonl") for line in whole_lines(path)]
    touching = []
    for name in ("first", "second"):
        with Scene.open(folder / name, budget_bytes=ROOM) as scene, with_avatars(scene):
            touching.append(
                [
                    scene.collide(claim["avatar"], np.array(claim["pose"])).verdict[0] == Verdict.CONTACT
                    for claim in claims
                ]
            )
    false = [
        all(touches[row] for generation, touches in enumerate(touching) if claim["served"] >> generation & 1)
        for row, claim in enumerate(claims)
    ]
    return len(claims), sum(false)


def whole_lines(path: Path) -> list[str]:
    """Return the lines of a file of JSON objects, without a last one that a kill cut off."""
    return [line for line in path.read_text().splitlines() if line.endswith("}")]


def _wall() -> Arrays:
    """Return the points of a wall in front of the façade, which only generation 1 has."""
    x, z = np.meshgrid(np.arange(-5.0, 5.0, 0.05), np.arange(0.0, 2.5, 0.05))
    return np.column_stack([x.ravel(), np.full(x.size, -2.0), z.ravel()])


@contextmanager
def with_avatars(scene: Any) -> Iterator[Any]:
    """Add the avatars to a scene, and yield it."""
    for name, (points, radius) in AVATARS.items():
        scene.add_avatar(name, points, radius)
    yield scene


def make_pool(
    scenes: tuple[Scene, ...], count: int, places: Arrays, rng: np.random.Generator
) -> list[Request]:
    """Return `count` requests near the places (n, 3), with the answer of each scene."""
    for scene in scenes:
        with with_avatars(scene):
            pass
    makers = list(_MAKERS)
    pool = []
    for number in range(count):
        op = makers[number % len(makers)]
        arguments, parameters = _MAKERS[op](rng, places)
        truths = tuple(ask(scene, op, arguments, parameters) for scene in scenes)
        pool.append(Request(op, arguments, parameters, truths))
    return pool


def ask(scene: Any, op: str, arguments: tuple[Any, ...], parameters: dict[str, Any]) -> Any:
    """Send one query to a scene or a client; join the parts of a path."""
    if op != "path":
        return getattr(scene, op)(*arguments, **parameters)
    from solidcloud.schemas.wire.path_messages import part_to_answers
    from solidcloud.schemas.wire.question_table import join_answers

    return join_answers([part_to_answers(part) for part in scene.path(*arguments, **parameters)])


def near(rng: np.random.Generator, places: Arrays, count: int) -> Arrays:
    """Return points (k, 3), most of them within decimetres of one of the places."""
    found: Arrays = rng.choice(places, count) + rng.normal(0.0, 0.3, (count, 3))
    return found


def poses_near(rng: np.random.Generator, places: Arrays, count: int) -> Arrays:
    """Return upright poses (k, 4, 4) near the places."""
    angle = rng.uniform(-np.pi, np.pi, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(angle)
    poses[:, 1, 0] = np.sin(angle)
    poses[:, 0, 1] = -poses[:, 1, 0]
    poses[:, :3, 3] = near(rng, places, count)
    return poses


def _moved(rng: np.random.Generator, poses: Arrays, far: float) -> Arrays:
    """Return the poses, each shifted by at most `far` [m]."""
    there = poses.copy()
    there[:, :3, 3] += rng.uniform(-far, far, (len(poses), 3)) * [1, 1, 0.1]
    return there


def _avatar(rng: np.random.Generator) -> str:
    return str(rng.choice(list(AVATARS)))


def _sweep(rng: np.random.Generator, places: Arrays) -> Any:
    poses = poses_near(rng, places, 3)
    return (_avatar(rng), poses, _moved(rng, poses, 1.0)), {}


def _move(rng: np.random.Generator, places: Arrays) -> Any:
    pose = poses_near(rng, places, 1)
    return (_avatar(rng), pose, _moved(rng, pose, 0.3)), {}


def _objects(rng: np.random.Generator, places: Arrays) -> Any:
    poses = poses_near(rng, places, 6)
    poses[3:, :3, 3] = poses[:3, :3, 3] + rng.uniform(-0.3, 0.3, (3, 3))
    return ([(_avatar(rng), pose, 1, 0xFFFFFFFF) for pose in poses],), {}


def _raycast(rng: np.random.Generator, places: Arrays) -> Any:
    return (near(rng, places, 12), rng.normal(size=(12, 3)), 12.0), {}


# Query -> function that makes its arguments and parameters.
_MAKERS: dict[str, Any] = {
    "collide": lambda rng, places: ((_avatar(rng), poses_near(rng, places, 12)), {"margin": 0.02}),
    "distance": lambda rng, places: ((_avatar(rng), poses_near(rng, places, 4), 0.6), {}),
    "contacts": lambda rng, places: (
        (_avatar(rng), poses_near(rng, places, 4)),
        {"margin": 0.05, "limit": 20},
    ),
    "sweep": _sweep,
    "raycast": _raycast,
    "within": lambda rng, places: ((near(rng, places, 12), 0.8), {}),
    "objects": _objects,
    "path": lambda rng, places: ((_avatar(rng), poses_near(rng, places, 60), "collide"), {}),
    "move": _move,
}
