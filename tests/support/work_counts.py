"""Queries about small fixed scenes: their answers, and the work done for them, as numbers to compare.

The work shows what no answer shows, such as bounds and the order of visits: node visits, pairs of
points tested, and the calls of every function of server/kernels, all interpreted. Scenes, avatars
and poses are computed from integers, square roots and sums in a fixed order. They are therefore
the same bits on any machine.
"""

import hashlib
import json
import os
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest import mock

import archive_cases
import numpy as np
from numpy.typing import NDArray
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.wire.arrays import array_fields
from solidcloud.server.avatars import avatar_model as avatar
from solidcloud.server.queries.context import query_budget as budget
from solidcloud.server.scene import Scene

GOLDEN = Path(__file__).parents[1] / "golden" / "work.json"
INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
# Functions of server/kernels that check the stop flag, or copy rows between two checks.
CHECKS = ("_stopped_interpreted", "should_end", "copy_rows")
COSTS = ("node_visits", "point_tests", "steps")

Answers = dict[str, Any]
Options = dict[str, Any]


# --- scenes, avatars, poses -----------------------------------------------------------------------------


def wall(count: int) -> NDArray[np.float64]:
    """Return points (count, 3) [m] of a floor, a wall and a bump.

    They lie on a lattice of 1/1024 m and are computed in integers.
    """
    i = np.arange(1, count + 1, dtype=np.int64)
    u, v = i * 7919 % 2039, i * 104729 % 2029
    steps = np.stack([u, v, i * i % 13], axis=1)
    steps[i % 3 == 0] = np.stack([i * 31 % 11, u, v], axis=1)[i % 3 == 0]
    steps[i % 7 == 0] = np.stack([u // 8 + 900, v // 8 + 700, (u * v) % 250], axis=1)[i % 7 == 0]
    return steps / 1024.0


def shell(count: int, radius: float) -> NDArray[np.float64]:
    """Return points (count, 3) [m] on a sphere elongated along z, no two at equal distance."""
    i = np.arange(1, count + 1, dtype=np.int64)
    whole = np.stack([i * 7919 % 2003 - 1001, i * 104729 % 1999 - 999, i * 1299709 % 1997 - 998], axis=1)
    own = whole.astype(np.float64)
    size = np.sqrt(own[:, 0] * own[:, 0] + own[:, 1] * own[:, 1] + own[:, 2] * own[:, 2])
    return own / size[:, None] * radius * np.array([1.0, 1.0, 1.5])


def turned(w: int, x: int, y: int, z: int, scale: float = 1.0) -> NDArray[np.float64]:
    """Return the rotation (3, 3) of a quaternion of integers."""
    n = float(w * w + x * x + y * y + z * z)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), w * w - x * x + y * y - z * z, 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), w * w - x * x - y * y + z * z],
    ]
    return np.array(rows) / n * scale


def poses() -> NDArray[np.float64]:
    """Return poses (k, 4, 4) in, on, near and far from the scene of `wall`, some scaled, one beside it."""
    places = [
        (3, 1, 0, 0, (0.5, 0.5, 0.3), 1.0), (5, 1, -2, 1, (1.25, 0.75, 0.3), 1.0), (1, 0, 0, 0, (1.0, 0.75, 0.55), 1.0),
        (2, 3, 1, -1, (0.22, 1.5, 0.9), 1.0), (7, 0, 2, 3, (1.7, 1.6, 0.345), 1.0), (4, -1, 1, 2, (1.0, 1.0, 0.9), 2.5),
        (1, 2, 3, 4, (1.2, 1.2, 0.1), 0.5), (9, 1, 1, 1, (-0.26, 1.0, 1.0), 1.0), (1, 1, 0, 0, (9.0, 9.0, 9.0), 1.0),
        (1, 3, 0, 1, (0.9, 0.7, 0.2), 0.75),
    ]  # fmt: skip
    return np.array([archive_cases.pose_of(turned(*q, s), np.array(at)) for *q, at, s in places])


