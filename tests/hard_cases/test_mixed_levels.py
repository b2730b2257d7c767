"""Hard case of voxels and representatives together; a test's number is its row in NUMERICS.md."""

import itertools
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import archive_cases
import naive_distance
import numpy as np
import pytest
import radius_class_archives
from judged_distance import judge_distance
from numpy.typing import NDArray
from sample_sizes import sample
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.arrays import array_fields
from solidcloud.server.kernels.core.scene_arrays import Arena
from solidcloud.server.queries.collide import collide
from solidcloud.server.queries.distance import distance
from solidcloud.server.queries.query_inputs import QueryBudget
from solidcloud.server.queries.sweep import DEFAULT_TOLERANCE, sweep
from solidcloud.server.residency.voxel_store import VoxelStore
from solidcloud.server.scene import Scene

# ECEF and UTM, in whole metres.
SHIFTS = [(0, 0, 0), (4_027_894, 307_045, 4_919_475), (500_000, 5_600_000, 100)]
STEP = archive_cases.BINARY_STEP
MARGIN, REACH = 0.02, 0.75
TOLERANCES = sample((0.0, 0.05), (0.0, 3e-3, 0.05, 0.4))


def scan(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a floor, a wall and scattered points in nine voxels and more, on the lattice."""
    count = 1500
    floor, wall = rng.uniform(0, 1.5, (2, count, 3))
    floor[:, 2] *= 0.002
    wall[:, 0] *= 0.002
    return np.rint(np.concatenate([floor, wall, rng.uniform(0, 1.5, (20, 3))]) / STEP) * STEP


class PartStore(VoxelStore):
    """Store of an archive in which only some voxels can be read. rows: of these; None: all."""

    rows: set[int] | None = None

    def load(self, row: int, arena: Arena, offset: int) -> NDArray[np.int64]:
        """Load a voxel, or fail."""
        if self.rows is not None and row not in self.rows:
            raise OSError(5, "Input/output error")
        return super().load(row, arena, offset)


@contextmanager
def opened(archive: Path, body: NDArray[np.float64], rows: set[int]) -> Iterator[Scene]:
    """Open an archive of which only these voxels can be read; they and its whole level are in memory."""
    store, room = PartStore(archive), 1 << 24
    with Scene.open(archive, budget_bytes=2 * room, level_bytes=room, open_store=lambda _: store) as scene:
        store.rows = rows
        with scene.archives[0].take() as generation:
            level = generation.level
            assert level is not None and level.fits
            with level.residency.hold(range(len(level.store.sizes))), scene.residency.hold(sorted(rows)):
                scene.add_avatar("body", body, 0.01)
                yield scene


def ask(scene: Scene, poses: NDArray[np.float64], budget: QueryBudget) -> list[Any]:
    """Return the answers of the queries that use representatives."""
    data, avatar = scene._data, scene.avatar("body", "")
    return [
        collide(data, avatar, poses, MARGIN, budget),
        distance(data, avatar, poses, REACH, budget),
        sweep(data, avatar, poses[:-1], poses[1:], MARGIN, DEFAULT_TOLERANCE, budget),
    ]


@pytest.mark.case(
    35,
    "voxels in memory beside representatives of others, at UTM and ECEF too: brute force, and the same everywhere",
)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.7, 1.0])
def test_case_35_voxels_and_representatives_together(tmp_path: Path, share: float) -> None:
    rng = np.random.default_rng(35)
    points = scan(rng)
    body = np.rint(rng.uniform(-0.15, 0.15, (20, 3)) / STEP) * STEP
    poses = archive_cases.near_poses(rng, points, body, 40, 0.5)
    poses[:, :3, 3] = np.rint(poses[:, :3, 3] / STEP) * STEP
    chosen: set[int] = set()
    answers: list[list[Any]] = []
    for number, shift in enumerate(SHIFTS):
        (tmp_path / str(number)).mkdir()
        case = archive_cases.build(tmp_path / str(number), points + np.array(shift), resolution=STEP, leaf=8)
        stored, radii = radius_class_archives.stored_radii(case.archive, None)
        moved = poses.copy()
        moved[:, :3, 3] += shift
        with Scene.open(case.archive) as scene:
            voxels, origin = scene.info().voxels, scene.info().origin
            scene.add_avatar("body", body, 0.01)
            true = scene.sweep("body", moved[:-1], moved[1:], MARGIN)
        if number == 0:
            chosen = set(rng.permutation(voxels)[: round(share * voxels)].tolist())
        judged = naive_distance.distance_by_radii(stored, origin, STEP, radii, body, 0.01, moved, 10.0)
        signed = np.array([each.signed for each in judged if each is not None])
        assert len(signed) == len(poses) and 0 < (signed <= MARGIN).sum() < len(signed)
        answers.append([])
        # With a deadline, far away, representatives are asked again about what is missing.
        for tolerance, deadline in itertools.product(TOLERANCES, (math.inf, 1e9)):
            with opened(case.archive, body, chosen) as scene:
                found = ask(scene, moved, QueryBudget(tolerance=tolerance, deadline=deadline))
            touch, near, swept = found
            answers[-1] += found
            exact = (touch.verdict != Verdict.UNKNOWN) if tolerance == 0 else touch.exact
            assert (signed[touch.verdict == Verdict.CLEAR] > MARGIN).all(), "a false clear"
            assert (signed[touch.verdict == Verdict.CONTACT] <= MARGIN + tolerance).all(), "too early"
            assert (signed[exact & (touch.verdict == Verdict.CONTACT)] <= MARGIN).all()
            if len(touch.lower):
                assert (touch.lower <= np.minimum(signed, MARGIN)).all() and (touch.upper >= signed).all()
            judge_distance(near, np.where(signed <= REACH, signed, np.inf), REACH, tolerance, share == 1.0)
            clear = swept.verdict == Verdict.CLEAR
            assert (true.verdict[clear] == Verdict.CLEAR).all()
            assert (swept.lower <= np.minimum(true.upper, 1.0)).all()
            assert (swept.upper >= true.lower).all()
            assert share < 1.0 or (touch.verdict != Verdict.UNKNOWN).all()
            if 0.0 < share < 1.0:
                lost = touch.voxels_missing > 0
                assert (touch.verdict == Verdict.CLEAR).any()
                assert (~lost).any(), "by voxels, or by the level before a voxel was asked for"
    for shift, elsewhere in zip(SHIFTS[1:], answers[1:], strict=True):
        for here, there in zip(answers[0], elsewhere, strict=True):
            for name in array_fields(type(here)):
                one, other = getattr(here, name), getattr(there, name)
                if name.startswith("witness"):
                    other = other - np.array(shift)
                assert one.tobytes() == other.tobytes(), name
