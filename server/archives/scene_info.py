"""Answers of `info`: of an archive, from its header alone, and of a scene of several."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from msgspec import structs

from ...schemas.scene.effect_table import ORDER, effect_name
from ...schemas.scene.scene_file import SceneFile, up_of
from ...schemas.wire.scene_messages import (
    WIRE_VERSION,
    AvatarInfo,
    ObjectInfo,
    SceneInfo,
    SourceInfo,
    SpawnInfo,
)
from ..residency.voxel_store import VoxelStore
from .rigid_transform import Pose, transform_boxes, transform_poses

# Fields of `SceneInfo` that are those of the archive's header.
_AS_STORED = (
    "format_version", "points", "lattice_source", "radius", "radius_model", "radius_error", "radius_sample",
    "moved_max", "degree", "leaf", "unknown_everywhere", "generation",
)  # fmt: skip
# Fields of several archives: added up, and of the archive with the largest radius. A change of any archive
# increases the sum of their generations.
_ADDED = ("points", "voxels", "record_bytes", "resident_bytes", "generation")
_OF_LARGEST = (
    "radius", "radius_model", "radius_error", "radius_sample", "radius_now", "radius_now_error",
)  # fmt: skip


def describe(store: VoxelStore, name: str) -> SceneInfo:
    """Return the description of an archive: counts, bounds [m], lattice, radius [m] and sources.

    name: of the scene. Positions are in the archive's own frame.
    """
    header = store.archive.header
    lattice, now = header.lattice, header.radius_now
    return SceneInfo(
        scene=name,
        wire_version=WIRE_VERSION,
        voxels=len(store.sizes),
        bounds=lattice.to_world(np.stack([header.low, header.high])).tolist(),
        origin=list(lattice.origin),
        lattice_step=lattice.step,
        voxel_size=lattice.voxel_size,
        radius_models=list(header.models),
        sources=[
            SourceInfo(s.path, s.index, s.sha256, s.count, s.format, s.pose.tolist(), s.skipped, s.fault)
            for s in header.sources[: header.listed_sources]
        ],
        skipped=[s.fault for s in header.sources if s.fault],
        record_bytes=int(store.archive.voxels["frame_bytes"].sum(dtype=np.int64)),
        resident_bytes=int(store.sizes.sum()),
        unknown=[lattice.to_world(box).tolist() for box in header.unknown],
        radius_now=now.radius if now else None,
        radius_now_error=now.error if now else None,
        **{field: getattr(header, field) for field in _AS_STORED},
    )


def describe_scene(info: SceneInfo, file: SceneFile, avatars: Sequence[AvatarInfo] = ()) -> SceneInfo:
    """Return a description with the declarations of the scene file: effects, avatars, up, objects.

    info: of the archives.  avatars: those that the scene file names.
    """
    spawn = file.spawn
    return structs.replace(
        info,
        effects=run_order(file),
        avatars=list(avatars),
        up=up_of(file),
        spawn=None if spawn is None else SpawnInfo(spawn.position, spawn.heading),
        objects=[ObjectInfo(item.name, item.avatar, item.pose, item.kind) for item in file.objects],
        default_radius_model=file.radius_model,
    )


def run_order(file: SceneFile) -> list[str]:
    """Return the names of a scene's effects in the order in which they run.

    `through` comes first, because it acts when the archive is opened.
    """
    declared = {effect_name(effect) for effect in file.effects}
    if len(declared) < 2:
        return list(declared)
    return [name for name in ("through", *ORDER) if name in declared]


def join_infos(name: str, each: Sequence[tuple[SceneInfo, Pose | None]]) -> SceneInfo:
    """Return the description of all archives as one scene.

    each: description and pose of each archive; None: the identity.
    Counts are summed, bounds are in the world [m], and sources are listed archive by archive. Each
    archive has its own lattice and trees; those of the first are given. Radii and the distance by
    which points were moved are the largest ones. Radius models are those that all archives store.
    """
    infos = [info for info, _ in each]
    first = infos[0]
    if len(each) == 1 and each[0][1] is None:
        return first
    bounds = np.array([_box(info.bounds, pose) for info, pose in each])
    largest = max(infos, key=lambda info: info.radius)
    return structs.replace(
        first,
        scene=name,
        format_version=max(info.format_version for info in infos),
        bounds=[bounds[:, 0].min(axis=0).tolist(), bounds[:, 1].max(axis=0).tolist()],
        moved_max=max(info.moved_max for info in infos),
        sources=[
            s
            if pose is None
            else structs.replace(s, pose=transform_poses(pose, np.array([s.pose]))[0].tolist())
            for info, pose in each
            for s in info.sources
        ],
        skipped=[fault for info in infos for fault in info.skipped],
        unknown=[_box(box, pose).tolist() for info, pose in each for box in info.unknown],
        unknown_everywhere=any(info.unknown_everywhere for info in infos),
        radius_models=[m for m in first.radius_models if all(m in info.radius_models for info in infos)],
        **{field: sum(getattr(info, field) for info in infos) for field in _ADDED},
        **{field: getattr(largest, field) for field in _OF_LARGEST},
    )


def _box(box: list[list[float]], pose: Pose | None) -> Any:
    """Return a box (2, 3), or the box that encloses it after transformation by a pose."""
    sides = np.array(box)
    return sides if pose is None else np.concatenate(transform_boxes(pose, sides[:1], sides[1:]))
