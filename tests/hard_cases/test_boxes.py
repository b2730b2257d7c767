"""Hard case of boxes as bounds, in exact fractions; a test's number is its row in NUMERICS.md."""

import itertools
import math
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import archive_cases
import naive
import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from sample_sizes import sample
from served_nodes import row_encloses
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.level import cover_units, open_level
from solidcloud.schemas.archive.voxel_grid import voxel_keys
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.kernels.core.reach import (
    INFINITE,
    VALID,
    VoxelTree,
    entry_fraction,
    find_reach,
    make_reach,
    make_voxel_tree,
)
from solidcloud.server.kernels.core.scene_arrays import LANES, ROW_WORDS, SceneArrays
from solidcloud.server.kernels.nearest.nearest_pair import unmark_beyond_box
from solidcloud.server.kernels.rays.hits import HitBatch
from solidcloud.server.queries import rays_and_points
from solidcloud.server.residency.arena import ArenaBuffer
from solidcloud.server.residency.voxel_store import VoxelStore

UNITS = 2**26
# Steps and origins [m]: map coordinates, the largest ones, and numbers that no float64 holds exactly.
STEPS = [1e-6, 1e-4, 0.1 / 3, 2.0**-10, 0.3]
ORIGINS = [(0.0, 0.0, 0.0), (512345.678901234, 5612345.1, -0.3), (-1e9 / 3, 1e9 / 3, 0.7e9)]

Ints = NDArray[np.int64]
Vector = list[Fraction]


def beyond(at: Vector, low: Vector, high: Vector) -> Fraction:
    """Return the squared distance of a point from a box."""
    gaps = [max(a - p, p - b, Fraction(0)) for p, a, b in zip(at, low, high, strict=True)]
    return sum((gap * gap for gap in gaps), Fraction(0))


def fractions(values: Any) -> Vector:
    """Return numbers as fractions."""
    return [Fraction(value) for value in np.asarray(values).tolist()]


def boxed_scene(
    rng: np.random.Generator, step: float, origin: tuple[float, ...]
) -> tuple[SceneArrays, VoxelTree]:
    """Return a scene of six voxels with boxes and no points, none in memory.

    Two scans that were left out have the boxes of the last two voxels.
    """
    steps = int(rng.choice([7, 1000, 70_000, 1 << 20]))
    # Such that all of it lies within 1e9 m.
    farthest = min(1 << 19, int(2e8 / step / steps))
    coordinates = rng.integers(-farthest, farthest, (6, 3))
    coordinates[1:3] = coordinates[0] + [[1, 0, 0], [0, -1, 1]]
    keys = voxel_keys(coordinates)
    coordinates = coordinates[np.argsort(keys)]
    inside = np.sort(rng.integers(0, steps, (2, 6, 3)), axis=0)
    low, high = inside + coordinates * steps
    arrays = SceneArrays(
        np.empty(0, np.float32), np.empty(0, np.int32), np.empty(0, np.uint16), np.full((6, 3), -1, np.int64),
        coordinates * steps, np.array(origin), step, step * UNITS, steps, 4, np.zeros(1, np.int64),
        np.zeros(1, np.int64),
    )  # fmt: skip
    bounds = np.stack([low.min(axis=0), high.max(axis=0)])
    return arrays, make_voxel_tree(low, high, bounds, np.stack([low, high], axis=1)[4:])


def poses_beside(
    rng: np.random.Generator, scene: SceneArrays, tree: VoxelTree, count: int
) -> NDArray[np.float64]:
    """Return poses at corners and edges of boxes, and away from them by up to some metres."""
    poses = []
    for _ in range(count):
        row, low = int(rng.integers(tree.voxels)), rng.random(3) < 0.5
        corner = np.where(low, tree.low[row], tree.high[row]) * scene.step
        away = rng.normal(size=3) * (rng.random(3) < 0.6) * rng.choice([0.0, 1e-8, 1e-3, 0.5, 5.0])
        turn = np.eye(3) if rng.random() < 0.3 else archive_cases.random_rotation(rng)
        poses.append(archive_cases.pose_of(turn, np.array(scene.origin) + corner + away))
    return np.array(poses)


