"""What several archives say of themselves as one scene: `info` and `stats`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from msgspec import structs

from ...schemas.wire.messages import SceneInfo, StatsAnswer
from ...schemas.wire.stats import Counters, Times
from ..observability.metrics import Metrics, times_of
from .archive_generation import Opened
from .archive_info import listed_sources
from .rigid_transform import Pose, moved_boxes, under

# Of StatsAnswer: what archives have each, to be added.
_MEMORY = (
    "generation", "budget_bytes", "resident_bytes", "coarse_bytes", "voxels", "resident", "kept",
    *Counters.__struct_fields__,
)  # fmt: skip


def info_of_several(name: str, each: Sequence[tuple[SceneInfo, Pose | None]]) -> SceneInfo:
    """What a scene of several archives says of itself. each: what one says, and its pose; None: at the identity.

    Counts are added, bounds are in the world, sources stand one archive's behind the other's. Of lattice and trees, of
    which each archive has its own, the first archive's are said; of radii and what points were moved, the largest. The
    radius models are those that all of them hold.
    """
    infos = [info for info, _ in each]
    first = infos[0]
    bounds = np.array([_box(info.bounds, pose) for info, pose in each])
    largest = max(infos, key=lambda info: info.radius)
    # A generation of the scene is a change of any archive.
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
            s if pose is None else structs.replace(s, pose=under(pose, np.array([s.pose]))[0].tolist())
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


def sources_asked(opened: Opened) -> int:
    """How many sources an archive lists, of the generation that is asked: those of the next archive stand behind."""
    count = opened.kept.get("sources")
    if count is None:
        count = opened.kept["sources"] = listed_sources(opened.store.archive.header)
    return int(count)


def _box(box: list[list[float]], pose: Pose | None) -> Any:
    """A box (2, 3), or that around it carried by a pose."""
    sides = np.array(box)
    return sides if pose is None else np.concatenate(moved_boxes(pose, sides[:1], sides[1:]))


def stats_of_several(
    name: str, each: Sequence[StatsAnswer], loads: Sequence[float], metrics: Metrics
) -> StatsAnswer:
    """What a scene of several archives keeps in memory, all together, and what was asked of it.

    metrics: counted that.  loads: seconds of the last loads of all. Keys are each archive's own.
    """
    total, users = metrics.snapshot()
    counts = total.counts
    times = [stats.load_seconds for stats in each]
    buckets = [t.buckets for t in times if t.buckets]
    of_all = Times(
        sum(t.count for t in times),
        sum(t.sum for t in times),
        max=max(t.max for t in times),
        buckets=np.sum(buckets, axis=0).tolist() if buckets else [],
    )
    keys = [stats.keys for stats in each if stats.keys is not None]
    return structs.replace(
        each[0],
        scene=name,
        requests=counts.requests,
        answers=counts.answers,
        unknown=counts.unknown,
        waited=counts.waited,
        load_seconds=times_of(loads, of_all),
        stall_seconds=counts.stalls.times(),
        engine_seconds=total.engine.times(),
        users=users,
        keys=sorted(key for own in keys for key in own) if keys else None,
        **{field: sum(getattr(stats, field) for stats in each) for field in _MEMORY},
    )
