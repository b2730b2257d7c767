"""Report of a chaos run: figures, violations of the guarantees, and a table."""

import json
import re
import statistics
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

from .chaos_run import ChaosRun
from .fixtures import judge_claims, whole_lines
from .server_restarts import SETTLED_SECONDS, Growth, ServerRuns

STOP_SECONDS = 2.0
GROWTH = 1.0  # [MB a minute]
# zenoh's own threads block on behalf of tasks; their number follows the load, so that a leak shows in
# the least number. In the second half, that may be this many more.
ZENOH_THREAD, POOL_GROWTH = re.compile(r"(app|acc|net|rx|tx)-\d+"), 2
# Shards are opened at the first read of one of their records, once.
SHARD = re.compile(r"\d+-\d{6}\.h5")


class Limits(NamedTuple):
    """Limits. recovery: seconds that a restart may add to a wait.  stop: seconds of a SIGTERM."""

    recovery: float = 2.0
    stop: float = STOP_SECONDS


def make_report(run: ChaosRun, folder: Path, seconds: float, limits: Limits) -> dict[str, Any]:
    """Return the figures of a run; `violations`: sentences, none if all guarantees held."""
    server_runs = run.server_runs
    totals = run.scoreboard.totals()
    claims, false_claims = judge_claims(folder)
    log = (folder / "server.log").read_text(errors="replace")
    report = {
        "seconds": round(seconds, 1),
        "seed": run.seed,
        **totals,
        "frames clear though something was unknown": claims,
        "of them in contact": false_claims,
        "done": dict(sorted(run.done.items())),
        "causes": _causes(folder),
        "servers": server_runs.number,
        "servers that ended by themselves": server_runs.died,
        "seconds from serving to right, of each client": _spread(run.recovery),
        "seconds to right without a restart": _spread(run.waits),
        "seconds of SIGTERM": _spread([stop.seconds for stop in server_runs.stops]),
        "exit codes of SIGTERM": sorted({stop.code for stop in server_runs.stops}),
        "memory": _memory(server_runs),
        "growth of memory, last server": _in_words(run.server_runs.growth()),
        "quiet points": [quiet._asdict() for quiet in server_runs.quiet],
        "tracebacks in the server's log": log.count("Traceback (most recent call last)"),
        "stuck": run.stuck,
        "wrong answers": _notes(folder),
    }
    report["violations"] = _violations(report, run, limits)
    return report


def _violations(report: dict[str, Any], run: ChaosRun, limits: Limits) -> list[str]:
    """Return the violated guarantees."""
    server_runs = run.server_runs
    found = [
        f"{report[name]} {words}"
        for name, words in (
            ("wrong", "answers are wrong"),
            ("of them in contact", "frames are clear in contact"),
            ("clear_away", "times clear while no server was up"),
            ("errors", "questions were refused with other errors than busy"),
            ("tracebacks in the server's log", "tracebacks in the server's log"),
        )
        if report[name]
    ]
    found += report["stuck"]
    if not report["right"]:
        found.append("no answer was right: nothing was tested")
    if server_runs.died:
        found.append(f"{len(server_runs.died)} servers ended by themselves, with {server_runs.died}")
    for kind, of in (("at most", max), ("in the median", statistics.median)):
        after, without = (of(waits) if waits else 0.0 for waits in (run.recovery, run.waits))
        if after > without + limits.recovery:
            found.append(
                f"right again {after:.2f} s after a restart {kind}, without one after {without:.2f} s: "
                f"at most {limits.recovery:g} s more expected"
            )
    for stop in server_runs.stops:
        if stop.code or stop.seconds > limits.stop:
            found.append(
                f"SIGTERM: exit code {stop.code} after {stop.seconds:.2f} s, 0 within {limits.stop:g} expected"
            )
    growth = server_runs.growth()
    last = [quiet for quiet in server_runs.quiet if quiet.life == server_runs.number]
    if growth is not None and growth.high > GROWTH:
        found.append(f"memory grows by {_in_words(growth)}: under {GROWTH:g} expected, with the interval")
    elif growth is None and (
        run.done["no quiet point"] > len(last) or (last and last[-1].age > SETTLED_SECONDS + 100)
    ):
        found.append(f"memory: {_in_words(growth)}")
    if last and last[-1].clients > run.ids:
        found.append(f"avatars of {last[-1].clients} clients at the end, of {run.ids} expected")
    # At the first quiet point of a server, something may not have been used yet.
    return found + _not_held([quiet.threads for quiet in last[1:]], [quiet.files for quiet in last[1:]])


def _in_words(growth: Growth | None) -> str:
    """Return the growth of memory as text."""
    if growth is None:
        return "not measured: too few quiet points"
    return (
        f"{growth.rate:.2f} MB a minute ({growth.low:.2f} to {growth.high:.2f}; "
        f"{growth.points} quiet points in {growth.minutes:.1f} minutes)"
    )


