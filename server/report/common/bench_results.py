"""Results of the benchmark: figures, targets and notes, as a table, JSON and CSV."""

import csv
import dataclasses
import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table
from rich.text import Text

from ....schemas.runtime.visible_text import visible
from ...cli.output.terminal import Terminal

# Mean number of other processes that wanted a core. Above it, long turns suffer more than short
# ones, and ratios mean little.
BUSY = 0.3
MET, MISSED, NOT_MEASURED = "met", "missed", "not measured"


@dataclass(frozen=True)
class Figure:
    """One figure.

    case: the measured case.
    side: the contender.
    what: the measured quantity.
    value: the median of the repetitions.
    best: the best of them.
    count: number of poses, rays or points behind it.
    """

    section: str
    case: str
    side: str
    what: str
    value: float
    unit: str
    best: float | None = None
    repetitions: int = 1
    count: int | None = None


@dataclass(frozen=True)
class Goal:
    """Target and its figure.

    key: of its note in engine_notes.py or build_notes.py.
    measured, limit: None where not measured.
    at_least: True for a lower limit, else the limit is an upper one.
    """

    key: str
    section: str
    text: str
    measured: float | None
    limit: float | None
    unit: str
    at_least: bool = False

    @property
    def met(self) -> bool | None:
        """Return whether the target is met; None: not measured. A NaN meets no target."""
        if self.measured is None or self.limit is None:
            return None
        return self.measured >= self.limit if self.at_least else self.measured <= self.limit

    @property
    def word(self) -> str:
        """Return `met`, `missed` or `not measured`."""
        return {True: MET, False: MISSED, None: NOT_MEASURED}[self.met]


@dataclass
class Part:
    """Results of one section.

    remarks: sentences.
    wrong: verdicts that differ from the reference, one sentence each.
    missing: what could not be measured, and why.
    error: reason for an early end of the section, or None.
    others: mean number of others that wanted a core while it was timed.
    """

    section: str
    figures: list[Figure] = field(default_factory=list)
    goals: list[Goal] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    error: str | None = None
    seconds: float = 0.0
    others: float = 0.0

    def add(
        self,
        case: str,
        side: str,
        what: str,
        values: float | Iterable[float],
        unit: str,
        count: int | None = None,
    ) -> float:
        """Add a figure of one or more repetitions; return its value, their median."""
        times = np.atleast_1d(np.asarray(values, np.float64))
        best = float(times.max() if unit.endswith("/s") else times.min())
        value = float(np.median(times))
        self.figures.append(Figure(self.section, case, side, what, value, unit, best, len(times), count))
        return value

    def goal(
        self,
        key: str,
        text: str,
        measured: float | None,
        limit: float | None,
        unit: str,
        *,
        at_least: bool = False,
    ) -> None:
        """Add a target."""
        self.goals.append(Goal(key, self.section, text, measured, limit, unit, at_least))

    def value(self, case: str, side: str, what: str) -> float | None:
        """Return the value of an added figure; None where it was not added."""
        for figure in self.figures:
            if (figure.case, figure.side, figure.what) == (case, side, what):
                return figure.value
        return None


def ratio(above: float | None, below: float | None) -> float | None:
    """Return above / below; None where either is missing, or below is zero."""
    return None if above is None or not below else above / below


def number(value: float | None) -> str:
    """Format a figure for people: three significant digits, thousands separated."""
    if value is None:
        return "-"
    if not math.isfinite(value) or value == 0:
        return f"{value:g}"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:,.{digits}f}"


def limit_text(row: dict[str, Any]) -> str:
    """Format the target of a row for people: its sense, limit and unit."""
    limit = "-" if row["limit"] is None else f"{row['limit']:,g}"
    return f"{'≥' if row['sense'] == '>=' else '≤'} {limit} {row['unit']}"


