"""Hard cases of points and where they lie; a test's number is its row in the table of hard cases (NUMERICS.md)."""

from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from sample_sizes import sample
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import BadRequestError, ScanError
from solidcloud.server.scene import Scene

POINT = np.zeros((1, 3))


def places(points: np.ndarray) -> np.ndarray:
    """Poses that only translate."""
    return np.array([archive_cases.pose_of(np.eye(3), point) for point in points]).reshape(-1, 4, 4)


def stored(case: archive_cases.Case) -> np.ndarray:
    """All lattice points (n, 3) of an archive, sorted."""
    with Archive(case.archive) as archive:
        base = archive.coordinates * archive.header.lattice.voxel_steps
        parts = [voxel_points(*archive.read_voxel(row)) + low for row, low in enumerate(base)]
    return np.array(sorted(map(tuple, np.concatenate(parts).tolist())))


@pytest.mark.case(
    7,
    "10^6 identical points: one cell over its capacity, a tree of the usual height, contact exact",
)
def test_case_07_identical_points_build_and_answer(tmp_path: Path) -> None:
    count = 1_000_000
    points = np.full((count, 3), 0.125)
    case = archive_cases.build(tmp_path, points, voxel=8.0)
    with Archive(case.archive) as archive:
        assert len(archive.voxels) == 1
        voxel, links = archive.read_voxel(0)
        assert len(voxel.points) == count and len(voxel.cells.nodes) == 1, "one cell, over its capacity"
        assert links.height <= 1 + np.ceil(np.log(count / 32) / np.log(8)), "and a tree of the usual height"
    touching = places(np.array([[0.125, 0.125, 0.145], [0.125, 0.125, 0.1452]]))
    assert archive_cases.ask(case, POINT, 0.01, touching).tolist() == [1, 0]


@pytest.mark.case(
    9,
    "one point needs --radius; an empty voxel is clear; an avatar and a scene without points are refused",
)
def test_case_09_one_point_an_empty_voxel_an_empty_avatar_an_empty_scene(tmp_path: Path) -> None:
    with pytest.raises(BadRequestError, match="give --radius"):
        archive_cases.build(tmp_path, POINT, radius=None)
    one = archive_cases.build(tmp_path, POINT, radius=0.02)
    assert archive_cases.ask(one, POINT, 0.03, places(np.array([[0.05, 0, 0], [0.0501, 0, 0]]))).tolist() == [
        1,
        0,
    ]
    with Scene.open(one.archive) as scene, pytest.raises(BadRequestError, match="'nobody' has no points"):
        scene.add_avatar("nobody", np.empty((0, 3)), 0.03)
    # Between two voxels with points lie some without: clear there, nothing missing, not outside.
    apart = archive_cases.build(tmp_path, np.array([[0.0, 0, 0], [9.0, 9, 9]]))
    with Scene.open(apart.archive) as scene:
        scene.add_avatar("ball", POINT, 0.1)
        answers = scene.collide("ball", places(np.array([[4.5, 4.5, 4.5]])))
    assert (answers.verdict[0], answers.outside[0], answers.voxels_missing[0]) == (0, False, 0)
    nothing = synthetic_scans.write_ply(tmp_path / "nothing.ply", np.empty((0, 3)))
    with pytest.raises(ScanError, match="no usable point"):
        build_archive([nothing], tmp_path / "empty", BuildConfig(jobs=1))
    assert not (tmp_path / "empty").exists()


@pytest.mark.case(
    10,
    "points on cell and voxel borders, including -0.0, are stored once each and give contact where they are",
)
def test_case_10_points_on_borders_are_each_in_one_cell(tmp_path: Path) -> None:
    steps = np.array([-20, -11, -10, -9, -1, 0, 1, 9, 10, 11, 20])
    points = np.stack(np.meshgrid(steps, steps, [0, 10], indexing="ij"), axis=-1).reshape(-1, 3) * 0.1
    points[points == 0.0] = -0.0
    case = archive_cases.build(tmp_path, points, voxel=1.0, resolution=0.1, radius=0.0, cell_points=1)
    expected = np.rint((points - points.min(axis=0)) / 0.1).astype(int)
    assert stored(case).tolist() == sorted(expected.tolist())
    with Archive(case.archive) as archive:
        assert not np.signbit(archive.header.lattice.origin[2])
        for row in range(len(archive.voxels)):
            voxel, links = archive.read_voxel(row)
            inside = voxel_points(voxel, links)
            assert (inside >= 0).all() and (inside < 10).all()
    on = np.concatenate([points, points + np.array([0.05, 0, 0])])
    assert archive_cases.ask(case, POINT, 0.01, places(on)).tolist() == [1] * len(points) + [0] * len(points)