def placed_exactly(body: AvatarModel, pose: NDArray[np.float64], scene: SceneArrays) -> list[Vector]:
    """Return the avatar's points under a pose, from the origin, without any rounding [m]."""
    rows = [fractions(row) for row in pose[:3]]
    origin = fractions(scene.origin)
    return [
        [a * x + b * y + c * z + t - o for (a, b, c, t), o in zip(rows, origin, strict=True)]
        for x, y, z in map(fractions, body.points)
    ]


@pytest.mark.case(
    39,
    "the broad phase at 1e9 m, steps of 1 µm to 30 cm: no voxel left out, `near` at most the distance, in fractions",
)
@pytest.mark.parametrize("origin", ORIGINS)
@pytest.mark.parametrize("step", STEPS)
def test_case_39_boxes_of_voxels_are_no_farther_than_their_points(
    step: float, origin: tuple[float, float, float]
) -> None:
    rng = np.random.default_rng(39)
    closest = 0
    for count in (1, 5):
        scene, tree = boxed_scene(rng, step, origin)
        body = make_avatar(np.rint(rng.uniform(-0.2, 0.2, (count, 3)) * 1e6) / 1e6, 0.0)
        if count == 1:  # without the slack of its root sphere
            body = body._replace(arrays=body.arrays._replace(radius=np.zeros(len(body.arrays.radius))))
        exact_step = Fraction(step)
        poses = poses_beside(rng, scene, tree, sample(6, 25))
        boxes = [
            ([f * exact_step for f in fractions(low)], [f * exact_step for f in fractions(high)])
            for low, high in zip(tree.low[:6], tree.high[:6], strict=True)
        ]
        for pose in poses:
            points = placed_exactly(body, pose, scene)
            in_units = [fractions(point) for point in naive.placed_units(body.points, pose, scene.origin)]
            squares = [min(beyond(point, *box) for point in points) for box in boxes]
            for row in range(6):
                # The least reach at which a point at the nearest place of the box is in contact (N5).
                sides = [
                    fractions(np.rint(side[row] * scene.units_per_step)) for side in (tree.low, tree.high)
                ]
                nearest = min(int(beyond(point, *sides)) for point in in_units)
                units = math.isqrt(nearest)
                units += units * units < nearest
                if units > 1 << 30 or units / UNITS / step + scene.voxel_steps > 1 << 22:
                    continue
                reach = make_reach(1, 6)
                fault, _, _, needed = find_reach(pose[None], body.arrays, 0.0, units, scene, tree, reach)
                assert fault == VALID and row in reach.lists.rows[:needed]
                closest += 1
                near = [Fraction(gap) * exact_step for gap in reach.lists.near[:needed]]
                for other, gap in zip(reach.lists.rows[:needed].tolist(), near, strict=True):
                    assert gap * gap <= squares[other], (float(gap), float(squares[other]))
                if row >= 4:  # such a box is also that of a scan left out
                    assert (Fraction(reach.lists.unseen[0]) * exact_step) ** 2 <= min(squares[4:])
    assert closest > 10


