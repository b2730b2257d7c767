"""Cases of a load test, each a kind of user at a budget under a policy; their figures and targets."""

from dataclasses import dataclass, field
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from ...common.bench_results import Part, ratio
from ..users import frame_outcomes as results
from ..users.frame_outcomes import PERCENTILES, Figures
from ..users.user_traces import ADVERSARY, Trace, of_users
from .load_run import Outcome
from .load_server import Memory

Floats = NDArray[np.float64]

AS_SERVED = "as served"  # where the server takes no --policy
ECHO = "echo"
DEFAULT = "lru+prefetch"
# The targets. Users of the first three: 8; of the last: 64.
STEADY = ("stroll", "run")
STALLED, WAIT_MS, WITHOUT_MISS = 0.0, 2.0, 0.999
IN_VAIN = 0.3  # share of the prefetched bytes
HARD = (ADVERSARY, "teleport")
MEMORY_BEYOND = 150 << 20  # above the budget and the memory of the warm process [bytes]
ROUND_TRIP = 1.5  # ratio to the echo's, medians
CROWD = 64
START_COLD, START_WARM = 3.0, 1.0  # [s]


@dataclass(frozen=True)
class Case:
    """One run.

    section: kinds, budgets, speeds or users.
    share: the budget, as a share of all decoded bytes.
    policy: None: the server's default.
    speed: maximum [m/s], None: the kind's default.
    """

    section: str
    kind: str
    users: int
    share: float
    policy: str | None
    speed: float | None = None

    @property
    def side(self) -> str:
        """Return the contender's name, for tables."""
        return self.policy or AS_SERVED

    @property
    def name(self) -> str:
        """Return the name of the measured case, for tables."""
        speed = "" if self.speed is None else f" at {self.speed:g} m/s"
        return f"{self.kind}{speed}, {self.users} users, budget {self.share:.3g}"


@dataclass
class Ran:
    """Finished case.

    budget: bytes.
    wrong: number of frames with a wrong verdict.
    speed: actual speed of the users [m/s].
    resident, rss: over time: seconds since the first frame, bytes.
    strip, stats: as in `Outcome`.
    """

    case: Case
    budget: int
    figures: Figures
    wrong: int
    speed: float
    empty: int
    peak: int
    memory: Memory
    resident: tuple[Floats, Floats]
    rss: tuple[Floats, Floats]
    strip: list[tuple[float, NDArray[np.uint64]]] = field(default_factory=list)
    stats: Any = None
    faults: list[str] = field(default_factory=list)


def make_ran(case: Case, budget: int, outcome: Outcome, wrong: int) -> Ran:
    """Return the figures of a run, without its frames."""
    at, rss = outcome.memory.samples()
    return Ran(
        case, budget, results.figures(outcome.frames), wrong, mean_speed(outcome.trace), outcome.empty,
        outcome.memory.peak(), outcome.memory, results.bytes_over_time(outcome.frames), (at - outcome.start, rss),
        outcome.strip, outcome.stats, outcome.faults,
    )  # fmt: skip


def mean_speed(trace: Trace) -> float:
    """Return the mean speed of all users over the floor without jitter [m/s]; NaN for users who jump."""
    moved, spent = 0.0, 0.0
    for user in np.unique(trace.user):
        own = of_users(trace, [int(user)])
        place = own.pose[::15, :2, 3]
        step = np.linalg.norm(np.diff(place, axis=0), axis=1)
        moved, spent = moved + float(step.sum()), spent + float(np.ptp(own.time[::15]))
        if (step > 15.0).any():
            return np.nan
    return moved / spent if spent else np.nan


def add_figures(part: Part, ran: Ran) -> None:
    """Add the figures of one run."""
    case, side, f = ran.case.name, ran.case.side, ran.figures

    def add(what: str, value: float, unit: str) -> None:
        if np.isfinite(value):
            part.add(case, side, what, value, unit, f.frames)

    add("users' speed", ran.speed, "m/s")
    add("frames stalled", f.stalled, "")
    if side != ECHO:
        add("frames without a miss", 100 * f.without_miss, "%")
        add("frames that waited", 100 * f.waited, "%")
        add("hit rate of voxels", 100 * f.hit_rate, "%")
        add("voxels missed", f.misses, "")
    for name, values in (
        ("due to answer", f.delays),
        ("round trip", f.round_trips),
        ("wait for voxels", f.waits),
    ):
        for share, value in zip(PERCENTILES, values, strict=True):
            add(f"{name}, p{share:g}", 1e3 * value, "ms")
    add("users behind, p99", 1e3 * f.late, "ms")
    add("answers", f.rate, "1/s")
    for name, count in (("unknown", f.unknown), ("refused", f.refused), ("never answered", f.unanswered)):
        add(name, count, "")
    if ran.case.side != ECHO:
        add("wrong", ran.wrong, "")
        add("memory beyond warm and empty", (ran.peak - ran.empty) / 2**20, "MB")
        add("budget", ran.budget / 2**20, "MB")
    if ran.stats is not None:
        _add_stats(part, ran)
    if ran.wrong:
        part.wrong.append(
            f"{case}, {side}: {ran.wrong} verdicts differ from those of a scene with all resident"
        )
    for text in dict.fromkeys(ran.faults):
        part.remarks.append(f"{case}, {side}: said: {text}")


