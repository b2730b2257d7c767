"""`raycast` with spheres of several sizes equals its definition; `within`, and objects among themselves, take none."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import naive
import naive_objects
import naive_rays
import numpy as np
import radius_class_archives
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from point_clouds import TREES, cloud
from ray_cases import KINDS, opened, same_points, same_rays, some_rays
from sample_sizes import sample
from solidcloud.schemas.archive.radius_model import RIM_BIT
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries.objects import SCENE_GROUP, objects
from solidcloud.server.queries.rays_and_points import raycast, within

MODELS = (*radius_class_archives.MODELS, "local", "local+border", "border:0")


@settings(max_examples=sample(4, 20), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    count=st.sampled_from([1, 2, 33, 300, 900]),
    model=st.sampled_from(MODELS),
    step=st.sampled_from([1e-6, archive_cases.BINARY_STEP, 1e-4, 1e-2]),
    voxel_steps=st.sampled_from([7, 1000, 70_000]),
    far=st.sampled_from([0.0, 5e5, 1e8]),
    tree=TREES,
)
def test_the_first_sphere_is_the_definitions(
    seed: int,
    kind: str,
    count: int,
    model: str | None,
    step: float,
    voxel_steps: int,
    far: float,
    tree: dict[str, Any],
) -> None:
    rng = np.random.default_rng(seed)
    if step <= far * 1e-14:
        far = 0.0
    extent = step * voxel_steps * rng.uniform(0.1, 3)
    points = cloud(rng, kind, count) * extent + far * rng.uniform(-1, 1, 3)
    with TemporaryDirectory() as folder, radius_class_archives.any_classes():
        case = archive_cases.build(
            Path(folder),
            points,
            voxel=step * voxel_steps,
            resolution=step,
            models=radius_class_archives.STORED,
            **tree,
        )
        stored, units = radius_class_archives.stored_radii(case.archive, model)
        with opened(case, model=model) as data:
            space = data.arrays.origin, data.arrays.step
            lattice = stored * data.arrays.step + data.arrays.origin
            radii = units / naive.UNITS
            o, d = some_rays(rng, lattice, extent, radii, 70)
            for reach in (extent * rng.uniform(0.3, 4), 1e6):
                expected = naive_rays.raycast(lattice, *space, radii, o, d, reach)
                same_rays(raycast(data, o, d, reach), expected, lattice)
            near = naive_rays.within(lattice, *space, o, 1.0)
            same_points(within(data, o, 1.0), near, lattice)


def test_a_larger_sphere_behind_is_hit_before_a_small_one(tmp_path: Path) -> None:
    """Two points on a ray, the near one on a rim; and two beside another."""
    points = np.array([[0.0, 0.0, 0.0], [0.05, 0.0, 0.0], [0.0, 0.1875, 1.0], [0.25, 0.1875, 1.0]])

    def rims(local: NDArray[np.int32]) -> NDArray[np.uint8]:
        return np.where(local[:, 0] == 0, RIM_BIT, 0).astype(np.uint8)

    with radius_class_archives.any_classes(rims):
        case = archive_cases.build(
            tmp_path, points, voxel=2.0, resolution=2.0**-10, radius=0.25, models=radius_class_archives.STORED
        )
    o, d = [[-1.0, 0.0, 0.0], [-1.0, 0.0, 1.0]], [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    unit = 2.0**-26
    for model, nearest, distance in (("border", 0.05, 0.8), (None, 0.0, 0.75)):
        with opened(case, model=model) as data:
            found = raycast(data, o, d, 2.0)
            assert np.allclose(found.cloud_point[:, 0], [nearest, 0.25 if model else 0.0], atol=1e-3)
            assert np.allclose(found.distance[0], distance, atol=1e-3)
            reach = float(found.distance[1])
            for more, hit in ((0.0, 1), (-2 * unit, 0)):
                assert raycast(data, o[1:], d[1:], reach + more).verdict.tolist() == [hit]
            # 0.1875 m from the ray: beyond a rim point's radius, within the others'.
            assert raycast(data, o[1:], d[1:], 1.0).verdict.tolist() == [0 if model else 1]
            # A rim point's sphere is grazed at half of the radius, and missed one unit farther.
            for y, hit in ((0.0625, 1), (0.0625 - unit, 0 if model else 1)):
                assert raycast(data, [[-1.0, y, 1.0]], d[1:], 1.0).verdict.tolist() == [hit]


def test_objects_touch_the_scene_by_its_own_spheres_and_one_another_as_ever(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    points = cloud(rng, "noise", 400) + 3.0
    with radius_class_archives.any_classes():
        case = archive_cases.build(tmp_path, points, models=radius_class_archives.STORED)
    bodies = [cloud(rng, "sphere", 60) * 0.2, cloud(rng, "noise", 20) * 0.05, np.empty((0, 3))]
    models, of = [make_avatar(body, 0.02) for body in bodies], rng.integers(3, size=60)
    poses = np.array(
        [
            archive_cases.pose_of(archive_cases.random_rotation(rng), rng.uniform(-1, 1, 3) + 3.0)
            for _ in range(60)
        ]
    )
    everything = np.full(60, SCENE_GROUP | 1)
    seen = {}
    for model in ("local", "local+border:0.5", "border:3", None):
        stored, units = radius_class_archives.stored_radii(case.archive, model)
        with opened(case, model=model) as data:
            space = stored, data.arrays.step, units
            expected = naive_objects.touching_scene(
                *space, [bodies[i] for i in of], [0.02] * 60, poses, data.arrays.origin, 0.01
            )
            asked = [models[i] for i in of], poses, np.ones(60, int), everything, 0.01
            found = objects(data, *asked)
            assert (found.verdict == 1).tolist() == expected
            seen[model] = found.pairs.tolist()
        assert 3 < sum(expected) < 57, model
    assert len({str(pairs) for pairs in seen.values()}) == 1 and seen[None]