@pytest.mark.case(
    39,
    "voxels listed for points and rays at 2^57 units: none is left out, `near` is at most the true distance",
)
@pytest.mark.parametrize("origin", ORIGINS)
@pytest.mark.parametrize("step", STEPS)
def test_case_39_lists_of_voxels_leave_none_out(step: float, origin: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(39)
    scene, tree = boxed_scene(rng, step, origin)
    k, per_step = sample(12, 40), Fraction(scene.units_per_step)
    places = poses_beside(rng, scene, tree, k)[:, :3, 3]
    places[::5] += rng.choice([-1.0, 1.0], (len(places[::5]), 3)) * 1e8  # far from all boxes
    at_units = np.rint((places - scene.origin) * UNITS).astype(np.int64)
    aims = rng.normal(size=(k, 3))
    aims[::4] = np.eye(3)[rng.integers(3, size=len(aims[::4]))] * rng.choice([-1.0, 1.0])
    aims[1::4, 0] *= 2.0**-60  # nearly along a face
    aims[::5] = (tree.low[0] + tree.high[0]) * step / 2 - (places[::5] - scene.origin)
    aims /= np.linalg.norm(aims, axis=1)[:, None]
    reach, radius = int(4e8 * UNITS), int(0.05 * UNITS)
    data: Any = SimpleNamespace(arrays=scene, tree=tree)
    for along in (False, True):
        batch = HitBatch(at_units, aims if along else aims[:0], reach, radius if along else 0)
        lists = rays_and_points._list(data, batch)
        found = 0
        for i, row in itertools.product(range(k), range(6)):
            own = slice(lists.starts[i], lists.starts[i + 1])
            near = dict(zip(lists.rows[own].tolist(), lists.near[own].tolist(), strict=True))
            at = fractions(at_units[i])
            # A lattice point in units is rounded half to even: by half a unit, or by float64 far away.
            box = [fractions(np.rint(side[row] * scene.units_per_step)) for side in (tree.low, tree.high)]
            exact = [[f * per_step for f in fractions(side[row])] for side in (tree.low, tree.high)]
            for low, high in (box, exact):
                if not along:
                    square = beyond(at, low, high)
                    if square > reach * reach:
                        continue
                    assert (Fraction(near[row]) * per_step) ** 2 <= square
                    assert row < 4 or (Fraction(lists.unseen[i]) * per_step) ** 2 <= square
                else:
                    enters = entered(at, fractions(aims[i]), low, high, Fraction(radius))
                    if enters is None or enters > reach:
                        continue
                    assert Fraction(near[row]) * per_step <= enters
                    assert row < 4 or Fraction(lists.unseen[i]) * per_step <= enters
                found += 1
        assert found > k


def entered(at: Vector, way: Vector, low: Vector, high: Vector, grow: Fraction) -> Fraction | None:
    """Return where a ray enters a box grown by `grow`; None if it does not."""
    first, last = Fraction(0), None
    for p, u, a, b in zip(at, way, low, high, strict=True):
        near, far = a - grow - p, b + grow - p
        if u == 0:
            if near > 0 or far < 0:
                return None
            continue
        begin, end = sorted((near / u, far / u))
        first, last = max(first, begin), end if last is None else min(last, end)
    return first if last is None or first <= last else None


@pytest.mark.case(
    39,
    "boxes that a motion meets, at 2^41 steps: never later than in fractions, never none where there is one",
)
def test_case_39_motions_enter_boxes_no_later_than_in_fractions() -> None:
    rng = np.random.default_rng(39)
    met = 0
    for _ in range(3000):
        size = float(rng.choice([10.0, 2.0**24, 2.0**41]))
        low = np.rint(rng.uniform(-size, size, 3)).astype(np.int64)
        high = low + rng.integers(0, int(rng.choice([1, 20, 1 << 21])), 3, endpoint=True)
        span = float(rng.choice([0.0, 0.3, 17.123, 1e5]))
        # From beside the box to its border or past it, many along an axis or along a face.
        begin = (low - span) + rng.normal(size=3) * rng.choice([0.0, 1e-3, 50.0, size])
        end = np.where(rng.random(3) < 0.5, low - span, high + span) + rng.normal(size=3) * rng.choice(
            [0, 30.0]
        )
        end = np.where(rng.random(3) < 0.2, begin, end)
        way = [b - a for a, b in zip(fractions(begin), fractions(end), strict=True)]
        first = entered(fractions(begin), way, fractions(low), fractions(high), Fraction(span))
        if first is None or first > 1:
            continue
        met += 1
        # The span as its callers widen it: a millionth of itself, one step, and the rounding far away.
        wide = span * (1.0 + 1e-6) + 1.0 + max(np.abs(begin).max(), np.abs(end).max()) * 2.0**-49
        found = entry_fraction(begin, end, wide, np.stack([low, high]).astype(np.float64))
        assert found != INFINITE and Fraction(found) <= first, (found, float(first))
    assert met > 50


@pytest.mark.case(
    39, "the box of a block of points, in float32: no avatar point is dropped that is as near to one of them"
)
def test_case_39_boxes_of_blocks_drop_no_near_point() -> None:
    rng = np.random.default_rng(39)
    kept = 0
    for _ in range(300):
        size = int(rng.choice([1, 300, 65536]))
        halves = rng.integers(0, size, 3 * LANES).astype(np.uint16)
        corner = np.float32(rng.uniform(-1, 1, 3) * rng.choice([0.0, 1e3, 2.0**23]))
        lanes = (corner[:, None] + rng.uniform(-size, 2 * size, (3, LANES))).astype(np.float32)
        # Some stand where a point does, or one float32 beside it.
        points = halves.reshape(3, LANES)
        lanes[:, ::4] = (corner[:, None] + points[:, ::4]).astype(np.float32)
        lanes[:, 1::4] = np.nextafter(
            (corner[:, None] + points[:, 1::4]).astype(np.float32), np.float32(np.inf)
        )
        # In float32, in the order of the kernel.
        own = lanes - corner[:, None]
        apart = points[:, None, :].astype(np.float32) - own[:, :, None]
        squares = (apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2]).min(axis=1)
        for far in (np.float32(0), *rng.choice(squares, 3), np.nextafter(squares.max(), np.float32(0))):
            keep = np.ones(LANES, bool)
            unmark_beyond_box(halves, 0, *corner, lanes[None], 0, np.float32(far), keep)
            assert keep[squares <= far].all()
            kept += int(keep.sum())
    assert kept > 100


