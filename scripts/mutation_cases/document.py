"""Writer of server/MUTATION.md: the figures of results.json, and the reasons in survivors.json."""

import json
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from .mutants import LEFT_OUT, PARTS_LEFT_OUT
from .plan import NONE
from .results import FileResults, Results, digest
from .trial import ERROR, FAILED, PASSED, REFUSED, ROOT, TIME

GOAL = 0.8
PLACE = ROOT / "server" / "MUTATION.md"
REASONS = Path(__file__).with_name("survivors.json")

HEAD = """# Mutation testing of the kernels

Made by `scripts/mutation --write` of `scripts/mutation_cases/results.json` and `survivors.json`; not by hand.

A mutant is a kernel file with one place changed: an operator, a comparison, a number, a condition. Each runs, with
`NUMBA_DISABLE_JIT=1`, the tests that `scripts/mutation_cases/plan.py` names for its file, until one fails: then it is
killed. What survives is a change that those tests do not notice. Changes are made by cosmic-ray {version}, its
operators and nothing else; of each file a sample is drawn at random, the same for the same seed and source. Every
place comes once before any comes twice, so that a `*`, which has eleven other operators to be replaced by, weighs no
more than an `and`.

Not among them:
{left_out}
- mutants that raise a `TypeError`, or an index that is no whole number: the compiler would have refused them. They are
  drawn and tried, and counted neither as killed nor as survivors (column "refused").

The tests named are quick ones, many of them written for this; the rest of the suite, which kills more, is not run here.
What bounds leave out is in no answer. It is in tests/golden/work.json: node visits, pairs of points tested, and calls
of every function of `server/kernels`, for fixed questions about small scenes.

"killed" is by an assertion, "error" by any other exception, "time" by running {patience} times as long as unchanged
(a loop without end, mostly). The goal is {goal:.0%} of each file.
Samples are small: of 25 mutants a share of 85 % is known to some 7 points either way, of 60 to some 5; a file near the
goal may lie on the other side of it. In `builder/kernels/neighbours`, `nearest_neighbours.py`, and in `server/kernels`,
`nearest_search.py` and `nearest_point.py` were below the goal at 25 or 30, and drawn larger. `nearest_resident.py`,
`sweep_resident.py` and `nearest_by_scan.py` are below it: the first two make arrays of one element for others, and
nearly all that survives there, one element more, or the last for the first, is the same; the third's survivors are
bounds, or the same.
`server/report/kernels` compare, and are not tried.
"""


class Group(NamedTuple):
    """Reason for accepting survivors, and the survivors it covers.

    changes: (file, function, was, now).
    """

    reason: str
    changes: list[tuple[str, str, str, str]]


def reasons() -> list[Group]:
    """Read survivors.json, which is written by hand.

    It is a list of {reason, changes: [[file, function, was, now], ...]}.
    """
    data = json.loads(REASONS.read_text()) if REASONS.is_file() else []
    return [Group(entry["reason"], [tuple(change) for change in entry["changes"]]) for entry in data]


def change_of(file: str, row: dict[str, Any]) -> tuple[str, str, str, str]:
    """Return the identity of a survivor in survivors.json: its change, independent of edits elsewhere."""
    return file, row["function"], row["was"], row["now"]


def share(own: FileResults) -> float:
    """Return the share of killed mutants among those that count; 1 for no mutants."""
    return own.killed() / own.counted() if own.counted() else 1.0


def table(kept: Results) -> list[str]:
    """Return one line per file, and the total."""
    kinds = (FAILED, ERROR, TIME, PASSED, REFUSED)
    lines = [
        "| file | sampled | killed | error | time | survived | share killed | refused | source |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: | --- |",
    ]
    sums = [0] * 6
    for file, own in sorted(kept.files.items()):
        counts = [own.counted(), *map(own.count, kinds)]
        sums = [a + b for a, b in zip(sums, counts, strict=True)]
        sampled = f"{counts[0]}, all" if own.complete else str(counts[0])
        now = digest((ROOT / file).read_bytes()) if (ROOT / file).is_file() else ""
        source = "as tried" if now == own.source else "changed since"
        cells = [f"`{file}`", sampled, *counts[1:5], f"{share(own):.0%}", counts[5], source]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    total = f"{(sums[0] - sums[4]) / max(sums[0], 1):.0%}"
    lines.append("| " + " | ".join(map(str, ["all", *sums[:5], total, sums[5], ""])) + " |")
    return lines + [f"\n`{file}` has no mutants: {why}." for file, why in NONE.items()]


def marked(text: str) -> str:
    """Format a change as code, shortened for reading."""
    return "`" + (text if len(text) <= 150 else text[:147] + "...") + "`"


def differing(was: str, now: str) -> tuple[str, str]:
    """Cut two long lines to the part where they differ, with a few words on either side."""
    head = 0
    while head < min(len(was), len(now)) and was[head] == now[head]:
        head += 1
    tail = 0
    while tail < min(len(was), len(now)) - head and was[-1 - tail] == now[-1 - tail]:
        tail += 1
    room = 30

    def cut(text: str) -> str:
        begin, end = max(0, head - room), min(len(text), len(text) - tail + room)
        return ("… " if begin else "") + text[begin:end] + (" …" if end < len(text) else "")

    return cut(was), cut(now)


def survivors(kept: Results) -> tuple[list[str], int]:
    """Return the survivors by reason, each with its place and change; and the number without a reason."""
    of = {change: group.reason for group in reasons() for change in group.changes}
    grouped: dict[str, list[str]] = defaultdict(list)
    for file, own in sorted(kept.files.items()):
        for row in own.survivors():
            was, now = map(marked, differing(row["was"], row["now"]))
            grouped[of.get(change_of(file, row), "")].append(
                f"- {file}:{row['line']} `{row['function'] or 'module'}`: {was} → {now}"
            )
    lines = []
    for reason in [*dict.fromkeys(group.reason for group in reasons()), ""]:
        if reason in grouped:
            lines += ["", f"**{reason or 'Not explained yet.'}**", "", *grouped[reason]]
    return lines, len(grouped.get("", []))


def write(kept: Results, patience: int) -> None:
    """Write server/MUTATION.md."""
    from importlib.metadata import version

    parts = [f"- {what}: {why};" for what, why in PARTS_LEFT_OUT.items()]
    parts += [f"- {names[0]}: {names[1]};" for names in LEFT_OUT.values()]
    head = HEAD.format(version=version("cosmic-ray"), left_out="\n".join(parts), patience=patience, goal=GOAL)
    listed, _ = survivors(kept)
    PLACE.write_text("\n".join([head, *table(kept), "", "## Survivors, and why each may live", *listed, ""]))


def verdict(kept: Results, files: Sequence[str]) -> bool:
    """Return whether the target is met and every survivor explained; print what is not."""
    good = True
    for file in files:
        own = kept.files.get(file)
        if own is None or own.again or share(own) < GOAL:
            found = "not tried" if own is None else f"{own.killed()} of {own.counted()} killed"
            if own is not None and own.again:
                found = f"{len(own.again)} survivors are to be tried again"
            print(f"error: {file}: {found}, expected at least {GOAL:.0%}", file=sys.stderr)
            good = False
    left = survivors(kept)[1]
    if left:
        print(f"error: {left} survivors without a reason in {REASONS.name}", file=sys.stderr)
    return good and not left
