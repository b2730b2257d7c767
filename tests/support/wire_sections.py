"""Comparison of the sections of WIRE.md with the declaration of a query's messages."""

import re
from collections.abc import Iterator
from typing import Any

from solidcloud.schemas.wire.arrays import array_fields
from solidcloud.schemas.wire.question_rules import COMMON, Question, Rows


def faults(question: Question[Any], text: str) -> list[str]:
    """Return the fields that the sections of a request and its answers lack or describe with another type."""
    found = []
    for kind, names in (
        (question.request, question.fields),
        (question.answers, [name for name in question.columns if name not in COMMON]),
    ):
        section = _section(text, kind.__name__)
        rows = dict(_rows(section))
        for name in names:
            expected = _array_type(question, kind, name)
            stated = rows.get(name, section)
            if f"`{name}`" not in section:
                found.append(f"{kind.__name__}: no `{name}`")
            elif expected not in stated and "as above" not in stated and not stated.startswith("as in"):
                found.append(f"{kind.__name__}: `{name}` is {expected}, not {stated}")
        others = {name for name in rows if name not in (*kind.__struct_fields__, *COMMON)}
        found += [f"{kind.__name__}: has no {name!r}" for name in sorted(others)]
    return found


def _section(text: str, name: str) -> str:
    """Return the text from the bold name of a message to that of the next."""
    begin = re.search(rf"^\*\*{name}\*\*", text, re.MULTILINE)
    assert begin, f"no section of {name}"
    rest = text[begin.end() :]
    end = re.search(r"^\*\*[A-Z]\w+(, \w+)*\*\*|^#", rest, re.MULTILINE)
    return rest[: end.start()] if end else rest


def _rows(section: str) -> Iterator[tuple[str, str]]:
    """Yield each field of a section's table, and its type."""
    for line in section.splitlines():
        cells = line.split(" | ")
        if line.startswith("| `"):
            for name in re.findall(r"`(\w+)`", cells[0]):
                yield name, cells[1]


def _array_type(question: Question[Any], kind: type, name: str) -> str:
    """Return the type of an array as WIRE.md writes it; "" for any other field."""
    of = array_fields(kind).get(name)
    if of is None:
        return ""
    rows = "n" if question.whole else "k"
    if kind is question.answers:
        rule = question.columns[name]
        rows = {Rows.STARTS: "k + 1", Rows.LISTED: rule.of[:1], Rows.PAIRS: "p"}.get(rule.rows, rows)
    return f"{of.dtype.name} ({', '.join([rows, *map(str, of.tail)])})"
