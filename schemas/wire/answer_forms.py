"""Forms of answers for people and for JSON: one line of text, and values that `json` can write.

Both read the declarations of the questions.
"""

import math
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .answer_facts import Fact, Summary
from .answers import Cost, Verdict
from .arrays import array_fields
from .question_rules import DECLARED, Question, Rows

VERDICT_NAMES = {int(verdict): verdict.name.lower() for verdict in Verdict}

# Key under which the rows that a column of starts refers to are listed; any other has its name.
_LISTED_AS = {"pair_starts": "contacts"}
_COST = Cost.__struct_fields__


def verdict_counts(verdict: NDArray[np.uint8]) -> str:
    """Return the number of each verdict, such as "68 clear, 2 contact, 0 unknown"."""
    return ", ".join(f"{int((verdict == value).sum())} {name}" for value, name in VERDICT_NAMES.items())


def answer_line(answers: Any) -> str:
    """Return one line: the number of each verdict, the facts of the question, faults and the time."""
    question = _question(answers)
    k = len(answers)
    items = question.items if k != 1 else question.items.removesuffix("s")
    head = f"{k} {items}" + (f" from {answers.first} of {answers.total}" if hasattr(answers, "total") else "")
    parts = [f"{head}: {verdict_counts(answers.verdict)}"]
    facts = [text for fact in question.facts if (text := _fact_text(fact, answers))]
    if facts:
        parts.append(", ".join(facts))
    if answers.faults:
        parts.append(f"{len(answers.faults)} unreadable voxel{'s' * (len(answers.faults) != 1)}")
    if answers.late:
        parts.append(f"{len(answers.late)} late voxel{'s' * (len(answers.late) != 1)}")
    if answers.stopped:
        parts.append("stopped early")
    if answers.engine_seconds > 0:
        parts.append(seconds_text(answers.engine_seconds))
    elif k and not answers.stopped and (answers.verdict == Verdict.UNKNOWN).all():
        parts.append("not answered")
    return "; ".join(parts)


def seconds_text(seconds: float) -> str:
    """Return a duration in ms or s with two or more digits, such as "0.31 ms"."""
    if seconds >= 1:
        return f"{seconds:.1f} s"
    return f"{seconds * 1e3:.2g} ms" if seconds < 0.0995 else f"{seconds * 1e3:.0f} ms"


def answer_values(answers: Any) -> dict[str, Any]:
    """Return answers as dicts, lists, numbers and strings; see `Cost.to_dict`."""
    question, k = _question(answers), len(answers)
    rows: list[dict[str, Any]] = [{} for _ in range(k)]
    kind: type[Cost] = type(answers)
    for name, of in array_fields(kind).items():
        column = getattr(answers, name)
        if len(column) == k and question.columns[name].rows in (Rows.ITEMS, Rows.BOUNDED):
            values = _json_column(column, vectors=bool(of.tail))
            for row, value in zip(rows, values, strict=True):
                row[name] = VERDICT_NAMES[value] if name == "verdict" else value
    for starts in question.with_rows.get(Rows.STARTS, ()):
        listed = _LISTED_AS.get(starts, starts.removesuffix("_starts") + "s")
        for row, values in zip(rows, _listed_rows(question, answers, starts), strict=True):
            row[listed] = values
    totals = {
        name: list(value) if isinstance(value := getattr(answers, name), tuple) else value for name in _COST
    }
    if Rows.PAIRS in question.with_rows:
        found = zip(answers.pairs.tolist(), answers.pair_verdict.tolist(), strict=True)
        totals["pairs"] = [{"objects": pair, "verdict": VERDICT_NAMES[verdict]} for pair, verdict in found]
    others = [name for name in answers.__struct_fields__ if name not in (*question.columns, *_COST)]
    totals |= {name: getattr(answers, name) for name in others}
    return {"answers": rows, **totals}


def _question(answers: Cost) -> Question[Any]:
    """Return the question of answers."""
    return DECLARED[type(answers)]


def _fact_text(fact: Fact, answers: Any) -> str:
    """Return a fact about all answers; "" if there is nothing to state."""
    column = getattr(answers, fact.column)
    if fact.summary is Summary.LEAST:
        finite = column[np.isfinite(column)]
        return fact.text.format(finite.min()) if len(finite) else ""
    if fact.summary is Summary.SUM:
        count = int(column.sum())
    else:
        count = len(column) if fact.summary is Summary.ROWS else int((column == Verdict.CONTACT).sum())
    if not count:
        return ""
    return fact.one if fact.one and count == 1 else fact.text.format(count)


def _listed_rows(question: Question[Any], answers: Any, starts: str) -> list[list[dict[str, Any]]]:
    """Return for each item the rows of the columns that a column of starts refers to."""
    prefix = starts.removesuffix("starts")
    names = [name.removeprefix(prefix) for name in question.rows_of(starts)]
    found = [getattr(answers, name) for name in question.rows_of(starts)]
    columns = [_json_column(column, vectors=column.ndim > 1) for column in found]
    rows = [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]
    ends = getattr(answers, starts).tolist()
    return [rows[begin:end] for begin, end in pairwise(ends)]


def _json_column(column: NDArray[Any], *, vectors: bool) -> list[Any]:
    """Convert a column to JSON values; elements that are not finite become None."""
    values: list[Any] = column.tolist()
    if column.dtype.kind != "f" or np.isfinite(column).all():
        return values
    if vectors:
        return [value if all(map(math.isfinite, value)) else None for value in values]
    return [value if math.isfinite(value) else None for value in values]
