"""Report of a mutation run: a table of the kernel files, and the survivors with their reasons.

A person writes the reasons in server/MUTATION.md. A survivor is identified there by its file, its
function and its change, so that edits elsewhere in the function do not matter.
"""

import re
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from .plan import LOWER_GOALS
from .trial import ERROR, FAILED, PASSED, REFUSED, ROOT, TIME
from .trial_results import FileResults, Results

GOAL = 0.8
REASONS = ROOT / "server" / "MUTATION.md"
MODULE = "module"  # instead of a function's name, outside functions
ANY = "*"  # instead of a file or a function: all of them

Change = tuple[str, str, str]  # file name, function, change
_TOKEN = re.compile(r"\d[\w.]*|\w+|\*\*|//|<<|>>|[<>=!|&^+*/-]=|\S")


def reasons(text: str) -> dict[Change, str]:
    """Return the reason of each change that a text lists.

    A reason is a bold paragraph, followed by one list item per file:
    - `file.py`: `function` `change`, `change`; `function` `change`
    """
    found: dict[Change, str] = {}
    for reason, items in re.findall(r"^\*\*([^*]+)\*\*\n\n((?:[- ] .*\n)+)", text, re.MULTILINE):
        for item in re.split(r"^- ", items, flags=re.MULTILINE)[1:]:
            file, *spans = (" ".join(span.split()) for span in re.findall(r"`([^`]+)`", item))
            function = MODULE
            for span in spans:
                if " → " in span:
                    found[file, function, span] = " ".join(reason.split())
                else:
                    function = span
    return found


def describe_change(was: str, now: str) -> str:
    """Return the tokens that differ between two lines, with those beside them: `lo < hi → <=`."""
    old, new = _TOKEN.findall(was), _TOKEN.findall(now)
    head = 0
    while head < min(len(old), len(new)) and old[head] == new[head]:
        head += 1
    tail = 0
    while tail < min(len(old), len(new)) - head and old[-1 - tail] == new[-1 - tail]:
        tail += 1
    end = len(old) - tail
    return f"{_joined(old[max(0, head - 2) : end + 1])} → {_joined(new[head : len(new) - tail])}"


def _joined(tokens: list[str]) -> str:
    """Join tokens, with a space only between two words."""
    return re.sub(r"(?<=\w) (?=\w)|( )", lambda gap: "" if gap[1] else " ", " ".join(tokens))


def reason_of(file: str, row: dict[str, Any], known: dict[Change, str]) -> str:
    """Return the reason of a survivor, "" where none is known."""
    change = describe_change(row["was"], row["now"])
    own = (Path(file).name, row["function"] or MODULE, change)
    return known.get(own) or known.get((own[0], ANY, change)) or known.get((ANY, ANY, change), "")


def share(own: FileResults) -> float:
    """Return the share of killed mutants among those that count; 1 for no mutants."""
    return own.killed() / own.counted() if own.counted() else 1.0


def table(kept: Results) -> list[str]:
    """Return one line per file, and the total."""
    kinds = (FAILED, ERROR, TIME, PASSED, REFUSED)
    lines = [
        "| file | sampled | killed | error | time | survived | share killed | refused |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    sums = [0] * 6
    for file, own in sorted(kept.files.items()):
        counts = [own.counted(), *map(own.count, kinds)]
        sums = [a + b for a, b in zip(sums, counts, strict=True)]
        sampled = f"{counts[0]}, all" if own.complete else str(counts[0])
        cells = [f"`{file}`", sampled, *counts[1:5], f"{share(own):.0%}", counts[5]]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    total = f"{(sums[0] - sums[4]) / max(sums[0], 1):.0%}"
    return [*lines, "| " + " | ".join(map(str, ["all", *sums[:5], total, sums[5]])) + " |"]


def survivors(kept: Results, known: dict[Change, str]) -> Iterator[tuple[str, str]]:
    """Yield every survivor's reason, "" where none is known, and its place and change."""
    for file, own in sorted(kept.files.items()):
        for row in own.survivors():
            function, change = row["function"] or MODULE, describe_change(row["was"], row["now"])
            yield reason_of(file, row, known), f"- {file}:{row['line']} `{function}` `{change}`: {row['was']}"


def report(kept: Results, known: dict[Change, str]) -> str:
    """Return the table, and the survivors by reason."""
    grouped: dict[str, list[str]] = defaultdict(list)
    for reason, line in survivors(kept, known):
        grouped[reason].append(line)
    lines = ["# Mutation testing of the kernels", "", *table(kept)]
    for reason in sorted(grouped):
        lines += ["", f"**{reason or 'Without a reason.'}**", "", *grouped[reason]]
    return "\n".join(lines) + "\n"


def verdict(kept: Results, known: dict[Change, str], files: Sequence[str]) -> bool:
    """Return whether the goal is met and every survivor has a reason; print what is not."""
    good = True
    for file in files:
        own, goal = kept.files.get(file), LOWER_GOALS.get(file, GOAL)
        if own is None or own.again or share(own) < goal:
            found = "not tried" if own is None else f"{own.killed()} of {own.counted()} killed"
            if own is not None and own.again:
                found = f"{len(own.again)} survivors are to be tried again"
            print(f"error: {file}: {found}, expected at least {goal:.0%}", file=sys.stderr)
            good = False
    for reason, line in survivors(kept, known):
        if not reason:
            print(f"error: survivor without a reason in {REASONS.name}: {line[2:]}", file=sys.stderr)
            good = False
    return good
