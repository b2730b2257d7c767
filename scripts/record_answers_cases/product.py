"""All contact with solidcloud: its command, its package, the fields of its answers.

A field of an answer that is not named here is not compared: costs, times, counts of voxels and
visits, bounds at a tolerance. A field that is named and missing ends the run.
"""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from plyfile import PlyData

from .plain_numbers import Avatar, Integers
from .requests import Group
from .sessions import Session

# By item; "pairs" and "clusters" name the rows that belong to each item, by their starts.
FIELDS = {
    "collide": ("verdict", "outside"),
    "distance": (
        "verdict", "signed_distance", "witness_avatar", "witness_cloud", "normal", "outside", "exact",
    ),
    "contacts": ("verdict", "pairs_found", "outside", "exact"),
    "sweep": ("verdict", "upper", "lower", "witness_avatar", "witness_cloud", "outside", "exact"),
    "raycast": ("verdict", "distance", "hit", "cloud_point", "normal", "outside"),
    "within": ("verdict", "distance", "cloud_point", "outside"),
}  # fmt: skip
LISTED = {
    "pair_starts": ("avatar_point", "cloud_point", "signed_distance", "avatar_index", "scan_index", "cluster"),
    "cluster_starts": (
        "cluster_count", "cluster_deepest", "cluster_avatar", "cluster_cloud", "cluster_scan", "cluster_low",
        "cluster_high",
    ),
}  # fmt: skip
OF_OBJECTS = ("verdict", "outside", "pairs", "pair_verdict")
OF_FRAMES = ("pose", "left", "verdict", "simulated", "stepped", "unknown")
OF_REPORTS = {
    "touched": ("place", "normal", "what", "unknown"),
    "ground": ("on_ground", "speed", "normal"),
    "proximity": ("distance", "avatar", "cloud", "normal", "unknown"),
    "contacts": ("total", "unknown", "clusters"),
    "clusters": ("count", "deepest", "avatar", "cloud"),
    "objects": ("poses", "touching"),
    "crowd": ("met",),
}

Item = dict[str, Any]


class Content(NamedTuple):
    """Points of an archive, in an order of their own: by place, then scan.

    lattice: (n, 3) int64, in steps from the world's origin.  step: [m].
    columns: the others by name: rank of the scan's file name, intensity.
    """

    lattice: Integers
    step: float
    columns: dict[str, np.ndarray]


def run(*arguments: str | Path) -> None:
    """Run the command `solidcloud` of this environment."""
    command = [str(Path(sys.executable).with_name("solidcloud")), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} ended with {done.returncode}: {done.stderr[-2000:]}")


def build(scans: Path, archive: Path, voxel: float, radius: str) -> None:
    """Build an archive with one job. voxel: [m].  radius: the models to store."""
    keep = "scan,intensity"
    run(
        "build",
        scans,
        "-o",
        archive,
        "--voxel",
        str(voxel),
        "--radius",
        radius,
        "--keep",
        keep,
        "--jobs",
        "1",
    )


def read_content(archive: Path) -> Content:
    """Return all points of an archive, from an exported file."""
    import solidcloud

    with solidcloud.open(archive) as scene:
        info = scene.info()
    exported = archive.with_suffix(".ply")
    run("export", archive, "-o", exported)
    vertices = PlyData.read(exported)["vertex"].data
    exported.unlink()
    step = info.lattice_step
    lattice = np.rint(np.stack([vertices[axis] for axis in "xyz"], axis=1) / step).astype(np.int64)
    # The numbers of scans need not follow the names of their files.
    names = [source.path for source in info.sources]
    columns = {"scan": np.array([sorted(names).index(name) for name in names])[vertices["scan"]]}
    if "intensity" in vertices.dtype.names:
        columns["intensity"] = vertices["intensity"].astype(np.float64)
    order = np.lexsort((*reversed(columns.values()), *lattice.T[::-1]))
    return Content(lattice[order], step, {name: values[order] for name, values in columns.items()})