def _add_stats(part: Part, ran: Ran) -> None:
    """Add the server's own counts, from its start on."""
    case, side, stats = ran.case.name, ran.case.side, ran.stats
    part.add(case, side, "the server's stalls, p99", 1e3 * stats.stall_seconds.p99, "ms", stats.requests)
    part.add(case, side, "a voxel's load, p99", 1e3 * stats.load_seconds.p99, "ms", stats.load_seconds.count)
    for name in ("waits", "late", "evicted", "too_soon", "prefetched", "used", "wasted"):
        part.add(case, side, f"voxels: {name.replace('_', ' ')}", getattr(stats, name), "")
    share = ratio(stats.wasted_bytes, stats.prefetched_bytes)
    if share is not None:
        part.add(case, side, "prefetched in vain, bytes", 100 * share, "%", stats.prefetched)


def add_goals(part: Part, runs: list[Ran]) -> None:
    """Add the targets of a section's runs.

    Those of steady users apply to the default policy only, where it was run by name.
    """
    sides = {ran.case.side for ran in runs}
    held = {DEFAULT} if DEFAULT in sides else sides
    for ran in runs:
        case, f = ran.case, ran.figures
        if case.side == ECHO or case.section not in ("kinds", "users"):
            continue
        name = f"{case.name}, {case.side}"
        if case.section == "kinds" and case.kind in STEADY and case.side in held:
            stalled = f.stalled if f.frames else None
            part.goal("stalled", f"{name}: frames stalled", stalled, STALLED, "")
            part.goal("wait", f"{name}: wait for voxels, p99", _number(1e3 * f.waits[1]), WAIT_MS, "ms")
            part.goal(
                "misses",
                f"{name}: frames without a miss",
                _number(f.without_miss),
                WITHOUT_MISS,
                "",
                at_least=True,
            )
            share = None if ran.stats is None else ratio(ran.stats.wasted_bytes, ran.stats.prefetched_bytes)
            if share is not None:
                part.goal("vain", f"{name}: bytes prefetched in vain", share, IN_VAIN, "")
        if case.section == "kinds" and case.kind in HARD:
            beyond = (ran.peak - ran.empty - ran.budget) / 2**20 if ran.peak else None
            part.goal("memory", f"{name}: memory beyond budget", beyond, MEMORY_BEYOND / 2**20, "MB")
        part.goal("right", f"{name}: wrong verdicts", float(ran.wrong), 0.0, "")
    echoes = {ran.case.users: ran for ran in runs if ran.case.side == ECHO}
    for ran in runs:
        beside = echoes.get(ran.case.users)
        if beside is None or ran is beside or ran.case.users != CROWD:
            continue
        times = ratio(_number(ran.figures.delays[0]), _number(beside.figures.delays[0]))
        part.goal("echo", f"{ran.case.name}, {ran.case.side}: p50 / echo's", times, ROUND_TRIP, "x")


def add_start(part: Part, cold: list[float], warm: list[float]) -> None:
    """Add the time from the command to a client's first right answer."""
    for name, seconds, limit in (("cold", cold, START_COLD), ("warm", warm, START_WARM)):
        value = None
        if seconds:
            value = part.add(f"start, {name} files", "", "to the first right answer", seconds, "s")
        part.goal("start", f"start, {name} files: first right answer", value, limit, "s")


def knee(runs: list[Ran]) -> dict[str, int | None]:
    """Return by side the least number of users at which a hundredth of the frames stalls.

    Unanswered frames count as stalled. None where no number of users reaches this.
    """
    found: dict[str, int | None] = {}
    for ran in sorted(runs, key=lambda r: r.case.users):
        f = ran.figures
        if found.setdefault(ran.case.side, None) is None and f.frames and f.stalled > 0.01 * f.frames:
            found[ran.case.side] = ran.case.users
    return found


def _number(value: float) -> float | None:
    """Return a figure, or None for NaN."""
    return float(value) if np.isfinite(value) else None


NOTES: dict[str, str] = {
    "stalled": "frames with no answer 33 ms after they were due, after the first second; of the users' own delay too",
    "wait": "in the engine, for voxels that were not there, whoever had them loaded",
    "misses": "voxels that had to be loaded while a frame waited; those being loaded already are not counted by it",
    "vain": "evicted before anybody asked for them, of all that were prefetched; those still there count as neither",
    "memory": "RSS at its highest, less that of the warm process with an empty cache, less --cache",
    "right": "against one call for each user of a scene in another process with everything resident",
    "echo": "from when a frame is due until its answer is decoded; of the echo, until its bytes are there",
    "start": "from the command until a client that was there before has an answer that is right",
}


def summary(ran: Ran) -> dict[str, object]:
    """Return a run for JSON: the case, its figures, memory and bytes over time."""
    f = ran.figures._asdict()
    plain = {name: [_number(v) for v in np.atleast_1d(value)] for name, value in f.items()}
    values = {name: found[0] if np.ndim(f[name]) == 0 else found for name, found in plain.items()}
    case = {
        name: getattr(ran.case, name) for name in ("section", "kind", "users", "share", "policy", "speed")
    }
    return {
        **case, "budget": ran.budget, "figures": values, "wrong": ran.wrong, "mean_speed": _number(ran.speed),
        "stats": None if ran.stats is None else msgspec.to_builtins(msgspec.structs.replace(ran.stats, keys=None)),
        "empty_rss": ran.empty, "peak_rss": ran.peak, "pss": ran.memory.pss,
        "resident": [column.tolist() for column in ran.resident], "rss": [column.tolist() for column in ran.rss],
    }  # fmt: skip
