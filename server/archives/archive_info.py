"""Descriptions (`SceneInfo`) of an archive and of a scene, from headers alone: no voxel is read."""

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
    """Return the description of an archive: counts, bounds [m], lattice, radius [m] and sources.

    name: of the scene. Positions are in the archive's own frame.
    """
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
    """Return the number of sources that an archive lists.

    Sources after the last one that was built are omitted. A source that was left out before it
    keeps its row, because a point's `scan_index` is a row of the list.
    """
    return max((number for number, s in enumerate(header.sources, 1) if not s.fault), default=0)


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
