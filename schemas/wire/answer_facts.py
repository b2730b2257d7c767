"""Facts that the line about all answers of a request states, as each question declares them."""

from enum import Enum, auto
from typing import NamedTuple


class Summary(Enum):
    """Reduction of a column to the one number that a line about all answers states."""

    LEAST = auto()  # of the finite values
    SUM = auto()
    ROWS = auto()  # number of rows
    CONTACTS = auto()  # number of rows with the verdict CONTACT


class Fact(NamedTuple):
    """Fact in the line that describes the answers of a question.

    column: name.  summary: see the class; the fact is omitted without a value, and for a count of 0.
    text: format of the number, such as "nearest {:.4g} m".  one: of a count of 1.
    """

    column: str
    summary: Summary
    text: str
    one: str = ""