def motions() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return first and last poses (k, 4, 4) of motions.

    They lead onto the floor, along it, through the wall and past it; some rest or rotate.
    """
    pairs = [
        ((1, 0, 0, 0, (1.5, 1.5, 1.5)), (3, 1, 0, 0, (1.4, 1.5, 0.1))),
        ((1, 0, 0, 0, (1.75, 0.3, 0.46)), (1, 0, 0, 1, (1.7, 1.8, 0.45))),
        ((2, 0, 1, 0, (0.8, 0.9, 1.0)), (2, 0, 1, 0, (-0.8, 1.0, 1.1))),
        ((1, 0, 0, 0, (3.0, 3.0, 3.0)), (1, 1, 0, 0, (3.0, 1.0, 3.0))),
        ((1, 0, 0, 0, (0.6, 0.6, 0.6)), (1, 0, 0, 0, (0.6, 0.6, 0.6))),
        ((1, 0, 0, 0, (1.2, 1.0, 0.42)), (1, 2, 0, 0, (1.2, 1.0, 0.42))),
    ]
    first, last = (
        np.array([archive_cases.pose_of(turned(*pair[end][:4]), np.array(pair[end][4])) for pair in pairs])
        for end in (0, 1)
    )
    return first, last


def rays() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return origins and directions (k, 3): at, along and past surfaces, and along an axis.

    One begins inside a sphere.
    """
    i = np.arange(30)
    origins = np.stack([1.0 + (i * 37 % 23) / 32, 0.25 + (i * 17 % 29) / 16, 0.25 + (i * 7 % 11) / 8], axis=1)
    # Of three rays, two point at a point or just past its sphere of 10 mm; the others run along an
    # axis and askew.
    directions = wall(300)[i * 9] + np.stack([i % 5, i * 3 % 5, i * 7 % 4], axis=1) / 512.0 - origins
    directions[2::3] = np.stack([i * 5 % 7 - 4, i * 3 % 5 - 2.0, -(i % 4) - 1.0], axis=1)[2::3]
    directions[8] = [0, 0, -1]
    origins[5] = wall(300)[5]
    size = np.sqrt(directions[:, 0] ** 2 + directions[:, 1] ** 2 + directions[:, 2] ** 2)
    return origins, directions / size[:, None]


def loose() -> NDArray[np.float64]:
    """Return points (k, 3) near and far from the scene."""
    i = np.arange(24)
    found = np.stack([(i * 37 % 23) / 10, (i * 17 % 29) / 12, (i * 7 % 11) / 9 - 0.1], axis=1)
    found[4] = wall(300)[40]
    return found


# --- questions ------------------------------------------------------------------------------------------


def scene_points(kind: str) -> NDArray[np.float64]:
    """Return the points of a scene."""
    return wall(300 if kind in ("fine", "broken") else 500)


