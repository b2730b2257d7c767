"""`raycast` and `within` equal their definitions, bit for bit, whatever the scan, the tree and the order of points."""

from fractions import Fraction
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import naive
import naive_rays
import numpy as np
import pytest
import synthetic_scans
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from point_clouds import FAR, STEPS, TREES, VOXEL_STEPS, cloud
from ray_cases import KINDS, opened, same_points, same_rays, some_rays
from sample_sizes import sample
from solidcloud.server.kernels.rays.hits import first_meeting
from solidcloud.server.queries.query_inputs import SceneData
from solidcloud.server.queries.rays_and_points import raycast, within


def stored(case: archive_cases.Case, data: SceneData) -> NDArray[np.float64]:
    """The case's points (n, 3) as the archive has them, world."""
    origin, step = data.arrays.origin, data.arrays.step
    return np.asarray(naive.lattice_of(case.points, origin, step) * step + origin)


@settings(max_examples=sample(6, 35), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    count=st.sampled_from([1, 2, 33, 300, 1500]),
    step=STEPS,
    voxel_steps=VOXEL_STEPS,
    far=FAR,
    thick=st.sampled_from([0.0, 0.7, 9.0, 4000.0]),
    tree=TREES,
)
def test_rays_and_points_are_answered_as_defined(
    seed: int,
    kind: str,
    count: int,
    step: float,
    voxel_steps: int,
    far: float,
    thick: float,
    tree: dict[str, Any],
) -> None:
    rng = np.random.default_rng(seed)
    if step <= far * 1e-14:
        far = 0.0
    extent = step * min(voxel_steps * rng.uniform(0.1, 3), 1 << 21)
    points = cloud(rng, kind, count) * extent + far * rng.uniform(-1, 1, 3)
    radius = min(step * thick, 8.0)
    with TemporaryDirectory() as folder:
        case = archive_cases.build(
            Path(folder), points, voxel=step * voxel_steps, resolution=step, radius=radius, **tree
        )
        with opened(case) as data:
            lattice = stored(case, data)
            space = data.arrays.origin, data.arrays.step
            o, d = some_rays(rng, lattice, extent, radius, 70)
            for reach in (min(extent * rng.uniform(0.3, 4), 1e6), 1e6):
                expected = naive_rays.raycast(points, *space, radius, o, d, reach)
                same_rays(raycast(data, o, d, reach), expected, lattice)
            loose = np.concatenate([lattice[rng.integers(len(lattice), size=9)], o[:40]])
            for reach in (0.0, min(extent * rng.uniform(0, 0.5), 16.0), 16.0):
                same_points(
                    within(data, loose, reach), naive_rays.within(points, *space, loose, reach), lattice
                )


