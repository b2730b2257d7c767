"""Metrics as Prometheus' text: the names, the numbers and who may read them."""

import builtins
import importlib
import sys
import urllib.request
from collections.abc import Iterator
from typing import Any, get_type_hints

import pytest

pytest.importorskip("prometheus_client")

from prometheus_client.parser import text_string_to_metric_families
from solidcloud.schemas.errors import BadRequestError, SolidcloudError
from solidcloud.schemas.wire.stats import StatsAnswer, UserStats
from solidcloud.server.observability.prometheus_export import MAX_USERS_LISTED, metrics_served
from solidcloud.server.observability.request_stats import Histogram
from solidcloud.server.zenoh_server.server_config import ServerConfig

FIELDS = [name for name, kind in get_type_hints(StatsAnswer).items() if kind is int]


class CountedScene:
    """A scene that says what it is told to."""

    def __init__(self, name: str, fault: Exception | None = None, **fields: Any) -> None:
        self.name, self.fields, self.fault = name, fields, fault

    def stats(self, keys: bool = False) -> StatsAnswer:
        assert not keys, "megabytes that nobody reads"
        if self.fault is not None:
            raise self.fault
        return StatsAnswer(scene=self.name, **self.fields)


def text_of(where: str) -> str:
    with urllib.request.urlopen(where, timeout=20) as reply:
        assert reply.headers["Content-Type"].startswith("text/plain")
        found: str = reply.read().decode()
    return found


def samples(text: str) -> Iterator[tuple[str, dict[str, str], float]]:
    """Every sample: its name, labels and value."""
    for family in text_string_to_metric_families(text):
        for sample in family.samples:
            yield sample.name, sample.labels, sample.value


def read(*scenes: CountedScene) -> list[tuple[str, dict[str, str], float]]:
    with metrics_served(scenes, "127.0.0.1", 0) as where:
        return list(samples(text_of(where)))


def test_every_count_is_there_under_a_name_as_prometheus_wants_it() -> None:
    numbers = {field: 1000 + number for number, field in enumerate(FIELDS)}
    found = read(CountedScene("hall", policy="lru", **numbers))
    own = {name: value for name, labels, value in found if labels == {"scene": "hall"}}
    values = sorted(value for value in own.values() if value >= 1000)
    assert values == sorted(numbers.values()), "each once"
    assert all(name.startswith("solidcloud_") for name in own)
    assert own["solidcloud_voxel_hits_total"] == numbers["hits"]
    assert own["solidcloud_prefetched_wasted_bytes_total"] == numbers["wasted_bytes"]
    assert own["solidcloud_resident_bytes"] == numbers["resident_bytes"]
    assert own["solidcloud_resident_voxels"] == numbers["resident"]
    assert ("solidcloud_scene_info", {"scene": "hall", "policy": "lru"}, 1.0) in found
    gauges = {"generation", "budget_bytes", "resident_bytes", "level_bytes", "voxels", "resident", "kept"}
    assert sum(name.endswith("_total") for name in own) == len(set(FIELDS) - gauges)


def test_times_are_histograms() -> None:
    histogram = Histogram()
    for seconds in (0.0, 0.0005, 0.0005, 0.004, 300.0):
        histogram.add(seconds)
    found = read(CountedScene("hall", stall_seconds=histogram.times()), CountedScene("attic"))
    buckets = {
        float(labels["le"]): value
        for name, labels, value in found
        if name == "solidcloud_stall_seconds_bucket" and labels["scene"] == "hall"
    }
    assert len(buckets) == 26 and list(buckets.values()) == sorted(buckets.values())
    assert [buckets[bound] for bound in (1e-6, 0.0002, 0.0005, 0.005, 100.0, float("inf"))] == [
        1,
        1,
        3,
        4,
        4,
        5,
    ]
    assert ("solidcloud_stall_seconds_count", {"scene": "hall"}, 5.0) in found
    assert ("solidcloud_stall_seconds_sum", {"scene": "hall"}, pytest.approx(300.005)) in found
    for name in ("load", "stall", "engine"):
        assert (f"solidcloud_{name}_seconds_count", {"scene": "attic"}, 0.0) in found


def test_users_are_told_apart_where_they_are_few() -> None:
    few = [UserStats(f"c{number}", 'a"\\l\n', requests=5, late=number) for number in range(MAX_USERS_LISTED)]
    found = read(CountedScene("hall", users=few), CountedScene("attic", users=[*few, UserStats("d", "al")]))
    users = {
        labels["client"]: (labels, value)
        for name, labels, value in found
        if name == "solidcloud_user_voxel_late_total"
    }
    assert len(users) == MAX_USERS_LISTED
    assert users["c3"] == ({"scene": "hall", "client": "c3", "avatar": 'a"\\l\n'}, 3.0)


def test_a_scene_that_cannot_be_asked_does_not_hide_the_others(caplog: pytest.LogCaptureFixture) -> None:
    found = read(CountedScene("hall", fault=RuntimeError("closed")), CountedScene("attic", hits=7))
    assert ("solidcloud_voxel_hits_total", {"scene": "attic"}, 7.0) in found
    assert not any(labels.get("scene") == "hall" for _, labels, _ in found)
    assert "cannot read the metrics of scene hall" in caplog.text


@pytest.mark.parametrize("port", [-1, 65536])
def test_a_port_that_is_none_is_refused(port: int) -> None:
    with pytest.raises(BadRequestError, match="--metrics-port"):
        ServerConfig(metrics_port=port)


def test_a_missing_library_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *arguments: Any, **more: Any) -> Any:
        if name.startswith("prometheus_client"):
            raise ModuleNotFoundError(f"No module named {name!r}", name="prometheus_client")
        return real(name, *arguments, **more)

    monkeypatch.delitem(sys.modules, "solidcloud.server.observability.prometheus_export")
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(SolidcloudError, match=r"prometheus_client.*pip install 'solidcloud\[metrics\]'"):
        importlib.import_module("solidcloud.server.observability.prometheus_export")