def _not_held(threads: list[dict[str, int]], files: list[dict[str, int]]) -> list[str]:
    """Return violations of the rules for threads and files, given by name at each quiet point."""
    found = _not_constant("threads", [_without(count, ZENOH_THREAD) for count in threads])
    pool = [sum(count.values()) - sum(_without(count, ZENOH_THREAD).values()) for count in threads]
    half = len(pool) // 2
    if half and min(pool[half:]) > min(pool[:half]) + POOL_GROWTH:
        found.append(
            f"threads of zenoh's pool at quiet points: {pool}, the least number in the second half at most "
            f"{POOL_GROWTH} above that in the first expected"
        )
    found += _not_constant("files", [_without(count, SHARD) for count in files])
    for name in sorted({name for count in files for name in count if SHARD.fullmatch(name)}):
        seen = [count.get(name, 0) for count in files]
        if max(seen) > 1:
            found.append(f"shard file {name!r} at quiet points: open {seen} times, at most once expected")
    return found


def _without(count: dict[str, int], names: re.Pattern[str]) -> dict[str, int]:
    """Return the counts of the names that do not match a pattern."""
    return {name: number for name, number in count.items() if not names.fullmatch(name)}


def _not_constant(what: str, counts: list[dict[str, int]]) -> list[str]:
    """Return the names whose count changes."""
    found = []
    for name in sorted({name for count in counts for name in count}):
        seen = [count.get(name, 0) for count in counts]
        if max(seen) > min(seen):
            found.append(f"{what} named {name!r} at quiet points: {seen}, a constant number expected")
    return found


def _spread(values: list[float]) -> dict[str, Any] | None:
    """Return number, median and maximum of values."""
    if not values:
        return None
    ordered = sorted(values)
    return {
        "count": len(values),
        "median": round(ordered[len(values) // 2], 3),
        "longest": round(ordered[-1], 3),
    }


def _memory(server_runs: ServerRuns) -> list[dict[str, Any]]:
    """Return each server's memory every ten seconds [MB]."""
    found: dict[tuple[int, int], float] = {}
    begins: dict[int, float] = {}
    for life, at, rss in server_runs.memory:
        since = at - begins.setdefault(life, at)
        found[life, int(since // 10) * 10] = round(rss / 1e6, 1)
    return [{"life": life, "seconds": since, "MB": size} for (life, since), size in found.items()]


def _causes(folder: Path) -> dict[str, int]:
    """Return the error messages of refused queries, counted."""
    total: Counter[str] = Counter()
    for path in folder.glob("causes-*.json"):
        try:
            total.update(json.loads(path.read_text()))
        except ValueError:  # killed while it wrote
            continue
    return dict(total.most_common(20))


def _notes(folder: Path) -> list[Any]:
    """Return the first faults that clients found."""
    lines = [line for path in sorted(folder.glob("wrong-*.jsonl")) for line in whole_lines(path)]
    return [json.loads(line) for line in lines[:20]]


def table(report: dict[str, Any]) -> str:
    """Format the figures as a table."""
    away = report["seconds from serving to right, of each client"] or {}
    waits = report["seconds to right without a restart"] or {}
    stops = report["seconds of SIGTERM"] or {}
    rows = [
        ("questions asked", f"{report['asked']:,}"),
        ("rows right / unknown", f"{report['right']:,} / {report['unknown']:,}"),
        ("unknown: nobody there / voxels missing", f"{report['nobody']:,} / {report['missing']:,}"),
        ("busy", f"{report['busy']:,}"),
        ("wrong, of them false clears", f"{report['wrong']}, {report['false_clear']}"),
        (
            "frames clear, with something unknown",
            f"{report['frames clear though something was unknown']}, {report['of them in contact']} in contact",
        ),
        ("clear while no server was up", f"{report['clear_away']}"),
        ("other errors", f"{report['errors']}"),
        ("servers", f"{report['servers']}"),
        ("serving to right again, median and longest", f"{away.get('median')}, {away.get('longest')} s"),
        ("right answer without a restart", f"{waits.get('median')}, {waits.get('longest')} s"),
        ("SIGTERM, median and longest", f"{stops.get('median')}, {stops.get('longest')} s"),
        ("memory", report["growth of memory, last server"]),
        *(
            (
                f"{what} at quiet points",
                str([sum(quiet[what].values()) for quiet in report["quiet points"]]),
            )
            for what in ("threads", "files")
        ),
        ("tracebacks in the server's log", str(report["tracebacks in the server's log"])),
    ]
    return "\n".join(f"{name:<44} {value}" for name, value in rows)
