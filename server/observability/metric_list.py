"""Table of the metrics that a monitoring system reads: the figures of `stats`.

Each is a field of `StatsAnswer`, or of `UserStats` for each user. To add a metric, add the field in
schemas/wire/stats.py, count it in request_stats.py or server/residency/voxel_cache.py, and add a
row here. prometheus_export.py serves the list.
"""

from typing import Literal, NamedTuple


class Metric(NamedTuple):
    """One metric.

    kind: type in Prometheus.  name: without the prefix `solidcloud_`.  text: help text.
    field: field of `StatsAnswer`, or of `UserStats`.
    """

    kind: Literal["gauge", "counter", "histogram"]
    name: str
    text: str
    field: str


SCENE_METRICS = (
    Metric("gauge", "generation", "Generation of the served archive.", "generation"),
    Metric("gauge", "budget_bytes", "Memory budget of decoded voxels.", "budget_bytes"),
    Metric("gauge", "resident_bytes", "Memory used by decoded voxels.", "resident_bytes"),
    Metric("gauge", "level_bytes", "Memory of levels of detail.", "level_bytes"),
    Metric("gauge", "voxels", "Voxels of the archive.", "voxels"),
    Metric("gauge", "resident_voxels", "Voxels that are resident or being loaded.", "resident"),
    Metric("gauge", "kept_voxels", "Voxels that users are in.", "kept"),
    Metric("counter", "voxel_hits", "Voxels requested and resident, or being loaded.", "hits"),
    Metric("counter", "voxel_waits", "Voxels requested while being loaded.", "waits"),
    Metric("counter", "voxel_misses", "Voxels requested and not resident.", "misses"),
    Metric("counter", "voxel_late", "Voxels requested and not resident in time.", "late"),
    Metric("counter", "prefetched", "Voxel loads started before any request.", "prefetched"),
    Metric("counter", "prefetched_bytes", "Bytes of prefetched voxels.", "prefetched_bytes"),
    Metric("counter", "prefetched_used", "Prefetched voxels requested since.", "used"),
    Metric(
        "counter",
        "prefetched_wasted",
        "Wasted prefetches: loads that failed, or voxels evicted unused.",
        "wasted",
    ),
    Metric("counter", "prefetched_wasted_bytes", "Bytes of wasted prefetches.", "wasted_bytes"),
    Metric("counter", "evicted", "Voxels evicted to make room for others.", "evicted"),
    Metric(
        "counter", "evicted_too_soon", "Evicted voxels that were requested again shortly after.", "too_soon"
    ),
    Metric("counter", "moved_bytes", "Bytes of voxels moved to join free memory.", "moved_bytes"),
    Metric("counter", "failed_loads", "Voxel loads that failed.", "failed"),
    Metric("counter", "requests", "Requests answered.", "requests"),
    Metric("counter", "answers", "Poses, rays, points, motions and objects answered.", "answers"),
    Metric("counter", "unknown_answers", "Answers that were unknown.", "unknown"),
    Metric("counter", "waited_requests", "Requests that waited for voxels.", "waited"),
    Metric("histogram", "load_seconds", "Time to load a voxel.", "load_seconds"),
    Metric("histogram", "stall_seconds", "Time that a request waited for voxels.", "stall_seconds"),
    Metric("histogram", "engine_seconds", "Time of a request in the engine.", "engine_seconds"),
)
# With labels for client and avatar.
USER_METRICS = (
    Metric("counter", "user_requests", "Requests answered, of one user.", "requests"),
    Metric(
        "counter",
        "user_answers",
        "Poses, rays, points, motions and objects answered, of one user.",
        "answers",
    ),
    Metric("counter", "user_unknown_answers", "Answers that were unknown, of one user.", "unknown"),
    Metric(
        "counter", "user_voxel_hits", "Voxels requested by one user and resident, or being loaded.", "hits"
    ),
    Metric("counter", "user_voxel_misses", "Voxels requested by one user and not resident.", "misses"),
    Metric("counter", "user_voxel_late", "Voxels requested by one user and not resident in time.", "late"),
    Metric("counter", "user_waited_requests", "Requests that waited for voxels, of one user.", "waited"),
)
