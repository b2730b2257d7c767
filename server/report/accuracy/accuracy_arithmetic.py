"""Measurement of the plain descent: arithmetic, bounding volumes, points as spheres or cubes."""

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.archive import Archive
from ....schemas.errors import InternalError
from ...avatars.avatar_model import make_avatar
from ..kernels.plain_descent import SLAB, brute_touch
from ..kernels.plain_pairs import CERTIFIED, FLOAT32, FLOAT32_WORLD, FLOAT64, INTEGERS
from .accuracy_case import REACH, Ground
from .accuracy_engine import Exact, fill_times
from .accuracy_plan import Plan
from .accuracy_row import PLAIN, Row, judge_distances, judge_verdicts
from .accuracy_timing import Timed, take_times
from .accuracy_volumes import PRIMITIVES, VOLUMES, Kind, Plain, ask, distances, make_plain

Floats = NDArray[np.float64]
Tick = Callable[[], None]

ARITHMETIC, VOLUME, ALL_PAIRS, PRIMITIVE = (
    "arithmetic",
    "bounding volume, plain",
    "bounding volume, all pairs",
    "point primitive",
)
ARITHMETICS = (
    Kind("float32 of map coordinates", SLAB, FLOAT32_WORLD),
    Kind("float32, unchecked", SLAB, FLOAT32),
    Kind("float64", SLAB, FLOAT64),
    Kind("float32 certified, integers decide", SLAB, CERTIFIED),
    Kind("integers", SLAB, INTEGERS),
)
# Setting of each knob with which the times of the others are compared.
DEFAULTS = {
    ARITHMETIC: "float32 certified, integers decide",
    VOLUME: "sphere with slab",
    ALL_PAIRS: "sphere with slab",
    PRIMITIVE: PRIMITIVES[0].name,
}


def plain_settings() -> list[tuple[str, Kind]]:
    """Return the knob and the kind of each setting."""
    return [
        *((ARITHMETIC, kind) for kind in ARITHMETICS),
        *((VOLUME, kind) for kind in VOLUMES),
        *((ALL_PAIRS, kind._replace(sift=False)) for kind in VOLUMES),
        *((PRIMITIVE, kind) for kind in PRIMITIVES),
    ]


def measure_plain(
    archive: Archive, ground: Ground, exact: Exact, plan: Plan, tick: Tick, *, only: tuple[str, ...] = ()
) -> list[Row]:
    """Measure errors and times of the settings of the plain descent; return one row each.

    only: the knobs to measure; empty: all.
    Raises InternalError if an exact kind, or a bounding volume, changes an answer.
    """
    plain = make_plain(archive, make_avatar(ground.avatar))
    chosen = [(knob, kind) for knob, kind in plain_settings() if not only or knob in only]
    walk = ground.walk[:: max(1, len(ground.walk) // plan.plain_frames)]
    rows, subjects = [], []
    for knob, kind in chosen:
        rows.append(_judge(plain, knob, kind, ground, exact))
        subjects.append(Timed(partial(ask, plain, kind)))
        tick()
    take_times(subjects, walk, plan.loops, plan.chunk, tick)
    for row, subject in zip(rows, subjects, strict=True):
        fill_times(row, subject)
        default = next(s for r, s in zip(rows, subjects, strict=True) if r.knob == row.knob and r.default)
        row.times = subject.mean / default.mean
    return rows


def _judge(plain: Plain, knob: str, kind: Kind, ground: Ground, exact: Exact) -> Row:
    """Return a row with the errors of one kind and its numbers of node and pair tests."""
    row = Row(knob, kind.name, default=kind.name == DEFAULTS[knob], by=PLAIN, scene=ground.name)
    found = ask(plain, kind, ground.judged)
    judge_verdicts(row, found.contact, np.zeros(len(found.contact), bool), exact.contact)
    tangent = ask(plain, kind, exact.tangent_poses).contact
    judge_verdicts(row, tangent, np.zeros(len(tangent), bool), exact.tangent, tangent=True)
    row.node_tests, row.pair_tests = float(found.node_tests.mean()), float(found.pair_tests.mean())
    if knob in (ARITHMETIC, PRIMITIVE):
        judge_distances(row, distances(plain, kind, ground.judged, REACH), np.minimum(exact.distance, REACH))
    wrong = row.early + row.late + row.tangent_early + row.tangent_late
    if kind.leaf in (CERTIFIED, INTEGERS) and wrong:
        raise InternalError(
            f"{knob} {kind.name}: {wrong} verdicts differ from the server's, expected none: this is a bug of this "
            "software, report it"
        )
    return row


def check_judge(archive: Archive, ground: Ground, exact: Exact, poses: int) -> int:
    """Check the reference verdicts against brute force at `poses` poses.

    Brute force tests every pair of points in integers. Half of the poses are near-tangent, if there
    are enough. Returns the number of poses compared.
    Raises InternalError if a verdict differs.
    """
    scene = _scene_units(archive)
    origin = np.array(archive.header.lattice.origin)
    avatar = make_avatar(ground.avatar)
    units = round(archive.header.radius * 2**26) + round(avatar.radius * 2**26)
    around = float(np.linalg.norm(ground.avatar, axis=1).max())
    near = np.linspace(0, max(len(exact.tangent) - 1, 0), min(poses // 2, len(exact.tangent))).astype(int)
    far = np.linspace(0, len(exact.contact) - 1, poses - len(near)).astype(int)
    asked = np.concatenate([exact.tangent_poses[near], ground.judged[far]])
    said = np.concatenate([exact.tangent[near], exact.contact[far]])
    for number, (pose, contact) in enumerate(zip(asked, said, strict=True)):
        middle = np.rint((pose[:3, 3] - origin) * 2.0**26)
        reach = around * 2.0**26 * 1.01 + 2 * units
        close = scene[(np.abs(scene - middle) <= reach).all(axis=1)]
        if brute_touch(pose, ground.avatar, close, units, origin) != contact:
            raise InternalError(
                f"pose {number} of those judged: the server answers {'contact' if contact else 'clear'}, a test of "
                "every pair of points finds the opposite: this is a bug of this software, report it"
            )
    return len(asked)


def _scene_units(archive: Archive) -> NDArray[np.int64]:
    """Return all scan points (n, 3) in exact units from the origin (NUMERICS.md N5)."""
    from ....builder.voxel.point_radius import voxel_points

    lattice = archive.header.lattice
    steps = [
        voxel_points(*archive.read_voxel(row)) + coordinate * lattice.voxel_steps
        for row, coordinate in enumerate(archive.coordinates)
    ]
    return np.rint(np.concatenate(steps).astype(np.float64) * lattice.units_per_step).astype(np.int64)
