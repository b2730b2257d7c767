"""Result of one check."""

from enum import StrEnum
from typing import NamedTuple


class Status(StrEnum):
    """Outcome of a check: FAULT prevents use, WARNING may prevent some, NOTE is for information."""

    OK = "ok"
    NOTE = "note"
    WARNING = "warning"
    FAULT = "fault"


class Check(NamedTuple):
    """Result of one check. text: what was found.  advice: what to do; "" if nothing."""

    name: str
    status: Status
    text: str
    advice: str = ""


def fine(name: str, text: str) -> Check:
    """Return the result of a check that found nothing wrong."""
    return Check(name, Status.OK, text)
