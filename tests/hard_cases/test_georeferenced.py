"""Hard case of map coordinates, for every question; a test's number is its row in NUMERICS.md."""

from pathlib import Path

import archive_cases
import contact_cases
import numpy as np
import pytest
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.schemas.wire.answers import Cost, Verdict
from solidcloud.schemas.wire.arrays import array_fields
from solidcloud.server.scene import Scene

# UTM, ECEF, and what lies on the other side of the world: whole metres, so that float64 holds what is moved.
SHIFTS = [(500_000, 5_600_000, 100), (4_027_894, 307_045, 4_919_475), (-2_694_892, -4_297_405, -3_854_579)]
# Columns of world positions, and that of a ray's hit: it is no lattice point, so float64 rounds it where it lies.
PLACES = ("witness_avatar", "witness_cloud", "avatar_point", "cloud_point", "cluster_avatar", "cluster_cloud",
          "cluster_low", "cluster_high")  # fmt: skip
COST = (
    "engine_seconds",
    "wait_seconds",
    "hits",
    "misses",
    "late",
    "resident",
    "resident_bytes",
    "faults",
    "stopped",
)


def dyadic(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Numbers rounded to 2^-20, which 1e7 m leave room for in float64."""
    return np.rint(values * 2.0**20) * 2.0**-20


def questions(scene: Scene, shift: NDArray[np.float64], seed: int) -> dict[str, Cost]:
    """The answers to every question of the same places, moved by `shift` [m]."""
    rng = np.random.default_rng(seed)
    count = 40
    body, box = dyadic(rng.uniform(-0.2, 0.2, (9, 3))), dyadic(rng.uniform(-0.1, 0.1, (40, 3)))
    scene.add_avatar("body", body, 0.01)
    scene.add_avatar("box", box, 0.003)
    points = synthetic_scans.make_scan("corner", 3, 300)
    poses = archive_cases.near_poses(rng, points, body, 2 * count, 0.08)
    poses[:, :3, 3] = dyadic(poses[:, :3, 3]) + shift
    ends = poses[rng.permutation(count)]
    starts = dyadic(rng.uniform(0, 2, (4 * count, 3)))
    aims = points[rng.integers(300, size=len(starts))] - starts + rng.normal(0, 0.006, starts.shape)
    items = [(("body", "box")[i % 2], pose, 1 + i % 3) for i, pose in enumerate(poses)]
    return {
        "collide": scene.collide("body", poses),
        "collide, early": scene.collide("body", poses, 0.002, tolerance=0.02),
        "distance": scene.distance("body", poses, 0.1),
        "distance within 30 %": scene.distance("body", poses, 0.1, relative_tolerance=0.3),
        "contacts": scene.contacts("box", poses, 20, 0.02, 0.05),
        "sweep": scene.sweep("body", poses[:count], ends),
        "raycast": scene.raycast(starts + shift, aims, 1.0),
        "within": scene.within(starts + shift, 0.1),
        "objects": scene.objects(items, 0.01),
    }


@pytest.mark.case(
    1,
    "every query at UTM and ECEF coordinates: the reply of the scene at the origin, bit for bit, costs included",
)
@pytest.mark.parametrize("shift", SHIFTS)
def test_case_01_every_question_answers_as_at_the_origin(tmp_path: Path, shift: tuple[int, int, int]) -> None:
    moved = np.array(shift, float)
    points = (
        np.rint(synthetic_scans.make_scan("corner", 3, 300) / archive_cases.BINARY_STEP)
        * archive_cases.BINARY_STEP
    )
    options = {"resolution": archive_cases.BINARY_STEP, "voxel": 0.375, "leaf": 8, "radius": 0.01}
    found, files = [], []
    for place in (np.zeros(3), moved):
        rng = np.random.default_rng(1)  # the same points into the same of two files
        folder = tmp_path / str(len(found))
        folder.mkdir()
        case = contact_cases.open_case(folder, points + place, rng, **options)
        case.store.close()
        with Scene.open(case.store.archive.folder, "scene") as scene:
            found.append(questions(scene, place, 7))
            files.append([Path(source.path).name for source in scene.info().sources])
            scene.residency.check()
    for name, near in found[0].items():
        far = found[1][name]
        for column in array_fields(type(near)):
            one, other = getattr(near, column), getattr(far, column)
            if column == "hit":
                # Within a unit in the last place of where it lies.
                assert np.array_equal(np.isnan(one), np.isnan(other))
                assert np.nanmax(np.abs((other - moved) - one)) <= np.spacing(np.abs(moved).max())
                continue
            if column in PLACES:
                other = other - moved
            # Scans are numbered in the order of their files' checksums, which the shift changes.
            if column in ("scan_index", "cluster_scan"):
                one, other = (np.take(names, rows) for names, rows in zip(files, (one, other), strict=True))
            assert one.tobytes() == other.tobytes(), (name, column)
        rest = set(near.__struct_fields__) - set(array_fields(type(near))) - set(COST)
        assert all(getattr(near, field) == getattr(far, field) for field in rest)
    for name, near in found[0].items():
        assert 0 < sum(near.verdict == Verdict.CONTACT) < len(near), name
    assert len(found[0]["contacts"].avatar_point) >= 5
    assert len(found[0]["objects"].pairs) > 0
