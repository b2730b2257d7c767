"""Progress interface of long work, and a silent implementation. The command line draws it."""

from typing import Protocol


class Progress(Protocol):
    """Listener to the stages of long work.

    The stages follow one another; the amounts of `advance` add up to about the total of the stage.
    """

    def start(self, stage: str, total: int, unit: str) -> None:
        """Begin a stage; total is in `unit`, such as "points"."""
        ...

    def advance(self, amount: int) -> None:
        """Report that `amount` more of the stage is done."""
        ...

    def finish(self) -> None:
        """End the stage."""
        ...


class Silent:
    """Progress listener that ignores every report."""

    def start(self, stage: str, total: int, unit: str) -> None:
        """Ignore the beginning of a stage."""

    def advance(self, amount: int) -> None:
        """Ignore the amount."""

    def finish(self) -> None:
        """Ignore the end of a stage."""
