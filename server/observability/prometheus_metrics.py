"""Prometheus metrics of `stats`, over HTTP. This is the only module that imports prometheus_client.

It keeps no counters: each scrape calls `stats` of the scenes, and both report the same numbers.
"""

import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from ...schemas.errors import SolidcloudError
from ...schemas.wire.stats import StatsAnswer, Times, UserStats

try:
    from prometheus_client import CollectorRegistry, ProcessCollector, start_http_server
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
    from prometheus_client.registry import Collector
except ModuleNotFoundError as missing:
    raise SolidcloudError(
        f"--metrics-port: the library {missing.name!r} is not installed: pip install 'solidcloud[metrics]'"
    ) from None

log = logging.getLogger(__name__)

# With more users than this there are no metrics per user: the monitoring system would keep one
# series per client forever, long after the client is gone.
FEW_USERS = 10

# Name of each metric, its help text, and its field of `StatsAnswer`.
_GAUGES = (
    ("generation", "Generation of the served archive.", "generation"),
    ("budget_bytes", "Memory budget of decoded voxels.", "budget_bytes"),
    ("resident_bytes", "Memory used by decoded voxels.", "resident_bytes"),
    ("coarse_bytes", "Memory used by coarse bounds.", "coarse_bytes"),
    ("voxels", "Voxels of the archive.", "voxels"),
    ("resident_voxels", "Voxels that are resident or being loaded.", "resident"),
    ("kept_voxels", "Voxels that users are in.", "kept"),
)
_COUNTERS = (
    ("voxel_hits", "Voxels requested and resident, or being loaded.", "hits"),
    ("voxel_waits", "Voxels requested while being loaded.", "waits"),
    ("voxel_misses", "Voxels requested and not resident.", "misses"),
    ("voxel_late", "Voxels requested and not resident in time.", "late"),
    ("prefetched", "Voxel loads started before any request.", "prefetched"),
    ("prefetched_bytes", "Bytes of prefetched voxels.", "prefetched_bytes"),
    ("prefetched_used", "Prefetched voxels requested since.", "used"),
    ("prefetched_wasted", "Wasted prefetches: loads that failed, or voxels evicted unused.", "wasted"),
    ("prefetched_wasted_bytes", "Bytes of wasted prefetches.", "wasted_bytes"),
    ("evicted", "Voxels evicted to make room for others.", "evicted"),
    ("evicted_too_soon", "Evicted voxels that were requested again shortly after.", "too_soon"),
    ("moved_bytes", "Bytes of voxels moved to join free memory.", "moved_bytes"),
    ("failed_loads", "Voxel loads that failed.", "failed"),
    ("requests", "Requests answered.", "requests"),
    ("answers", "Poses, rays, points, motions and objects answered.", "answers"),
    ("unknown_answers", "Answers that were unknown.", "unknown"),
    ("waited_requests", "Requests that waited for voxels.", "waited"),
)
_HISTOGRAMS = (
    ("load_seconds", "Time to load a voxel.", "load_seconds"),
    ("stall_seconds", "Time that a request waited for voxels.", "stall_seconds"),
    ("engine_seconds", "Time of a request in the engine.", "engine_seconds"),
)
_OF_USERS = (
    ("user_requests", "Requests answered, of one user.", "requests"),
    ("user_answers", "Poses, rays, points, motions and objects answered, of one user.", "answers"),
    ("user_unknown_answers", "Answers that were unknown, of one user.", "unknown"),
    ("user_voxel_hits", "Voxels requested by one user and resident, or being loaded.", "hits"),
    ("user_voxel_misses", "Voxels requested by one user and not resident.", "misses"),
    ("user_voxel_late", "Voxels requested by one user and not resident in time.", "late"),
    ("user_waited_requests", "Requests that waited for voxels, of one user.", "waited"),
)


class StatsLike(Protocol):
    """A scene that reports statistics."""

    name: str

    def stats(self, keys: bool = False) -> StatsAnswer: ...


class StatsCollector(Collector):
    """Collector of the metrics of scenes, for a Prometheus registry."""

    def __init__(self, scenes: Sequence[StatsLike]) -> None:
        """Collect the metrics of these scenes."""
        self._scenes = tuple(scenes)

    def collect(self) -> Iterator[Metric]:
        """Yield every metric of every scene. A scene whose `stats` fails is left out."""
        found = []
        for scene in self._scenes:
            try:
                found.append(scene.stats())
            except Exception:
                log.exception("cannot read the metrics of scene %s", scene.name)
        scenes = GaugeMetricFamily("solidcloud_scene_info", "1 for each scene.", labels=["scene", "policy"])
        for stats in found:
            scenes.add_metric([stats.scene, stats.policy], 1)
        yield scenes
        for name, says, field in _GAUGES:
            gauge = GaugeMetricFamily(f"solidcloud_{name}", says, labels=["scene"])
            for stats in found:
                gauge.add_metric([stats.scene], getattr(stats, field))
            yield gauge
        for name, says, field in _COUNTERS:
            counter = CounterMetricFamily(f"solidcloud_{name}", says, labels=["scene"])
            for stats in found:
                counter.add_metric([stats.scene], getattr(stats, field))
            yield counter
        for name, says, field in _HISTOGRAMS:
            histogram = HistogramMetricFamily(f"solidcloud_{name}", says, labels=["scene"])
            for stats in found:
                times = getattr(stats, field)
                histogram.add_metric([stats.scene], _buckets(times), times.sum)
            yield histogram
        yield from _of_users(found)


def _buckets(times: Times) -> list[tuple[str, float]]:
    """Return Prometheus buckets: upper bound and cumulative count."""
    return [("+Inf" if bound == math.inf else f"{bound:g}", count) for bound, count in times.at_most()]


def _of_users(found: Sequence[StatsAnswer]) -> Iterator[Metric]:
    """Yield the counters per user, for scenes with at most FEW_USERS."""
    users: list[tuple[str, UserStats]] = [
        (stats.scene, user) for stats in found if len(stats.users) <= FEW_USERS for user in stats.users
    ]
    for name, says, field in _OF_USERS:
        counter = CounterMetricFamily(f"solidcloud_{name}", says, labels=["scene", "client", "avatar"])
        for scene, user in users:
            counter.add_metric([scene, user.client, user.avatar], getattr(user, field))
        yield counter


@contextmanager
def metrics_served(scenes: Sequence[StatsLike], host: str, port: int) -> Iterator[str]:
    """Serve the metrics of scenes and of this process over HTTP during the block; yield the URL.

    host: address to listen on.  port: 0: any free port.
    Raises SolidcloudError if the port cannot be opened.
    """
    registry = CollectorRegistry(auto_describe=True)
    registry.register(StatsCollector(scenes))
    ProcessCollector(registry=registry)
    try:
        server, thread = start_http_server(port, host, registry)
    except OSError as error:
        raise SolidcloudError(
            f"--metrics-port {port}: cannot listen on {host}: {error}: is another server there? try another port"
        ) from None
    try:
        yield f"http://{host}:{server.server_port}/metrics"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
