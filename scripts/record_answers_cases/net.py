"""The net: scans, archives and scenes, all groups and sessions, and their comparison with a record."""

import os
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from plyfile import PlyData

from .plain_numbers import UNIT, Floats, make_avatars, turned
from .product import Item, Product, build, read_content, run
from .records import Answered, Recorded, answered, content_digest
from .requests import make_groups
from .sessions import AVATARS, BESIDE, Session, make_real_sessions, make_sessions

INPUTS = Path(__file__).resolve().parents[2] / "tests" / "golden" / "answers"
SCANS = os.environ.get("SOLIDCLOUD_SCANS", "")
REAL_SCAN = Path(SCANS or ".", "indoor_atrium.laz")
# Edge of a voxel [m]: each scan then has dozens of voxels.
VOXEL = 4.0
LARGE = 1 << 30
# Room for the largest voxel and a few others, decoded [bytes].
SMALL = {"facade": 250_000, "town": 50_000, "grid": 50_000, "pair": 350_000, "atrium": 1_500_000}
RADII = {"facade": "mean,local,border", "town": "mean,local", "grid": "0.03", "atrium": "mean,local,border"}
MODELS: dict[str, Sequence[str | None]] = {
    "facade": (None, "mean:1.5", "local", "border", "local+border", "local:0.7", "fixed:0.05"),
    "town": (None, "local", "local:1.3", "fixed:0.1"),
    "grid": (None, "fixed:0.0", "fixed:0.2"),
    "pair": (None, "local", "fixed:0.04"),
    "atrium": (None, "local", "border", "fixed:0.005"),
}
REQUESTS = 4000
# Every so many requests are repeated alone and in a small cache. A prime, because the kinds of
# requests repeat after 2, 3, 5 and 8.
STRIDE = 7
BATCH = 50


class Result(NamedTuple):
    """Answers of a group in one pass, beside their record.

    requests: how many were asked.  different: how many differ; all if the record has not these requests.
    fields: those that differ, if every request was asked.  examples: the first requests that differ.
    """

    scene: str
    passed: str
    group: str
    requests: int
    different: int
    fields: list[str]
    examples: list[str]
    answers: Answered


class Net:
    """Archives and scenes in a folder, and the answers about them.

    contents: digests of the content of the archives that were built, by name.
    loads: voxels loaded by scene and pass: in a small cache, some are loaded many times.
    """

    def __init__(self, folder: Path, recorded: Recorded, voxel: float = VOXEL) -> None:
        """Use an empty folder. recorded: what to compare with.  voxel: edge of the archives' voxels [m]."""
        self._folder, self._recorded, self._voxel = folder, recorded, voxel
        self._paths: dict[str, str] = {}
        self._points: dict[str, Floats] = {}
        self.contents: dict[str, str] = {}
        self.loads: Counter[tuple[str, str]] = Counter()
        with np.load(INPUTS / "inputs.npz") as inputs:
            self._walk, figure = inputs["walk"].astype(np.int64), inputs["figure"].astype(np.int64)
        self._avatars = make_avatars(figure)
        for name in AVATARS:
            self._paths[name] = str(write_points(folder / f"{name}.xyz", self._avatars[name].points))

    def build(self, name: str) -> None:
        """Build an archive and read its content."""
        scans = {"atrium": REAL_SCAN, "grid": self._folder / "grid-scans"}.get(name, INPUTS / name)
        if name == "grid":
            write_grid(scans)
        archive = self._folder / name
        build(scans, archive, self._voxel / (4 if name == "grid" else 1), RADII[name])
        content = read_content(archive)
        self._paths[name], self._points[name] = str(archive), content.lattice * content.step
        self.contents[name] = content_digest(content.lattice, *content.columns.values())

    def ask(self, scene: str) -> Iterator[Result]:
        """Yield the results of a scene's groups: in batches, then some requests alone and in a small cache."""
        points = self._pair() if scene == "pair" else self._points[scene]
        groups = make_groups(scene, points, self._avatars, MODELS[scene], REQUESTS)
        for passed, cache, every, batch in (
            ("batches", LARGE, 1, BATCH),
            ("single", LARGE, STRIDE, 1),
            ("small cache", SMALL[scene], STRIDE, BATCH),
        ):
            with ExitStack() as stack:
                product = Product(Path(self._paths[scene]), cache, stack)
                product.add_avatars(self._avatars)
                for group in groups:
                    asked = group.rows(every)
                    step = 1 if asked.size == group.size else every
                    yield self._compared(scene, passed, group.name, product.ask(asked, batch), step)
                self.loads[scene, passed] = product.loads()

    def sessions(self, real: bool) -> list[Session]:
        """Return the sessions in generated scans, or those in the real scan."""
        return make_real_sessions() if real else make_sessions(self._walk)

    def walk(self, session: Session) -> Result:
        """Return the frames of a session."""
        scene = "+".join(name for name, _ in session.archives)
        path = self._folder / f"{session.name.replace(' ', '-').replace(',', '')}.toml"
        path.write_text(session.scene_file(self._paths))
        with ExitStack() as stack:
            product = Product(path, SMALL[session.archives[0][0]] if session.small_cache else LARGE, stack)
            result = self._compared(scene, "session", session.name, product.walk(session), 1)
            self.loads[scene, "session"] += product.loads()
            return result

    def _pair(self) -> Floats:
        """Write the scene of two archives; return points of both, world [m]."""
        path = self._folder / "pair.toml"
        placed = "".join(
            f'[[archives]]\npath = "{self._paths[name]}"\npose = {pose.tolist()}\n'
            for name, pose in (("facade", np.eye(4)), ("town", BESIDE))
        )
        path.write_text(f"format = 1\n{placed}")
        self._paths["pair"] = str(path)
        moved = turned(BESIDE[:3, :3], self._points["town"]) + BESIDE[:3, 3]
        return np.concatenate([self._points["facade"], moved])

    def _compared(self, scene: str, passed: str, name: str, items: Iterator[Item], step: int) -> Result:
        """Return the result of a group. step: between its requests in the record."""
        recorded = self._recorded.groups.get(name)
        expected = [] if recorded is None else recorded.digests[::step].tolist()
        found = answered(items, expected)
        count = len(found.digests)
        if recorded is None or count != len(expected):
            return Result(scene, passed, name, count, count, ["not recorded"], [], found)
        different = int((found.digests != expected).sum())
        names = sorted({*found.fields, *recorded.fields}) if different and step == 1 else []
        fields = [each for each in names if found.fields.get(each) != recorded.fields.get(each)]
        examples = [
            f"{number * step}: was verdict {recorded.verdicts[number * step]}, "
            f"{float(recorded.numbers[number * step])!r}; is {plain(item)}"
            for number, item in found.items.items()
        ]
        return Result(scene, passed, name, count, different, fields, examples, found)


