"""Radius classes equal brute force, and are a function of the points around: not of voxels, files, jobs or memory."""

import math
from fractions import Fraction
from functools import lru_cache
from pathlib import Path

import naive_classes
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.kernels.neighbours.nearest_neighbours import bound_boxes, box_starts
from solidcloud.builder.kernels.neighbours.point_classes import TOO_FEW_NEIGHBOURS, point_classes
from solidcloud.builder.passes.radius_classes import class_limits
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.index import Header
from solidcloud.schemas.archive.radius_model import LOCAL_CLASSES, RIM_BIT, local_radii, radius_distribution
from synthetic_scans import make_scan, write_xyz

STEP = 0.001
ALL = frozenset({"mean", "local", "border"})


def build(folder: Path, *clouds: NDArray[np.int64], **options: object) -> Path:
    """An archive of scans, each of lattice points (n, 3)."""
    name = f"{sum(1 for _ in folder.iterdir())}"
    paths = [write_xyz(folder / f"{name}-{i}.xyz", cloud * STEP) for i, cloud in enumerate(clouds)]
    config = BuildConfig(
        **{"resolution": STEP, "jobs": 1, "cell_points": 40, "leaf": 8, "models": ALL, **options}
    )
    build_archive(paths, folder / name, config)
    return folder / name


def stored(folder: Path) -> tuple[NDArray[np.int64], NDArray[np.uint8], Header]:
    """All points (n, 3) of an archive [lattice steps], sorted, with their classes (n,)."""
    rows = []
    with Archive(folder) as archive:
        for row in range(len(archive.voxels)):
            voxel, links = archive.read_voxel(row)
            lattice = (
                voxel_points(voxel, links) + archive.coordinates[row] * archive.header.lattice.voxel_steps
            )
            rows.append(np.column_stack([lattice, voxel.radius_class]))
        table = np.concatenate(rows)
        table = table[np.lexsort((table[:, 2], table[:, 1], table[:, 0]))]
        return table[:, :3], table[:, 3].astype(np.uint8), archive.header


