"""What `stats` says as Prometheus' text, over HTTP. The only user of prometheus_client.

Nothing is counted here: each scrape asks the scenes, so that what is read and what `stats` says is the same.
"""

import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from ..schemas.errors import SolidcloudError
from ..schemas.stats import StatsAnswer, Times, UserStats

try:
    from prometheus_client import CollectorRegistry, ProcessCollector, start_http_server
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
    from prometheus_client.registry import Collector
except ModuleNotFoundError as missing:
    raise SolidcloudError(
        f"--metrics-port: the library {missing.name!r} is not installed: pip install 'solidcloud[metrics]'"
    ) from None

log = logging.getLogger(__name__)

# With more users than this none is told apart: a series a client would be kept for ever by who scrapes, long after it
# is gone.
FEW_USERS = 10

# Name, what it says, and the field of `StatsAnswer` that it is.
_GAUGES = (
    ("generation", "Generation of the archive that is served.", "generation"),
    ("budget_bytes", "Bytes that decoded voxels may take.", "budget_bytes"),
    ("resident_bytes", "Bytes that decoded voxels take.", "resident_bytes"),
    ("coarse_bytes", "Bytes that coarse tops take.", "coarse_bytes"),
    ("voxels", "Voxels of the archive.", "voxels"),
    ("resident_voxels", "Voxels decoded in memory, or being loaded.", "resident"),
    ("kept_voxels", "Voxels that users stand in.", "kept"),
)
_COUNTERS = (
    ("voxel_hits", "Voxels asked for and there, or being loaded.", "hits"),
    ("voxel_waits", "Voxels asked for and being loaded.", "waits"),
    ("voxel_misses", "Voxels asked for and not there.", "misses"),
    ("voxel_late", "Voxels not there in time.", "late"),
    ("prefetched", "Voxels loaded before anybody asked.", "prefetched"),
    ("prefetched_bytes", "Their bytes.", "prefetched_bytes"),
    ("prefetched_used", "Voxels prefetched, and asked for since.", "used"),
    ("prefetched_wasted", "Voxels prefetched, and gone without being asked for.", "wasted"),
    ("prefetched_wasted_bytes", "Their bytes.", "wasted_bytes"),
    ("evicted", "Voxels gone for others.", "evicted"),
    ("evicted_too_soon", "Voxels gone for others, and asked for again shortly after.", "too_soon"),
    ("moved_bytes", "Bytes of voxels moved to join free room.", "moved_bytes"),
    ("failed_loads", "Loads that failed.", "failed"),
    ("requests", "Requests answered.", "requests"),
    ("answers", "Poses, rays, points, motions and objects answered.", "answers"),
    ("unknown_answers", "Answers that were unknown.", "unknown"),
    ("waited_requests", "Requests that waited for voxels.", "waited"),
)
_HISTOGRAMS = (
    ("load_seconds", "What loading a voxel took.", "load_seconds"),
    ("stall_seconds", "What a request waited for voxels.", "stall_seconds"),
    ("engine_seconds", "What a request took in the engine.", "engine_seconds"),
)
_OF_USERS = (
    ("user_requests", "Requests answered, of one user.", "requests"),
    ("user_answers", "Poses, rays, points and motions answered, of one user.", "answers"),
    ("user_unknown_answers", "Answers that were unknown, of one user.", "unknown"),
    ("user_voxel_hits", "Voxels asked for and there, by one user.", "hits"),
    ("user_voxel_misses", "Voxels asked for and not there, by one user.", "misses"),
    ("user_voxel_late", "Voxels not there in time, for one user.", "late"),
    ("user_waited_requests", "Requests that waited for voxels, of one user.", "waited"),
)


class StatsLike(Protocol):
    """A scene that is asked."""

    name: str

    def stats(self, keys: bool = False) -> StatsAnswer: ...


class StatsCollector(Collector):
    """What a registry asks for the metrics of scenes."""

    def __init__(self, scenes: Sequence[StatsLike]) -> None:
        """Of these scenes."""
        self._scenes = tuple(scenes)

    def collect(self) -> Iterator[Metric]:
        """Every metric of every scene; a scene that cannot be asked has none this once."""
        found = []
        for scene in self._scenes:
            try:
                found.append(scene.stats())
            except Exception:
                log.exception("no metrics of scene %s", scene.name)
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
    """Buckets as Prometheus wants them: upper end, and how many took no longer."""
    return [("+Inf" if bound == math.inf else f"{bound:g}", count) for bound, count in times.at_most()]


def _of_users(found: Sequence[StatsAnswer]) -> Iterator[Metric]:
    """Counters a user, of scenes with few."""
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
    """Serve the metrics of scenes, and of this process, over HTTP while inside; gives where.

    host: the address to be reached at.  port: 0: any that is free. SolidcloudError: it cannot be listened on.
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