@pytest.mark.case(
    39,
    "the index of an archive and of its level: the least boxes around the points, in integers, at UTM coordinates",
)
@pytest.mark.parametrize("kind", ["corner", "noise", "duplicates"])
def test_case_39_boxes_of_the_index_fit_their_points(tmp_path: Path, kind: str) -> None:
    points = synthetic_scans.make_scan(kind, 6, 200) + np.array([512345.678901234, 5612345.1, -0.3])
    case = archive_cases.build(tmp_path, points, resolution=0.01 / 3, leaf=4)
    with Archive(case.archive) as archive:
        level = open_level(archive)
        assert level is not None
        with level:
            for opened in (archive, level):
                lows, highs = [], []
                for row, voxel in enumerate(opened.voxels):
                    own = voxel_points(*opened.read_voxel(row))
                    assert voxel["low"].tolist() == own.min(axis=0).tolist()
                    assert voxel["high"].tolist() == own.max(axis=0).tolist()
                    base = opened.coordinates[row] * opened.header.lattice.voxel_steps
                    lows.append(own.min(axis=0) + base)
                    highs.append(own.max(axis=0) + base)
                assert opened.header.low.tolist() == np.min(lows, axis=0).tolist()
                assert opened.header.high.tolist() == np.max(highs, axis=0).tolist()


@pytest.mark.case(
    39,
    "spheres, slabs and covers of a level as served (float32): each point in all nodes above a representative",
)
@pytest.mark.parametrize("kind", ["plane", "corner", "noise", "duplicates"])
def test_case_39_nodes_of_a_level_enclose_what_they_stand_for(tmp_path: Path, kind: str) -> None:
    """No search of the level passes by a point of the archive."""
    points = synthetic_scans.make_scan(kind, 7, 250)
    case = archive_cases.build(tmp_path, points, voxel=70.0, leaf=4, degree=3, cell_points=40)
    with Archive(case.archive) as archive:
        level = open_level(archive)
        assert level is not None
        store = VoxelStore(level.folder, lambda _: level)
        assert len(archive.voxels) == len(level.voxels) == 1
        assert level.header.lattice.voxel_steps == archive.header.lattice.voxel_steps
        buffer = ArenaBuffer(ArenaBuffer.rounded(int(store.sizes[0])))
        where = store.load(0, buffer.arena, 0)
        voxel, links = level.read_voxel(0)
        assert voxel.radius_class is not None
        covers = cover_units()[voxel.radius_class]
        representatives, step = voxel_points(voxel, links), Fraction(archive.header.lattice.step)
        above: dict[int, list[int]] = {}
        for node in range(len(links.first)):
            for child in range(int(links.first[node]), int(links.first[node]) + int(voxel.nodes.count[node])):
                # Representatives are numbered from -1 down.
                above[-1 - child if links.is_leaf[node] else child] = [*above.get(node, []), node]
        rows = [
            fractions(buffer.arena.words[int(where[0]) + n * ROW_WORDS :][:10])
            for n in range(len(links.first))
        ]
        for point in map(fractions, voxel_points(*archive.read_voxel(0))):
            held_by = 0
            for number, place in enumerate(map(fractions, representatives)):
                apart = [(p - b) * step * UNITS for p, b in zip(point, place, strict=True)]
                if sum(d * d for d in apart) > int(covers[number]) ** 2:
                    continue
                held_by += all(row_encloses(rows[node], point) for node in above[-1 - number])
            assert held_by, point
        store.close()
