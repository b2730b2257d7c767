"""Scenes, motions and expected answers for tests of `sweep`."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import archive_cases
import naive
import naive_sweep
import numpy as np
import radius_class_archives
from numpy.typing import NDArray
from solidcloud.schemas.wire.answers import SweepAnswers, Verdict
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries.query_inputs import SceneData, make_scene_data, with_radius_model
from solidcloud.server.queries.sweep import DEFAULT_TOLERANCE, sweep
from solidcloud.server.residency.voxel_cache import VoxelCache
from solidcloud.server.residency.voxel_store import VoxelStore

CLOUDS = ("plane", "corner", "pillar", "noise", "duplicates", "one point")


def turned(rng: np.random.Generator, turn: NDArray[np.float64], most: float) -> NDArray[np.float64]:
    """Return a rotation by at most this angle [rad]."""
    axis = rng.normal(size=3)
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = rng.uniform(0, most)
    return (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross) @ turn


def motions(
    rng: np.random.Generator,
    points: NDArray[np.float64],
    avatar: NDArray[np.float64],
    count: int,
    near: float,
    way: float,
    turn: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return first and last poses (count, 4, 4) of motions, most with rotation.

    Each begins within `near` of some scan point.
    """
    first = archive_cases.near_poses(rng, points, avatar, count, near)
    last = first.copy()
    for pose in last:
        pose[:3, :3] = turned(rng, pose[:3, :3], turn)
        pose[:3, 3] += rng.normal(size=3) * way
    return first, last


@contextmanager
def opened(
    case: archive_cases.Case, budget_bytes: int = 1 << 26, model: str | None = None
) -> Iterator[SceneData]:
    """Return the arguments that `sweep` takes from an archive, with the radii of a model."""
    store = VoxelStore(case.archive)
    try:
        data = make_scene_data(store.archive, VoxelCache(store, budget_bytes))
        yield with_radius_model(data, store.archive, model)
        data.residency.check()
    finally:
        store.close()


def ask(
    data: SceneData,
    avatar: NDArray[np.float64],
    radius: float,
    first: NDArray[np.float64],
    last: NDArray[np.float64],
    **options: Any,
) -> SweepAnswers:
    """Return the answers for motions from first to last (k, 4, 4)."""
    return sweep(data, make_avatar(avatar, radius), first, last, **{"tolerance": DEFAULT_TOLERANCE} | options)


def moved(avatar: NDArray[np.float64], one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Return the largest displacement of an avatar point between two poses [m]."""
    apart = avatar @ (other[:3, :3] - one[:3, :3]).T + (other[:3, 3] - one[:3, 3])
    return float(np.linalg.norm(apart, axis=1).max())


def named_pair(answers: SweepAnswers, i: int, origin: Any, step: float) -> tuple[list[int], list[int]]:
    """Return the pair that an answer names: its scan point [lattice steps] and avatar centre [exact units]."""
    placed = np.rint((answers.witness_avatar[i] - origin) * naive.UNITS).astype(np.int64)
    return naive.lattice_of(answers.witness_cloud[i], origin, step).tolist(), placed.tolist()


def radii_of(case: archive_cases.Case, data: SceneData, model: str | None) -> NDArray[np.float64]:
    """Return the radius (n,) [m] of each of a case's points; equal for points at the same position."""
    stored, units = radius_class_archives.stored_radii(case.archive, model)
    found = dict(zip(map(tuple, stored.tolist()), units.tolist(), strict=True))
    lattice = naive.lattice_of(case.points, data.arrays.origin, data.arrays.step)
    return np.array([found[tuple(place)] for place in lattice.tolist()]) / naive.UNITS


def judge(
    case: archive_cases.Case,
    data: SceneData,
    avatar: NDArray[np.float64],
    radius: float,
    first: NDArray[np.float64],
    last: NDArray[np.float64],
    answers: SweepAnswers,
    *,
    margin: float = 0.0,
    tolerance: float = 1e-6,
    samples: int = 60,
    model: str | None = None,
) -> None:
    """Assert that no answer contradicts sampled poses, judged by brute force in integers.

    model: of the radii with which `data` was opened. Samples lie evenly on the whole motion, and
    closely before `lower` and between the two bounds.
    """
    arrays = data.arrays
    radii = radii_of(case, data, model)
    scan = (case.points, arrays.origin, arrays.step, radii)
    lattice = naive.lattice_of(*scan[:3])
    for i, motion in enumerate(zip(first, last, strict=True)):
        lower, upper = float(answers.lower[i]), float(answers.upper[i])
        said = (Verdict(int(answers.verdict[i])).name, lower, upper, motion[0].tolist(), motion[1].tolist())
        assert 0 <= lower <= 1 and lower <= upper, said
        close = lower - lower * np.geomspace(1e-15, 1e-2, 14)
        between = np.linspace(lower, min(upper, 1.0), 9)
        at = np.unique(np.concatenate([np.linspace(0, 1, samples), close, between]))
        touching = naive_sweep.touching(*scan, avatar, radius, motion, at, margin)
        assert not touching[at < lower].any(), ("contact before lower", at[touching].tolist(), said)
        if answers.verdict[i] == Verdict.CLEAR:
            assert lower == 1 and upper == np.inf and answers.exact[i], said
            assert not touching.any(), ("contact on a clear way", at[touching].tolist(), said)
        if answers.verdict[i] != Verdict.CONTACT:
            assert upper == np.inf and np.isnan(answers.witness_avatar[i]).all(), said
            continue
        assert naive_sweep.touching(*scan, avatar, radius, motion, [upper], margin)[0], (
            "upper is clear",
            said,
        )
        if upper == 0:
            pairs = naive_sweep.touching_pairs(*scan, avatar, radius, motion[0], margin)
            assert named_pair(answers, i, arrays.origin, arrays.step) == min(pairs), said
        poses = [naive_sweep.pose_at(*motion, t) for t in (lower, upper)]
        far = max(float(np.abs(p[:3, 3] - arrays.origin).max()) for p in poses) + 1.0
        if answers.exact[i]:
            assert moved(avatar, *poses) <= tolerance * (1 + 1e-9) + far * 2.0**-45, said
        apart = np.linalg.norm(answers.witness_avatar[i] - answers.witness_cloud[i])
        named = radii[(lattice == naive.lattice_of(answers.witness_cloud[i], *scan[1:3])).all(axis=1)]
        assert len(named), said
        assert apart <= named[0] + margin + radius + 1e-7 + far * 2.0**-45, said
