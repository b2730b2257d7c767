"""`objects` equals the definition for every pair, whatever the trees, the order, the groups; and says so both ways."""

import math
from collections.abc import Iterator
from pathlib import Path

import archive_cases
import naive
import naive_objects
import numpy as np
import pytest
import synthetic_scans
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from point_clouds import signed_permutations
from sample_sizes import sample
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.queries.objects import SCENE_GROUP, objects
from solidcloud.server.queries.query_inputs import SceneData, make_scene_data
from solidcloud.server.residency.voxel_cache import VoxelCache
from solidcloud.server.residency.voxel_store import VoxelStore

ALL = 0xFFFF_FFFF
ORIGIN_SHIFT = 3.0


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SceneData]:
    """A scene of 60 points, far enough from the origin for its own not to be zero."""
    points = synthetic_scans.make_scan("noise", 11, 60) + ORIGIN_SHIFT
    case = archive_cases.build(tmp_path_factory.mktemp("objects"), points, radius=0.05)
    store = VoxelStore(case.archive)
    yield make_scene_data(store.archive, VoxelCache(store, 64 << 20))
    store.close()


def body(rng: np.random.Generator, kind: str) -> NDArray[np.float64]:
    """Points (n, 3) within 0.4 m of zero: trees of no, one, two and three levels."""
    count = {"empty": 0, "point": 1, "few": 20, "shell": 500, "many": 1200, "off": 40}[kind]
    points = rng.normal(size=(count, 3))
    points *= 0.3 / np.maximum(np.linalg.norm(points, axis=1), 1e-9)[:, None]
    if kind == "off":  # far from its own frame's origin
        points += [900.0, -500.0, 0.0]
    return points


def at_random(rng: np.random.Generator, body: NDArray[np.float64], box: float) -> NDArray[np.float64]:
    """A pose that puts the body's middle somewhere in a box around the scene's origin."""
    turn = archive_cases.random_rotation(rng)
    middle = body.mean(axis=0) if len(body) else np.zeros(3)
    return archive_cases.pose_of(turn, rng.uniform(-box, box, 3) + ORIGIN_SHIFT - turn @ middle)


@settings(max_examples=sample(4, 25), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kinds=st.lists(
        st.sampled_from(["empty", "point", "few", "shell", "many", "off"]), min_size=1, max_size=5
    ),
    n=st.sampled_from([0, 1, 2, 7, 14]),
    box=st.sampled_from([0.2, 0.6, 2.0]),
    margin=st.sampled_from([0.0, 0.02, 0.3]),
    bits=st.sampled_from([SCENE_GROUP - 1, 7, 3]),
)
def test_pairs_are_those_of_the_definition(
    data: SceneData, seed: int, kinds: list[str], n: int, box: float, margin: float, bits: int
) -> None:
    rng = np.random.default_rng(seed)
    bodies = [body(rng, kind) for kind in kinds]
    radii = rng.choice([0.0, 0.01, 0.03], len(kinds)).tolist()
    models = [make_avatar(points, radius) for points, radius in zip(bodies, radii, strict=True)]
    of = rng.integers(len(kinds), size=n).tolist()
    poses = np.array([at_random(rng, bodies[i], box) for i in of])
    poses = poses.reshape(-1, 4, 4)
    groups, masks = rng.integers(0, bits, n, endpoint=True), rng.integers(0, bits, n, endpoint=True)
    arguments = [bodies[i] for i in of], [radii[i] for i in of]
    expected = naive_objects.touching_pairs(
        *arguments, poses, groups.tolist(), masks.tolist(), data.arrays.origin, margin
    )
    answers = objects(data, [models[i] for i in of], poses, groups, masks, margin)
    assert answers.pairs.tolist() == expected
    assert (answers.pair_verdict == 1).all() and len(answers) == n
    # In any other order the same pairs, by their new numbers.
    order = rng.permutation(n)
    turned = objects(data, [models[of[i]] for i in order], poses[order], groups[order], masks[order], margin)
    assert sorted(sorted(order[list(pair)].tolist()) for pair in turned.pairs) == expected
    assert turned.pairs_tested == answers.pairs_tested and turned.pairs_filtered == answers.pairs_filtered


