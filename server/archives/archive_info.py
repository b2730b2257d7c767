"""Description of an archive, and what a scene file adds to it. Reads no voxel."""

from collections.abc import Sequence

import numpy as np
from msgspec import structs

from ...schemas.archive.index import Header
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


def describe(store: VoxelStore, name: str) -> SceneInfo:
    """Return the description of an archive: counts, bounds, lattice, radius, sources."""
    header = store.archive.header
    lattice, now = header.lattice, header.radius_now
    return SceneInfo(
        scene=name,
        format_version=header.format_version,
        wire_version=WIRE_VERSION,
        points=header.points,
        voxels=len(store.sizes),
        bounds=lattice.to_world(np.stack([header.low, header.high])).tolist(),
        origin=list(lattice.origin),
        lattice_step=lattice.step,
        lattice_source=header.lattice_source,
        voxel_size=lattice.voxel_size,
        radius=header.radius,
        radius_model=header.radius_model,
        radius_models=list(header.models),
        radius_error=header.radius_error,
        radius_sample=header.radius_sample,
        moved_max=header.moved_max,
        degree=header.degree,
        leaf=header.leaf,
        sources=[
            SourceInfo(s.path, s.index, s.sha256, s.count, s.format, s.pose.tolist(), s.skipped, s.fault)
            for s in header.sources[: listed_sources(header)]
        ],
        skipped=[s.fault for s in header.sources if s.fault],
        record_bytes=int(store.archive.voxels["frame_bytes"].sum(dtype=np.int64)),
        resident_bytes=int(store.sizes.sum()),
        unknown=[lattice.to_world(box).tolist() for box in header.unknown],
        unknown_everywhere=header.unknown_everywhere,
        generation=header.generation,
        radius_now=now.radius if now else None,
        radius_now_error=now.error if now else None,
    )


def listed_sources(header: Header) -> int:
    """Return how many sources an archive lists: all up to the last one that was not left out.

    A point's scan_index is a row of the list, so a source that was left out keeps its row.
    """
    return max((number for number, s in enumerate(header.sources, 1) if not s.fault), default=0)


def describe_scene(info: SceneInfo, file: SceneFile, avatars: Sequence[AvatarInfo] = ()) -> SceneInfo:
    """Return the description of a scene with what its file declares. avatars: the scene's own."""
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

    `through` is the first: it acts when the archive is opened.
    """
    declared = {effect_name(effect) for effect in file.effects}
    if len(declared) < 2:
        return list(declared)
    return [name for name in ("through", *ORDER) if name in declared]