def plain(value: Any) -> Any:
    """Return a value with lists and numbers in the place of arrays, to be printed."""
    if isinstance(value, dict):
        return {name: plain(each) for name, each in value.items()}
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def write_points(path: Path, points: Floats) -> Path:
    """Write points (n, 3) [m] as text, exactly; return the path."""
    path.write_text("".join(f"{float(x)!r} {float(y)!r} {float(z)!r}\n" for x, y, z in points))
    return path


def write_grid(folder: Path) -> None:
    """Write two scans on a grid of 1/16 m, where ties abound: a floor, some of it twice, and two walls."""
    folder.mkdir()
    edge, half = np.arange(100) / 16 - 1, np.arange(40) / 16
    x, y = (each.ravel() for each in np.meshgrid(edge, edge, indexing="ij"))
    floor = np.stack([x, y, 0 * x], axis=1)
    write_points(folder / "floor.xyz", np.concatenate([floor, floor[::7]]))
    a, z = (each.ravel() for each in np.meshgrid(edge, half, indexing="ij"))
    walls = [np.stack([a, 0 * a + 5, z], axis=1), np.stack([0 * a + 5, a, z], axis=1)]
    write_points(folder / "walls.xyz", np.concatenate(walls))


def make_inputs() -> None:
    """Make the scans, the figure and the walk anew with this version's generators.

    They are stored because generated scans differ between processors: rays are cast in float32.
    """
    for name, count in (("facade", 100_000), ("town", 25_000)):
        shutil.rmtree(INPUTS / name, ignore_errors=True)
        run("make", name, "--points", str(count), "-o", INPUTS / name)
    truth = INPUTS / "facade.truth.json"
    figure, walk = INPUTS / "figure.ply", INPUTS / "walk.csv"
    run("make", "figure", "--points", "300", "-o", figure)
    run("make", "walk", truth, "-o", walk)
    vertices = PlyData.read(figure)["vertex"].data
    points = np.rint(np.stack([vertices[axis] for axis in "xyz"], axis=1) / UNIT).astype(np.int16)
    rows = np.loadtxt(walk, delimiter=",", skiprows=1)[::3]  # t, x, y, z, qw, qx, qy, qz
    steps = np.rint(rows[:, [1, 2, 3, 4, 7]] / UNIT).astype(np.int32)
    for path in (figure, walk, *INPUTS.glob("*.truth.json")):
        path.unlink()
    np.savez_compressed(INPUTS / "inputs.npz", figure=points, walk=steps)