@settings(max_examples=sample(3, 10), deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), kind=st.sampled_from(KINDS))
def test_no_tree_voxel_order_or_cache_changes_an_answer(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    points = cloud(rng, kind, 300)
    o, d = some_rays(rng, points, 1.0, 0.02, 70)
    seen = []
    with TemporaryDirectory() as folder:
        for options in (
            {"voxel": 4.0},
            {"voxel": 0.5, "degree": 2, "leaf": 1},
            {"voxel": 0.2, "degree": 16, "leaf": 32, "cell_points": 10, "with_slab": False},
        ):
            case = archive_cases.build(
                Path(folder), rng.permutation(points), resolution=1e-3, radius=0.02, **options
            )
            for budget in (64 << 20, None):  # None: no more than the largest voxel
                with opened(case) as data:
                    largest = max(data.residency.bytes_of([row]) for row in range(len(data.arrays.where)))
                with opened(case, budget or largest) as data:
                    rays, loose = raycast(data, o, d, 5.0), within(data, o, 2.0)
                    data.residency.check()
                    columns = rays.distance, rays.cloud_point, rays.hit, rays.normal, rays.outside
                    seen.append([c.tobytes() for c in (*columns, loose.distance, loose.cloud_point)])
    assert all(one == seen[0] for one in seen)


@settings(max_examples=sample(3, 10), deadline=None, derandomize=True)
@example(seed=1, shift=(6_378_137, -6_378_137, 6_356_752))
@given(seed=st.integers(0, 2**32 - 1), shift=st.tuples(*[st.integers(-(10**7), 10**7)] * 3))
def test_far_from_the_origin_is_as_at_the_origin(seed: int, shift: tuple[int, int, int]) -> None:
    """Shifts of whole metres of coordinates that are whole 2^-20 m are exact: nothing at all may differ."""
    rng = np.random.default_rng(seed)
    points = np.rint(cloud(rng, "plane", 300) * 2.0**20) * 2.0**-20
    o, d = some_rays(rng, points, 1.0, 0.02, 70)
    o = np.rint(o * 2.0**20) * 2.0**-20
    answers = []
    with TemporaryDirectory() as folder:
        for by in (np.zeros(3), np.array(shift)):
            with opened(archive_cases.build(Path(folder), points + by, radius=0.02)) as data:
                rays, loose = raycast(data, o + by, d, 4.0), within(data, o + by, 3.0)
                columns = rays.distance, rays.normal, rays.outside, rays.node_visits, rays.point_tests
                answers.append([c.tobytes() for c in (*columns, loose.distance, loose.node_visits)])
                assert 0 < rays.verdict.sum() < 70 and 0 < loose.verdict.sum() < 70
    assert answers[0] == answers[1]


@settings(max_examples=300, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.sampled_from([1e3, 1e6, 1e9, 1e12, 6e13]),
    radius=st.sampled_from([0, 1, 10**5, 10**6, 2**30]),
    grazing=st.booleans(),
)
def test_the_formula_is_as_near_the_ideal_as_it_says(
    seed: int, size: float, radius: int, grazing: bool
) -> None:
    """In fractions, for the direction given: which spheres are hit, and where. The bounds of kernels/rays/hits.py."""
    rng = np.random.default_rng(seed)
    d = np.rint(rng.normal(size=3) * size).astype(np.int64)
    direction = rng.normal(size=3)
    if grazing:
        across = np.cross(d, direction)
        direction = d + across / np.linalg.norm(across) * radius
    if rng.random() < 0.5:
        direction = rng.normal(size=3) * np.abs(direction).max() * 1e-9 + direction
    u = naive_rays.unit_vectors(direction[None])[0]
    t = float(first_meeting(*d, *u, np.int64(radius)))
    miss2, along2 = naive_rays.ideal_miss(d.tolist(), direction.tolist())
    if sum(int(c) ** 2 for c in d) <= radius**2:
        assert t == 0.0
        return
    length = naive_rays.root(sum((Fraction(int(c)) ** 2 for c in d), Fraction(0))) + 1
    off = length / 2**49
    forward = sum(Fraction(int(a)) * Fraction(float(c)) for a, c in zip(d, direction, strict=True)) > 0
    if forward and miss2 <= max(radius - off, Fraction(0)) ** 2 and radius > off and along2 > off**2:
        assert t < np.inf
    if (not forward and along2 > off**2) or miss2 > (radius + off) ** 2:
        assert t == np.inf
    if t < np.inf:
        ideal = naive_rays.root(along2) - naive_rays.root(max(radius**2 - miss2, Fraction(0)))
        assert abs(Fraction(t) - ideal) <= off * 2 + naive_rays.root(off * 4 * radius) + Fraction(1, 2**40)


@pytest.mark.parametrize("leaf", [1, 32])
def test_of_spheres_hit_at_once_the_least_point_is_named(tmp_path: Path, leaf: int) -> None:
    """The four corners of a square, by a ray through its middle; from within all four; nearest to its middle."""
    h = 2.0**-4
    corners = np.array([[0, h, -h], [0, h, h], [0, -h, -h], [0, -h, h]])
    for points, least in ((corners, (0, -h, -h)), (corners[[0, 1, 3]], (0, -h, h))):
        for order in (points, points[::-1]):
            case = archive_cases.build(
                tmp_path, np.concatenate([order, [[1, 1, 1]]]), resolution=2.0**-10, radius=0.125, leaf=leaf
            )
            with opened(case) as data:
                answers = raycast(data, [(-1.0, 0, 0), (0.0, 0, 0)], [(1.0, 0, 0), (0.0, 1, 0)], 9.0)
                assert answers.cloud_point.tolist() == [list(least)] * 2
                assert answers.distance[1] == 0 and 0.9 < answers.distance[0] < 1
                assert within(data, [(0.0, 0, 0)], 1.0).cloud_point.tolist() == [list(least)]


def test_reach_is_inclusive_to_the_unit(tmp_path: Path) -> None:
    """Lengths of 3, 4, 12 and 13: at the reach, one unit of 2^-26 m short of it, and one beyond."""
    unit = 2.0**-26
    case = archive_cases.build(tmp_path, np.array([[0.0, 0, 0], [1, 1, 1]]), resolution=2.0**-10, radius=0.25)
    away = np.array([[3.0, 4, 12]]) / 64
    with opened(case) as data:
        for more, found in ((0, 1), (unit, 1), (-unit, 0)):
            assert within(data, away, 13 / 64 + more).verdict.tolist() == [found]
            assert raycast(data, [(-1.0, 0, 0)], [(1.0, 0, 0)], 0.75 + more).verdict.tolist() == [found]
            # A ray along x that passes at the radius grazes; one unit farther it does not.
            passing = [(-1.0, 0.25 - more, 0)]
            assert raycast(data, passing, [(1.0, 0, 0)], 1.5).verdict.tolist() == [found]


@pytest.mark.parametrize("kind", synthetic_scans.WITH_POINTS)
def test_a_few_rays_of_every_kind_of_scan(tmp_path: Path, rng: np.random.Generator, kind: str) -> None:
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan(kind, 11, 60), radius=0.05)
    with opened(case) as data:
        lattice = stored(case, data)
        space = data.arrays.origin, data.arrays.step
        o, d = some_rays(rng, lattice, 1.0, 0.05, 14)
        expected = naive_rays.raycast(case.points, *space, 0.05, o, d, 3.0)
        same_rays(raycast(data, o, d, 3.0), expected, lattice)
        same_points(within(data, o, 1.0), naive_rays.within(case.points, *space, o, 1.0), lattice)
        assert (expected.row >= 0).any()
