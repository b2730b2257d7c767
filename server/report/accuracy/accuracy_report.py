"""Results of an accuracy report."""

from typing import Any, NamedTuple

from .accuracy_row import Row


class Report(NamedTuple):
    """Results of all measurements.

    ground: description of the test data.
    facts: numbers about the scene and the machine, for JSON and the page.
    """

    ground: str
    rows: list[Row]
    facts: dict[str, Any]