class Product:
    """A scene, opened in this process, that answers groups of requests and walks of users."""

    def __init__(self, path: Path, cache_bytes: int, stack: ExitStack) -> None:
        """Open an archive or a scene file. cache_bytes: of decoded voxels."""
        import solidcloud

        self._scene = stack.enter_context(solidcloud.open(path, budget_bytes=cache_bytes))
        names = [source.path for source in self._scene.info().sources]
        self._scans = np.array([*(sorted(names).index(name) for name in names), -1])

    def add_avatars(self, avatars: dict[str, Avatar]) -> None:
        """Add avatars under their names."""
        for name, avatar in avatars.items():
            self._scene.add_avatar(name, avatar.points, avatar.radius)

    def loads(self) -> int:
        """Return how many voxels were loaded so far."""
        return int(self._scene.stats().misses)

    def ask(self, group: Group, batch: int) -> Iterator[Item]:
        """Yield the compared fields of the answer to each request of a group, `batch` requests a call."""
        options = dict(group.options)
        if group.method == "path":
            op = options.pop("op")
            for part in self._scene.path(group.avatar, group.arrays[0], op, **options):
                yield from self._items(op, part)
            return
        method, subject = getattr(self._scene, group.method), [group.avatar] if group.avatar else []
        if group.method == "objects":
            for poses in group.arrays[0]:
                # The last object is of another group, which does not touch the first two.
                bits = [(1, 0xFFFFFFFF)] * 2 + [(2, 0xFFFFFFFF)] * (len(poses) - 3) + [(4, 0xFFFFFFFE)]
                answer = method([(group.avatar, p, *b) for p, b in zip(poses, bits, strict=True)], **options)
                yield {name: getattr(answer, name) for name in OF_OBJECTS}
            return
        for first in range(0, group.size, batch):
            arrays = [np.ascontiguousarray(each[first : first + batch]) for each in group.arrays]
            yield from self._items(group.method, method(*subject, *arrays, **options))

    def _items(self, query: str, answer: Any) -> Iterator[Item]:
        """Yield the compared fields of each item of an answer."""
        columns = {name: getattr(answer, name) for name in FIELDS[query]}
        rows = {}
        if query == "contacts":
            for starts, names in LISTED.items():
                listed = {name: getattr(answer, name) for name in names}
                for name in ("scan_index", "cluster_scan"):
                    if name in listed:
                        listed[name] = self._scans[listed[name]]
                rows[starts] = getattr(answer, starts), listed
        for k in range(len(answer)):
            item = {name: column[k] for name, column in columns.items()}
            for starts, listed in rows.values():
                item |= {name: column[starts[k] : starts[k + 1]] for name, column in listed.items()}
            yield item

    def walk(self, session: Session) -> Iterator[Item]:
        """Yield the compared fields of each frame: of the users in turn, a command of each after another."""
        with ExitStack() as stack:
            users = [
                stack.enter_context(self._scene.session(user.avatar, client=f"user{number}"))
                for number, user in enumerate(session.users)
            ]
            for number in range(max(len(user.commands) for user in session.users)):
                for user, walking in zip(session.users, users, strict=True):
                    if number < len(user.commands):
                        command = user.commands[number]
                        state = walking.wait(walking.wish(**command, time=number / 30), timeout=60)
                        yield _frame(state)


def _frame(state: Any) -> Item:
    """Return the compared fields of a state."""
    found = {name: getattr(state, name) for name in OF_FRAMES}
    for name in ("touched", "ground", "proximity", "contacts", "objects", "crowd"):
        found[name] = _report(name, getattr(state, name))
    if (unsure := state.uncertainty) is not None:
        # The last digits of probabilities follow the machine's erf, the first six do not.
        scans = {name: round(value, 6) for name, value in unsure.scans.items()}
        found["uncertainty"] = round(unsure.probability, 6), scans, unsure.unknown
    return found


def _report(name: str, report: Any) -> Any:
    """Return the compared fields of a report, or of each report of a list; None without one."""
    if isinstance(report, list):
        return [_report(name, each) for each in report]
    if report is None:
        return None
    found = {field: getattr(report, field) for field in OF_REPORTS[name]}
    return {f: _report(f, value) if f in OF_REPORTS else value for f, value in found.items()}
