"""A moving avatar against one that stands, by the kernel alone: the judge steps along and asks every pair of points."""

import os
from typing import NamedTuple

import archive_cases
import naive
import naive_sweep
import numpy as np
import pytest
from judged_sweeps import turned
from numpy.typing import NDArray
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.kernels.bodies import body_pairs
from solidcloud.server.kernels.bodies import body_sweep as kernel
from solidcloud.server.runtime.stop_flag import NO_STOP

pytestmark = pytest.mark.interpreted
INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"

ORIGIN = np.array([3.0, -20.0, 500.0])
TOLERANCE = 1e-6


class Asked(NamedTuple):
    """What the kernel said. row: of the body, -1: none.  fraction: nothing touches before.  witness: (2, 3)."""

    row: int
    fraction: float
    witness: NDArray[np.float64]


def box_of(model: AvatarModel) -> NDArray[np.float64]:
    return np.array([model.points.min(axis=0), model.points.max(axis=0)])


def units_of(model: AvatarModel) -> int:
    return int(np.rint(model.radius * naive.UNITS))


def scratch_of(*models: AvatarModel) -> kernel.BodyScratch:
    """Scratch that just holds these."""
    return kernel.make_body_scratch(
        max(len(m.arrays.radius) for m in models), max(len(m.rows) for m in models)
    )


def ask(
    a: AvatarModel, first: NDArray[np.float64], last: NDArray[np.float64],
    b: AvatarModel, poses: NDArray[np.float64], margin: float = 0.0, until: float = np.inf,
    scratch: kernel.BodyScratch | None = None,
) -> Asked:  # fmt: skip
    """Ask for all bodies at once."""
    ends = [pose.copy() for pose in (first, last)]
    for end in ends:
        end[:3, 3] -= ORIGIN
    witness, named = np.full((2, 3), np.nan), np.full(2, -1)
    row, fraction = kernel.sweep_bodies(
        a.arrays, box_of(a), units_of(a), *ends, b.arrays, poses, units_of(b), np.arange(len(poses)), ORIGIN,
        int(np.rint(margin * naive.UNITS)), TOLERANCE, until, witness, named, scratch or scratch_of(a, b),
        NO_STOP.flag,
    )  # fmt: skip
    if row >= 0:
        point = b.points[b.rows[named[0], named[1]]]
        assert np.allclose(poses[row, :3, :3] @ point + poses[row, :3, 3], witness[1], atol=1e-9)
    return Asked(int(row), float(fraction), witness)


def touching(
    a: AvatarModel, first: NDArray[np.float64], last: NDArray[np.float64],
    b: AvatarModel, pose: NDArray[np.float64], fractions: NDArray[np.float64], more_units: int = 0,
) -> NDArray[np.bool_]:  # fmt: skip
    """Whether a touches b at each of the fractions, by the definition; more_units: of reach."""
    ends = [end.copy() for end in (first, last)]
    for end in ends:
        end[:3, 3] -= ORIGIN
    standing = naive.placed_units(b.points, pose, ORIGIN)
    reach = units_of(a) + units_of(b) + more_units
    return np.array(
        [
            naive.touches(
                naive.placed_units(a.points, naive_sweep.pose_at(*ends, float(t)), np.zeros(3)), standing, reach
            )
            for t in fractions
        ]
    )  # fmt: skip


def at(x: float) -> NDArray[np.float64]:
    """The pose that only moves, from the origin."""
    return archive_cases.pose_of(np.eye(3), ORIGIN + np.array([x, 0.0, 0.0]))


