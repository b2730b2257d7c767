"""Test samples of statistics: rates between two readings, and who is given which."""

import json
import threading
from types import SimpleNamespace
from typing import Any

import pytest
from solidcloud.schemas.errors import BusyError
from solidcloud.schemas.wire.stats import EffectStats, StatsAnswer
from solidcloud.server.viewer.feeds.statistics_feed import Reading, StatisticsFeed, sample


def reading(time: float, hits: int = 0, frames: int = 0, **fields: Any) -> Reading:
    """Return statistics in which `stop` took 2 ms in each frame, and `contacts` 1 ms in every second."""
    effects = [
        EffectStats("stop", frames, 0.002 * frames),
        EffectStats("contacts", frames // 2, 0.001 * (frames // 2)),
    ]
    stats = StatsAnswer(
        scene="hall", hits=hits, effects=effects, resident_bytes=300, budget_bytes=1000, **fields
    )
    return Reading(time, 0.25, stats)


def test_rates_and_mean_times_of_effects_in_a_frame() -> None:
    made = sample(reading(10.0, hits=100, frames=60, misses=4), reading(12.0, hits=160, frames=100, misses=5))
    assert made is not None
    assert made["time"] == 12.0 and made["frames"] == 20.0
    assert made["rates"] == {
        "hits": 30.0,
        "misses": 0.5,
        "prefetched": 0,
        "used": 0,
        "wasted": 0,
        "evicted": 0,
    }
    assert made["totals"]["hits"] == 160
    stop, contacts = made["effects"]
    assert stop == ["stop", pytest.approx(0.002), 20.0]
    # It ran in half of the frames: in the mean frame it took half of its time.
    assert contacts == ["contacts", pytest.approx(0.0005), 10.0]
    assert made["memory"]["voxels"] == 300 and made["memory"]["budget"] == 1000


@pytest.mark.parametrize(
    ("before", "after"),
    [
        (reading(1.0, hits=5), reading(2.0, hits=4)),
        (reading(1.0, frames=5), reading(2.0, frames=4)),
        (reading(1.0), reading(2.0, generation=1)),
        (reading(1.0), reading(1.0)),
        (Reading(1.0, 0.0, StatsAnswer(scene="hall")), reading(2.0)),
    ],
)
def test_there_is_no_sample_across_a_new_beginning(before: Reading, after: Reading) -> None:
    assert sample(before, after) is None


class Reader:
    """Server that counts the questions, and is busy for some of them."""

    def __init__(self, busy: set[int]) -> None:
        self.asked, self.busy = 0, busy

    def stats(self) -> StatsAnswer:
        self.asked += 1
        if self.asked in self.busy:
            raise BusyError("no server")
        return reading(0.0, hits=self.asked, frames=self.asked).stats


def test_browsers_are_given_the_minute_and_each_later_sample() -> None:
    reader = Reader(busy={3})
    scene: Any = SimpleNamespace(reader=reader)
    got: list[dict[str, Any]] = []
    enough = threading.Event()

    def listen(message: str) -> None:
        got.append(json.loads(message))
        if len(got) > 3:
            enough.set()

    with StatisticsFeed(lambda: scene, interval=0.01) as feed:
        feed.follow(1, listen)
        assert enough.wait(60)
        feed.leave(1)
        late: list[dict[str, Any]] = []
        feed.follow(2, lambda message: late.append(json.loads(message)))
    assert got[0] == {"type": "statistics", "all": True, "samples": []}
    assert all(not each["all"] and len(each["samples"]) == 1 for each in got[1:])
    assert late[0]["all"] and late[0]["samples"][:3] == [each["samples"][0] for each in got[1:4]]
    # Nothing is counted across the question without an answer: 2 to 4.
    hits = [each["samples"][0]["totals"]["hits"] for each in got[1:4]]
    assert hits == [2, 5, 6]
