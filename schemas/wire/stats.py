"""Messages of `stats`: statistics of a scene's cache, its requests and its users."""

import math
from itertools import accumulate

import msgspec

from .requests import Request

# Upper bounds of `Times.buckets` [s]: 1, 2 and 5 of every decade from a microsecond to 100 s. They
# must not change, because monitoring systems add up buckets over months.
TIME_BOUNDS = (*(float(f"{m}e{e}") for e in range(-6, 2) for m in (1, 2, 5)), 100.0)


class StatsRequest(Request, frozen=True):
    """Request for cache and user statistics. An omitted payload means the defaults.

    keys: also list the resident voxels.
    """

    keys: bool = False


class Times(msgspec.Struct, frozen=True):
    """Distribution of a repeatedly measured duration [s].

    count, sum: over all measurements.
    p50, p90, p99: percentiles, overestimated by at most a tenth.  max: the longest.
    buckets: number of measurements in each interval between the bounds 0, 1, 2, 5, 10, 20, 50 µs
    and so on up to 100 s, upper bound included; the last bucket counts those above 100 s. [] if
    there are no measurements.
    """

    count: int = 0
    sum: float = 0.0
    p50: float = 0.0
    p90: float = 0.0
    p99: float = 0.0
    max: float = 0.0
    buckets: list[int] = []

    def at_most(self) -> list[tuple[float, int]]:
        """Return (bound [s], cumulative count) for each of TIME_BOUNDS and for infinity."""
        counts = self.buckets or [0] * (len(TIME_BOUNDS) + 1)
        return list(zip((*TIME_BOUNDS, math.inf), accumulate(counts), strict=True))


class UserStats(msgspec.Struct, frozen=True):
    """Requests and waits of one user, an avatar of a client, since it was first seen.

    See StatsAnswer for the counts.
    avatar: "" for queries without an avatar.
    stall_p50, stall_p99, stall_max: time that a request waited for voxels [s].
    silent_seconds: since its last answer.
    """

    client: str
    avatar: str
    requests: int = 0
    answers: int = 0
    hits: int = 0
    misses: int = 0
    late: int = 0
    unknown: int = 0
    waited: int = 0
    stall_p50: float = 0.0
    stall_p99: float = 0.0
    stall_max: float = 0.0
    silent_seconds: float = 0.0


class AvatarStats(msgspec.Struct, frozen=True):
    """Memory that the avatars of a scene's clients take, and its limits.

    bytes: of their arrays.  avatars: their number, including those being built.
    clients: number of clients with avatars.
    max_bytes, max_avatars, max_clients: limits of these.
    max_bytes_by_client, max_avatars_by_client: limits per client. 0: no limit.
    """

    bytes: int = 0
    avatars: int = 0
    clients: int = 0
    max_bytes: int = 0
    max_bytes_by_client: int = 0
    max_avatars: int = 0
    max_avatars_by_client: int = 0
    max_clients: int = 0


class EffectStats(msgspec.Struct, frozen=True):
    """Cost of one effect in the frames of all users since the scene was opened.

    frames: in which it ran.  seconds: that it took in all of them. Divide differences between two
    answers by those of `frames` for its time in a frame.
    """

    effect: str
    frames: int = 0
    seconds: float = 0.0


class Counters(msgspec.Struct, frozen=True, kw_only=True):
    """Counters of a voxel cache; they count voxels unless the name says bytes.

    hits: requested and resident, or being loaded.  waits: those of them that were being loaded.
    misses: requested and not resident.
    late: deadlines missed: requested and not resident in time.
    prefetched: loads started before any request.  used: prefetched voxels requested since.
    wasted: wasted prefetches: the load failed, or the voxel was evicted without having been
    requested.
    evicted: evicted to make room for others.
    too_soon: evicted voxels that were requested again shortly after.
    moved_bytes: of voxels moved to join free memory.  failed: loads that failed.
    """

    hits: int = 0
    waits: int = 0
    misses: int = 0
    late: int = 0
    prefetched: int = 0
    prefetched_bytes: int = 0
    used: int = 0
    wasted: int = 0
    wasted_bytes: int = 0
    evicted: int = 0
    too_soon: int = 0
    moved_bytes: int = 0
    failed: int = 0


class StatsAnswer(Counters, frozen=True, kw_only=True):
    """Statistics of a scene's cache and of its users.

    generation: of the archive.  policy: name of the eviction policy.
    budget_bytes: limit for decoded voxels and levels of detail together.
    resident_bytes: used by decoded voxels, `resident` of the `voxels` in the archive.
    level_bytes: of levels of detail.  kept: voxels in which users stand.
    The counters of `Counters` begin when this generation is first served.

    The following begin when the scene is first served.
    requests: number of requests; each part of a path counts as one.
    answers: poses (rays, points, motions, objects) in them.
    unknown: answers that were unknown.  waited: requests that waited for voxels.
    load_seconds: count, sum and buckets of all loads; percentiles and max of the last ones.
    stall_seconds: time that each request waited for voxels.
    engine_seconds: time that each request took in the engine, including waits.
    users: the most recently active users, the most recent first.
    keys: of the resident voxels, ascending; null: not requested.
    avatars: memory of the clients' avatars.
    compiling: as in SceneInfo.
    effects: cost of each of the scene's effects, in the order in which they run.
    """

    scene: str
    generation: int = 0
    policy: str = ""
    budget_bytes: int = 0
    resident_bytes: int = 0
    level_bytes: int = 0
    voxels: int = 0
    resident: int = 0
    kept: int = 0
    requests: int = 0
    answers: int = 0
    unknown: int = 0
    waited: int = 0
    load_seconds: Times = Times()
    stall_seconds: Times = Times()
    engine_seconds: Times = Times()
    users: list[UserStats] = []
    keys: list[int] | None = None
    avatars: AvatarStats = AvatarStats()
    compiling: list[str] = []
    effects: list[EffectStats] = []