@settings(max_examples=sample(4, 20), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kinds=st.tuples(*[st.sampled_from(["point", "few", "many", "off"])] * 2),
    far=st.sampled_from([0.0, 5e5, 1e8]),
)
def test_contact_begins_at_the_unit_the_definition_says(
    data: SceneData, seed: int, kinds: tuple[str, str], far: float
) -> None:
    """The margin is set to the least unit that is contact, and to one less."""
    rng = np.random.default_rng(seed)
    bodies = [body(rng, kind) for kind in kinds]
    models = [make_avatar(points, 0.001) for points in bodies]
    poses = np.array([at_random(rng, points, 1.0) for points in bodies])
    poses[:, :3, 3] += far * rng.uniform(-1, 1, 3)
    origin = data.arrays.origin
    a, b = (naive.placed_units(points, pose, origin) for points, pose in zip(bodies, poses, strict=True))
    square = min(naive.least_square(a[i : i + 300], b) for i in range(0, len(a), 300))
    least = math.isqrt(square - 1) + 1 if square else 0
    given_units = 2 * naive.reach_units(0.001, 0.0, 0.0)
    for reach in (least - 1, least, least + 1):
        if reach >= given_units:
            for order in ([0, 1], [1, 0]):
                answers = objects(
                    data,
                    [models[i] for i in order],
                    poses[order],
                    [1, 1],
                    [1, 1],
                    (reach - given_units) / naive.UNITS,
                )
                assert (len(answers.pairs) == 1) == (reach >= least), (reach, least)


@settings(max_examples=sample(4, 20), deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), kinds=st.tuples(*[st.sampled_from(["point", "few", "many"])] * 2))
def test_it_does_not_matter_which_of_two_is_moved(data: SceneData, seed: int, kinds: tuple[str, str]) -> None:
    """collide(A, B, M) = collide(B, A, M^-1) for M exactly invertible (NUMERICS.md case 29), to the unit."""
    rng = np.random.default_rng(seed)
    origin = data.arrays.origin
    bodies = [np.rint(body(rng, kind) * 2.0**20) * 2.0**-20 for kind in kinds]
    models = [make_avatar(points, 3 * 2.0**-20) for points in bodies]
    still = archive_cases.pose_of(np.eye(3), origin)  # t - O is then zero, and every product exact
    for turn in [signed_permutations()[i] for i in rng.integers(24, size=4)]:
        shift = np.rint(rng.uniform(-0.4, 0.4, 3) * 2.0**20) * 2.0**-20
        moved, back = np.eye(4), np.eye(4)
        moved[:3, :3], moved[:3, 3] = turn, shift + origin
        back[:3, :3], back[:3, 3] = turn.T, -(turn.T @ shift) + origin
        if (moved[:3, 3] - origin != shift).any() or (back[:3, 3] - origin != -(turn.T @ shift)).any():
            continue  # the origin took bits of the shift
        a = naive.placed_units(bodies[0], moved, origin)
        b = naive.placed_units(bodies[1], still, origin)
        square = min(naive.least_square(a[i : i + 300], b) for i in range(0, len(a), 300))
        for reach in (math.isqrt(max(square - 1, 0)), math.isqrt(max(square - 1, 0)) + 1):
            margin = (reach - 2 * 3 * 64) / naive.UNITS
            if margin < 0:
                continue
            one = objects(data, models, np.array([moved, still]), [1, 1], [1, 1], margin)
            other = objects(data, models[::-1], np.array([back, still]), [1, 1], [1, 1], margin)
            assert one.pairs.tolist() == other.pairs.tolist()
            assert len(one.pairs) == (square <= reach * reach)


