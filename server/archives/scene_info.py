"""Answers of `info` and `stats` for a scene of several archives."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from msgspec import structs

from ...schemas.wire.scene_messages import SceneInfo
from ...schemas.wire.stats import AvatarStats, Counters, StatsAnswer
from ..observability.request_stats import RequestStats, times_of
from .archive_generation import ArchiveGeneration
from .archive_info import listed_sources
from .rigid_transform import Pose, transform_boxes, transform_poses


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
    # A change of any archive increases the sum, so the sum is the scene's generation.
    return structs.replace(
        first,
        scene=name,
        format_version=max(info.format_version for info in infos),
        points=sum(info.points for info in infos),
        voxels=sum(info.voxels for info in infos),
        bounds=[bounds[:, 0].min(axis=0).tolist(), bounds[:, 1].max(axis=0).tolist()],
        radius=largest.radius,
        radius_model=largest.radius_model,
        radius_error=largest.radius_error,
        radius_sample=largest.radius_sample,
        moved_max=max(info.moved_max for info in infos),
        sources=[
            s
            if pose is None
            else structs.replace(s, pose=transform_poses(pose, np.array([s.pose]))[0].tolist())
            for info, pose in each
            for s in info.sources
        ],
        skipped=[fault for info in infos for fault in info.skipped],
        record_bytes=sum(info.record_bytes for info in infos),
        resident_bytes=sum(info.resident_bytes for info in infos),
        unknown=[_box(box, pose).tolist() for info, pose in each for box in info.unknown],
        unknown_everywhere=any(info.unknown_everywhere for info in infos),
        radius_models=[m for m in first.radius_models if all(m in info.radius_models for info in infos)],
        generation=sum(info.generation for info in infos),
        radius_now=largest.radius_now,
        radius_now_error=largest.radius_now_error,
    )


def count_sources(opened: ArchiveGeneration) -> int:
    """Return the number of sources that a generation lists; those of the next archive follow."""
    count = opened.kept.get("sources")
    if count is None:
        count = opened.kept["sources"] = listed_sources(opened.store.archive.header)
    return int(count)


def _box(box: list[list[float]], pose: Pose | None) -> Any:
    """Return a box (2, 3), or the box that encloses it after transformation by a pose."""
    sides = np.array(box)
    return sides if pose is None else np.concatenate(transform_boxes(pose, sides[:1], sides[1:]))


def make_stats(
    name: str,
    each: Sequence[ArchiveGeneration],
    metrics: RequestStats,
    avatars: AvatarStats,
    *,
    keys: bool = False,
) -> StatsAnswer:
    """Return cache statistics summed over the archives of a scene, and its request statistics.

    metrics: the requests answered so far.  avatars: statistics of the clients' avatars.
    keys: also list the resident voxels, each by its key in its own archive.
    """
    total, users = metrics.snapshot()
    counts = total.counts
    residencies = [opened.data.residency for opened in each]
    level_bytes = sum(opened.level_bytes for opened in each)
    counters = [structs.asdict(residency.counters()) for residency in residencies]
    loads = [seconds for residency in residencies for seconds in residency.load_times()]
    return StatsAnswer(
        scene=name,
        generation=sum(opened.store.archive.header.generation for opened in each),
        policy=residencies[0].policy.name,
        budget_bytes=sum(residency.budget_bytes for residency in residencies) + level_bytes,
        resident_bytes=sum(residency.resident_bytes for residency in residencies),
        level_bytes=level_bytes,
        voxels=sum(len(opened.store.sizes) for opened in each),
        resident=sum(residency.resident for residency in residencies),
        kept=sum(len(residency.kept) for residency in residencies),
        requests=counts.requests,
        answers=counts.answers,
        unknown=counts.unknown,
        waited=counts.waited,
        load_seconds=times_of(loads, total.loads.times()),
        stall_seconds=counts.stalls.times(),
        engine_seconds=total.engine.times(),
        users=users,
        keys=sorted(key for opened in each for key in _resident_keys(opened)) if keys else None,
        avatars=avatars,
        **{field: sum(own[field] for own in counters) for field in Counters.__struct_fields__},
    )


def _resident_keys(opened: ArchiveGeneration) -> list[int]:
    """Return the keys of an archive's resident voxels."""
    rows = np.flatnonzero(opened.data.residency.where[:, 0] >= 0)
    keys: list[int] = opened.store.archive.voxels["key"][rows].tolist()
    return keys
