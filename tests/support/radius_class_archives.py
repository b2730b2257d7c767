"""Archives whose points have radius classes of all kinds, with the radii that the tests expect."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.builder.passes import build_shards as shards
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.radius_model import RADIUS_CLASSES, class_radii

STORED = frozenset({"mean", "local", "border"})
# For archives of a few metres and some hundred points: some poses touch and some do not.
MODELS = ("local:0.2", "border:3", "local+border:0.3", "mean:2", "fixed:0.004", None)


def hashed_classes(local: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Return a class (n,) for points (n, 3), equal for equal points.

    In about half of all places it is equal for neighbours, too.
    """
    near = (local >> 9).sum(axis=1) % 2 == 0
    mixed = np.where(near[:, None], local >> 7, local).astype(np.int64) @ np.array([7919, 104729, 1299709])
    return (mixed % RADIUS_CLASSES).astype(np.uint8)


# The functions of the `any_classes` that are entered, the innermost last.
_replacing: list[Callable[[NDArray[np.int32]], NDArray[np.uint8]]] = []


@contextmanager
def any_classes(
    classes_of: Callable[[NDArray[np.int32]], NDArray[np.uint8]] = hashed_classes,
) -> Iterator[None]:
    """Let builds with one job take the classes from `classes_of` instead of from neighbours.

    classes_of: local lattice points (n, 3) of a voxel -> (n,).
    """
    voxel_classes = shards.voxel_classes

    def others(key: int, local: NDArray[np.int32], *rest: Any) -> Any:
        return voxel_classes(key, local, *rest)._replace(of_point=classes_of(local))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(shards, "voxel_classes", others)
        _replacing.append(classes_of)
        try:
            yield
        finally:
            _replacing.pop()


def replaced_classes() -> Callable[[NDArray[np.int32]], NDArray[np.uint8]] | None:
    """Return the function that `any_classes` builds with; None outside of it."""
    return _replacing[-1] if _replacing else None


def stored_radii(folder: Path, model: str | None) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return all points (n, 3) of an archive [lattice steps] and the radius (n,) of each [exact units]."""
    points, radii = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
    with Archive(folder) as archive:
        header = archive.header
        table = class_radii(model, header.radius, header.models)
        for row in range(len(archive.voxels)):
            voxel, links = archive.read_voxel(row)
            points.append(voxel_points(voxel, links) + archive.coordinates[row] * header.lattice.voxel_steps)
            classes = np.zeros(len(voxel.points), np.int64) if len(table) == 1 else voxel.radius_class
            radii.append(table[classes])
    return np.concatenate(points), np.concatenate(radii)