def build(folder: Path, kind: str) -> Path:
    """Build the archive of a kind, in an empty folder."""
    archive = archive_cases.build(
        folder, scene_points(kind), resolution=2.0**-10, radius=0.01, **KINDS[kind]
    ).archive
    if kind == "broken":
        with Archive(archive) as opened_archive:
            entries = opened_archive.voxels[::3].copy()
            paths = [opened_archive.shard_path(int(entry["shard"])) for entry in entries]
        for entry, path in zip(entries, paths, strict=True):
            record = bytearray(path.read_bytes())
            record[int(entry["frame_offset"][2]) + int(entry["frame_bytes"][2]) // 2] ^= 1
            path.write_bytes(record)
    return archive


# Small cells and nodes in many voxels; a few large nodes in one voxel; spheres of several sizes; an
# archive in which every third record is damaged, so that its voxel is missing.
KINDS: dict[str, dict[str, Any]] = {
    "fine": {"voxel": 0.5, "leaf": 4, "degree": 3, "cell_points": 24},
    "flat": {"voxel": 4.0},
    "classed": {
        "voxel": 1.0,
        "leaf": 8,
        "cell_points": 100,
        "models": frozenset({"mean", "local", "border"}),
        "keep": frozenset({"scan"}),
    },
    "broken": {"voxel": 0.5},
}
OPTIONS: dict[str, Options] = {kind: {} for kind in KINDS} | {"classed": {"radius_model": "local+border"}}
# Points and radius of two avatars: one is a single leaf node, the other a tree.
AVATARS = {"small": (shell(20, 0.25), 0.02), "large": (shell(200, 0.25), 0.01)}
DEEP = (shell(300, 0.3), 0.01)


def about_objects(scene: Scene, options: Options) -> list[Any]:
    """Return the queries of objects against each other and the scene."""
    places, names = poses()[:7], ["small", "large", "small", "small", "large", "small", "large"]
    places[3:6, :3, 3] = [[0.9, 0.75, 0.35], [1.3, 0.9, 0.9], [1.3, 1.35, 0.9]]
    places[5, :3, :3] /= 2.5
    places[6, :3, 3] = [1.0, 0.875, 0.3]
    groups, masks = [1, 1, 2, 3, 1, 1, 1], [3, 1, 1, 3, 1, 2**31 + 1, 2**31 + 3]
    rows = list(zip(names, places, groups, masks, strict=True))
    return [scene.objects(rows, 0.05, **options)]


# Without any time, no voxel is loaded, and the bounds are those of the index.
BUDGETS = ((0.01, 20), (0.0, 2), (0.0, 7), (0.05, None))  # tolerance [m], visits
QUESTIONS: dict[str, Callable[[Scene, Options], list[Any]]] = {
    "collide": lambda s, o: [s.collide(a, poses(), m, **o) for a in AVATARS for m in (0.0, 0.04)],
    "collide one": lambda s, o: [s.collide("large", pose[None], **o) for pose in poses()[:5]],
    "collide within": lambda s, o: [
        s.collide(a, poses(), 0.01, tolerance=t, **o) for a in AVATARS for t in (0.003, 0.03, 0.3)
    ],
    "collide bounded": lambda s, o: [
        s.collide(a, poses(), 0.01, tolerance=t, budget_visits=b, **o)
        for a in AVATARS
        for t, b in ((0.02, 1 << 40), (0.0, 40), (0.005, 200))
    ],
    "collide deep": lambda s, o: [
        s.collide(a, poses()[:8], m, **o) for a in ("deep", "deepest") for m in (0.0, 0.04)
    ],
    "distance deep": lambda s, o: [s.distance(a, poses()[:8], 3.0, **o) for a in ("deep", "deepest")],
    "bounded deep": lambda s, o: [
        s.collide("deep", poses()[:6], 0.01, tolerance=0.001, budget_visits=1 << 40, **o),
        s.distance("deep", poses()[:6], 1.0, tolerance=0.001, budget_visits=400, **o),
    ],
    "contacts deep": lambda s, o: [s.contacts("deep", poses()[:7], 20, m, **o) for m in (0.0, 0.03)],
    "distance": lambda s, o: [s.distance(a, poses(), r, **o) for a in AVATARS for r in (0.1, 3.0)],
    "distance within": lambda s, o: [
        *(s.distance(a, poses(), 3.0, tolerance=t, **o) for a in AVATARS for t in (0.003, 0.1)),
        *(s.distance(a, poses(), 3.0, relative_tolerance=0.3, **o) for a in AVATARS),
    ],
    "distance bounded": lambda s, o: [
        s.distance("small", poses(), 3.0, budget_ms=0.0, **o),
        *(
            s.distance(a, poses(), 1.0, tolerance=t, budget_visits=b, **o)
            for a in AVATARS
            for t, b in ((0.02, 1 << 40), (0.0, 60), (0.005, 300))
        ),
    ],
    "contacts": lambda s, o: [
        s.contacts(a, poses(), limit, 0.01, **o) for a in AVATARS for limit in (5, 100)
    ],
    "sweep": lambda s, o: [s.sweep(a, *motions(), **o) for a in AVATARS],
    "sweep bounded": lambda s, o: [
        *(s.sweep("small", *motions(), 0.01, tolerance=1e-3, budget_visits=b, **o) for b in (30, 400)),
        s.sweep("small", *motions(), budget_ms=0.0, **o),
    ],
    "raycast": lambda s, o: [s.raycast(*rays(), r, **o) for r in (0.5, 8.0)],
    "raycast bounded": lambda s, o: [
        *(s.raycast(*rays(), 8.0, tolerance=t, budget_visits=b, **o) for t, b in BUDGETS),
        s.raycast(*rays(), 8.0, budget_ms=0.0, **o),
    ],
    "within": lambda s, o: [s.within(loose(), r, **o) for r in (0.05, 8.0)],
    "within bounded": lambda s, o: [
        *(s.within(loose(), 0.3, tolerance=t, budget_visits=b, **o) for t, b in BUDGETS),
        s.within(loose(), 8.0, budget_ms=0.0, **o),
    ],
    "objects": about_objects,
}


# --- what is kept ---------------------------------------------------------------------------------------


def told(answers: Any) -> tuple[Answers, Answers]:
    """Return the content of an answer as one digest per field, bit for bit, and its costs."""
    says, costs = {}, {}
    for name in array_fields(type(answers)):
        column = np.asarray(getattr(answers, name))
        if name in COSTS:
            costs[name] = column.tolist()
        else:
            # All NaNs count as equal.
            column = np.where(np.isnan(column), np.nan, column) if column.dtype.kind == "f" else column
            says[name] = hashlib.sha256(np.ascontiguousarray(column).tobytes()).hexdigest()[:12]
    return says, costs


@contextmanager
def counted_calls() -> Iterator[Counter[str]]:
    """Count the calls of functions of server/kernels within the block, as "file.function".

    Checks of the stop flag are not counted: they are no work, and there is one at nearly every
    node. Nor is how arrays are handed to kernels.
    """
    calls: Counter[str] = Counter()
    names: dict[Any, str] = {}

    def note(frame: Any, event: str, _: Any) -> None:
        if event == "call":
            code = frame.f_code
            if code not in names:
                path = Path(code.co_filename)
                own = ("server", "kernels") in pairwise(path.parts) and path.stem != "array_references"
                own &= code.co_name not in CHECKS
                names[code] = f"{path.stem}.{code.co_name}" if own else ""
            calls[names[code]] += 1

    sys.setprofile(note)
    try:
        yield calls
    finally:
        sys.setprofile(None)
        calls.pop("", None)


@contextmanager
def opened(archive: Path, question: str) -> Iterator[Scene]:
    """Open a scene and add the avatars.

    With a deadline, how much of a level is loaded by then depends on the clock: these questions have
    no level.
    """
    with Scene.open(archive, coarse_bytes=0 if "bounded" in question else None) as scene:
        # Loads that a query did not wait for would run beside the next query, and their calls might
        # be counted.
        scene.residency.on_owed = None
        for name, (points, radius) in AVATARS.items():
            scene.add_avatar(name, points, radius)
        # Like avatars of 8,000 points and more, whose leaf nodes are too many for a front: their
        # front consists of inner nodes, one level above the leaf nodes, and two.
        for name, most in (("deep", 3), ("deepest", 1)):
            with mock.patch.object(avatar, "MAX_FRONT", most):
                scene.add_avatar(name, *DEEP)
        yield scene


def measure(archive: Path, question: str, kind: str) -> Answers:
    """Return the answer and cost of a query of a newly opened scene; calls only when interpreted."""
    # Interpreted, finishing after a budget of no time takes longer than its grace period.
    with (
        mock.patch.object(budget, "GRACE", 3600.0),
        opened(archive, question) as scene,
        counted_calls() as calls,
    ):
        answers = QUESTIONS[question](scene, OPTIONS[kind])
    says, costs = zip(*map(told, answers), strict=True)
    return {
        "verdicts": [one.verdict.tolist() for one in answers],
        "answers": {name: [one[name] for one in says] for name in says[0]},
        "costs": {name: [one[name] for one in costs] for name in costs[0]},
        "calls": dict(sorted(calls.items())),
    }


def dumped(golden: Answers) -> str:
    """Return JSON with one line per field and function, so that a comparison shows each change."""
    lines = ["{"]
    for question, kinds in golden.items():
        for kind, kept in kinds.items():
            lines.append(f' "{question}, {kind}": {{')
            lines.append(f'  "verdicts": {json.dumps(kept["verdicts"])},')
            for part in ("answers", "costs", "calls"):
                rows = [f"   {json.dumps(name)}: {json.dumps(value)}" for name, value in kept[part].items()]
                lines += [f'  "{part}": {{', ",\n".join(rows), "  }" if part == "calls" else "  },"]
            lines.append(" },")
    lines[-1] = " }"
    return "\n".join([*lines, "}", ""])