def busy(parts: Iterable[Part]) -> str:
    """Return a remark about other work on the machine; empty where it was negligible."""
    worst = max((part.others for part in parts), default=0.0)
    return f"the machine was busy: {worst:.1f} others wanted a core" if worst > BUSY else ""


def goal_rows(parts: Iterable[Part], notes: dict[str, str]) -> list[dict[str, Any]]:
    """Return one row per target, for the table, the JSON and the picture."""
    return [
        {
            "key": goal.key,
            "section": goal.section,
            "goal": goal.text,
            "measured": goal.measured,
            "limit": goal.limit,
            "sense": ">=" if goal.at_least else "<=",
            "unit": goal.unit,
            "verdict": goal.word,
            "note": notes.get(goal.key, ""),
        }
        for part in parts
        for goal in part.goals
    ]


def show(parts: list[Part], notes: dict[str, str], section: str = "Speed") -> None:
    """Print figures, targets with their notes, wrong verdicts and missing measurements.

    section: of scripts/FIGURES.md.
    """
    console = Terminal(width=150)
    for part in parts:
        if part.figures:
            console.print(_figures_table(part))
        for line in part.remarks:
            console.print(f"  {line}", style="dim")
    rows = goal_rows(parts, notes)
    if rows:
        table = Table(title=f"goals of section `{section}`")
        for name, justify in (("goal", "left"), ("figure", "right"), ("limit", "right"), ("", "left")):
            table.add_column(name, justify=justify)  # type: ignore[arg-type]
        for row in rows:
            style = {MET: "green", MISSED: "bold red", NOT_MEASURED: "yellow"}[row["verdict"]]
            table.add_row(row["goal"], number(row["measured"]), limit_text(row), Text(row["verdict"], style))
        console.print(table)
    if busy(parts):
        console.print(f"{busy(parts)}: not figures to quote", style="bold red")
    for key in dict.fromkeys(row["key"] for row in rows):
        own = [row for row in rows if row["key"] == key]
        missed = sum(row["verdict"] == MISSED for row in own)
        if missed or own[0]["note"]:
            console.print(f"{key}: {missed} of {len(own)} missed: {own[0]['note'] or 'no note yet'}")
    for part in parts:
        for line in part.missing:
            console.print(f"not measured ({part.section}): {line}", style="yellow")
        if part.error:
            console.print(f"section {part.section} ended early: {part.error}", style="bold red")
        for line in part.wrong:
            console.print(f"WRONG ({part.section}): {line}", style="bold red")


def _figures_table(part: Part) -> Table:
    table = Table(title=f"{part.section} ({part.seconds:.0f} s)")
    for name, justify in (("case", "left"), ("side", "left"), ("what", "left")):
        table.add_column(name, justify=justify)  # type: ignore[arg-type]
    for name in ("median", "best", "unit", "of"):
        table.add_column(name, justify="left" if name == "unit" else "right")
    last = ""
    for f in part.figures:
        table.add_row(
            "" if f.case == last else f.case, f.side, f.what, number(f.value),
            number(f.best) if f.repetitions > 1 else "", f.unit, "" if f.count is None else f"{f.count:,}",
        )  # fmt: skip
        last = f.case
    return table


def write(parts: list[Part], notes: dict[str, str], about: dict[str, Any], target: Path) -> None:
    """Write the report as JSON, and all figures as CSV beside it."""
    target.parent.mkdir(parents=True, exist_ok=True)
    report = {
        **about,
        "goals": goal_rows(parts, notes),
        "sections": [dataclasses.asdict(part) for part in parts],
    }
    target.write_text(json.dumps(report, indent=1) + "\n")
    with open(target.with_suffix(".csv"), "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [f.name for f in dataclasses.fields(Figure)])
        writer.writeheader()
        for figure in (figure for part in parts for figure in part.figures):
            row = dataclasses.asdict(figure)
            writer.writerow(
                {name: visible(value) if isinstance(value, str) else value for name, value in row.items()}
            )