def test_thousands_of_small_objects_as_all_pairs_say(data: SceneData, rng: np.random.Generator) -> None:
    """Spheres, so that the judge can look at all four million pairs; half of them nearly tangent to another."""
    n, radius = 3000, 2.0**-5
    centers = rng.uniform(-2, 2, (n, 3))
    away = rng.normal(size=(n // 2, 3))
    away *= (2 * radius + rng.integers(-2, 3, n // 2) * 2.0**-27)[:, None] / np.linalg.norm(away, axis=1)[
        :, None
    ]
    centers[n // 2 :] = centers[: n // 2] + away
    centers = rng.permutation(centers)
    poses = np.array([archive_cases.pose_of(np.eye(3), c + data.arrays.origin) for c in centers])
    groups, masks = 1 << rng.integers(0, 3, n), rng.choice([1, 6, 7, 7], n)
    answers = objects(data, [make_avatar([[0.0, 0, 0]], radius)] * n, poses, groups, masks)
    units = naive.placed_units(np.zeros((1, 3)), poses[0], data.arrays.origin)
    units = np.concatenate([naive.placed_units(np.zeros((1, 3)), pose, data.arrays.origin) for pose in poses])
    expected, filtered, near = [], 0, 0
    reach = 2 * naive.reach_units(radius, 0.0, 0.0)
    for i in range(n):
        square = ((units[i + 1 :] - units[i]) ** 2).sum(axis=1)
        let = ((groups[i + 1 :] & masks[i]) > 0) & ((masks[i + 1 :] & groups[i]) > 0)
        expected += [[i, i + 1 + j] for j in np.flatnonzero((square <= reach**2) & let)]
        filtered += int(((square <= reach**2) & ~let).sum())
        near += int((np.abs(np.sqrt(square) - reach) < 3).sum())
    assert answers.pairs.tolist() == expected
    assert near > 1000 and 300 < len(expected) < 3000
    # Of all pairs few were looked at, and of those not let at least the ones that touch were seen.
    assert answers.pairs_tested < 20 * len(expected) and answers.pairs_filtered >= filtered


def test_a_few_objects_in_all_their_groups(data: SceneData, rng: np.random.Generator) -> None:
    bodies = [body(rng, kind) for kind in ("few", "point", "empty", "off")]
    models = [make_avatar(points, 0.02) for points in bodies]
    of = [0, 1, 2, 3, 0, 1, 2, 3]
    poses = np.array([at_random(rng, bodies[i], 0.25) for i in of])
    groups, masks = [1, 1, 1, 1, 2, 2, 2, 2], [3, 1, 3, 2, 1, 3, 3, 3]
    expected = naive_objects.touching_pairs(
        [bodies[i] for i in of], [0.02] * 8, poses, groups, masks, data.arrays.origin, 0.1
    )
    answers = objects(data, [models[i] for i in of], poses, groups, masks, 0.1)
    assert answers.pairs.tolist() == expected and expected
    assert answers.pairs_filtered > 0 and not answers.verdict.any(), "the scene's bit is in no mask"


def test_tangent_objects_touch_and_one_unit_apart_do_not(data: SceneData) -> None:
    """Lengths of 3, 4, 12 and 13, as near and as far from the origin as the unit is exact."""
    ball = make_avatar([[0.0, 0, 0]], 13 / 128)
    for far in (0.0, 2.0**26):
        for more, touch in ((0.0, True), (2.0**-26, False), (-(2.0**-26), True)):
            places = np.array([[far, far, -far], [far + 3 / 64 + more, far + 4 / 64, -far + 12 / 64]])
            poses = np.array(
                [archive_cases.pose_of(np.eye(3), place + data.arrays.origin) for place in places]
            )
            if (poses[:, :3, 3] - data.arrays.origin != places).any():
                continue  # the origin takes bits of the place
            for order in ([0, 1], [1, 0]):
                found = objects(data, [ball, ball], poses[order], [1, 1], [1, 1])
                assert (len(found.pairs) == 1) == touch


def test_against_the_scene_as_each_alone(data: SceneData, rng: np.random.Generator) -> None:
    from solidcloud.server.queries.collide import collide

    bodies = [body(rng, kind) for kind in ("few", "shell", "empty")]
    models: list[AvatarModel] = [make_avatar(points, 0.02) for points in bodies]
    of = rng.integers(3, size=40)
    poses = np.array([at_random(rng, bodies[i], 1.2) for i in of])
    poses[:, :3, 3] += 1.0  # the scan's middle
    masks = np.where(rng.random(40) < 0.7, SCENE_GROUP | 1, ALL ^ SCENE_GROUP).astype(np.uint32)
    answers = objects(data, [models[i] for i in of], poses, np.ones(40, int), masks, 0.01)
    for i in range(40):
        alone = collide(data, models[of[i]], poses[i][None], 0.01)
        if masks[i] & SCENE_GROUP:
            assert answers.verdict[i] == alone.verdict[0] and answers.outside[i] == alone.outside[0]
        else:
            assert answers.verdict[i] == 0 and answers.node_visits[i] == 0 and not answers.outside[i]
    assert 3 < answers.verdict.sum() < 37
    assert (answers.verdict < 2).all()


def test_a_scene_path_is_not_needed(tmp_path: Path) -> None:
    """Objects far outside the dataset meet all the same."""
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan("plane", 1, 50))
    store = VoxelStore(case.archive)
    far = make_scene_data(store.archive, VoxelCache(store, 1 << 20))
    ball = make_avatar([[0.0, 0, 0]], 0.5)
    poses = np.array([archive_cases.pose_of(np.eye(3), np.array([x, 5e6, -4e6])) for x in (0.0, 0.9, 1.95)])
    answers = objects(far, [ball] * 3, poses, [1] * 3, [ALL] * 3)
    assert answers.pairs.tolist() == [[0, 1]] and answers.outside.all() and answers.misses == 0
    assert objects(far, [ball] * 3, poses, [1] * 3, [ALL] * 3, 0.06).pairs.tolist() == [[0, 1], [1, 2]]
    store.close()
