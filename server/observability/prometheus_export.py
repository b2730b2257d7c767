"""Export of the metrics to Prometheus, over HTTP. Only this module imports prometheus_client.

It keeps no counters: each scrape calls `stats` of the scenes, and both report the same numbers.
"""

import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

from ...schemas.errors import SolidcloudError
from ...schemas.wire.stats import StatsAnswer, Times, UserStats
from .metric_list import SCENE_METRICS, USER_METRICS

try:
    from prometheus_client import CollectorRegistry, ProcessCollector, start_http_server
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
    from prometheus_client.registry import Collector
except ModuleNotFoundError as missing:
    raise SolidcloudError(
        f"--metrics-port: the library {missing.name!r} is not installed: pip install 'solidcloud[metrics]'"
    ) from None

log = logging.getLogger(__name__)

# With more users there are no metrics per user, because a monitoring system keeps the series of
# every client that ever connected.
MAX_USERS_LISTED = 10

_FAMILIES: dict[str, Any] = {
    "gauge": GaugeMetricFamily,
    "counter": CounterMetricFamily,
    "histogram": HistogramMetricFamily,
}


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
        for metric in SCENE_METRICS:
            family = _FAMILIES[metric.kind](f"solidcloud_{metric.name}", metric.text, labels=["scene"])
            for stats in found:
                value = getattr(stats, metric.field)
                values: tuple[Any, ...] = (
                    (_buckets(value), value.sum) if metric.kind == "histogram" else (value,)
                )
                family.add_metric([stats.scene], *values)
            yield family
        yield from _of_users(found)


def _buckets(times: Times) -> list[tuple[str, float]]:
    """Return Prometheus buckets: upper bound and cumulative count."""
    return [("+Inf" if bound == math.inf else f"{bound:g}", count) for bound, count in times.at_most()]


def _of_users(found: Sequence[StatsAnswer]) -> Iterator[Metric]:
    """Yield the counters per user, for scenes with at most MAX_USERS_LISTED."""
    users: list[tuple[str, UserStats]] = [
        (stats.scene, user) for stats in found if len(stats.users) <= MAX_USERS_LISTED for user in stats.users
    ]
    for metric in USER_METRICS:
        counter = CounterMetricFamily(
            f"solidcloud_{metric.name}", metric.text, labels=["scene", "client", "avatar"]
        )
        for scene, user in users:
            counter.add_metric([scene, user.client, user.avatar], getattr(user, metric.field))
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