@pytest.mark.case(
    11, "voxels of 8, 0.3 and 0.07 m and shifted grids: the judge's verdicts; contact from across a border"
)
def test_case_11_contact_across_borders_for_any_voxels(tmp_path: Path, rng: np.random.Generator) -> None:
    size, count = sample((300, 30), (800, 80))
    points, avatar = synthetic_scans.make_scan("noise", 6, size), rng.uniform(-0.3, 0.3, (20, 3))
    poses = archive_cases.near_poses(rng, points, avatar, count, 0.06)
    lows = points.min(axis=0)
    found = []
    for voxel, shift in ((8.0, 0.0), (0.3, 0.0), (0.07, 0.0), (0.3, 0.1), (0.3, 0.2)):
        # A stray point moves the origin, and with it the grid, by whole steps: 0.1 m is 1,024 of 2^-10 m less 102.
        stray = (
            lows - np.rint(shift / archive_cases.BINARY_STEP) * archive_cases.BINARY_STEP if shift else lows
        )
        case = archive_cases.build(
            tmp_path,
            np.concatenate([points, stray[None]]),
            voxel=voxel,
            resolution=archive_cases.BINARY_STEP,
            radius=0.015,
        )
        verdicts = archive_cases.ask(case, avatar, 0.02, poses)
        assert verdicts.tolist() == case.judge(avatar, 0.02, poses).astype(int).tolist()
        if not shift:
            found.append(verdicts.tolist())
    assert found[0] == found[1] == found[2] and count / 8 < sum(found[0]) < count * 7 / 8
    # Two points on either side of a border, each touched from the other side.
    pair = archive_cases.build(
        tmp_path, np.array([[0.0, 0, 0], [0.999, 0, 0], [1.0, 0, 0]]), voxel=1.0, resolution=1e-3
    )
    beside = places(np.array([[0.975, 0, 0], [1.025, 0, 0], [0.9995, 0.02, 0], [-0.02, 0, 0]]))
    assert archive_cases.ask(pair, POINT, 0.016, beside).tolist() == [1, 1, 1, 1]


@pytest.mark.case(
    12,
    "points one step apart in far corners of a voxel of 2^21 steps, twins among them: cells of one step, no deeper",
)
def test_case_12_the_deepest_level_is_one_lattice_step(tmp_path: Path) -> None:
    step = archive_cases.BINARY_STEP
    last = (1 << 21) - 2
    corners = np.array([[x, y, z] for x in (0, last) for y in (0, last) for z in (0, last)])
    around = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    lattice = (corners[:, None] + around).reshape(-1, 3)
    points = np.concatenate([lattice, lattice[::5], lattice[::5]]) * step
    case = archive_cases.build(
        tmp_path, points, voxel=(1 << 21) * step, resolution=step, radius=step / 4, cell_points=1
    )
    with Archive(case.archive) as archive:
        assert len(archive.voxels) == 1 and archive.header.lattice.voxel_steps == 1 << 21
        cells = archive.read_voxel(0)[0].cells
    # A cell a place; twins share the smallest there is, which holds more than its capacity and is not split.
    assert len(cells.points) == len(lattice) and (cells.log2_size == 0).all()
    assert sorted(cells.points.tolist()) == [1] * (len(lattice) - 13) + [3] * 13
    assert stored(case).tolist() == sorted(np.rint(points / step).astype(int).tolist())
    # Every place is told from its neighbours a step away, and so is what lies between two.
    assert archive_cases.ask(case, POINT, step / 4, places(lattice * step)).tolist() == [1] * len(lattice)
    beside = places((lattice[:8] - [0.75, 0, 0]) * step)
    expected = case.judge(POINT, step / 4, beside).astype(int).tolist()
    assert archive_cases.ask(case, POINT, step / 4, beside).tolist() == expected and 0 < sum(expected) < 8


