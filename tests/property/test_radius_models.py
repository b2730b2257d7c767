"""`collide` with spheres of several sizes: contact begins at the very unit, whatever the tree and the model."""

import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import archive_cases
import naive
import numpy as np
import pytest
import radius_class_archives
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from point_clouds import KINDS, TREES, cloud
from sample_sizes import sample
from solidcloud.schemas.errors import BadRequestError
from solidcloud.server.scene import Scene


def least_margin(a: NDArray[np.int64], scan: NDArray[np.int64], radii: NDArray[np.int64], own: int) -> int:
    """The least margin, exact units, at which some pair of a (m, 3) and scan (n, 3) is in contact; may be negative.

    radii: (n,) of the scan's points.  own: of a's.
    """
    squares = ((a[:, None] - scan).astype(np.float64) ** 2).sum(axis=2)
    nearly = np.sqrt(squares) - radii
    # float64 is off by less than a unit here: the least is among those within two units of the least.
    found = []
    for i, j in np.argwhere(nearly <= nearly.min() + 2):
        square = sum(int(d) ** 2 for d in a[i] - scan[j])
        root = math.isqrt(square)
        found.append(root + (root * root < square) - int(radii[j]) - own)
    return min(found)


@settings(max_examples=sample(5, 30), deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(KINDS),
    count=st.sampled_from([2, 33, 300]),
    body=st.sampled_from(KINDS),
    model=st.sampled_from(radius_class_archives.MODELS),
    voxel=st.sampled_from([0.07, 0.5, 4.0]),
    tree=TREES,
)
def test_contact_begins_where_the_definition_says(
    seed: int,
    kind: str,
    count: int,
    body: str,
    model: str | None,
    voxel: float,
    tree: dict[str, Any],
) -> None:
    rng = np.random.default_rng(seed)
    points, avatar = cloud(rng, kind, count), cloud(rng, body, 20) * 0.3
    with TemporaryDirectory() as folder, radius_class_archives.any_classes():
        case = archive_cases.build(
            Path(folder), points, voxel=voxel, models=radius_class_archives.STORED, **tree
        )
        stored, radii = radius_class_archives.stored_radii(case.archive, model)
        with Scene.open(case.archive) as scene:
            info = scene.info()
            scene.add_avatar("avatar", avatar, 0.01)
            b = naive.scan_units(stored, info.lattice_step)
            poses = archive_cases.near_poses(rng, points, avatar, 12, 0.3)
            for pose in poses:
                own = naive.reach_units(0.01, 0.0, 0.0)
                least = least_margin(naive.placed_units(avatar, pose, info.origin), b, radii, own)
                for margin in (least - 1, least, least + 1):
                    if margin < 0:
                        continue
                    answers = scene.collide("avatar", pose[None], margin / naive.UNITS, radius_model=model)
                    assert answers.verdict[0] == (margin >= least), (pose.tolist(), margin, least)
            together = scene.collide("avatar", poses, radius_model=model).verdict
            alone = [scene.collide("avatar", pose[None], radius_model=model).verdict[0] for pose in poses]
            assert together.tolist() == alone


def test_a_model_the_archive_does_not_hold_is_refused(tmp_path: Path) -> None:
    case = archive_cases.build(tmp_path, np.zeros((1, 3)), models=frozenset({"mean", "local"}))
    pose = np.eye(4)[None]
    with Scene.open(case.archive) as scene:
        scene.add_avatar("avatar", [[0.0, 0, 0.0]], 0.01)
        assert scene.collide("avatar", pose, radius_model="local").verdict[0] == 1
        with pytest.raises(BadRequestError, match=r"stores mean,local: .* --radius mean,local,border"):
            scene.collide("avatar", pose, radius_model="border")
        with pytest.raises(BadRequestError, match="expected mean, local"):
            scene.collide("avatar", pose, radius_model="nearest")


def test_reach_is_that_of_the_largest_sphere_there_is(tmp_path: Path) -> None:
    # A grid of 1 cm: spheres of a few millimetres, though the ladder goes to 32 mm.
    grid = np.stack(np.meshgrid(*[np.arange(6) * 0.01] * 3), axis=-1).reshape(-1, 3)
    case = archive_cases.build(tmp_path, grid, models=frozenset({"mean", "local"}), radius=0.02)
    _, radii = radius_class_archives.stored_radii(case.archive, "local")
    with Scene.open(case.archive) as scene:
        data = scene.archives[0]._opened.radius_model("local")
        assert data.radius_units == radii.max() < 0.02 * naive.UNITS
        assert data.arrays.radius_deficit.min() == 0 and data.arrays.radius_deficit.max() > 0