def random_motion(
    rng: np.random.Generator, way: float, turn: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    first = archive_cases.pose_of(archive_cases.random_rotation(rng), ORIGIN + rng.normal(size=3) * 0.5)
    last = first.copy()
    last[:3, :3] = turned(rng, first[:3, :3], turn)
    last[:3, 3] += rng.normal(size=3) * way
    return first, last


@pytest.mark.parametrize(("way", "turn"), [(30.0, 0.0), (0.0, 3.1), (5.0, 2.0)])
def test_nothing_touches_before_what_is_said_and_something_does_soon_after(way: float, turn: float) -> None:
    rng = np.random.default_rng(round(way * 10 + turn * 100))
    a = make_avatar(rng.normal(size=(40, 3)) * 0.2, 0.02)
    b = make_avatar(rng.normal(size=(90, 3)) * np.array([0.3, 0.02, 0.3]), 0.015)
    met = clear = 0
    for _ in range(12):
        first, last = random_motion(rng, way, turn)
        pose = archive_cases.pose_of(archive_cases.random_rotation(rng), ORIGIN + rng.normal(size=3) * 0.5)
        found = ask(a, first, last, b, pose[None])
        said = (first.tolist(), last.tolist(), pose.tolist(), found)
        before = np.linspace(0, 1, 40)
        if found.row < 0:
            clear += 1
            assert found.fraction == np.inf
            assert not touching(a, first, last, b, pose, before).any(), said
            continue
        far = found.fraction
        close = far - far * np.geomspace(1e-14, 1e-2, 10)
        before = np.concatenate(
            [before[before < far], close[close < far], [np.nextafter(far, 0)] if far else []]
        )
        assert not touching(a, first, last, b, pose, before).any(), said
        # Soon: some point goes no more than the tolerance, or it is a graze: within 1.2 units of a contact there.
        after = np.linspace(far, min(1.0, far + 4 * TOLERANCE / max(way + turn, 1e-3)), 9)
        grazes = touching(a, first, last, b, pose, np.array([far]), more_units=3)
        assert touching(a, first, last, b, pose, after).any() or grazes.any(), said
        apart = np.linalg.norm(found.witness[0] - found.witness[1])
        assert apart <= a.radius + b.radius + 2 * TOLERANCE, said
        met += 1
    assert met and (clear or way == 0)


def test_a_leaf_of_two_centimetres_is_met_at_fifty_metres_a_step() -> None:
    """A door leaf: two sheets of points, 2 cm thick with its spheres."""
    side = np.arange(-0.4, 0.41, 0.05 if INTERPRETED else 0.02)
    y, z = (grid.ravel() for grid in np.meshgrid(side, side))
    leaf = make_avatar(np.stack([np.zeros_like(y), y, z], axis=1), 0.025 if INTERPRETED else 0.01)
    rng = np.random.default_rng(1)
    ball = rng.normal(size=(50, 3))
    ball = make_avatar(0.2 * ball / np.linalg.norm(ball, axis=1)[:, None], 0.02)
    pose = archive_cases.pose_of(np.eye(3), ORIGIN)
    for way in (0.5, 5.0, 50.0, 500.0):
        for _ in range(2 if INTERPRETED else 8):
            start = np.array([-way * rng.uniform(0.3, 0.7) - 0.3, rng.uniform(-0.2, 0.2), 0.0])
            first = archive_cases.pose_of(archive_cases.random_rotation(rng), ORIGIN + start)
            last = first.copy()
            last[:3, 3] += [way + 0.6, 0, 0]
            found = ask(ball, first, last, leaf, pose[None])
            assert found.row == 0
            there = first[0, 3] + found.fraction * (last - first)[0, 3] - ORIGIN[0]
            assert -0.2 - 0.02 - leaf.radius - 1e-6 <= there < 0
            assert abs(found.witness[1, 0] - ORIGIN[0]) < 1e-7


def test_the_first_of_several_is_named_and_what_comes_later_than_asked_is_not() -> None:
    one = make_avatar(np.zeros((1, 3)), 0.5)
    poses = np.array([at(x) for x in (7.0, 3.0, 5.0, 3.0)])
    first, last = (at(x) for x in (0.0, 10.0))
    found = ask(one, first, last, one, poses)
    assert found.row == 1  # the first of two that are met at the same moment
    assert abs(found.fraction - 0.2) < 1e-8
    assert np.allclose(found.witness - ORIGIN, [[2, 0, 0], [3, 0, 0]], atol=1e-7)
    assert abs(ask(one, first, last, one, poses, margin=0.5).fraction - 0.15) < 1e-8
    later = ask(one, first, last, one, poses, until=0.2 - 1e-6)
    assert later.row == -1 and later.fraction == 0.2 - 1e-6


def test_bounds_of_bodies_and_of_motions_are_no_wider_than_they_must_be() -> None:
    rng = np.random.default_rng(11)
    box = np.array([[-0.3, -0.1, 0.2], [0.5, 0.4, 1.9]])
    corners = np.array([[x, y, z] for x in box[:, 0] for y in box[:, 1] for z in box[:, 2]])
    bound = np.empty((2, 3))
    for _ in range(20):
        pose = archive_cases.pose_of(archive_cases.random_rotation(rng), ORIGIN + rng.normal(size=3))
        body_pairs.bound_body(box, pose, ORIGIN, 0.07, bound)
        placed_corners = corners @ pose[:3, :3].T + pose[:3, 3] - ORIGIN
        low, high = placed_corners.min(axis=0) - 0.07, placed_corners.max(axis=0) + 0.07
        assert ((bound[0] < low) & (low < bound[0] + 1e-6)).all()
        assert ((bound[1] > high) & (high > bound[1] - 1e-6)).all()
    # A metre along each axis either way: bodies a millimetre beyond its bounds, and as much within.
    first = np.eye(4)
    kinds = np.full(4, 2, np.uint8)
    for axis in range(3):
        for way in (-1.0, 1.0):
            last = first.copy()
            last[axis, 3] = way
            low, high = box[0, axis] - 0.07 + min(way, 0.0), box[1, axis] + 0.07 + max(way, 0.0)
            bounds = np.tile([[-1.0] * 3, [3.0] * 3], (4, 1, 1))
            edges = [low - 1e-3, low + 1e-3, high - 1e-3, high + 1e-3]
            bounds[:, 0, axis] = [-9.0, -9.0, edges[2], edges[3]]
            bounds[:, 1, axis] = [edges[0], edges[1], 9.0, 9.0]
            rows, motion = np.full(5, -7), (box, first, last, np.zeros(3))
            assert body_pairs.find_near_bodies(*motion, 0.07, bounds, kinds, 6, -1, rows) == 2
            assert rows.tolist() == [1, 2, -7, -7, -7]
            assert body_pairs.find_near_bodies(*motion, 0.07, bounds, kinds, 5, -1, rows) == 0
            assert body_pairs.find_near_bodies(*motion, 0.07, bounds, kinds, 2, 1, rows) == 1
            assert rows[0] == 2


@pytest.mark.parametrize("axis", range(3))
def test_what_all_but_touches_is_left_along_any_axis_and_by_turning_what_touches_is_not(axis: int) -> None:
    """As above, along each axis; then spheres that touch, to the unit, and are turned apart: that is a contact."""
    unit = 2.0**-26
    one = make_avatar(np.zeros((1, 3)), 0.5)
    along, across = np.roll(np.eye(3), axis, axis=1)[:2]
    pose = archive_cases.pose_of(np.eye(3), ORIGIN + (1 + unit) * along)
    first = archive_cases.pose_of(np.eye(3), ORIGIN + 0.4 * unit * along)
    for way, ends in (
        (-along, False),
        (across, False),
        (across - 1e-3 * along, False),
        (across + along, True),
    ):
        last = first.copy()
        last[:3, 3] += way
        assert (ask(one, first, last, one, pose[None]).row == 0) == ends, way
    arm = make_avatar(along[None], 0.5)
    quarter = archive_cases.pose_of(np.column_stack([across, -along, np.cross(across, -along)]), ORIGIN)
    quarter[:3, :3] = quarter[:3, :3] @ np.column_stack([along, across, np.cross(along, across)]).T
    begin = archive_cases.pose_of(np.eye(3), ORIGIN)
    for gap, fraction in ((0.0, 0.0), (1e-3, np.inf)):
        there = archive_cases.pose_of(np.eye(3), ORIGIN + (2 + gap) * along)
        assert ask(arm, begin, quarter, one, there[None]).fraction == fraction
        assert ask(arm, begin, begin, one, there[None]).fraction == fraction, "at rest"
