"""The measured rows of an accuracy report."""

from typing import Any, NamedTuple

from .accuracy_row import Row


class Report(NamedTuple):
    """What was measured. ground: in words.  facts: figures of the scene and the machine, for JSON and the page."""

    ground: str
    rows: list[Row]
    facts: dict[str, Any]