@pytest.mark.case(
    13,
    "10^6 points in 5 cm beside 100 over 8 m: work grows with the levels, in build and queries",
)
def test_case_13_a_million_to_one_in_one_voxel(tmp_path: Path, rng: np.random.Generator) -> None:
    sizes = (10_000, 1_000_000)
    thin = rng.uniform(0, 8, (100, 3))
    thin[:2] = [[0, 0, 0], [7.9, 7.9, 7.9]]
    avatar = rng.uniform(-0.02, 0.02, (30, 3))
    poses = archive_cases.near_poses(rng, np.full((1, 3), 4.025), avatar, 100, 0.08)
    work, cost, near = [], [], []
    for size in sizes:
        dense = 4.0 + rng.uniform(0, 0.05, (size, 3))
        case = archive_cases.build(tmp_path, np.concatenate([thin, dense]), voxel=8.0, radius=1e-4)
        # Points a cubic metre: in the middle, and around it.
        assert (size / 0.05**3) / (100 / 8.0**3) >= 1e6
        with Archive(case.archive) as archive:
            assert len(archive.voxels) == 1
            voxel, links = archive.read_voxel(0)
        # What measuring bounds looks at: every node's points, so every point once a level above it.
        held = np.zeros(len(links.first), np.int64)
        for node in range(len(held) - 1, -1, -1):
            first, count = int(links.first[node]), int(voxel.nodes.count[node])
            held[node] = count if links.is_leaf[node] else held[first : first + count].sum()
        work.append(held.sum() / (size + 100))
        with Scene.open(case.archive) as scene:
            scene.add_avatar("avatar", avatar, 1e-4)
            found, apart = scene.collide("avatar", poses), scene.distance("avatar", poses, 0.1)
        cost.append((found.node_visits + found.point_tests / 32.0).mean())
        near.append((apart.node_visits + apart.point_tests / 32.0).mean())
        some = slice(None, None, 20)
        assert found.verdict[some].tolist() == case.judge(avatar, 1e-4, poses[some]).astype(int).tolist()
    # A hundred times the points: found 4.8 and 7.6 looks a point, 2 and 6 times the cost of a question.
    assert work[1] <= work[0] + 4, work
    assert cost[1] <= 9 * cost[0] and near[1] <= 9 * near[0], (cost, near)


@pytest.mark.case(
    27,
    "points and avatar in any order, files in any order: the same shards, the same archive, the same verdicts",
)
def test_case_27_no_order_changes_answers_or_bytes(tmp_path: Path, rng: np.random.Generator) -> None:
    points, avatar = synthetic_scans.make_scan("corner", 8, 200), rng.uniform(-0.2, 0.2, (15, 3))
    poses = archive_cases.near_poses(rng, points, avatar, 10, 0.1)
    first = archive_cases.build(tmp_path, points, leaf=4, cell_points=20)
    second = archive_cases.build(tmp_path, rng.permutation(points), leaf=4, cell_points=20)
    shards = [sorted((case.archive / "shards").iterdir()) for case in (first, second)]
    assert [[f.read_bytes() for f in s] for s in shards[:1]] == [
        [f.read_bytes() for f in s] for s in shards[1:]
    ]
    # Two files in either order: the whole archive is the same.
    for name, part in (("a", points[:120]), ("b", points[120:])):
        synthetic_scans.write_ply(tmp_path / f"{name}.ply", part)
    both = [tmp_path / "a.ply", tmp_path / "b.ply"]
    options = BuildConfig(voxel=0.5, radius=0.01, jobs=1, leaf=4, cell_points=20)
    for order, target in ((both, "ab"), (both[::-1], "ba")):
        build_archive(order, tmp_path / target, options)
    files = [sorted((tmp_path / target).rglob("*.h5")) for target in ("ab", "ba")]
    assert [f.read_bytes() for f in files[0]] == [f.read_bytes() for f in files[1]]
    ab = archive_cases.Case(tmp_path / "ab", points)
    verdicts = [
        archive_cases.ask(case, body, 0.01, poses).tolist()
        for case in (first, second, ab)
        for body in (avatar, avatar[::-1], rng.permutation(avatar))
    ]
    assert all(v == verdicts[0] for v in verdicts)
