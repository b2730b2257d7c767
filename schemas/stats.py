"""What a server says of its memory and its users: the messages of `stats`."""

import math
from itertools import accumulate

import msgspec

from .requests import Request

# Upper ends of `Times.buckets` [s]: 1, 2 and 5 of every decade from a microsecond to 100 s. Changed, what a reader
# keeps of a server over months no longer adds up.
TIME_BOUNDS = (*(float(f"{m}e{e}") for e in range(-6, 2) for m in (1, 2, 5)), 100.0)


class StatsRequest(Request, frozen=True):
    """Ask what is resident and what users had to wait for. It may be left out: then all is as by default.

    keys: whether to name the resident voxels.
    """

    keys: bool = False


class Times(msgspec.Struct, frozen=True):
    """How long something took, many times [s].

    count, sum: of all.  p50, p90, p99: so many percent took no longer, said up to a tenth too long.  max: the longest.
    buckets: how many took no longer than each of 1, 2 and 5 µs, 10, 20 and 50 µs, and so on to 100 s, and longer than
    the one before; at the end those that took longer than all.  None of these: [].
    """

    count: int = 0
    sum: float = 0.0
    p50: float = 0.0
    p90: float = 0.0
    p99: float = 0.0
    max: float = 0.0
    buckets: list[int] = []

    def at_most(self) -> list[tuple[float, int]]:
        """(bound [s], how many took no longer) for each of TIME_BOUNDS, and infinity at the end."""
        counts = self.buckets or [0] * (len(TIME_BOUNDS) + 1)
        return list(zip((*TIME_BOUNDS, math.inf), accumulate(counts), strict=True))


class UserStats(msgspec.Struct, frozen=True):
    """What one user, an avatar of a client, asked and got since it was first seen; see StatsAnswer for the counts.

    avatar: "" for what is asked of none.  stall_p50, stall_p99, stall_max: waited for voxels, a request [s].
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
    """What the avatars of a scene's clients take of memory, and how much they may.

    bytes, avatars, clients: of their arrays; their number, those being built included; how many clients have any.
    max_bytes, max_avatars, max_clients: the limits of these; max_bytes_by_client, max_avatars_by_client: those of one
    client. 0: no limit.
    """

    bytes: int = 0
    avatars: int = 0
    clients: int = 0
    max_bytes: int = 0
    max_bytes_by_client: int = 0
    max_avatars: int = 0
    max_avatars_by_client: int = 0
    max_clients: int = 0


class Counters(msgspec.Struct, frozen=True, kw_only=True):
    """What a memory for voxels did so far; voxels but where bytes are said.

    hits: asked for and there, or being loaded; waits: of them being loaded.  misses: asked for and not there.
    late: asked for and not there in time.  prefetched: loads begun before anybody asked; used: of them asked for since;
    wasted: of them failed, or gone again without.  evicted: gone for others; too_soon: of them asked for again shortly
    after.  moved_bytes: of voxels moved to join free room.  failed: loads that failed.
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
    """What a scene keeps in memory, and how it did so far.

    generation: of the archive.  policy: which voxel goes first.  budget_bytes: for decoded voxels and coarse tops;
    resident_bytes: taken of it by decoded voxels, `resident` of the `voxels`; coarse_bytes: by coarse tops.
    kept: voxels that users stand in.

    Counters are of this generation, since it is served.

    Since the scene is served: requests, the parts of paths one by one; answers: poses (rays, points, motions, objects)
    in them; unknown: of the answers; waited: requests that waited for voxels.
    load_seconds: count, sum and buckets of all loads; the rest of the last ones.  stall_seconds: what each request
    waited for voxels.  engine_seconds: what each took in the engine, waits included.
    users: those heard of last, the most recent first.  keys: of the resident voxels, ascending; null: not asked for.
    avatars: what clients' avatars take.
    """

    scene: str
    generation: int = 0
    policy: str = ""
    budget_bytes: int = 0
    resident_bytes: int = 0
    coarse_bytes: int = 0
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