def cloud(kind: str, seed: int, count: int = 400, size: int = 1500) -> NDArray[np.int64]:
    """Lattice points (n, 3) with the least coordinate of each axis 0: dense and thin parts, some points twice."""
    rng = np.random.default_rng(seed)
    steps = np.floor(make_scan(kind, seed, count) / 2 * size).astype(np.int64)
    steps[: count // 3] = steps[: count // 3] // 6 + size // 3
    steps = np.concatenate([steps, steps[rng.integers(len(steps), size=count // 8)]])
    return steps - steps.min(axis=0)


def judge(lattice: NDArray[np.int64], step: str = "0.001") -> tuple[NDArray[np.uint8], int]:
    """Return the class (n,) of each point by brute force, and how many have too few neighbours."""
    return _judge(np.ascontiguousarray(lattice).tobytes(), step)


@lru_cache(maxsize=4)  # the same points in other voxels are judged once
def _judge(points: bytes, step: str) -> tuple[NDArray[np.uint8], int]:
    lattice = np.frombuffer(points, np.int64).reshape(-1, 3)
    of_place = naive_classes.judge(lattice, step)
    judged = [of_place[tuple(point)] for point in lattice.tolist()]
    classes = np.array([found.local + RIM_BIT * found.rim for found in judged], np.uint8)
    return classes, sum(found.capped for found in judged)


@pytest.mark.parametrize("kind", ["corner", "duplicates"])
def test_classes_equal_brute_force_for_any_voxels(kind: str, tmp_path: Path) -> None:
    lattice = cloud(kind, 4)
    # Voxels larger than all, of half of it, and smaller than what a class looks at.
    for voxel in (8.0, 0.7, 0.16):
        points, classes, header = stored(build(tmp_path, lattice, voxel=voxel))
        expected, few = judge(points)
        assert np.array_equal(classes, expected)
        assert len(np.unique(classes)) > 4
        assert header.radius_capped == few
        assert header.radius_counts.tolist() == np.bincount(expected, minlength=32).tolist()
        assert header.models == ("mean", "local", "border")


def test_the_finest_lattice_and_the_largest_voxels(tmp_path: Path) -> None:
    # A voxel of 2 m and what is around it take more than the 21 bits of a Morton code.
    rng = np.random.default_rng(9)
    wide = rng.integers(0, 2_600_000, (300, 3)) * [1, 1, 0]
    dense = rng.integers(0, 100_000, (200, 3)) * [1, 0, 1] + [1_950_000, 700_000, 0]
    lattice = np.concatenate([[[0, 0, 0]], wide, dense])
    path = write_xyz(tmp_path / "a.xyz", lattice * 1e-6)
    build_archive([path], tmp_path / "a", BuildConfig(resolution=1e-6, voxel=2.0, jobs=1, models=ALL))
    points, classes, header = stored(tmp_path / "a")
    assert header.lattice.voxel_steps == 2_000_000
    expected, few = judge(points, "1e-06")
    assert np.array_equal(classes, expected)
    assert header.radius_capped == few
    assert len(np.unique(classes)) > 3


@pytest.mark.parametrize("models", [{"local"}, {"border"}])
def test_only_what_is_asked_for_is_stored(models: set[str], tmp_path: Path) -> None:
    lattice = cloud("corner", 8)
    full = stored(build(tmp_path, lattice))[1]
    _, classes, header = stored(build(tmp_path, lattice, models=frozenset({"mean", *models})))
    kept = ("local" in models) * (RIM_BIT - 1) + ("border" in models) * RIM_BIT
    assert np.array_equal(classes, full & kept)
    assert set(header.models) == {"mean", *models}
    found = radius_distribution(header.models, header.radius_counts, header.radius_capped)
    assert found is not None
    local = np.bincount(full % 16, minlength=16)
    assert [(r.radius, r.points) for r in found.local] == (
        [(r, n) for r, n in zip(local_radii(), local, strict=True) if n] if "local" in models else []
    )
    assert (found.capped is None) == ("local" not in models)
    assert found.rim == (int((full >= RIM_BIT).sum()) if "border" in models else None)


@pytest.mark.parametrize("step", ["0.0001", "0.001", "0.002", "1e-06", "0.25", "0.0009765625"])
def test_limits_are_the_last_integers_that_the_definition_holds(step: str) -> None:
    limits, size = class_limits(float(step)), Fraction(step)
    assert limits.reach2 * size**2 <= naive_classes.REACH**2 < (limits.reach2 + 1) * size**2
    assert len(limits.local2) == len(naive_classes.LADDER) - 1 == LOCAL_CLASSES - 1
    for limit, radius in zip(limits.local2.tolist(), naive_classes.LADDER, strict=False):
        assert limit * size**2 <= (13 * Fraction(radius, 1_000_000)) ** 2 < (limit + 1) * size**2
    # So that no point farther than the last neighbour that counts could have another class than the last.
    assert 13 * naive_classes.LADDER[-2] < 362_000 < 13 * naive_classes.LADDER[-1]


@pytest.mark.interpreted
@pytest.mark.parametrize("held", [11, 12, 24, 30])
def test_the_kernel_and_the_judge_agree_at_the_edge_of_each_rule(held: int) -> None:
    # Few neighbours or enough, symmetric or to one side, at each limit and a step beyond it.
    limits = class_limits(STEP)
    for limit in limits.local2[::3].tolist():
        for beyond in (0, 1):
            for side in (0, 1, 2):
                points = _ring(held, math.isqrt(limit) + beyond, side)
                at = naive_classes.judge(points.astype(np.int64), "0.001")[0, 0, 0]
                assert class_of_origin(points) == at.local + RIM_BIT * at.rim + TOO_FEW_NEIGHBOURS * at.capped


def class_of_origin(points: NDArray[np.integer]) -> int:
    """The class that the kernel gives the first of points (n, 3) that is (0, 0, 0), with TOO_FEW_NEIGHBOURS."""
    points = points.astype(np.int32)
    rows = np.where((points == 0).all(axis=1), 0, -1).astype(np.int32)
    starts, classes = box_starts(len(points)), np.empty(1, np.uint8)
    point_classes(points, bound_boxes(points, starts), starts, rows, *class_limits(STEP), classes)
    return int(classes[0])


def _ring(held: int, radius: int, side: int) -> NDArray[np.int32]:
    """The origin, and `held` points at most `radius` from it: all around, on two of three sides, or on one side."""
    turns = np.arange(held) / max(held, 1) * 2 * np.pi / (1, 1.5, 2)[side]
    lengths = np.where(np.arange(held) % 2, radius, radius * 0.9)
    around = np.column_stack([np.cos(turns), np.sin(turns), np.zeros(held)]) * lengths[:, None]
    return np.unique(np.concatenate([[[0, 0, 0]], np.trunc(around)]), axis=0).astype(np.int32)
