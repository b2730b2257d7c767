"""Archive generation that a thread holds: its normals, and the way into its frame and back."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...archives.archive_generation import ArchiveGeneration
from ...archives.placed_archive import PlacedArchive
from ...archives.rigid_transform import rotate_vectors, transform_points, transform_poses
from ...queries.context.query_context import SceneData
from ...queries.resident_fast_path import SweepResult
from .frame import Pose, Vec

# If the points near a touched one form no surface, because the scan is sparse, the reach of its
# normal is multiplied by this factor.
SPARSE_FACTOR = 3.0


class HeldArchive(NamedTuple):
    """Archive generation that a thread holds. data: with the scene's radius model."""

    opened: ArchiveGeneration
    data: SceneData
    placed: PlacedArchive


def normals_of(seen: HeldArchive) -> Any:
    """Return the `Normals` of an archive generation."""
    kept = seen.opened.kept
    normals = kept.get("normals")
    if normals is None:
        # Imported here: only some effects need normals.
        from ...queries.surface_normals import Normals

        normals = kept.setdefault("normals", Normals(seen.data, seen.opened.store.archive))
    return normals


def touched_in_archive(
    seen: HeldArchive, cloud: Vec, ways: NDArray[np.float64]
) -> tuple[Vec, NDArray[np.float64]]:
    """Return a scan point (3,) and directions (k, 3) of the world in an archive's frame."""
    inverse = seen.placed.inverse
    if inverse is None:
        return cloud, ways
    return transform_points(inverse, cloud[None])[0], rotate_vectors(inverse, ways)


def to_archive(seen: HeldArchive, pose: Pose) -> Pose:
    """Return a pose of the world in an archive's frame."""
    inverse = seen.placed.inverse
    return pose if inverse is None else transform_poses(inverse, pose[None])[0]


def to_world(seen: HeldArchive, place: NDArray[np.float64]) -> Vec:
    """Return a point (3,) of an archive in the world frame."""
    pose = seen.placed.pose
    return place if pose is None else transform_points(pose, place[None])[0]


def swept_in_world(swept: SweepResult, seen: HeldArchive, number: int) -> SweepResult:
    """Return an archive's answer about a motion, in the world frame."""
    if swept.avatar is None or swept.cloud is None:
        return swept._replace(archive=number)
    return swept._replace(
        archive=number, avatar=to_world(seen, swept.avatar), cloud=to_world(seen, swept.cloud)
    )
